"""Forward model of a patch: wire-to-wire resistances from electrode positions.

The rubber between two electrodes at distance d has resistance ρ d. The N·M paths between an upper and a lower
wire are in parallel, so  ρ / R_k = F_k(X) = Σ_j Σ_i 1 / |x_i − x̄_jk|  (Xu et al. 2018, eq. 2). F_k is the
electrostatic potential of M unit charges at the electrodes of lower wire k, summed over the N electrodes of
the upper wire. Its gradient is ∂F_k/∂x_i = − Σ_j (x_i − x̄_jk) / |x_i − x̄_jk|³.

These NumPy functions are the reference for the compiled functions in ``kernels``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from skinnode.model.layout import Float, PatchLayout, require_array


def _offsets(layout: PatchLayout, upper_m: ArrayLike) -> Float:
    """Return x_i − x̄_jk (U, K, M, N, 3) for every pair of electrodes."""
    upper = require_array("upper_m", upper_m, layout.upper_m.shape)
    return upper[:, None, None, :, :] - layout.lower_m[None, :, :, None, :]


def potential_per_m(layout: PatchLayout, upper_m: ArrayLike) -> Float:
    """Return F, (U, K) in 1/m, for upper electrodes at ``upper_m``, (U, N, 3) in metres.

    F is inf if an upper electrode coincides with a lower electrode.

    Raises:
        ValueError: If the array has the wrong shape or contains NaN.
    """
    distance = np.linalg.norm(_offsets(layout, upper_m), axis=-1)
    with np.errstate(divide="ignore"):
        return np.asarray((1.0 / distance).sum(axis=(2, 3)))


def resistance_ohm(layout: PatchLayout, upper_m: ArrayLike) -> Float:
    """Return the wire-to-wire resistances R = ρ / F of a patch (Xu et al. 2018, eq. 2).

    Args:
        layout: The patch.
        upper_m: (U, N, 3) positions of the upper electrodes, in metres.

    Returns:
        (U, K) resistances, in ohms.

    Raises:
        ValueError: If the array has the wrong shape or contains NaN.
    """
    return layout.resistivity_ohm_per_m / potential_per_m(layout, upper_m)


def jacobian(layout: PatchLayout, upper_m: ArrayLike) -> Float:
    """Return the Jacobian of F = ρ / R with respect to the positions of the upper electrodes.

    Args:
        layout: The patch.
        upper_m: (U, N, 3) positions of the upper electrodes, in metres.

    Returns:
        (U, K, N, 3) Jacobian, in 1/m².

    Raises:
        ValueError: If the array has the wrong shape or contains NaN.
    """
    offset = _offsets(layout, upper_m)
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-(offset / distance**3).sum(axis=2))
