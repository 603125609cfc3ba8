"""A hard case: a patch, the options that an informed user would set, and a stream for every seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.bench.truth import Converter, Load, Skin, Stream, random_press, stream
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.tolerances import Tolerances

PATHS: Final = ("path gauss_newton", "path levenberg_marquardt", "path dogleg", "path adaptive")
TRACKERS: Final = ("exact", "posterior", "auto")
PITCH_M: Final = 4e-3
FINE: Final = Converter(sigma=1e-5)
"""Converter with roughly the noise of a 16-bit converter."""
STRIDE: Final = 4
"""Number of path samples per tracker frame."""
DRIFT: Final = 0.02
MODEL_ERROR: Final = 0.05
"""Relative error of the wrong models in case 13 when predicting the change in R. Measured on a 30 % press,
staggered, h = 0.5: ‖ΔR‖ is off by 2.2 to 5 %; for a single pair of wires, the change is off by 1 to 5 % in
the median and by 7 % at worst."""


@dataclass(frozen=True, eq=False)
class Case:
    """A hard case. ``make`` returns the stream for a seed's random generator."""

    number: int
    name: str
    skin: Skin
    make: Callable[[np.random.Generator], Stream]
    methods: tuple[str, ...] = TRACKERS
    converter: Converter = FINE
    """Converter for the streams; the user knows its noise."""
    drift: str = "none"
    stride: int = 1
    """Number of stream frames per tracker frame; a path uses all frames."""
    known_wrong: tuple[str, ...] = ()
    """Methods known to be wrong on this case, as ``docs/limits.md`` states. Their rows are shown, but do not
    count as wrong."""
    model_error: float = 0.0
    """Relative error that the user expects the model to make in predicting the change in R."""
    tolerances: Tolerances | None = None
    """Tolerances that the user states."""


def preset(name: str, height: float) -> PatchLayout:
    """Return a preset of 10 × 10 electrodes with a height of ``height`` pitches."""
    return PatchLayout.preset(name, pitch_m=PITCH_M, height_m=height * PITCH_M)


def narrowed(layout: PatchLayout) -> PatchLayout:
    """Return five upper wires, which are enough because paths are solved wire by wire."""
    return PatchLayout(layout.upper_m[[0, 2, 5, 8, 9]], layout.lower_m, layout.resistivity_ohm_per_m)


def press_and_release(steps: int) -> Float:
    """Return fractions of the depth: zero, equal steps up to one, and zero again."""
    return np.array([*np.linspace(0.0, 1.0, steps + 1), 0.0])


def pressing(  # noqa: PLR0913 - one argument per way to change a stream
    skin: Skin,
    depth: float,
    converter: Converter,
    shares: Float,
    *,
    spoil: Callable[[np.random.Generator, Stream, Skin], Stream] | None = None,
    gain: Callable[[np.random.Generator, int], Float] | None = None,
    presses: Callable[[np.random.Generator], tuple[Load, ...]] | None = None,
) -> Callable[[np.random.Generator], Stream]:
    """Return a function that makes the stream of one random press.

    Args:
        skin: The patch.
        depth: Depth of the press in heights.
        converter: Converter that reads the resistances.
        shares: Fractions (T,) of the depth, one per frame.
        spoil: Function that returns a modified stream.
        gain: Function that returns factors that scale the resistances, (T, U, K) or broadcastable to that
            shape.
        presses: Function that returns the presses that replace the single random press.
    """

    def make(rng: np.random.Generator) -> Stream:
        drawn: tuple[Load, ...] = (random_press(rng, skin.layout, depth),)
        found = drawn if presses is None else presses(rng)
        taken = stream(skin, found, shares, converter, rng, None if gain is None else gain(rng, len(shares)))
        return taken if spoil is None else spoil(rng, taken, skin)

    return make
