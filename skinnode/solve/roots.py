"""Rules and thresholds that decide which root of F = b is the true position of the skin.

A zero residual does not identify the true position, because F = b has several roots. The rules are based on
four criteria: the layout at rest, the properties of a root, the relative likelihood of two roots of the same
wire, and the posterior of the whole patch. A layout's relevant properties are its folds, and how sensitive
its resistances are to electrode positions. A root's relevant properties are its branch, distance from rest
and roughness. All functions of this module are pure; their callers store the state.

=================  =====  ================================================  ================================
constant           value  meaning                                           measured on
=================  =====  ================================================  ================================
FOLDED             250    conditioning above which presses meet folds       6000 wires of three layouts
BLIND              1e7    conditioning above which a root is meaningless    symmetric; aligned, h ≥ 1.5
NEARLY_BLIND       1e5    conditioning above which UNLIKELY_BLIND applies   aligned from h = 1
NONLINEAR          0.003  std, clearances, above which noise hides folds    not measured
JUMP               0.2    move between frames, clearances, to be checked    folds crossed from 0.24
LARGE              0.03   displacement, clearances, that must be smooth     folds lie farther out
ROUGH_IN_STREAM    1.2    roughness / size, checked with the posterior      presses 0.5 to 1.7, wrong 1 to 2
ROUGH_AT_PATH_END  0.8    roughness / size that triggers a second attempt   presses 0.67, wrong 0.7 to 2
SMOOTH_PATH        0.2    largest miss of a secant / size on smooth paths   right paths 0.2, wrong from 0.24
LONG_PATH          20     samples from which only the second half counts    one path that jumped and returned
ROOT_RESIDUAL      1e-9   RMS of F/b − 1 up to which a path ends at a root  not measured
STILL_CONFIRMED    0.2    relative change up to which a check stays valid   not measured
SAME_ROOT          0.001  relative distance up to which roots are equal     not measured
TWIN_REACH         2      largest relative distance of a twin               staggered, h = 0.3 to 1
TWIN_ROUGHNESS     1.05   ratio of roughness that decides between twins     82 + 60 + 40 presses, staggered
UNLIKELY           4      energy margin over other roots                    1530 pairs of roots
UNLIKELY_BLIND     16     energy margin for nearly blind wires              not measured
REFEREE_NOISE      1e-5   minimum noise for a posterior that checks roots   not measured
AGREE              6      standard deviations up to which roots agree       not measured
NEAR               0.25   first correction, clearances, when tracking       not measured
FAR                0.1    move, clearances, before annealing is compared    folds crossed from 0.3
LIKELIER           4      energy margin of a second annealing               a wrong maximum lost by 23
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
"""Threshold of the RMS of ∂x/∂(ln R) at rest, in clearances; on layouts above this threshold, presses run
into folds. The RMS is 70 for the staggered layout at h = 0.5, where none of 6000 wires ran into a fold.
The RMS is at least 1200 for staggered layouts with h ≥ 1 and for all aligned and symmetric layouts; on
these layouts, one wire in 30 ends at a wrong root."""
BLIND: Final = 1e7
"""RMS of ∂x/∂(ln R), in clearances, above which a root is meaningless: R changes only in the seventh digit
while electrodes move through the whole layer. Wires on a symmetry line of the layout are blind, because
each of their roots has a mirror image. The only other blind wires are wires at least 1.5 pitches above
aligned lower wires."""
NEARLY_BLIND: Final = 1e5
"""RMS of ∂x/∂(ln R), in clearances, above which a root must be clearly likelier than all other roots.

Aligned layouts with h ≥ 1 exceed this value.
"""
NONLINEAR: Final = 0.003
"""Standard deviation of the exact inverse, in clearances, above which F is nonlinear within the range of
the noise. Above this value, all roots are as doubtful as roots near a fold."""

# -- one root -----------------------------------------------------------------------------------------------

JUMP: Final = 0.2
"""Movement of an electrode between two frames, in clearances, above which the new root may be wrong.

