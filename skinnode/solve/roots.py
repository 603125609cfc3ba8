"""Criteria for choosing among the roots of F = b, and their thresholds.

The equations F = b of a wire have several roots, but only one of them is the actual position of the skin. The
roots on either side of a fold (a surface where det J = 0) are called twins; they merge at the fold. Five
criteria identify the correct root: the sign of det J, the distance from the rest position, the roughness, the
energy compared with other roots of the wire, and the posterior estimate of the whole patch.

Definitions:

- Roughness of a displacement u: √(uᵀ C⁻¹ u), with the covariance C of :mod:`skinnode.solve.smoothness`.
- Energy of a displacement: −2 log p, where p is its probability density.
- Clearance: the smallest distance at rest between an upper and a lower electrode.
- Conditioning of a wire: RMS of ∂x/∂(ln R) at rest, in clearances.

=================  =====  ================================================  ================================
constant           value  meaning                                           measured on
=================  =====  ================================================  ================================
FOLDED             250    conditioning above which presses can cross folds  6000 wires of three layouts
BLIND              1e7    conditioning above which a root is meaningless    symmetric; aligned, h ≥ 1.5
NEARLY_BLIND       1e5    conditioning above which UNLIKELY_BLIND applies   aligned, h ≥ 1
NONLINEAR          0.003  std, clearances, above which roots are checked    not measured
JUMP               0.2    movement, clearances, that triggers a check       folds crossed at ≥ 0.24
LARGE              0.03   minimum displacement for a check of roughness     no fold this close to rest
ROUGH_IN_STREAM    1.2    roughness / size that triggers a check            correct 0.5 to 1.7, wrong 1 to 2
ROUGH_AT_PATH_END  0.8    roughness / size that triggers a second attempt   correct 0.67, wrong 0.7 to 2
SMOOTH_PATH        0.2    maximum secant error / size on a smooth path      correct ≤ 0.2, wrong ≥ 0.24
LONG_PATH          20     minimum number of samples in a long path          one path that left and returned
ROOT_RESIDUAL      1e-9   maximum RMS of F/b − 1 at a root                  not measured
STILL_CONFIRMED    0.2    maximum relative change in a confirmed root       not measured
SAME_ROOT          0.001  maximum relative distance of identical roots      not measured
TWIN_REACH         2      maximum relative distance of a twin               staggered, h = 0.3 to 1
TWIN_ROUGHNESS     1.05   minimum roughness of a twin / that of the root    82 + 60 + 40 presses, staggered
UNLIKELY           4      minimum energy margin to other roots              1530 pairs of roots
UNLIKELY_BLIND     16     minimum energy margin for nearly blind wires      not measured
REFEREE_NOISE      1e-5   minimum noise of a posterior that checks roots    not measured
AGREE              6      maximum distance from the posterior, std          not measured
NEAR               0.25   correction, clearances, that triggers annealing   not measured
FAR                0.1    movement, clearances, that triggers annealing     folds crossed at ≥ 0.3
LIKELIER           4      minimum decrease in energy by annealing           23 for a wrong maximum
SUSPICIOUS         3      nuisance, prior std, that triggers annealing      not measured
BELIEVABLE         5      nuisance, prior std, that rejects a frame         not measured
IMPOSSIBLE_CHANCE  1e-9   false-alarm probability of the χ² test            by definition
Z_REFUSE           5.998  normal quantile of 1 − 1e-9, for tall systems     by definition
=================  =====  ================================================  ================================
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.solve.cramer_rao import patch_std, wire_std
from skinnode.solve.linalg.vectors import Index

Mask = NDArray[np.bool_]

# -- the layout ---------------------------------------------------------------------------------------------

FOLDED: Final = 250.0
"""Conditioning of a wire above which a press can move the wire across a fold.

The conditioning is 70 on the staggered layout with h = 0.5, on which no folds were found. It is at least 1200
on staggered layouts with h ≥ 1, and on all aligned and symmetric layouts. On those layouts, the solver found
a wrong root for one wire in 30.
"""
BLIND: Final = 1e7
"""Conditioning of a wire above which the resistances do not determine the positions of its electrodes.

Only two kinds of wire exceed this limit: wires on a symmetry line of the layout, and wires at least 1.5
pitches above aligned lower wires.
"""
NEARLY_BLIND: Final = 1e5
"""Conditioning of a wire above which :data:`UNLIKELY_BLIND` replaces :data:`UNLIKELY`.

