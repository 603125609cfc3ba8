"""``[solver]`` and ``[stream]``: how the host solves scans and hands fields to programs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from skinnode.config.table import Allowed, Stiffness, Table, one_of

Method = Literal["auto", "exact", "posterior"]
Operator = Literal["gauss_newton", "levenberg_marquardt", "dogleg"]
Drift = Literal["none", "patch", "wire"]
Partial = Literal["pass", "withhold"]


class SolverConfig(Table):
    """How resistances become displacements."""

    method: Annotated[Method, one_of(Method)] = "auto"
    """``exact`` inverse of each wire, ``posterior`` of the patch, or the one of both that suits layout and
    noise."""
    operator: Annotated[Operator, one_of(Operator)] = "dogleg"
    """Operator of the exact inverse."""
    stiffness_n_per_m: Stiffness | None = None
    """Stiffness of the rubber under one electrode; with it a field of the exact inverse carries forces. A
    patch may have its own in its calibration."""
    deadline_us: Annotated[
        int | None, Field(ge=100, le=10_000_000), Allowed("an integer from 100 to 10000000")
    ] = None
    """Maximum microseconds for a frame, which then ends with the estimate so far; None: no limit."""
    estimate_noise: bool = False
    """Estimate the noise of the resistances from the stream; requires the posterior."""
    drift: Annotated[Drift, one_of(Drift)] = "none"
    """Estimate a common gain of the resistances of the ``patch``, or of each upper ``wire``, along with the
    displacement; requires the posterior."""
    normal_only: bool = False
    """Solve for the height of the electrodes alone: no shear."""
    workers: Annotated[int | None, Field(ge=1, le=64), Allowed("an integer from 1 to 64")] = None
    """Threads that solve patches in parallel; None: one a processor core, at most one a patch."""


class StreamConfig(Table):
    """How scans and fields reach a program."""

    partial: Annotated[Partial, one_of(Partial)] = "pass"
    """What to do with an incomplete scan, which lost chunks or the summary with its check: ``pass`` it on,
    unchecked, with a mask of the valid resistances, or ``withhold`` it. It is counted either way."""
    capacity_fields: Annotated[int, Field(ge=1, le=1_000_000), Allowed("an integer from 1 to 1000000")] = 64
    """Maximum fields that a subscriber may lag behind before it loses the oldest. 64 is more than a second
    of four patches at 12.5 scans a second."""
