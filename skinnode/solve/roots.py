"""Rules and thresholds that decide which root of F = b is the true position of the skin.

A zero residual does not identify the true position, because F = b has several roots. The rules use four
criteria: the layout at rest, the properties of a root, the relative likelihood of two roots of a wire, and
the posterior of the whole patch. The relevant properties of a layout are folds, and the sensitivity of its
resistances to electrode positions; those of a root are its branch, distance from rest and roughness. All
functions of this module are pure; their callers store the state.

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
"""RMS of ∂x/∂(ln R) at rest, in clearances, above which presses run into folds. The value is 70 for the
staggered layout at h = 0.5, where none of 6000 wires ran into a fold. The value is at least 1200 for
staggered layouts with h ≥ 1 and for aligned and symmetric layouts, where one wire in 30 ends at a wrong
root."""
BLIND: Final = 1e7
"""RMS of ∂x/∂(ln R), in clearances, above which a root is meaningless: electrodes can cross the whole layer
while R changes only in its seventh digit. Wires on a symmetry line of the layout are blind, because each of
their roots has a mirror image. The only other blind wires are wires at least 1.5 pitches above aligned lower
wires."""
NEARLY_BLIND: Final = 1e5
"""RMS of ∂x/∂(ln R), in clearances, above which a root must be clearly likelier than any other; aligned
layouts exceed this value at h ≥ 1."""
NONLINEAR: Final = 0.003
"""Standard deviation of the exact inverse, in clearances, above which F is not linear within the noise. All
roots are then as doubtful as roots near a fold."""

# -- one root -----------------------------------------------------------------------------------------------

JUMP: Final = 0.2
"""Movement of an electrode between two frames, in clearances, above which the next root may be wrong;
movements of 0.24 or more were observed to cross folds."""
LARGE: Final = 0.03
"""Displacement, in clearances, above which the roughness is checked; all folds are at larger
displacements."""
ROUGH_IN_STREAM: Final = 1.2
"""Roughness-to-size ratio above which a live stream checks a displacement against the posterior.
The ratio is 0.5 to 1 for presses, up to 1.7 if they move a single electrode, and 1 to 2 for wrong roots."""
ROUGH_AT_PATH_END: Final = 0.8
"""Roughness-to-size ratio of a displacement above which the end of a path is solved again from the
smoothest displacement. The ratio is 0.67 on average for presses, below 0.9 for nine presses in ten, up to 1.9
if they move a single electrode, and 0.7 to 2 for wrong roots."""
SMOOTH_PATH: Final = 0.2
"""Maximum distance, on a smooth path, between a sample's solution and the secant through the two previous
solutions, relative to the final displacement. For the first sample, the distance is measured from the rest
position. The value was measured on 3500 wires of aligned and staggered layouts, h = 0.3 to 1, under presses
of 30 to 70 % with shears of 0.3 to 0.8. On 59 of these wires, paths of 5 to 100 samples led across a fold to
a root other than the accepted root. On 37 of the 59 wires, the accepted root was wrong; the largest distance
was at most 0.2 except on 2 wires (0.27 and 0.67). On the other 22 wires, the accepted root was right, because
the 5 samples of the path were too far apart to follow; the largest distance was at least 0.24."""
LONG_PATH: Final = 20
"""Number of samples from which only the second half of a path must be smooth. On one of 720 wires, the first
of 20 samples led to a wrong root, and the third sample led back to the true root with a deviation of 0.21
from the secant. The deviation of the other 17 samples was at most 0.06, and the accepted root was wrong by 69
%."""
ROOT_RESIDUAL: Final = 1e-9
"""Maximum RMS of F/b − 1 at which the end of a path counts as a root, even if J is too close to singular for
CONVERGED."""
STILL_CONFIRMED: Final = 0.2
"""Maximum relative change since its confirmation at which a rough displacement is not checked again."""

# -- two roots of one wire ----------------------------------------------------------------------------------

SAME_ROOT: Final = 1e-3
"""Maximum distance between two solutions that count as the same root, relative to the displacement."""
TWIN_REACH: Final = 2.0
"""Maximum distance at which a twin root is solved for, relative to the wire's largest displacement. On the
staggered layout, h = 0.3 to 1, more distant twins were at least 1.3 times as rough as the root."""
TWIN_ROUGHNESS: Final = 1.05
"""Ratio between the roughnesses of two roots at a fold above which the smoother root is accepted. In 82
random presses of 50 % on the staggered layout, h = 1, the twins of wrong roots were at most 1.044 times as
rough as the wrong roots themselves. Of 100 correct roots, 4 have a twin within this ratio and lose the status
CONVERGED. In 60 further presses of each depth and height (6710 wires, h = 0.3 to 1), no wrong root was
reported as CONVERGED. In another 40 presses (4510 wires), one wrong root was reported as CONVERGED."""
UNLIKELY: Final = 4.0
"""Energy margin by which all other roots must be less likely than the accepted root. In 1530 pairs of roots
from presses of 30 to 70 % (staggered layout, h = 1; aligned layout, h = 0.5), the wrong root was likelier in
19 pairs, by an energy of at most 1.4. In a second set of the same size, the wrong root was likelier by at
most 2.6. A root at the end of a path is not more reliable: with paths of 5 samples, the wrong root was
likelier by up to 2.5."""
UNLIKELY_BLIND: Final = 16.0
"""Energy margin by which all other roots of a nearly blind wire must be less likely; such a wire may also
have undiscovered roots."""

# -- the posterior of the patch -----------------------------------------------------------------------------

REFEREE_NOISE: Final = 1e-5
"""Smallest relative noise assumed by a posterior that checks roots; with less noise, the posterior itself is
forced onto a root of F = b."""
AGREE: Final = 6.0
"""Number of standard deviations within which the posterior confirms a root."""
NEAR: Final = 0.25
"""Maximum first correction of an electrode, in clearances; a larger first correction is followed by
annealing."""
FAR: Final = 0.1
"""Movement of an electrode, in clearances, after which the estimate is compared with an estimate annealed
from rest. Without the comparison, presses of 0.3 or more crossed folds unnoticed, one frame at a time."""
LIKELIER: Final = 4.0
"""Energy margin by which an estimate from a second annealing must be likelier to replace the first estimate.
A smaller margin indicates that both annealings found the same maximum, shifted towards the estimated loads.
The wrong maximum that was observed was less likely by a margin of 23."""
SUSPICIOUS: Final = 3.0
"""Value of a nuisance, in prior standard deviations, above which the estimate is compared with an annealed
estimate and never held. A wrong drift or model error can mimic a displacement, and the stream would not
recover from it."""
BELIEVABLE: Final = 5.0
"""Value of a nuisance, in prior standard deviations, above which the frame is INCONSISTENT."""
IMPOSSIBLE_CHANCE: Final = 1e-9
"""Probability per frame that the χ² test reports a wire that obeys the model as INCONSISTENT."""
Z_REFUSE: Final = 5.998
"""Normal quantile of 1 − 1e-9; the corresponding χ² is the limit above which the root of a tall system is
rejected. At 100 frames/s, noise alone exceeds the limit once in four months. Wrong roots and wrong
resistances cause a larger χ²."""


def folded_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return the wires (U,) on which presses run into folds of F = b."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > FOLDED)


def blind_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return the wires (U,) whose resistances do not determine the positions of their electrodes."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > BLIND)


def nonlinear_in_noise(layout: PatchLayout, relative_noise: ArrayLike, normal_only: bool = False) -> bool:
    """Return whether F is not linear within the noise of the exact inverse."""
    return patch_std(layout, relative_noise, normal_only) > NONLINEAR


def on_rest_branch(status: Index, branch: Index, rest_branch: Index, out_of_reach: Mask) -> Mask:
    """Return the wires (U,) whose solve reached a root within reach, on the branch of the rest position.

    On this branch, the determinant of J has the same sign as at rest. A system with more equations than
    unknowns has no determinant; the sign is then 0. A root is within reach if no electrode moves farther than
    its clearance from the lower layer (:meth:`skinnode.solve.wires.problem.PatchProblem.out_of_reach`).

    Args:
        status: (U,) statuses of the solves.
        branch: (U,) sign of det J at the solution, 0 if unknown.
        rest_branch: (U,) sign of det J at rest, 0 if unknown.
        out_of_reach: (U,) wires with an electrode farther from rest than its clearance.
    """
    return np.asarray((status == Status.CONVERGED) & (branch * rest_branch >= 0) & ~out_of_reach)


def crossed_fold(branch: Index, before: Index) -> Mask:
    """Return the wires (U,) whose det J changed sign between ``before`` and ``branch`` (U,)."""
    return np.asarray(branch * before < 0)


def rough_at_path_end(roughness: Float, displacement: Float, step_limit: float) -> Mask:
    """Return the wires (U,) whose displacement is too rough to be a press.

    Args:
        roughness: (U,) √(uᵀ C⁻¹ u).
        displacement: (U, n) displacement, pitches.
        step_limit: Initial trust radius of the patch, pitches; the displacement size that C assumes.
    """
    size = np.sqrt((displacement**2).sum(axis=1)) / step_limit
    return np.asarray(roughness > ROUGH_AT_PATH_END * size)


def distance(x: Float, other: Float) -> Float:
    """Return the largest coordinate difference (U,) of each wire between two positions (U, n)."""
    return np.asarray(np.abs(x - other).max(axis=1))


def agrees(gap: Float, reach: Float) -> Mask:
    """Return the wires (U,) whose coordinates all differ from an estimate by at most ``reach``.

    Args:
        gap: (U, ...) absolute differences from the estimate.
        reach: Limits of the same shape, :data:`AGREE` standard deviations.
    """
    return np.asarray((gap <= reach).all(axis=tuple(range(1, gap.ndim))))


def still_confirmed(displacement: Float, confirmed: Float) -> Mask:
    """Return the wires (U,) whose displacement (U, N, 3) has changed little since its confirmation."""
    change = np.abs(displacement - confirmed).max(axis=(1, 2))
    return ~np.asarray(change > STILL_CONFIRMED * np.abs(displacement).max(axis=(1, 2)))


def beyond_prior(nuisances: Float, variance: Float, deviations: float) -> bool:
    """Return whether any nuisance is implausibly large.

    Args:
        nuisances: (p,) estimates of the nuisances.
        variance: (p,) prior variances of the nuisances.
        deviations: Largest plausible value, in prior standard deviations.
    """
    return bool((np.abs(nuisances) > deviations * np.sqrt(variance)).any())
