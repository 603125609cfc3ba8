"""``[solver]`` and ``[stream]``: how the host solves scans and delivers fields to programs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from skinnode.config.table import Allowed, Stiffness, Table, one_of

Method = Literal["auto", "exact", "posterior"]
Operator = Literal["gauss_newton", "levenberg_marquardt", "dogleg"]
Drift = Literal["none", "patch", "wire"]
Prior = Literal["auto", "cells", "discs"]
Past = Literal["off", "auto"]
Partial = Literal["pass", "withhold"]


class SolverConfig(Table):
    """Settings for computing displacements from resistances."""

    method: Annotated[Method, one_of(Method)] = "auto"
    """Solver method: ``exact`` inverts the model of each wire, ``posterior`` estimates the whole patch, and
    ``auto`` selects one of these two according to the layout and the noise."""
    operator: Annotated[Operator, one_of(Operator)] = "dogleg"
    """Operator that computes the steps of the method ``exact``."""
    stiffness_n_per_m: Stiffness | None = None
    """Stiffness of the rubber under one electrode, in N/m; the method ``exact`` uses it to compute forces.
    The calibration of a patch can override this stiffness."""
    deadline_us: Annotated[
        int | None, Field(ge=100, le=10_000_000), Allowed("an integer from 100 to 10000000")
    ] = None
    """Time limit for solving one scan, in microseconds; None means no limit. At the limit, the solver returns
    its current estimate."""
    estimate_noise: bool = False
    """Estimate the noise in the resistances from the stream of scans. Requires the method ``posterior``."""
    drift: Annotated[Drift, one_of(Drift)] = "none"
    """Estimate the drift of the resistances together with the displacement: as one gain for the whole
    ``patch``, or one gain for each upper ``wire``. Requires the method ``posterior``."""
    prior: Annotated[Prior, one_of(Prior)] = "auto"
    """Loads that the method ``posterior`` expects in a touched patch: independent loads in single ``cells``,
    or loads in a few soft ``discs``. ``auto`` selects ``discs`` if the noise is 1e-4 or more. At a noise of
    1e-3, the errors with ``discs`` are about half as large, and a scan takes 0.7 to 1.2 times as long. The
    method ``exact`` expects no loads and refuses ``discs``."""
    past: Annotated[Past, one_of(Past)] = "auto"
    """Use earlier scans: with ``auto``, the method ``posterior`` combines each scan with earlier scans if the
    noise is 1e-4 or more; with ``off``, every scan is solved on its own."""
    normal_only: bool = False
    """Solve only for the z displacements of the electrodes, not for shear."""
    max_std_m: Annotated[
        float | None,
        Field(gt=0, le=1, allow_inf_nan=False),
        Allowed("a number greater than 0 and at most 1 (m)"),
    ] = None
    """Maximum standard deviation of the displacements in a precise field, in metres. If None, the limit is
    derived from the layout and the noise."""
    max_force_std_n: Annotated[
        float | None,
        Field(gt=0, le=1e6, allow_inf_nan=False),
        Allowed("a number greater than 0 and at most 1e6 (N)"),
    ] = None
    """Maximum standard deviation of the normal forces of contacts in a precise field, in newtons. If None,
    the limit is derived from the layout and the properties of the rubber, and applies only to calibrated
    forces."""
    detect: bool = True
    """Detect touch before solving: report ``touched``, and do not solve the scans of an untouched patch."""
    false_alarms_per_hour: Annotated[
        float,
        Field(ge=1e-6, le=1e4, allow_inf_nan=False),
        Allowed("a number from 1e-6 to 1e4 (1/h)"),
    ] = 0.1
    """Acceptable number of false touches caused by noise alone, per patch and hour."""
    workers: Annotated[int | None, Field(ge=1, le=64), Allowed("an integer from 1 to 64")] = None
    """Number of threads that solve patches in parallel. If None, the host uses one thread per core, but at
    most one per patch."""


class StreamConfig(Table):
    """Settings for delivering scans and fields to programs."""

    partial: Annotated[Partial, one_of(Partial)] = "pass"
    """Treatment of scans with missing chunks or without a summary: ``pass`` delivers them unchecked, with a
    mask of the valid resistances; ``withhold`` does not deliver them. They are counted in either case."""
    capacity_fields: Annotated[int, Field(ge=1, le=1_000_000), Allowed("an integer from 1 to 1000000")] = 64
    """Maximum number of fields in a subscriber's queue; if the queue is full, the oldest field is dropped.
    At 12.5 scans per second, four patches fill the default queue of 64 fields in 1.3 s."""
