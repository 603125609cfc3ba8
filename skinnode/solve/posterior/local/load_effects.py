"""Effects of the loads on one frame's whitened data, computed for further cells as a search needs them."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import multiply, multiply_vector
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.posterior.local import discs as kernels
from skinnode.solve.posterior.local.discs import LOADS, Effects, Scratch
from skinnode.solve.posterior.map_estimate import MapEstimator

FARTHEST: Final = 4.7
"""Maximum distance between a place and the cells whose effects are computed for it, in cells. A disc that
needs loads at a greater distance is too wide to be used."""


class Room(NamedTuple):
    """Memory for the effects of up to Q cells on up to m data values."""

    gram: Float
    """(4Q, 4Q) products of the effects."""
    rows: Float
    """(4Q m,) effects."""

    @classmethod
    def of(cls, cells: int, data: int) -> Room:
        """Return memory for ``cells`` cells and ``data`` data values."""
        loads = LOADS * cells
        return cls(np.empty((loads, loads)), np.empty(loads * data))


class LoadEffects:
    """Effects of the loads on some cells, given the whitened data and the estimator's current factors.

    Args:
        estimator: MAP estimator of the patch.
        place: (Q, 2) row and column of each cell.
        response_t: (4Q, U f) displacement per unit load, in pitches.
        data: (m,) whitened data z.
        room: Memory for the effects; used until the next search.

    Attributes:
        cells: (n,) cells whose effects have been computed.
        rows_t: (4n, m) Bᵀ: effect of each load on the data.
        effects: Effects as used by the kernels.
    """

    def __init__(
        self, estimator: MapEstimator, place: Float, response_t: Float, data: Float, room: Room
    ) -> None:
        self._estimator, self._place, self._response_t = estimator, place, response_t
        self._data, self._room = data, room
        self._position = np.full(len(place), -1)  # of each cell in ``cells``; −1 if it is not among them
        self.cells: Index = np.arange(0)
        self.rows_t = np.empty((0, len(data)))
        self.effects = Effects(np.empty((0, 2)), room.gram, np.empty(0), 0.0)

    def near(self, places: Float, reach: Float, *, include: bool = True) -> Index:
        """Return the positions in :attr:`cells` of the cells within ``reach`` (P,) of ``places`` (P, 2).

        If ``include`` is true, the effects of loads on these cells are computed unless they are already
        known.
        """
        square = ((self._place[:, None] - places) ** 2).sum(axis=-1)
        near = np.flatnonzero((square <= np.minimum(reach, FARTHEST) ** 2).any(axis=1))
        fresh = near[self._position[near] < 0]
        if fresh.size and include:
            self._position[fresh] = self.cells.size + np.arange(fresh.size)
            self._add(fresh)
        positions = self._position[near]
        return positions[positions >= 0]

    def given(self, discs: Float, own: Index, scratch: Scratch) -> Effects:
        """Return the effects of the cells at positions ``own`` on what ``discs`` leave of the data."""
        effects, loads = self.effects, LOADS * own.size
        cross, gram, explained = np.empty((effects.match.size, loads)), *np.empty((2, loads, loads))
        match, known = np.empty((2, loads))
        count = kernels.whiten_by_discs(discs, effects, own, scratch, cross, gram, match)
        cross = cross[: max(count, 0)]
        cross_t = np.ascontiguousarray(cross.T)
        multiply(cross_t, cross, explained)
        multiply_vector(cross_t, scratch.vector[: len(cross)], known)
        gram -= explained
        match -= known
        strongest = float(np.exp(2.0 * discs[:, 3]).max())
        return Effects(effects.place[own], gram, match, strongest)

    def mean(self, discs: Float, scratch: Scratch) -> tuple[Float, float]:
        """Return the mean loads (4n,) for ``discs``, and their evidence."""
        q = np.empty(self.effects.match.size)
        return q, kernels.mean_loads(discs, self.effects, scratch, q)

    def response_t(self) -> Float:
        """Return the displacement (4n, U f) per unit load on :attr:`cells`, in pitches."""
        return np.asarray(self._response_t[_loads_of(self.cells)])

    def _add(self, fresh: Index) -> None:
        """Compute the effects of loads on the cells ``fresh``."""
        old, m, gram = len(self.rows_t), len(self._data), self._room.gram
        response = np.ascontiguousarray(self._response_t[_loads_of(fresh)].T)
        size = old + response.shape[1]
        rows, products = np.empty((m, response.shape[1])), np.empty((size, response.shape[1]))
        self._estimator.whiten(response, rows)
        self.cells = np.concatenate([self.cells, fresh])
        self.rows_t = self._room.rows[: size * m].reshape(size, m)
        self.rows_t[old:] = rows.T
        multiply(self.rows_t, rows, products)
        gram[:size, old:size], gram[old:size, :old] = products, products[:old].T
        match = np.empty(size)
        match[:old] = self.effects.match
        multiply_vector(self.rows_t[old:], self._data, match[old:])
        self.effects = Effects(self._place[self.cells], gram, match, 0.0)


def _loads_of(cells: Index) -> Index:
    """Return the indices of the loads of ``cells``."""
    return np.asarray((LOADS * cells[:, None] + np.arange(LOADS)).ravel())
