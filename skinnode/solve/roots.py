"""Rules and thresholds that decide which root of F = b is the true position of the skin.

A zero residual does not identify the true position, because F = b has several roots. Two roots merge at a
fold, where det J = 0. The roots on either side of a fold are called twins. A root is judged by the sign of
det J, its distance from the rest position, its roughness, its likelihood relative to other roots of the same
wire, and the posterior estimate of the whole patch. The roughness of a displacement u is √(uᵀ C⁻¹ u), with C
from :mod:`skinnode.solve.smoothness`. The conditioning of a wire is the RMS of ∂x/∂(ln R) at rest. The
clearance between the layers is the smallest distance at rest between an upper and a lower electrode. The
energy of a displacement is −2 log p, where p is the probability density of the displacement.

=================  =====  ================================================  ================================
constant           value  meaning                                           measured on
=================  =====  ================================================  ================================
FOLDED             250    conditioning above which presses can pass folds   6000 wires of three layouts
BLIND              1e7    conditioning above which a root is meaningless    symmetric; aligned, h ≥ 1.5
NEARLY_BLIND       1e5    conditioning above which UNLIKELY_BLIND applies   aligned, h ≥ 1
NONLINEAR          0.003  std, clearances, above which roots are checked    not measured
JUMP               0.2    movement, clearances, that triggers a check       folds passed at 0.24 or more
LARGE              0.03   minimum displacement for a check of roughness     no fold this close to rest
ROUGH_IN_STREAM    1.2    roughness / size that triggers a check            presses 0.5 to 1.7, wrong 1 to 2
ROUGH_AT_PATH_END  0.8    roughness / size that triggers a second attempt   presses 0.67, wrong 0.7 to 2
SMOOTH_PATH        0.2    maximum secant error / size on a smooth path      right ≤ 0.2, wrong ≥ 0.24
LONG_PATH          20     minimum number of samples of a long path          one path that left and returned
ROOT_RESIDUAL      1e-9   maximum RMS of F/b − 1 at a root                  not measured
STILL_CONFIRMED    0.2    maximum relative change of a confirmed root       not measured
SAME_ROOT          0.001  maximum relative distance of equal roots          not measured
TWIN_REACH         2      maximum relative distance of a twin               staggered, h = 0.3 to 1
TWIN_ROUGHNESS     1.05   minimum ratio of roughness, twin to root          82 + 60 + 40 presses, staggered
UNLIKELY           4      minimum energy margin over other roots            1530 pairs of roots
UNLIKELY_BLIND     16     minimum energy margin for nearly blind wires      not measured
REFEREE_NOISE      1e-5   minimum noise of a posterior that checks roots    not measured
AGREE              6      maximum standard deviations between equal roots   not measured
NEAR               0.25   first correction, clearances, before annealing    not measured
FAR                0.1    movement, clearances, before annealing            folds passed at 0.3 or more
LIKELIER           4      minimum energy decrease by annealing              23 for a wrong maximum
SUSPICIOUS         3      nuisance, prior std, that triggers a check        not measured
BELIEVABLE         5      nuisance, prior std, that rejects a frame         not measured
IMPOSSIBLE_CHANCE  1e-9   probability of the χ² that rejects a wire         by definition
Z_REFUSE           5.998  normal quantile of the same, for tall systems     by definition
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
"""RMS of ∂x/∂(ln R) at rest, relative to the clearance between the layers, above which a press can move a
wire past a fold. The RMS is 70 on the staggered layout with h = 0.5, where no folds were found. The RMS is at
least 1200 on staggered layouts with h of 1 or more and on all aligned and symmetric layouts. On these
layouts, the solver found a wrong root for one wire in 30."""
BLIND: Final = 1e7
"""RMS of ∂x/∂(ln R) at rest, relative to the clearance between the layers, above which the resistances do not
determine the electrode positions. The only such wires are wires on a symmetry line of the layout and wires at
least 1.5 pitches above aligned lower wires."""
NEARLY_BLIND: Final = 1e5
"""RMS of ∂x/∂(ln R) at rest, relative to the clearance between the layers, above which the margin
:data:`UNLIKELY_BLIND` replaces :data:`UNLIKELY`.

