"""Moves the fields of a stream to the time at which the first upper wire of each scan was sampled.

A board samples the upper wires of a scan one after the other. While the skin moves, each wire of a solved
field therefore refers to a different time: wire u to time t + u τ, where t is the time of the scan and τ the
row time. The displacement x of a wire at the time t is interpolated between the last two scans, which sampled
the wire at t' + u τ and at t + u τ:

    x(t) ≈ (1 − f) x(t + u τ) + f x(t' + u τ),    f = u τ / (t − t')

Interpolation does not increase the noise. Fields are interpolated, not readings, because readings are not
linear in the displacement, and because a mixture of the readings before and after a jump does not correspond
to any displacement.

The error of the interpolation is estimated from Δ, the difference between the last scan and the line through
the two scans before it: Δ may be due to a jump or a change of speed at an unknown time between two scans
(:mod:`skinnode.solve.skew.interpolation`). Its variance, reduced by the part of Δ that the noise of the
fields explains, is added to that of the field.

The loads and contacts of the field are interpolated in the same way.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from skinnode.model.frames import FieldFrame, amended
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.skew.contact_skew import ContactScan, interpolated_contacts
from skinnode.solve.skew.interpolation import timing_variance


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """Last solution of each upper wire, and its time."""

    moved_m: Float
    """(U, N, 3) displacement, in m."""
    std_m: Float
    """(U, N, 3) standard deviation, in m; 0 if the wire has no usable solution."""
    core_m: Float
    """(U, N, 3) standard deviation without the allowance for large errors of the prior, in m."""
    force_n: Float
    """(U, N, 3) loads, in N; 0 if they are not estimated."""
    t_ns: NDArray[np.int64]
    """(U, 1, 1) time of the scan, in ns."""
    known: NDArray[np.bool_]
    """(U, 1, 1) mask of the wires with a usable solution."""

    @classmethod
    def of(cls, field: FieldFrame, t_ns: int) -> Self:
        """Return the solution of a field. If its readings contradict each other, no wire is known."""
        moved, std, core = field.displacement_m, field.displacement_std_m, field.core_std_m
        known = np.asarray(np.isfinite(std).all(axis=(1, 2), keepdims=True))
        if field.wires_trusted is not None and not field.wires_trusted.any():
            known = np.zeros_like(known)
        if not known.all():
            std = np.where(known, std, 0.0)
            core = None if core is None else np.where(known, core, 0.0)
        force = np.zeros_like(moved) if field.force_n is None else field.force_n
        return cls(moved, std, std if core is None else core, force, np.full(known.shape, t_ns), known)

    def replaced(self, new: Self, wires: NDArray[np.bool_]) -> Self:
        """Return the solution ``new`` of the wires in the mask (U, 1, 1), and this one of the others."""
        if wires.all():
            return new
        return type(self)(
            *(
                np.where(wires, getattr(new, each.name), getattr(self, each.name))
                for each in dataclasses.fields(self)
            )
        )


class ScanSkew:
    """Last two fields of a patch, used to interpolate the next field.

    Each stream needs its own instance.

    Args:
        layout: The patch.
        row_time_s: Time between the samples of successive upper wires, in s.
        period_s: Time between two frames whose times are not given, in s.

    Raises:
        ValueError: If the upper wires cannot be sampled within the period.
    """

    def __init__(self, layout: PatchLayout, row_time_s: float, period_s: float) -> None:
        wires = layout.shape[0]
        if wires * row_time_s > (1.0 + 1e-9) * period_s:  # a limit computed from microseconds is rounded
            raise ValueError(
                f"row_time_s: got {row_time_s}, must be at most {period_s / wires:g}, because {wires} upper "
                f"wires must be sampled within scan_period_s = {period_s:g}"
            )
        self._layout = layout
        self._late_ns: Float = 1e9 * row_time_s * np.arange(wires, dtype=np.float64)[:, None, None]
        self._period_ns = round(1e9 * period_s)
        self.reset()

    def reset(self) -> None:
        """Forget all fields. The next field is returned unchanged."""
        self._last: _Solved | None = None
        self._before: _Solved | None = None
        self._contacts: tuple[ContactScan, ...] = ()  # of the last two fields
        self._now_ns = 0
        self._given_ns: int | None = None  # time of the last frame, as given

    def at_first_wire(self, field: FieldFrame, t_ns: int | None) -> FieldFrame:
        """Return a field at the time at which the first upper wire was sampled.

        A wire is left unchanged if it has no solution in this field or no earlier solution. The field of a
        patch at rest is left unchanged, as is a field that contradicts its readings.

        Args:
            field: Next field of the stream, in which each upper wire belongs to its own time.
            t_ns: Time of the frame on any monotonic clock, ns; None if unknown.
        """
        now_ns = self._advance(t_ns)
        new, last, before = _Solved.of(field, now_ns), self._last, self._before
        scan, scans = ContactScan(now_ns, field.contacts), self._contacts
        self._last = new if last is None else last.replaced(new, new.known)
        self._before = last if before is None or last is None else before.replaced(last, new.known)
        if new.known.any():  # otherwise, the field says nothing about contacts
            self._contacts = (scan, *scans[:1])
        if last is None or not (new.known.any() and new.moved_m.any()) or _is_still(new, last, before):
            return field
        field = _interpolated(field, new, last, last if before is None else before, self._late_ns)
        if not field.contacts:
            return field
        return amended(field, contacts=interpolated_contacts(self._layout, self._late_ns, scan, scans))

    def _advance(self, t_ns: int | None) -> int:
        """Return the time of the next frame, in ns; without given times, one period after the last frame."""
        given, self._given_ns = self._given_ns, t_ns
        self._now_ns += self._period_ns if t_ns is None or given is None else t_ns - given
        return self._now_ns


def _is_still(new: _Solved, last: _Solved, before: _Solved | None) -> bool:
    """Return whether no wire has moved in the last two scans."""
    return all(
        each is None or each.moved_m is new.moved_m or np.array_equal(each.moved_m, new.moved_m)
        for each in (last, before)
    )


def _interpolated(
    field: FieldFrame, new: _Solved, last: _Solved, before: _Solved, late_ns: Float
) -> FieldFrame:
    """Return a field without its contacts, interpolated to the time of the first upper wire.

    Args:
        field: The field.
        new: Solution of the field.
        last: Solution of each wire before ``new``.
        before: Solution of each wire before ``last``.
        late_ns: (U, 1, 1) time between the samples of the first wire and of each wire, in ns.
    """
    interval, earlier = new.t_ns - last.t_ns, last.t_ns - before.t_ns
    known = new.known & last.known & (interval > 0)
    f = np.where(known, np.minimum(late_ns / np.maximum(interval, 1), 1.0), 0.0)
    ratio = np.where(before.known & (earlier > 0), interval / np.maximum(earlier, 1), 0.0)
    change = new.moved_m - last.moved_m
    off2 = (change - ratio * (last.moved_m - before.moved_m)) ** 2
    noise2 = new.std_m**2 + ((1.0 + ratio) * last.std_m) ** 2 + (ratio * before.std_m) ** 2
    unexplained = _unexplained(off2, noise2)
    timing_m = np.sqrt(timing_variance(f) * unexplained * off2)
    changed = np.broadcast_to(f > 0.0, change.shape)

    def widened(std_m: Float, own_m: Float, last_m: Float) -> Float:
        return np.where(changed, np.hypot((1.0 - f) * own_m + f * last_m, timing_m), std_m)

    force, core = field.force_n, field.core_std_m
    return amended(
        field,
        displacement_m=new.moved_m - f * change,
        displacement_std_m=widened(field.displacement_std_m, new.std_m, last.std_m),
        core_std_m=None if core is None else widened(core, new.core_m, last.core_m),
        force_n=None if force is None else new.force_n - f * (new.force_n - last.force_n),
    )


def _unexplained(off2: Float, noise2: Float) -> float:
    """Return the fraction (0 to 1) of the squared deviations that noise does not explain.

    The wire with the largest deviations determines the result for the whole patch. If it has changed its
    speed, the deviations of the other wires are considered real, even if they are as small as their noise.

    Args:
        off2: (U, N, 3) squared deviations of the last scan from a line, in m².
        noise2: (U, N, 3) variances of these deviations due to noise, in m²; 0 for coordinates that are fixed.
    """
    uncertain = noise2 > 0.0
    ratio = np.where(uncertain, off2 / np.where(uncertain, noise2, 1.0), 0.0)
    excess = ratio.sum(axis=(1, 2)) / np.maximum(uncertain.sum(axis=(1, 2)), 1)
    return 1.0 - 1.0 / max(float(excess.max()), 1.0)
