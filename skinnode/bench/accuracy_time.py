"""Measures the time per tracked frame of the exact inverse and of the posterior."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.bench.case import preset
from skinnode.bench.timing import take_turns
from skinnode.bench.truth import Converter, Press, Skin, stream
from skinnode.model.layout import Float
from skinnode.solve.posterior.posterior import Posterior
from skinnode.solve.tracker import Tracker

FRAMES: Final = 12
SIGMA: Final = 1e-5
FEW: Final = 3
LIMITS_US: Final = {"exact": 500.0, "posterior, full frame": 5000.0, f"posterior, {FEW} active wires": 1000.0}


class Cycle:
    """Solves a press and its release, frame by frame.

    A call solves the whole cycle, because some frames take much longer than others.

    Args:
        solver: Solver to measure.
        frames: (T, U, K), ohm: resistances during the press; the release repeats them in reverse order.
        valid: (U, K) bool: True for the resistances to use; default: all.
    """

    def __init__(
        self, solver: Tracker | Posterior, frames: Float, valid: NDArray[np.bool_] | None = None
    ) -> None:
        self._solver, self._valid = solver, valid
        self.frames = np.concatenate([frames, frames[-2:0:-1]])
        self.active: list[int] = []
        """Number of wires in each frame that were solved rather than held."""

    def __call__(self) -> None:
        """Solve all frames."""
        for frame_ohm in self.frames:
            frame = self._solver.update(frame_ohm, self._valid)
            held = 0 if frame.held is None else int(frame.held.sum())
            self.active.append(len(frame.status) - held)


def _frames(skin: Skin, press: Press, sigma: float) -> Float:
    """Return the (T, U, K) resistances in ohms during a press from half to full depth."""
    shares = np.linspace(0.5, 1.0, FRAMES)
    return stream(skin, (press,), shares, Converter(sigma=sigma), np.random.default_rng(5)).frames_ohm


def run(rounds: int) -> list[dict[str, Any]]:
    """Time each solver; return the time per frame (µs), its limit and the mean number of wires solved.

    The time per frame is the mean over a cycle; the result is the median of all rounds. A press deforms the
    whole half-space and therefore moves every wire. To leave only three wires active, the benchmark masks the
    readings of all other wires. The posterior runs with ``hold`` off, so it also solves wires whose readings
    have not changed.
    """
    skin = Skin(preset("staggered", 0.5))
    layout, rest = skin.layout, skin.rest_ohm
    press = Press((18.3e-3, 17.1e-3), 10e-3, 0.3 * layout.height_m, (0.2, -0.1))
    frames = _frames(skin, press, SIGMA)
    exact, full, few = LIMITS_US
    middle = np.zeros(layout.shape, bool)
    middle[3 : 3 + FEW] = True
    options: dict[str, Any] = {"relative_noise": SIGMA, "baseline_ohm": rest}
    cycles: dict[str, Cycle] = {
        exact: Cycle(Tracker(layout, method="exact", **options), frames),
        full: Cycle(Posterior(layout, hold=False, **options), frames),
        few: Cycle(Posterior(layout, hold=False, **options), frames, middle),
    }
    calls: dict[str, Callable[[], object]] = {**cycles}
    return [
        {
            "what": name,
            "us": timing.call_us / len(cycles[name].frames),
            "limit_us": LIMITS_US[name],
            "active": float(np.mean(cycles[name].active)),
        }
        for name, timing in take_turns(calls, rounds=rounds).items()
    ]