Wires of aligned layouts with h ≥ 1 exceed this limit.
"""
NONLINEAR: Final = 0.003
"""Standard deviation of the exact inverse, in clearances, above which every root is checked.

F is nonlinear on the scale of such errors, so the linear error estimate is not valid.
"""

# -- one root -----------------------------------------------------------------------------------------------

JUMP: Final = 0.2
"""Movement of an electrode from one frame to the next, in clearances, above which the new root is checked.

The smallest movement across a fold in simulations was 0.24 clearances.
"""
LARGE: Final = 0.03
"""Displacement, in clearances, above which the roughness of a root is checked.

There are no folds this close to the rest position.
"""
ROUGH_IN_STREAM: Final = 1.2
"""Ratio of roughness to size above which a displacement in a live stream is checked with the posterior.

In simulations, the ratio was 0.5 to 1 for most presses, up to 1.7 for presses that moved a single electrode,
and 1 to 2 for wrong roots.
"""
ROUGH_AT_PATH_END: Final = 0.8
"""Ratio of roughness to size above which the last sample of a path is solved again from the guided start.

In simulations, the mean ratio was 0.67 for correct roots; wrong roots had ratios of 0.7 to 2.
"""
SMOOTH_PATH: Final = 0.2
"""Maximum prediction error on a smooth path, relative to the final displacement.

Each position is predicted by linear extrapolation from the previous two samples. In simulations, the error
was at most 0.2 on 35 of 37 correct paths, and at least 0.24 on 22 wrong paths.
"""
LONG_PATH: Final = 20
"""Minimum number of samples in a long path.

Only the second half of a long path is tested for smoothness, because a path that jumps to a wrong root early
may return to the correct root.
"""
ROOT_RESIDUAL: Final = 1e-9
"""RMS of F/b − 1 up to which the end of a path counts as a root, regardless of the solver's status.

If J is nearly singular at a root, the solver does not report CONVERGED.
"""
STILL_CONFIRMED: Final = 0.2
"""Maximum change in a confirmed displacement, relative to its size, before it must be confirmed again."""

# -- two roots of one wire ----------------------------------------------------------------------------------

SAME_ROOT: Final = 1e-3
"""Maximum distance between two solutions of the same root, relative to the displacement."""
TWIN_REACH: Final = 2.0
"""Distance between a root and its twin, relative to the wire's largest displacement, above which the twin is
ignored. Such distant twins are at least 1.3 times as rough as the root."""
TWIN_ROUGHNESS: Final = 1.05
"""Ratio of the twin's roughness to the root's roughness below which the root is rejected as ambiguous.

In 82 simulated presses, the ratio was at most 1.044 for wrong roots. A threshold of 1.05 also rejects 4 % of
the correct roots.
"""
UNLIKELY: Final = 4.0
"""Minimum difference in energy (−2 log probability density) between an accepted root and any other root of
the wire. In 3060 simulated pairs of roots, no wrong root had an energy more than 2.6 below that of the
correct root."""
UNLIKELY_BLIND: Final = 16.0
"""Like :data:`UNLIKELY`, but for wires whose conditioning exceeds :data:`NEARLY_BLIND`.

The margin is larger because the search may miss roots of these wires.
"""

# -- the posterior of the patch -----------------------------------------------------------------------------

REFEREE_NOISE: Final = 1e-5
"""Lower limit on the relative noise assumed by a posterior that checks roots.

With less noise, the posterior could converge to the same wrong root as the exact inverse.
"""
AGREE: Final = 6.0
"""Maximum distance from the posterior estimate at which a root is confirmed, in standard deviations."""
NEAR: Final = 0.25
"""Size of the first correction to an electrode position, in clearances, above which the posterior is computed
by annealing."""
FAR: Final = 0.1
"""Movement of an electrode, in clearances, after which the posterior estimate is compared with an estimate
annealed from the rest position.

The comparison detects slow presses that cross a fold.
"""
LIKELIER: Final = 4.0
"""Minimum decrease in energy (−2 log posterior density) for a second annealed estimate to replace the first.

A smaller decrease means that both estimates belong to the same maximum of the posterior density.
"""
SUSPICIOUS: Final = 3.0
"""Size of a nuisance parameter, in prior standard deviations, above which the frame is also solved by
annealing.

