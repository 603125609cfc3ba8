"""Time of a tracked frame: the exact inverse, the posterior of a full frame, the posterior of few wires."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from skinnode.cli._bench_timing import take_turns
from skinnode.cli._cases import preset
from skinnode.cli._truth import Converter, Press, Skin, stream
from skinnode.model.layout import Float
from skinnode.solve.posterior import Posterior
from skinnode.solve.tracker import Tracker

FRAMES: Final = 12
FEW_FRAMES: Final = 3
"""So few that each moves by more than noise and is solved."""
SIGMA: Final = 1e-5
FEW: Final = 3
LIMITS_US: Final = {"exact": 500.0, "posterior, full frame": 5000.0, f"posterior, {FEW} active wires": 1000.0}


class Cycle:
    """A press to and fro; every call solves the next frame."""

    def __init__(self, solver: Tracker | Posterior, frames: Float) -> None:
        self._solver, self._next = solver, 0
        self._frames = np.concatenate([frames, frames[-2:0:-1]])
        self.active: list[int] = []
        """Wires that were solved, frame by frame."""

    def __call__(self) -> None:
        frame = self._solver.update(self._frames[self._next])
        self._next = (self._next + 1) % len(self._frames)
        held = 0 if frame.held is None else int(frame.held.sum())
        self.active.append(len(frame.status) - held)


def _frames(skin: Skin, press: Press, sigma: float, count: int = FRAMES) -> Float:
    """A press that deepens from half to all of its depth."""
    shares = np.linspace(0.5, 1.0, count)
    return stream(skin, (press,), shares, Converter(sigma=sigma), np.random.default_rng(5)).frames_ohm


def _noise_for_few(skin: Skin, press: Press) -> float:
    """The noise under which three wires feel a press: all of a half-space moves, far away less than noise."""
    found: dict[float, float] = {}
    for sigma in np.geomspace(1e-5, 1e-3, 25).tolist():
        posterior = Posterior(skin.layout, relative_noise=sigma, baseline_ohm=skin.rest_ohm)
        cycle = Cycle(posterior, _frames(skin, press, sigma, FEW_FRAMES))
        for _ in range(8 * FEW_FRAMES):
            cycle()
        found[sigma] = abs(float(np.mean(cycle.active)) - FEW)
    return min(found, key=found.__getitem__)


def run(rounds: int) -> list[dict[str, Any]]:
    """A row for each: µs a frame (median of turns), the limit, and how many wires were solved."""
    skin = Skin(preset("staggered", 0.5))
    layout, rest = skin.layout, skin.rest_ohm
    press = Press((18.3e-3, 17.1e-3), 10e-3, 0.3 * layout.height_m, (0.2, -0.1))
    frames = _frames(skin, press, SIGMA)
    x, y, _ = layout.upper_m[4, 4]
    small = Press((float(x), float(y)), 6e-3, 0.1 * layout.height_m)
    sigma = _noise_for_few(skin, small)
    exact, full, few = LIMITS_US
    cycles: dict[str, Cycle] = {
        exact: Cycle(Tracker(layout, method="exact", relative_noise=SIGMA, baseline_ohm=rest), frames),
        full: Cycle(Posterior(layout, relative_noise=SIGMA, baseline_ohm=rest, hold=False), frames),
        few: Cycle(
            Posterior(layout, relative_noise=sigma, baseline_ohm=rest),
            _frames(skin, small, sigma, FEW_FRAMES),
        ),
    }
    calls: dict[str, Callable[[], object]] = {**cycles}
    timings = take_turns(calls, rounds=rounds)
    return [
        {
            "what": name,
            "us": timing.call_us,
            "limit_us": LIMITS_US[name],
            "active": float(np.mean(cycles[name].active)),
        }
        for name, timing in timings.items()
    ]