Some movements of 0.24 or more have been observed to cross folds.
"""
LARGE: Final = 0.03
"""Displacement, in clearances, above which roughness is checked; no fold is closer to the rest position."""
ROUGH_IN_STREAM: Final = 1.2
"""Ratio of a displacement's roughness to its size above which a live stream checks the displacement with
the posterior. The ratio is 0.5 to 1 for most presses, up to 1.7 for presses that move a single electrode,
and 1 to 2 for wrong roots."""
ROUGH_AT_PATH_END: Final = 0.8
"""Ratio of a displacement's roughness to its size above which the end of a path is solved again from the
smoothest displacement. For presses, the ratio is 0.67 on average, below 0.9 for nine in ten, and up to 1.9
for presses that move a single electrode. For wrong roots, the ratio is 0.7 to 2."""
SMOOTH_PATH: Final = 0.2
"""Maximum distance of a sample's solution from the secant through the previous two solutions, relative to
the final displacement, on a smooth path. For the first sample of a path, the distance is measured from the
rest position. The value was measured on 3500 wires of aligned and staggered layouts, h = 0.3 to 1, under
presses of 30 to 70 % with shears of 0.3 to 0.8. On 59 of these wires, paths of 5 to 100 samples led across
a fold to a root other than the accepted root. On 37 of the 59 wires, the accepted root was wrong; the
largest distance was at most 0.2, except on 2 wires (0.27 and 0.67). On the other 22 wires, whose paths had
only 5 widely spaced samples, the accepted root was right; the largest distance was at least 0.24."""
LONG_PATH: Final = 20
"""Minimum number of samples of a long path; only the second half of a long path must be smooth.

On one of 720 wires, the first of 20 samples led to a wrong root, and the third sample led back to the true
root, 0.21 from the secant. The other 17 samples were within 0.06 of the secant, and the accepted root was
wrong by 69 %.
"""
ROOT_RESIDUAL: Final = 1e-9
"""Maximum RMS of F/b − 1 for accepting the end of a path as a root.

J may be too close to singular for the status CONVERGED.
"""
STILL_CONFIRMED: Final = 0.2
"""Maximum relative change of a confirmed rough displacement; after a larger change, the displacement is
checked again."""

# -- two roots of one wire ----------------------------------------------------------------------------------

SAME_ROOT: Final = 1e-3
"""Maximum distance between two solutions that are considered the same root, relative to the displacement."""
TWIN_REACH: Final = 2.0
"""Maximum distance of a twin root that is solved for, relative to the wire's largest displacement. On the
staggered layout, h = 0.3 to 1, more distant twins were at least 1.3 times as rough as the root."""
TWIN_ROUGHNESS: Final = 1.05
"""Minimum roughness ratio of two roots at a fold for accepting the smoother root. In 82 random presses of
50 % on the staggered layout, h = 1, the twins of wrong roots were at most 1.044 times as rough as the
wrong roots themselves. Of 100 correct roots, 4 have a twin within this ratio and lose the status
CONVERGED. In 60 further presses of each depth and height (6710 wires, h = 0.3 to 1), no wrong root was
reported as CONVERGED. In another 40 presses (4510 wires), one wrong root was reported as CONVERGED."""
UNLIKELY: Final = 4.0
"""Minimum difference in energy between the accepted root and every other root. In 1530 pairs of roots from
presses of 30 to 70 % (staggered layout, h = 1; aligned layout, h = 0.5), the wrong root was likelier in 19
pairs, by an energy of at most 1.4. In a second set of the same size, the wrong root was likelier by at
most 2.6. Roots at the end of a path are not more reliable: on paths of 5 samples, the wrong root was
    likelier by up to 2.5."""
UNLIKELY_BLIND: Final = 16.0
"""Minimum difference in energy between the accepted root of a nearly blind wire and every other root.

A nearly blind wire may also have undiscovered roots.
"""

# -- the posterior of the patch -----------------------------------------------------------------------------

REFEREE_NOISE: Final = 1e-5
"""Minimum relative noise assumed by a posterior that checks roots.

If the assumed noise were lower, the posterior itself would be forced onto a root of F = b.
"""
AGREE: Final = 6.0
"""Number of standard deviations within which the posterior confirms a root."""
NEAR: Final = 0.25
"""Maximum first correction of an electrode, in clearances; a larger first correction is followed by
annealing."""
FAR: Final = 0.1
"""Movement of an electrode, in clearances, after which the estimate is compared with an estimate annealed
from rest. Without this comparison, presses of 0.3 or more clearances crossed folds unnoticed in small
steps."""
LIKELIER: Final = 4.0
"""Minimum difference in energy for the estimate of a second annealing to replace the first estimate.

