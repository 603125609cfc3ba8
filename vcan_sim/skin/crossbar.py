"""Read-out of the crossbar: computes the measured resistances by nodal analysis of the complete network.

A resistive wire is a chain of resistors that starts at the connector, with a node at each electrode. A wire
without resistance is a single node. C is the matrix of conductances between upper and lower nodes. Each wire
is in series with its contact and with a multiplexer (upper wires) or an amplifier input (lower wires). With
the conductance matrices T of the chains and connectors, Kirchhoff's current law determines the voltages v of
the upper nodes and w of the lower nodes (Ho, Ruehli and Brennan, IEEE Trans. Circuits Syst. 22, 1975):

    ⎡ A_u   −C ⎤ ⎡ v ⎤   ⎡ currents fed ⎤
    ⎢          ⎥ ⎢   ⎥ = ⎢              ⎥,    A_u = diag(C 1) + T_u,    A_l = diag(Cᵀ 1) + T_l
    ⎣ −Cᵀ  A_l ⎦ ⎣ w ⎦   ⎣ into nodes   ⎦

A_l is tridiagonal, so w is eliminated first. The matrix of the remaining system for v is the Schur complement
A_u − C A_l⁻¹ Cᵀ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from skinnode.model.layout import Float


@dataclass(frozen=True, eq=False)
class Side:
    """Upper or lower wires of a crossbar and their resistances.

    Args:
        series_ohm: (W,) float64, ohm: total resistance of each wire's contact and its multiplexer or
            amplifier input, in series with the wire.
        wire_ohm: Wire resistance per electrode pitch, in ohms; 0 makes each wire a single node.
        electrodes: Number of electrodes per wire.
    """

    series_ohm: Float
    wire_ohm: float
    electrodes: int

    @property
    def nodes(self) -> int:
        """Number of network nodes per wire."""
        return self.electrodes if self.wire_ohm else 1

    @property
    def feed_ohm(self) -> Float:
        """Resistance (W,) in ohms between the source or amplifier and the first node of each wire."""
        return np.asarray(self.series_ohm + self.wire_ohm)

    @property
    def ideal(self) -> bool:
        """Whether all wires connect to their sources or amplifiers without resistance."""
        return not self.feed_ohm.any()

    def first(self) -> Float:
        """Return the incidence matrix (W · nodes, W): 1 at the first node of each wire, 0 elsewhere."""
        wires = len(self.series_ohm)
        found = np.zeros((wires * self.nodes, wires))
        found[np.arange(wires) * self.nodes, np.arange(wires)] = 1.0
        return found

    def diagonals(self, sums: Float, feed: Float | float) -> tuple[Float, Float]:
        """Return the diagonal (n,) and the superdiagonal (n,) of the matrix diag(sums) + T.

        The first entry of the superdiagonal is unused.

        Args:
            sums: (n,) float64, S: total conductance of the paths at each node.
            feed: (W,) float64, S: conductances of the connectors.
        """
        wires = len(self.series_ohm)
        diagonal, beside = sums.reshape(wires, self.nodes).copy(), np.zeros((wires, self.nodes))
        if self.nodes > 1:
            step = 1.0 / self.wire_ohm
            beside[:, 1:] = -step
            diagonal[:, 1:] += step
            diagonal[:, :-1] += step
        diagonal[:, 0] += feed
        return diagonal.ravel(), beside.ravel()


def grounded_ohm(conductance: Float, upper: Side, lower: Side) -> Float:
    """Return the resistances (U, K) in ohms that the ``grounded`` read-out measures.

    Upper wires are driven one at a time, with all others grounded. A reading is the driving voltage divided
    by the current into the amplifier of a lower wire. Without series and wire resistances, a reading is the
    resistance of the crossing.

    Args:
        conductance: (upper nodes, lower nodes) float64, S: conductances of the paths between nodes.
        upper: Upper wires.
        lower: Lower wires.
    """
    above, below = conductance.sum(axis=1), conductance.sum(axis=0)
    if lower.ideal:  # upper wires are independent if all lower wires are grounded
        return np.asarray(1.0 / (_driven(above, upper).T @ conductance))
    feed = 1.0 / lower.feed_ohm
    if upper.ideal:
        lowered = _tridiagonal(lower.diagonals(below, feed), conductance.T @ upper.first())
    else:
        across = _tridiagonal(lower.diagonals(below, feed), conductance.T)
        schur = _dense(upper.diagonals(above, 1.0 / upper.feed_ohm)) - conductance @ across
        lowered = across @ np.linalg.solve(schur, upper.first() / upper.feed_ohm)
    current = feed[:, None] * lowered[:: lower.nodes]
    return np.asarray(1.0 / current.T)


def floating_ohm(conductance: Float, upper: Side, lower: Side) -> Float:
    """Return the resistances (U, K) in ohms that the ``floating`` read-out measures.

    One pair of wires is measured while all other wires float. A reading is the effective resistance between
    two nodes, Z_uu + Z_kk − 2 Z_uk, plus the series resistances of the two wires. Z is the inverse of the
    conductance matrix of the network (Klein and Randić, J. Math. Chem. 12, 1993).

    Args:
        conductance: (upper nodes, lower nodes) float64, S: conductances of the paths between nodes.
        upper: Upper wires.
        lower: Lower wires.
    """
    above, below = conductance.sum(axis=1), conductance.sum(axis=0)
    ends = lower.first()
    solved = _tridiagonal(lower.diagonals(below, 0.0), np.hstack([conductance.T, ends]))
    across, own = np.split(solved, [len(above)], axis=1)
    schur = _dense(upper.diagonals(above, 0.0)) - conductance @ across
    # The matrix of a floating network is singular. Adding a constant to all of its elements fixes the mean of
    # v without changing any voltage difference.
    schur += above.mean()
    z = np.linalg.inv(schur)
    between = across[:: lower.nodes] @ z  # (K, upper nodes): Z_lu
    z_kk = np.einsum("kk->k", own[:: lower.nodes]) + np.einsum("kn,kn->k", between, across[:: lower.nodes])
    z_uu = np.einsum("nn->n", z)[:: upper.nodes]
    pairs = z_uu[:, None] + z_kk - 2.0 * between[:, :: upper.nodes].T
    return np.asarray(pairs + upper.feed_ohm[:, None] + lower.feed_ohm)


def _driven(above: Float, upper: Side) -> Float:
    """Return the voltages (upper nodes, U) for 1 V at each driven wire, with all lower nodes grounded."""
    if upper.ideal:
        return upper.first()
    feed = 1.0 / upper.feed_ohm
    return _tridiagonal(upper.diagonals(above, feed), upper.first() * feed)


def _tridiagonal(diagonals: tuple[Float, Float], right: Float) -> Float:
    """Solve a symmetric positive definite tridiagonal system, with right-hand sides in columns."""
    diagonal, beside = diagonals
    if not beside.any():
        return np.asarray(right / diagonal[:, None])
    return np.asarray(scipy.linalg.solveh_banded(np.stack([beside, diagonal]), right, check_finite=False))


def _dense(diagonals: tuple[Float, Float]) -> Float:
    diagonal, beside = diagonals
    found = np.diag(diagonal)
    if beside.any():
        index = np.arange(len(diagonal) - 1)
        found[index, index + 1] = found[index + 1, index] = beside[1:]
    return found
