"""Which root of F = b is the skin's: every rule by which a root is accepted or refused, and every threshold.

Zero residuals prove nothing, because F = b has several roots. The rules look at four things: the layout at
rest (does it have folds, does it see its electrodes at all), one root (its branch, its distance from rest,
its roughness), two roots of one wire (which is the likelier), and the posterior of the whole patch, which
knows the neighbouring wires. The functions are pure; callers keep the state.

=================  =====  ================================================  ================================
constant           value  meaning                                           measured on
=================  =====  ================================================  ================================
FOLDED             250    conditioning above which presses meet folds       6000 wires of three layouts
BLIND              1e7    conditioning above which a root says nothing      symmetric; aligned, h ≥ 1.5
NEARLY_BLIND       1e5    conditioning above which UNLIKELY_BLIND holds     aligned from h = 1
NONLINEAR          0.003  std, clearances, above which noise hides folds    not measured
JUMP               0.2    move between frames, clearances, that is checked  folds passed from 0.24
LARGE              0.03   displacement, clearances, that must be smooth     folds lie farther out
ROUGH_IN_STREAM    1.2    roughness over size put to the posterior          presses 0.5 to 1.7, wrong 1 to 2
ROUGH_AT_PATH_END  0.8    roughness over size that gets a second try        presses 0.67, wrong 0.7 to 2
STILL_CONFIRMED    0.2    share of change within which a check holds        not measured
SAME_ROOT          0.001  relative distance of one root found twice         not measured
TWIN_REACH         2      relative distance of a twin at most               staggered, h = 0.3 to 1
TWIN_ROUGHNESS     1.05   ratio of roughness that decides between twins     82 + 60 + 40 presses, staggered
UNLIKELY           4      energy by which other roots must lose             1530 pairs of roots
UNLIKELY_BLIND     16     the same for nearly blind wires                   not measured
REFEREE_NOISE      1e-5   least noise of a posterior that judges a root     not measured
AGREE              6      standard deviations within which it agrees        not measured
NEAR               0.25   first correction, clearances, when tracking       not measured
FAR                0.1    move, clearances, before annealing is compared    folds passed from 0.3
LIKELIER           4      energy by which annealing again must win          the wrong one met lost by 23
SUSPICIOUS         3      prior deviations of a nuisance to be checked      not measured
BELIEVABLE         5      prior deviations that refuse a frame              not measured
IMPOSSIBLE_CHANCE  1e-9   chance of the χ² that refuses a wire              by definition
Z_REFUSE           5.998  normal deviate of that chance, tall systems       by definition
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
"""RMS of ∂x/∂(ln R) at rest over the clearance above which presses run into folds: 70 on staggered at h =
0.5, where none of 6000 wires did, 1200 and more on staggered from h = 1 on and on aligned and symmetric,
where one in 30 ends on a wrong root."""
BLIND: Final = 1e7
"""RMS of ∂x/∂(ln R) over the clearance above which a root says nothing: the wire's electrodes cross the layer
within the seventh digit of R. Wires on a symmetry line of the layout are blind, because each of their roots
has a mirror image; of the others only the wires of layers of 1.5 pitches and more above aligned lower
wires."""
NEARLY_BLIND: Final = 1e5
"""RMS of ∂x/∂(ln R) over the clearance above which a root must be clearly likelier than any other: aligned
from h = 1 on."""
NONLINEAR: Final = 0.003
"""Standard deviation of the exact inverse, clearances, above which F is not linear within its noise: a root
is then as doubtful as near a fold."""

# -- one root -----------------------------------------------------------------------------------------------

JUMP: Final = 0.2
"""Move of an electrode between two frames, clearances, above which the next root need not be the right one:
folds were passed from 0.24 on."""
LARGE: Final = 0.03
"""Displacement, clearances, above which its roughness is checked: folds lie at still larger ones."""
ROUGH_IN_STREAM: Final = 1.2
"""Roughness of a displacement over its size above which a live stream puts it to the posterior. Presses have
0.5 to 1, up to 1.7 if they move one electrode; wrong roots have 1 to 2."""
ROUGH_AT_PATH_END: Final = 0.8
"""Roughness of a displacement over its size above which the end of a path gets a second try from the
smoothest displacement. Presses have 0.67 on average, less than 0.9 in nine of ten and up to 1.9 if they move
one electrode; wrong roots have 0.7 to 2."""
STILL_CONFIRMED: Final = 0.2
"""Change of a displacement since it was confirmed, as a share of it, up to which a rough wire is not checked
again."""

# -- two roots of one wire ----------------------------------------------------------------------------------

SAME_ROOT: Final = 1e-3
"""Distance of two solutions, as a share of the displacement, up to which they are one root."""
TWIN_REACH: Final = 2.0
"""Largest distance of a twin worth solving for, in largest displacements of its wire: twins farther away were
at least 1.3 times as rough on staggered, h = 0.3 to 1."""
TWIN_ROUGHNESS: Final = 1.05
"""Ratio of roughness by which the smoother of two roots at a fold is taken for true. Over 82 random presses
of 50 % on staggered, h = 1, the twins of wrong roots were at most 1.044 times as rough; 4 in 100 right roots
have a twin as smooth, and lose their CONVERGED. Of 60 presses more of each depth and height (6710 wires, h =
0.3 to 1) no wrong root ended CONVERGED, of 40 others (4510) one did."""
UNLIKELY: Final = 4.0
"""Energy by which other roots must be less likely. Of 1530 pairs of roots of presses of 30 to 70 % on
staggered, h = 1, and aligned, h = 0.5, the wrong one was the likelier in 19, by 1.4 at most, and in as many
pairs more by 2.6. That the samples led to a root is no better proof: with 5 of them by 2.5 as well."""
UNLIKELY_BLIND: Final = 16.0
"""Energy by which other roots must be less likely on nearly blind wires, which may have more roots than are
found."""

# -- the posterior of the patch -----------------------------------------------------------------------------

REFEREE_NOISE: Final = 1e-5
"""Least relative noise of a posterior that judges a root: with less it is drawn to roots itself."""
AGREE: Final = 6.0
"""Standard deviations within which the posterior confirms a root."""
NEAR: Final = 0.25
"""Share of the clearance by which a first correction may move an electrode; beyond, the estimate is
annealed."""
FAR: Final = 0.1
"""Share of the clearance by which an electrode may move before the estimate is compared with one annealed
from rest: folds were passed by presses of 0.3 and more, frame by frame, and never noticed afterwards."""
LIKELIER: Final = 4.0
"""Energy by which an estimate annealed again must be the likelier. With less it is the same maximum, drawn
nearer to the loads found; the wrong maximum that was met lost by 23."""
SUSPICIOUS: Final = 3.0
"""Prior deviations of a nuisance above which the estimate is compared with the annealed one, and never held:
a drift or a model error can take the place of a displacement, and a stream would stay there."""
BELIEVABLE: Final = 5.0
"""Prior deviations of a nuisance above which the frame is INCONSISTENT: nothing was explained."""
IMPOSSIBLE_CHANCE: Final = 1e-9
"""Chance a frame at which a wire that obeys the model is called INCONSISTENT: χ² test."""
Z_REFUSE: Final = 5.998
"""Normal deviate of 1 − 1e-9, the quantile of χ² above which a tall system is INCONSISTENT: once in four
months at 100 frames/s, and below what a wrong root or a wrong value causes."""


def folded_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return the wires (U,) on which presses run into folds of F = b."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > FOLDED)


def blind_wires(layout: PatchLayout, normal_only: bool = False) -> Mask:
    """Return the wires (U,) whose roots say nothing about their electrodes."""
    return np.asarray(wire_std(layout, 1.0, normal_only) > BLIND)


def nonlinear_in_noise(layout: PatchLayout, relative_noise: ArrayLike, normal_only: bool = False) -> bool:
    """Return whether F is not linear within the noise of the exact inverse."""
    return patch_std(layout, relative_noise, normal_only) > NONLINEAR


def on_rest_branch(status: Index, branch: Index, rest_branch: Index, out_of_reach: Mask) -> Mask:
    """Return the wires (U,) whose solve came to a root on the branch of the rest position, within reach.

    The determinant of J keeps the sign that it has at rest. A system with more equations than unknowns has no
    determinant, and 0 for a sign. No electrode moves farther than its clearance from the lower layer
    (:meth:`skinnode.solve.wires.problem.PatchProblem.out_of_reach`).

    Args:
        status: (U,) statuses of the solves.
        branch: (U,) sign of det J at the solution, 0 if unknown.
        rest_branch: (U,) sign of det J at rest, 0 if unknown.
        out_of_reach: (U,) wires with an electrode farther from rest than its clearance.
    """
    return np.asarray((status == Status.CONVERGED) & (branch * rest_branch >= 0) & ~out_of_reach)


def crossed_fold(branch: Index, before: Index) -> Mask:
    """Return the wires (U,) whose det J changed its sign from ``before`` to ``branch`` (U,)."""
    return np.asarray(branch * before < 0)


def rough_at_path_end(roughness: Float, displacement: Float, step_limit: float) -> Mask:
    """Return the wires (U,) whose displacement is too rough for a press.

    Args:
        roughness: (U,) √(uᵀ C⁻¹ u).
        displacement: (U, n) pitches.
        step_limit: First trust radius of the patch, pitches: the size for which C was made.
    """
    size = np.sqrt((displacement**2).sum(axis=1)) / step_limit
    return np.asarray(roughness > ROUGH_AT_PATH_END * size)


def distance(x: Float, other: Float) -> Float:
    """Return the largest difference of a coordinate of two positions (U, n), by wire: (U,)."""
    return np.asarray(np.abs(x - other).max(axis=1))


def agrees(gap: Float, reach: Float) -> Mask:
    """Return the wires (U,) none of whose coordinates differs from an estimate by more than ``reach``.

    Args:
        gap: (U, ...) differences from the estimate, absolute.
        reach: Same shape, :data:`AGREE` standard deviations.
    """
    return np.asarray((gap <= reach).all(axis=tuple(range(1, gap.ndim))))


def still_confirmed(displacement: Float, confirmed: Float) -> Mask:
    """Return the wires (U,) that hardly changed (U, N, 3) since their displacement was confirmed."""
    change = np.abs(displacement - confirmed).max(axis=(1, 2))
    return ~np.asarray(change > STILL_CONFIRMED * np.abs(displacement).max(axis=(1, 2)))


def beyond_prior(nuisances: Float, variance: Float, deviations: float) -> bool:
    """Return whether a nuisance is so unlikely that it replaces something else.

    Args:
        nuisances: (p,) estimates.
        variance: (p,) prior variances.
        deviations: Prior standard deviations that are still likely.
    """
    return bool((np.abs(nuisances) > deviations * np.sqrt(variance)).any())