A smaller difference indicates that both annealings found the same maximum, shifted towards the estimated
loads. For the only wrong maximum observed, the difference was 23.
"""
SUSPICIOUS: Final = 3.0
"""Value of a nuisance parameter, in prior standard deviations, above which the estimate is not held, but
compared with an annealed estimate. A wrong drift or model error can mimic a displacement, and a stream
that held such an estimate would not recover."""
BELIEVABLE: Final = 5.0
"""Value of a nuisance parameter, in prior standard deviations, above which the frame is INCONSISTENT."""
IMPOSSIBLE_CHANCE: Final = 1e-9
"""Probability per frame that the χ² test reports a correctly modelled wire as INCONSISTENT."""
Z_REFUSE: Final = 5.998
"""Normal quantile of 1 − 1e-9; the corresponding χ² is the limit above which the root of a tall system is
rejected. At 100 frames/s, noise alone exceeds this χ² limit once in four months. Wrong roots and wrong
resistances cause values of χ² above the limit."""


def folded_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return a mask (U,) of the wires on which presses run into folds of F = b."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > FOLDED)


def blind_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return a mask (U,) of the wires whose resistances do not determine their electrodes' positions."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > BLIND)


def nonlinear_in_noise(layout: PatchLayout, relative_noise: ArrayLike, normal_only: bool = False) -> bool:
    """Return whether F is nonlinear within the range of the exact inverse's noise."""
    return patch_std(layout, relative_noise, normal_only) > NONLINEAR


def on_rest_branch(status: Index, branch: Index, rest_branch: Index, out_of_reach: Mask) -> Mask:
    """Return a mask (U,) of the wires solved to a root within reach, on the rest position's branch.

    On this branch, the determinant of J has the same sign as at rest. For a system with more equations than
    unknowns, which has no determinant, the sign is 0. A root is within reach if no electrode moves farther
    than its clearance from the lower layer (:meth:`skinnode.solve.wires.problem.PatchProblem.out_of_reach`).

    Args:
        status: (U,) statuses of the solves.
        branch: (U,) sign of det J at the solution, 0 if unknown.
        rest_branch: (U,) sign of det J at rest, 0 if unknown.
        out_of_reach: (U,) wires with an electrode farther from rest than its clearance.
    """
    return np.asarray((status == Status.CONVERGED) & (branch * rest_branch >= 0) & ~out_of_reach)


def crossed_fold(branch: Index, before: Index) -> Mask:
    """Return a mask (U,) of the wires whose det J changed sign between ``before`` and ``branch`` (U,)."""
    return np.asarray(branch * before < 0)


def rough_at_path_end(roughness: Float, displacement: Float, step_limit: float) -> Mask:
    """Return a mask (U,) of the wires whose displacement is too rough to be a press.

    Args:
        roughness: (U,) √(uᵀ C⁻¹ u).
        displacement: (U, n) displacement, pitches.
        step_limit: Initial trust radius of the patch, pitches; the displacement size that C assumes.
    """
    size = np.sqrt((displacement**2).sum(axis=1)) / step_limit
    return np.asarray(roughness > ROUGH_AT_PATH_END * size)


def distance(x: Float, other: Float) -> Float:
    """Return the largest coordinate difference (U,) between two positions (U, n) of each wire."""
    return np.asarray(np.abs(x - other).max(axis=1))


def agrees(gap: Float, reach: Float) -> Mask:
    """Return a mask (U,) of the wires whose coordinates all differ from an estimate by at most ``reach``.

    Args:
        gap: (U, ...) absolute differences from the estimate.
        reach: Limits of the same shape, :data:`AGREE` standard deviations.
    """
    return np.asarray((gap <= reach).all(axis=tuple(range(1, gap.ndim))))


def still_confirmed(displacement: Float, confirmed: Float) -> Mask:
    """Return a mask (U,) of wires whose displacement (U, N, 3) has changed little since confirmation."""
    change = np.abs(displacement - confirmed).max(axis=(1, 2))
    return ~np.asarray(change > STILL_CONFIRMED * np.abs(displacement).max(axis=(1, 2)))


def beyond_prior(nuisances: Float, variance: Float, deviations: float) -> bool:
    """Return whether any nuisance parameter is implausibly large.

    Args:
        nuisances: (p,) estimates of the nuisances.
        variance: (p,) prior variances of the nuisances.
        deviations: Largest plausible estimate, in prior standard deviations.
    """
    return bool((np.abs(nuisances) > deviations * np.sqrt(variance)).any())
