"""Determine a hand's limitations: results ruled out by its hand file, layouts or noise.

A limitation is not an error. ``skinnode hand check`` lists the limitations so that users do not expect more
than the hand can deliver.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from skinnode.compiled.jit import is_cold
from skinnode.config import HandConfig, PatchConfig, SolverConfig
from skinnode.host.scan_solver import tracker_options
from skinnode.host.solve_rate import SolveRate
from skinnode.model.layout import PatchLayout
from skinnode.protocol.codes import CodeScale
from skinnode.solve.cramer_rao import patch_std
from skinnode.solve.options import TrackerOptions
from skinnode.solve.posterior.posterior import Posterior
from skinnode.solve.tracker import choose_method
from skinnode.solve.wires.problem import PatchProblem

BY_PRIOR: Final = 0.3
"""Standard deviation (fraction of the clearance) above which the resistances alone do not determine the
displacements well enough. Few presses are deeper than this fraction of the clearance.
"""

DISCS_HELP: Final = 1e-3
"""Noise from which discs reduce the median error to 0.5 to 0.6 of its value (docs/methods.md)."""


_BY_PRIOR: Final = (
    "neighbouring crossings and the elastic model supply the missing information (see data_share)"
)


@dataclass(frozen=True, slots=True)
class Limitation:
    """Result that some patches of a hand cannot provide."""

    patches: tuple[str, ...]
    """Names of the patches."""
    key: str
    """Hand-file key that can be changed to remove the limitation."""
    text: str
    """Missing result, and the reason why it is missing."""


def limitations(hand: HandConfig, rate: SolveRate | None) -> list[Limitation]:
    """Return the limitations of a hand. Patches with the same limitation share an entry.

    The function compiles no kernels. It checks the solver's deadline only if the kernels are already
    compiled.

    Args:
        hand: The hand.
        rate: Solve times measured on this computer; None if they are unknown.
    """
    patches: dict[tuple[str, str], list[str]] = {}
    planned_hz = 1e3 / hand.sync.period_ms
    if rate is not None and rate.rate_hz < planned_hz:
        text = (
            f"if all patches are touched, this computer solves {rate.rate_hz:.3g} scans per second of each "
            f"patch, fewer than the planned {planned_hz:.3g}: it skips the other scans"
        )
        patches["sync.period_ms", text] = [patch.name for patch in hand.patches]
    for patch in hand.patches:
        for key, text in (*_of_results(patch, hand.solver), *_of_place(patch, hand)):
            patches.setdefault((key, text), []).append(patch.name)
    return [Limitation(tuple(names), key, text) for (key, text), names in patches.items()]


def _of_results(patch: PatchConfig, solver: SolverConfig) -> Iterator[tuple[str, str]]:
    """Yield the key and text of each solver limitation for a patch."""
    layout = patch.layout.build()
    noise = math.hypot(patch.relative_noise, CodeScale(patch.code_bits).relative_std)
    options = tracker_options(patch, solver, relative_noise=noise)
    method, _ = choose_method(layout, options)
    unknowns = layout.unknowns // (3 if solver.normal_only else 1)
    enough = layout.shape[1] >= unknowns
    share = patch_std(layout, noise, solver.normal_only) if enough else math.inf
    if not enough:
        text = f"{layout.shape[1]} lower wires for {unknowns} unknowns per upper wire: {_BY_PRIOR}"
        yield "patches.layout", text
    elif share > BY_PRIOR and method == "posterior":
        alone = f"at a noise of {noise:.0e}, resistances alone give errors of ± {share:.0%} of the clearance"
        yield "patches.layout", f"{alone}: {_BY_PRIOR}"
    elif share > BY_PRIOR:
        yield (
            "solver.method",
            f"at a noise of {noise:.0e}, the exact inverse has errors of ± {share:.0%} of the clearance, "
            'which are too large to be useful; method = "auto" uses the posterior',
        )
    if noise >= DISCS_HELP and method == "posterior" and solver.prior == "cells":
        yield (
            "solver.prior",
            f'at a noise of {noise:.0e}, the errors are about twice those with prior = "auto"',
        )
    if method == "exact" and not patch.tolerances.build().exact:
        yield (
            "solver.method",
            "the exact inverse cannot account for the patch's tolerances: its standard deviations are "
            'correct only if all electrodes are exactly at their nominal positions; method = "auto" uses the '
            "posterior",
        )
    if not patch.calibration.force_calibrated:
        yield (
            "patches.calibration",
            "no calibrated forces: the standard deviations of normal forces are large enough to cover rubber "
            "bonded to a rigid support; set force_calibrated after a test with known forces",
        )
    if solver.normal_only:
        yield "solver.normal_only", "no shear displacements and no shear forces"
    reached_m = share * float(PatchProblem.of(layout).clearance.min()) * layout.pitch_m
    if solver.max_std_m is not None and method == "exact" and solver.max_std_m < reached_m:
        text = f"no field will be precise: even at rest, the standard deviation is {1e6 * reached_m:.2g} µm"
        yield "solver.max_std_m", text
    if solver.deadline_us is not None:
        yield from _of_deadline(layout, options, solver.deadline_us)


def _of_deadline(layout: PatchLayout, options: TrackerOptions, deadline_us: int) -> Iterator[tuple[str, str]]:
    if is_cold("gauss_newton_step"):
        yield "solver.deadline_us", "deadline not checked, because the kernels have not been compiled yet"
        return
    needed_us = 1e6 * Posterior(layout, options.of_posterior()).from_rest_s
    if needed_us > deadline_us:
        yield (
            "solver.deadline_us",
            f"the posterior needs at least {needed_us:.0f} µs for a new touch on this computer, longer than "
            f"the deadline of {deadline_us} µs: the first fields of a touch will not be trusted",
        )


def _of_place(patch: PatchConfig, hand: HandConfig) -> Iterator[tuple[str, str]]:
    """Yield the key and text of each limitation due to a missing pose."""
    if "pose" not in patch.model_fields_set:
        yield "patches.pose", "no pose: contacts are in the patch's own coordinate frame"
    if patch.link is not None and patch.link not in [link.name for link in hand.links]:
        text = f"link {patch.link!r} has no pose in the hand: the program must supply the pose (HandFrame.at)"
        yield "links", text
