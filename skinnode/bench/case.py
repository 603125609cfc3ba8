"""Defines a hard case: a patch, the options that an informed user would set, and one stream per seed."""

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
"""Converter with a relative noise of 1e-5, which is typical of a 16-bit converter."""
STRIDE: Final = 4
"""Value of :attr:`Case.stride` for cases that both trackers and path methods solve."""
DRIFT: Final = 0.02
MODEL_ERROR: Final = 0.05
"""Relative error of the predicted resistance change ΔR that the solver assumes in case 13. The wrong models
in this case predicted ‖ΔR‖ with an error of 2.2 to 5 % (30 % press, ``staggered``, h = 0.5)."""


@dataclass(frozen=True, eq=False)
class Case:
    """A hard case; ``make`` generates a stream from a seeded random generator."""

    number: int
    name: str
    skin: Skin
    make: Callable[[np.random.Generator], Stream]
    methods: tuple[str, ...] = TRACKERS
    converter: Converter = FINE
    """Converter that reads the resistances; the solver knows its noise."""
    drift: str = "none"
    stride: int = 1
    """A tracker solves only every ``stride``-th frame; path methods solve every frame."""
    known_wrong: tuple[str, ...] = ()
    """Methods known to fail in this case (see ``docs/limits.md``). Their wrong results are reported but do
    not make the benchmark fail."""
    model_error: float = 0.0
    """Solver option: relative error of the predicted resistance change ΔR."""
    tolerances: Tolerances | None = None
    """Manufacturing tolerances passed to the solver; None for the solver's default."""


def preset(name: str, height: float) -> PatchLayout:
    """Return a preset layout with 10 upper wires of 10 electrodes and a height of ``height`` pitches."""
    return PatchLayout.preset(name, pitch_m=PITCH_M, height_m=height * PITCH_M)


def narrowed(layout: PatchLayout) -> PatchLayout:
    """Reduce a layout to five upper wires, which suffice because paths are solved wire by wire."""
    return PatchLayout(layout.upper_m[[0, 2, 5, 8, 9]], layout.lower_m, layout.resistivity_ohm_per_m)


def press_and_release(steps: int) -> Float:
    """Return depth fractions that rise from 0 to 1 in equal steps and drop to 0 in the last frame."""
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
    """Return a function that generates the stream of one random press.

    Args:
        skin: The patch.
        depth: Depth of the press divided by the layer height.
        converter: Converter that reads the resistances.
        shares: (T,) depth in each frame, as a fraction of ``depth``.
        spoil: Function that returns a copy of a stream with faulty data; default: no faults.
        gain: Function that returns the factors by which the resistances are multiplied, (T, U, K) or
            broadcastable to that shape; default: 1.
        presses: Function that returns the presses; default: one random press.
    """

    def make(rng: np.random.Generator) -> Stream:
        drawn: tuple[Load, ...] = (random_press(rng, skin.layout, depth),)
        found = drawn if presses is None else presses(rng)
        taken = stream(skin, found, shares, converter, rng, None if gain is None else gain(rng, len(shares)))
        return taken if spoil is None else spoil(rng, taken, skin)

    return make