The RMS is above this limit on aligned layouts with h ≥ 1.
"""
NONLINEAR: Final = 0.003
"""Standard deviation of the exact inverse, relative to the clearance between the layers, above which every
root is checked. F is nonlinear on the scale of such errors, so a linear error estimate is not valid."""

# -- one root -----------------------------------------------------------------------------------------------

JUMP: Final = 0.2
"""Movement of an electrode between two frames, relative to the clearance between the layers, above which the
new root is checked.

The smallest movement across a fold that has been observed was 0.24.
"""
LARGE: Final = 0.03
"""Displacement, relative to the clearance between the layers, above which the roughness of a root is checked.
All folds are farther than this from the rest position."""
ROUGH_IN_STREAM: Final = 1.2
"""Ratio of the roughness of a displacement to its size, above which a live stream checks the displacement
with the posterior. The ratio was 0.5 to 1 for most presses, up to 1.7 for presses that moved a single
electrode, and 1 to 2 for wrong roots."""
ROUGH_AT_PATH_END: Final = 0.8
"""Ratio of the roughness of a displacement to its size, above which the end of a path is solved again from
the guided start. The ratio was 0.67 on average for presses, and 0.7 to 2 for wrong roots."""
SMOOTH_PATH: Final = 0.2
"""Maximum error of the positions predicted along a smooth path, relative to the final displacement. A
position is predicted by extrapolation from the previous two samples. In simulations, the error was at most
0.2 on all but two of 37 correct paths, and at least 0.24 on 22 wrong paths."""
LONG_PATH: Final = 20
"""Minimum number of samples in a long path. Only the second half of a long path must be smooth, because a
path that jumps to a wrong root early on may return to the correct root."""
ROOT_RESIDUAL: Final = 1e-9
"""Maximum RMS of F/b − 1 at the end of a path that has reached a root.

At such a root, J may be nearly singular, so that the solver does not report CONVERGED.
"""
STILL_CONFIRMED: Final = 0.2
"""Maximum change of a confirmed displacement, relative to its size, for which the confirmation remains
valid."""

# -- two roots of one wire ----------------------------------------------------------------------------------

SAME_ROOT: Final = 1e-3
"""Maximum distance between two solutions that are considered to be the same root, relative to the
displacement."""
TWIN_REACH: Final = 2.0
"""Maximum distance between a root and its twin across a fold, relative to the wire's largest displacement.
More distant twins are at least 1.3 times as rough as the root, so they are ignored."""
TWIN_ROUGHNESS: Final = 1.05
"""Ratio of a twin's roughness to a root's roughness, below which the root is rejected as ambiguous. In 82
simulated presses, the ratio was at most 1.044 for wrong roots. A ratio of 1.05 also rejects 4 % of the
correct roots."""
UNLIKELY: Final = 4.0
"""Minimum difference in energy (−2 log probability density) between an accepted root and any other root of
the wire. In 3060 simulated pairs of roots, the energy of a wrong root was at most 2.6 below that of the
correct root."""
UNLIKELY_BLIND: Final = 16.0
"""Minimum difference in energy (−2 log probability density) between two roots of a nearly blind wire.

For nearly blind wires, the search may miss roots, so the difference must be larger than :data:`UNLIKELY`.
"""

# -- the posterior of the patch -----------------------------------------------------------------------------

REFEREE_NOISE: Final = 1e-5
"""Minimum relative noise that the posterior assumes when it checks a root.

If the posterior assumed less noise, it might converge to the same wrong root as the exact inverse.
"""
AGREE: Final = 6.0
"""Maximum distance between a root and the posterior estimate that confirms the root, in standard
deviations."""
NEAR: Final = 0.25
"""First correction of an electrode position, relative to the clearance between the layers, above which the
posterior is computed by annealing."""
FAR: Final = 0.1
"""Movement of an electrode, relative to the clearance between the layers, after which the posterior estimate
is compared with an estimate annealed from the rest position. Otherwise, a slow press could pass a fold
unnoticed."""
LIKELIER: Final = 4.0
"""Minimum decrease in energy (−2 log posterior density) for which a second annealed estimate replaces the
first.