An incorrect drift estimate can mimic a displacement, and without annealing it would persist in the stream.
"""
BELIEVABLE: Final = 5.0
"""Size of a nuisance parameter, in prior standard deviations, above which a frame is INCONSISTENT."""
IMPOSSIBLE_CHANCE: Final = 1e-9
"""Probability, per frame, that the χ² test reports a wire as INCONSISTENT although the model is correct."""
Z_REFUSE: Final = 5.998
"""Quantile of the standard normal distribution for the probability 1 − 1e-9.

If a wire has more equations than unknowns, its root is rejected if the χ² of the residual exceeds the χ²
quantile for the same probability. At 100 frames/s, noise alone causes one rejection per wire in four months.
"""


def folded_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return a mask (U,) of the wires that a press can move across a fold."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > FOLDED)


def blind_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return a mask (U,) of the wires whose electrode positions are not determined by the resistances."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > BLIND)


def nonlinear_in_noise(layout: PatchLayout, relative_noise: ArrayLike, normal_only: bool = False) -> bool:
    """Return whether the noise is too large for the exact inverse's linear error estimate to be valid."""
    return patch_std(layout, relative_noise, normal_only) > NONLINEAR


def on_rest_branch(status: Index, branch: Index, rest_branch: Index, out_of_reach: Mask) -> Mask:
    """Return a mask (U,) of the wires with a plausible root on the branch of the rest position.

    A root is on the branch of the rest position if det J has the same sign at both. Wires with more equations
    than unknowns skip this test, because their J has no determinant. A root is plausible if every electrode
    is within its clearance of its rest position
    (:meth:`skinnode.solve.wires.problem.PatchProblem.out_of_reach`).

    Args:
        status: (U,) status of each wire's solve.
        branch: (U,) sign of det J at the solution; 0 if unknown.
        rest_branch: (U,) sign of det J at rest; 0 if unknown.
        out_of_reach: (U,) mask of the wires with an electrode farther from rest than its clearance.
    """
    return np.asarray((status == Status.CONVERGED) & (branch * rest_branch >= 0) & ~out_of_reach)


def crossed_fold(branch: Index, before: Index) -> Mask:
    """Return a mask (U,) of the wires whose det J has opposite signs in ``branch`` and ``before`` (U,)."""
    return np.asarray(branch * before < 0)


def rough_at_path_end(roughness: Float, displacement: Float, step_limit: float) -> Mask:
    """Return a mask (U,) of the wires whose displacement is too rough for a press.

    Args:
        roughness: (U,) roughness √(uᵀ C⁻¹ u) of each displacement u.
        displacement: (U, n) displacements, in pitches.
        step_limit: Standard deviation of each coordinate according to C, in pitches.
    """
    size = np.sqrt((displacement**2).sum(axis=1)) / step_limit
    return np.asarray(roughness > ROUGH_AT_PATH_END * size)


def distance(x: Float, other: Float) -> Float:
    """Return the largest coordinate difference (U,) between ``x`` and ``other`` (U, n), for each wire."""
    return np.asarray(np.abs(x - other).max(axis=1))


def agrees(gap: Float, reach: Float) -> Mask:
    """Return a mask (U,) of the wires whose coordinates are all within ``reach`` of an estimate.

    Args:
        gap: (U, ...) absolute differences between the coordinates and the estimate.
        reach: (U, ...) maximum differences; same shape as ``gap``.
    """
    return np.asarray((gap <= reach).all(axis=tuple(range(1, gap.ndim))))


def still_confirmed(displacement: Float, confirmed: Float) -> Mask:
    """Return a mask (U,) of the wires whose displacement (U, N, 3) is still close to ``confirmed``."""
    change = np.abs(displacement - confirmed).max(axis=(1, 2))
    return ~np.asarray(change > STILL_CONFIRMED * np.abs(displacement).max(axis=(1, 2)))


def beyond_prior(nuisances: Float, variance: Float, deviations: float) -> bool:
    """Return whether any nuisance parameter is larger than its prior allows.

    Args:
        nuisances: (p,) estimated nuisance parameters.
        variance: (p,) prior variances of the nuisance parameters.
        deviations: Limit, in prior standard deviations.
    """
    return bool((np.abs(nuisances) > deviations * np.sqrt(variance)).any())
