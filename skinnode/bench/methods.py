"""Sets up solvers with the best options for a hard case, and solves its streams."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skinnode.bench.case import DRIFT, Case
from skinnode.bench.truth import Stream
from skinnode.bench.verdict import LIMIT, Solved
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from skinnode.model.status import Status
from skinnode.solve.paths.path import solve_path
from skinnode.solve.paths.step_control import Adaptive, Uniform
from skinnode.solve.posterior.posterior import Posterior
from skinnode.solve.tracker import Tracker

Method = Callable[[Stream], Solved]


def set_up(case: Case, name: str) -> Method:
    """Set up the method ``name`` for ``case``. The method resets its solver before each stream."""
    if last_only(name):
        return functools.partial(_path, case, name.removeprefix("path "))
    solver = solver_of(case, name)
    return lambda stream: _solved(fields(case, name, solver, stream))


def last_only(name: str) -> bool:
    """Return whether a method yields a result only for the last frame of a stream."""
    return name.startswith("path ")


def _path(case: Case, how: str, stream: Stream) -> Solved:
    """Solve a stream with :func:`solve_path`; ``how`` is ``adaptive`` or the name of the operator to use."""
    adaptive = how == "adaptive"
    path = solve_path(
        case.skin.layout,
        stream.frames_ohm,
        operator="dogleg" if adaptive else how,
        schedule=Adaptive() if adaptive else Uniform(),
        baseline_ohm=case.skin.rest_ohm,
    )
    # The verdict accepts errors up to LIMIT times std, but the error estimate is already an upper bound.
    std = np.broadcast_to(path.error_estimate_m[:, None, None] / LIMIT, path.displacement_m.shape)
    return Solved(path.displacement_m[None], std[None], _converged(path.status)[None])


def fields(case: Case, name: str, solver: Tracker | Posterior, stream: Stream) -> list[FieldFrame]:
    """Solve every frame of the stream with ``solver``, which :func:`solver_of` created for ``name``."""
    solver.reset()
    noise = _noise_for_exact(case, stream) if name == "exact" else stream.noise
    frames = zip(stream.frames_ohm, stream.valid, noise, strict=True)
    return [solver.update(*frame) for frame in frames]


def solver_of(case: Case, name: str) -> Tracker | Posterior:
    """Create a solver for the case; ``name`` is ``exact``, ``posterior`` or ``auto``."""
    # Default noise, which every call to ``update`` overrides with the noise of the frame.
    common: dict[str, Any] = {
        "relative_noise": case.converter.relative_std,
        "baseline_ohm": case.skin.rest_ohm,
    }
    if name == "exact":
        return Tracker(case.skin.layout, method="exact", **common)
    if case.drift != "none":
        common |= {"drift": case.drift, "drift_std": DRIFT}
    if case.model_error:
        common["model_error"] = case.model_error
    if case.tolerances is not None:
        common["tolerances"] = case.tolerances
    if name == "posterior":
        return Posterior(case.skin.layout, **common)
    return Tracker(case.skin.layout, method="auto", **common)


def _noise_for_exact(case: Case, stream: Stream) -> Float:
    """Add drift and model error to the noise, because the exact inverse has no options for them."""
    change = np.nan_to_num(np.abs(stream.frames_ohm / case.skin.rest_ohm - 1.0), posinf=0.0)
    drift = 0.0 if case.drift == "none" else DRIFT
    return np.asarray(np.sqrt(stream.noise**2 + drift**2 + (case.model_error * change) ** 2))


def _solved(frames: list[FieldFrame]) -> Solved:
    return Solved(
        np.stack([frame.displacement_m for frame in frames]),
        np.stack([frame.displacement_std_m for frame in frames]),
        np.stack([_claimed(frame) for frame in frames]),
    )


def _claimed(frame: FieldFrame) -> NDArray[np.bool_]:
    """Return a (U,) mask of the wires that are CONVERGED and, if trust was assessed, trusted."""
    converged = _converged(frame.status)
    return converged if frame.wires_trusted is None else converged & frame.wires_trusted


def _converged(status: tuple[Status, ...]) -> NDArray[np.bool_]:
    return np.array([one is Status.CONVERGED for one in status])