If the energy decreases by less, both estimates belong to the same maximum of the posterior density.
"""
SUSPICIOUS: Final = 3.0
"""Estimate of a nuisance parameter, in prior standard deviations, above which the frame is also solved by
annealing. A wrong drift estimate can mimic a displacement and would otherwise persist throughout a stream."""
BELIEVABLE: Final = 5.0
"""Estimate of a nuisance parameter, in prior standard deviations, above which a frame is INCONSISTENT."""
IMPOSSIBLE_CHANCE: Final = 1e-9
"""Probability that the χ² test reports a wire as INCONSISTENT in a frame although the model is correct."""
Z_REFUSE: Final = 5.998
"""Normal quantile for the probability 1 − 1e-9. The root of a wire with more equations than unknowns is
rejected if the χ² of its residual exceeds the corresponding χ² quantile. At 100 frames/s, noise alone causes
one rejection per wire in four months."""


def folded_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return a mask (U,) of the wires that a press can move past a fold of F = b."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > FOLDED)


def blind_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return a mask (U,) of the wires whose resistances do not determine their electrodes' positions."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > BLIND)


def nonlinear_in_noise(layout: PatchLayout, relative_noise: ArrayLike, normal_only: bool = False) -> bool:
    """Return whether the noise is too large for a linear error estimate of the exact inverse."""
    return patch_std(layout, relative_noise, normal_only) > NONLINEAR


def on_rest_branch(status: Index, branch: Index, rest_branch: Index, out_of_reach: Mask) -> Mask:
    """Return a mask (U,) of the wires whose root is plausible and on the same branch as the rest position.

    Two positions are on the same branch if det J has the same sign at both positions. With more equations
    than unknowns, det J does not exist, and this condition is ignored. A root is plausible if no electrode
    moves farther than its distance at rest from the nearest lower electrode
    (:meth:`skinnode.solve.wires.problem.PatchProblem.out_of_reach`).

    Args:
        status: (U,) statuses of the solves.
        branch: (U,) sign of det J at the solution, 0 if unknown.
        rest_branch: (U,) sign of det J at rest, 0 if unknown.
        out_of_reach: (U,) mask of the wires whose roots are implausibly far from rest.
    """
    return np.asarray((status == Status.CONVERGED) & (branch * rest_branch >= 0) & ~out_of_reach)


def crossed_fold(branch: Index, before: Index) -> Mask:
    """Return a mask (U,) of the wires whose det J changed sign between ``before`` and ``branch`` (U,)."""
    return np.asarray(branch * before < 0)


def rough_at_path_end(roughness: Float, displacement: Float, step_limit: float) -> Mask:
    """Return a mask (U,) of the wires whose displacement is too rough to be caused by a press.

    Args:
        roughness: (U,) √(uᵀ C⁻¹ u).
        displacement: (U, n) displacement, pitches.
        step_limit: Standard deviation of a coordinate in C, pitches.
    """
    size = np.sqrt((displacement**2).sum(axis=1)) / step_limit
    return np.asarray(roughness > ROUGH_AT_PATH_END * size)


def distance(x: Float, other: Float) -> Float:
    """Return the largest coordinate difference (U,) between two positions (U, n) of each wire."""
    return np.asarray(np.abs(x - other).max(axis=1))


def agrees(gap: Float, reach: Float) -> Mask:
    """Return a mask (U,) of the wires with every coordinate within ``reach`` of an estimate.

    Args:
        gap: (U, ...) absolute differences from the estimate.
        reach: Maximum difference, same shape as ``gap``.
    """
    return np.asarray((gap <= reach).all(axis=tuple(range(1, gap.ndim))))


def still_confirmed(displacement: Float, confirmed: Float) -> Mask:
    """Return a mask (U,) of the wires whose displacement (U, N, 3) is still close to ``confirmed``."""
    change = np.abs(displacement - confirmed).max(axis=(1, 2))
    return ~np.asarray(change > STILL_CONFIRMED * np.abs(displacement).max(axis=(1, 2)))


def beyond_prior(nuisances: Float, variance: Float, deviations: float) -> bool:
    """Return whether the estimate of any nuisance parameter is implausibly large.

    Args:
        nuisances: (p,) estimates of the nuisance parameters.
        variance: (p,) prior variances of the nuisance parameters.
        deviations: Largest plausible estimate, in prior standard deviations.
    """
    return bool((np.abs(nuisances) > deviations * np.sqrt(variance)).any())
