"""Finds the contacts in displacement fields of the exact inverse.

:mod:`skinnode.solve.exact.load_fit` computes the loads that explain a field. Wires without a position, or
with a much larger standard deviation than the other wires, are left out.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import numpy as np

from skinnode.compiled.jit import njit
from skinnode.model.frames import Contact, FieldFrame, amended
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status
from skinnode.process.clock import perf_counter
from skinnode.solve.exact.load_fit import LoadFit
from skinnode.solve.linalg.vectors import Index
from skinnode.solve.options import TrackerOptions
from skinnode.solve.posterior.contacts import ContactFinder

UNTOUCHED: Final = 4.0
"""Maximum displacement, in standard deviations, of a patch that is considered untouched.

Noise alone exceeds this limit in 2 % of frames, which are then searched for contacts.
"""
PATIENCE: Final = 4
"""Number of successive interrupted fields after which contacts are computed although the deadline has passed.
Computing them from a few wires takes up to 7 ms."""
WILD: Final = 16.0
"""Ratio of a wire's variance to the median of all wires, above which the wire is left out. All variances are
relative to their values at rest."""


class ExactContacts:
    """Estimates the contacts in a stream of exact fields; each stream needs its own instance.

    Args:
        layout: The patch.
        options: Options of the tracker.
    """

    def __init__(self, layout: PatchLayout, options: TrackerOptions) -> None:
        self.layout = layout
        self._fit = LoadFit(layout, options)
        factors = self._fit.factors
        self._finder = ContactFinder(
            factors.prior,
            layout,
            options.rubber,
            calibrated=options.force_calibrated,
            outermost=False,
        )
        self._moved = np.empty(factors.free.size)
        self._stiff = options.stiffness_n_per_m is not None
        self._field = np.empty((2, layout.upper_m.size))
        self._ratio, self._sorted = np.empty((2, layout.upper_m.shape[0]))
        self._no_contacts: tuple[Contact, ...] = ()
        self.no_force_n = np.zeros(layout.upper_m.shape)
        """(U, N, 3) zero forces of an untouched patch, in N; read-only."""
        self.no_force_n.setflags(write=False)
        self._wire = factors.free // (3 * layout.upper_m.shape[1])
        self.reset()
        solved = np.full(self._moved.size, 1e-3)
        self._finder.warm_up(self._fit.fit(solved, 1.0))
        # The following two calls compile the kernels before a stream starts.
        self._find(np.zeros(layout.upper_m.shape), np.ones(layout.upper_m.shape))
        self._fit.fit_without(solved, 1.0, self._wire == 0)
        self.reset()

    def reset(self) -> None:
        """Discard the state of the stream."""
        self._finder.reset()
        self._fit.reset()
        self.forget()
        self._interrupted = 0  # number of successive fields that the deadline interrupted

    def forget(self) -> None:
        """Forget the contacts of the previous field, so that an interrupted field does not repeat them."""
        self._force, self._contacts, self._known = self.no_force_n, self._no_contacts, False

    def add(self, field: FieldFrame) -> FieldFrame:
        """Return the field with its contacts and, unless the ``stiffness_n_per_m`` option is set, its forces.

        Wires with an infinite standard deviation are ignored. If every wire is ignored, there are no contacts
        and all forces are zero. If the deadline interrupted the solver, there is no time to compute contacts,
        and the field has the contacts and forces of the previous field. In every :data:`PATIENCE`-th such
        field in succession, they are computed from the solved wires regardless.

        Args:
            field: Field of the exact method, after its roots and readings have been checked.
        """
        start = perf_counter()
        held = field.held is not None and bool(field.held.all())
        self._interrupted = self._interrupted + 1 if Status.DEADLINE in field.status else 0
        if self._interrupted % PATIENCE:
            self._known = False
        elif not (held and self._known):
            self._force, self._contacts = self._find(field.displacement_m, field.displacement_std_m)
            self._known = True
        if not self._contacts and (self._stiff or self._force is field.force_n):
            return field
        force, contacts = self._force, self._contacts
        stats = dataclasses.replace(field.stats, time_s=field.stats.time_s + perf_counter() - start)
        if self._stiff:
            return amended(field, contacts=contacts, stats=stats)
        return amended(field, contacts=contacts, force_n=force, stats=stats)

    def _find(self, displacement_m: Float, std_m: Float) -> tuple[Float, tuple[Contact, ...]]:
        np.copyto(self._field[0], displacement_m.ravel())
        np.copyto(self._field[1], std_m.ravel())
        factors = self._fit.factors
        largest, level, wild = _judge(
            self._field, factors.free, factors.rest_std, self.layout.pitch_m, self._moved, self._ratio,
            self._sorted,
        )  # fmt: skip
        if not largest > UNTOUCHED:  # untouched, or all standard deviations are infinite
            self._finder.reset()
            return self.no_force_n, ()
        if wild:
            left_out = ~(self._ratio <= WILD * level)
            loads = self._fit.fit_without(self._moved, level, left_out[self._wire])
            std_m = np.where(left_out[:, None, None], np.inf, std_m)
        else:
            loads = self._fit.fit(self._moved, level)
        return self._finder.find(loads, displacement_m, std_m)


@njit
def _judge(  # noqa: PLR0913 - a kernel: field, factors and outputs by name
    field: Float,
    free: Index,
    rest_std: Float,
    pitch: float,
    moved: Float,
    ratio: Float,
    ordered: Float,
) -> tuple[float, float, bool]:
    """Find the largest displacement in a field and the wires with unusually large standard deviations.

    Args:
        field: (2, 3UN) displacements and their standard deviations, in m.
        free: (n,) indices of the free coordinates.
        rest_std: (n,) standard deviations of the free coordinates at rest, in pitches.
        pitch: Pitch, in m.
        moved: (n,) output: displacements of the free coordinates, in pitches.
        ratio: (U,) output: each wire's mean ratio of a variance to the variance at rest; inf if a variance is
            infinite.
        ordered: (U,) work array.

    Returns:
        The largest displacement, in standard deviations; the median of the finite ratios; and True if any
        wire's ratio exceeds :data:`WILD` times the median.
    """
    largest, each, known = 0.0, free.size // ratio.size, 0
    for u in range(ratio.size):
        ratio[u] = 0.0
        for j in range(u * each, (u + 1) * each):
            at, std = field[0, free[j]], field[1, free[j]]
            moved[j] = at / pitch
            if std > 0.0:
                largest = max(largest, abs(at) / std)
            ratio[u] += (std / (pitch * rest_std[j])) ** 2 / each
        if ratio[u] < math.inf:
            place = known
            while place > 0 and ordered[place - 1] > ratio[u]:
                ordered[place] = ordered[place - 1]
                place -= 1
            ordered[place] = ratio[u]
            known += 1
    if known == 0:
        return 0.0, 1.0, True
    level, wild = ordered[known // 2], False
    for u in range(ratio.size):
        wild = wild or not ratio[u] <= WILD * level
    return largest, level, wild
