"""Tracker that estimates the displacement field of a patch for each frame of a live stream.

The ``exact`` method solves each upper wire separately. The ``posterior`` method estimates the whole patch at
once, using an elastic prior. The default method, ``auto``, selects ``exact`` if the noise is low enough, and
``posterior`` otherwise. The posterior also checks doubtful roots found by the exact method
(:mod:`skinnode.solve.root_gate`).

Before a frame is solved, a detector decides whether the patch is touched (:mod:`skinnode.solve.detect`). An
untouched patch is not solved.

The tracker estimates the noise of the stream and corrects the stated noise
(:mod:`skinnode.solve.noise_estimate`). With ``auto``, the tracker changes the method when the estimated noise
crosses the limit for ``exact``. The new method starts at the rest position.

If the noise is 1e-4 or more, the posterior also uses the readings of earlier frames
(:mod:`skinnode.solve.posterior.past`), but no readings from before an untouched frame or a gap in the stream.

Finally, if the upper wires are sampled one after the other, the field of a moving skin is moved to the time
of the first wire (:mod:`skinnode.solve.skew`). All solvers and tests use the fields as solved, before this
step.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.frames import FieldFrame, amended
from skinnode.model.layout import Float, PatchLayout, require_array
from skinnode.process.clock import perf_counter
from skinnode.solve.checks.data_check import DataCheck
from skinnode.solve.checks.linearised_readings import Solved
from skinnode.solve.cramer_rao import patch_std
from skinnode.solve.detect.rest_gate import RestGate
from skinnode.solve.exact.contacts import ExactContacts
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.inputs import CodeDecoder, CodeMap, broadcast_noise, checked_codes, checked_mask
from skinnode.solve.noise_estimate import NoiseEstimate
from skinnode.solve.options import TrackerArguments, TrackerOptions, merged
from skinnode.solve.posterior.posterior import Posterior
from skinnode.solve.precision import is_precise, limits_of
from skinnode.solve.root_gate import RootGate
from skinnode.solve.skew.scan_skew import ScanSkew
from skinnode.solve.wires.problem import PatchProblem

NO_CODE: Final = np.uint32(0xFFFF_FFFF)
"""Invalid code that replaces the code of a reading to be ignored; converters never send it."""
EXACT_STD: Final = 0.0025
"""RMS standard deviation of the exact inverse at rest, in clearances, up to which ``auto`` selects ``exact``.

With 16-bit codes, the standard deviation is 0.0005 on the staggered layout with h = 0.5, and 0.05 on the
aligned layout.
"""
GAP_NS: Final = 2_000_000_000
"""Interval between two frames, in ns, above which frames before the gap are not used."""
GAP_PERIODS: Final = 1.5
"""Minimum length of such a gap, in scan periods."""


class Tracker:
    """Estimates the displacement field of one patch for each frame of a stream.

    Each patch needs its own tracker. The constructor compiles the kernels, which release the GIL.

    Args:
        layout: The patch.
        options: Options of the tracker; default: ``TrackerOptions()``.
        **arguments: Individual options, which take precedence over ``options``.

    Attributes:
        layout: The patch.
        options: Options in effect.
        method: Method in use, ``exact`` or ``posterior``. With ``auto``, it can change during a stream.
        reason: Short explanation of why this method is in use.
        t_ns: Time of the next frame on any monotonic clock, in ns. After a gap in the stream, the detector
            allows for drift in the meantime, and no earlier frames are used; if None (the default), gaps and
            lost frames are not noticed.

    Raises:
        ValueError: If an option has the wrong shape or is out of range.
    """

    def __init__(
        self,
        layout: PatchLayout,
        options: TrackerOptions | None = None,
        **arguments: Unpack[TrackerArguments],
    ) -> None:
        self.options = options = merged(TrackerOptions, options, arguments)
        self.layout = layout
        self.method, self.reason = self._chosen = choose_method(layout, options)
        self.t_ns: int | None = None
        self._last_ns: int | None = None
        self._gap_ns = max(GAP_NS, round(1e9 * GAP_PERIODS * options.scan_period_s))
        self._limits = limits_of(layout, options)
        self._exact: ExactTracker | None = None
        self._contacts: ExactContacts | None = None
        self._rest = RestGate(layout, options) if options.detect else None
        self._skew: ScanSkew | None = None
        if options.row_time_s:
            self._skew = ScanSkew(layout, options.row_time_s, options.scan_period_s)
        self._decoder = None if options.codes is None else CodeDecoder(options.codes)
        self._stated = broadcast_noise(options.relative_noise, layout)
        self._stated_of_codes = (
            self._stated if options.codes is None else broadcast_noise(options.codes.relative_noise, layout)
        )
        if self.method == "posterior":
            self._posterior = Posterior(layout, options.of_posterior())
            return
        # This posterior checks roots in only some of the frames, too few to estimate the noise; it uses the
        # noise estimate of the exact tracker.
        self._posterior = Posterior(layout, dataclasses.replace(options.of_posterior(), follow_noise=False))
        self._noise = NoiseEstimate(layout.shape) if options.follow_noise else None
        self._factor = 1.0  # noise factor for which the method and the root check are configured
        self._exact = ExactTracker(
            layout,
            operator=options.operator,
            relative_noise=options.relative_noise,
            baseline_ohm=options.baseline_ohm,
            stiffness_n_per_m=options.stiffness_n_per_m,
            hold=options.hold,
            deadline_us=options.deadline_us,
            normal_only=options.normal_only,
            active_only=options.active_only,
            codes=options.codes,
            noise_estimate=self._noise,
        )
        self._gate = RootGate(self._exact, self._posterior, options)
        self._problem = PatchProblem.of(layout, options.baseline_ohm)
        sigma = float(np.median(np.asarray(options.relative_noise, np.float64)))
        self._check = DataCheck(self._problem, sigma)
        if options.contacts:
            self._contacts = ExactContacts(layout, options)
            self._exact.untouched_force_n = self._contacts.no_force_n
        self.reset()

    def prepare(self) -> None:
        """Compute the tables that would otherwise delay the first frames of a touch by up to 0.1 s.

        For the reference patch, this takes 0.6 s and 200 MB. Trackers of the same layout share the tables.
        The host calls this method before it starts the nodes.
        """
        self._posterior.check.prepare()
        if self._rest is not None:
            self._rest.detector.prepare()

    def reset(self) -> None:
        """Discard the state of the stream; the solve of the next frame starts at the rest position."""
        self._posterior.reset()
        if self._rest is not None:
            self._rest.reset()
        if self._skew is not None:
            self._skew.reset()
        if self._exact is None:
            self._follow_noise()
            return
        self._exact.reset()
        self._gate.reset()
        self._check.reset()
        if self._contacts is not None:
            self._contacts.reset()
        if self._noise is not None:
            self._noise.reset()
        self._follow_noise()

    def update(
        self, frame_ohm: ArrayLike, valid: ArrayLike | None = None, relative_noise: ArrayLike | None = None
    ) -> FieldFrame:
        """Compute the displacement field of one frame.

        Invalid resistances do not raise an exception. A wire that cannot be solved keeps its last trusted
        position, with an infinite standard deviation and a status other than CONVERGED.

        Args:
            frame_ohm: (U, K) resistances, in ohms; values that are not positive and finite are ignored.
            valid: (U, K) bool: False for missing readings; default: all True.
            relative_noise: Relative standard deviation of the resistances of this frame, a number or (U, K);
                default: the ``relative_noise`` option. A resistance is ignored if its standard deviation is
                not positive and finite.

        Returns:
            The field, with one status per wire.

        Raises:
            ValueError: If an argument has the wrong shape.
        """
        start = perf_counter()
        self._note_gap()
        if self._rest is not None:
            ohm = require_array("frame_ohm", frame_ohm, self.layout.shape, finite=False)
            mask = None if valid is None else checked_mask(valid, self.layout)
            noise = None if relative_noise is None else broadcast_noise(relative_noise, self.layout)
            rest = self._at_rest(ohm, mask, noise)
            if rest is not None:
                return self._at_one_time(rest)
        if self._exact is None or self.method == "posterior":
            field = self._posterior.update(frame_ohm, valid, relative_noise)
        else:
            field = self._exact.update(frame_ohm, valid, relative_noise, self._check.left_out)
            field = self._gate.check(field, start)
            field = self._checked(field, self._exact.arrays.ohm, start)
        return self._finished(field)

    def update_codes(self, codes: NDArray[np.uint32]) -> tuple[FieldFrame, int]:
        """Compute the displacement field of a scan from its codes.

        This method is faster than decoding the codes and calling :meth:`update`.

        Args:
            codes: (U, K) uint32 codes; the ``codes`` option maps them to resistances.

        Returns:
            The field, and the number of invalid codes.

        Raises:
            ValueError: If ``codes`` has the wrong shape or type, or the ``codes`` option is not set.
        """
        start, meaning = perf_counter(), self.options.codes
        if meaning is None:
            raise ValueError("codes: got None, must be a CodeMap passed to the constructor")
        self._note_gap()
        if self._rest is not None:
            assert self._decoder is not None  # the ``codes`` option is set
            ohm, _, invalid = self._decoder.decode(checked_codes(codes, self.layout))
            rest = self._at_rest(ohm, None, None, meaning)  # invalid codes are NaN
            if rest is not None:
                return self._at_one_time(rest), invalid
        if self._exact is None or self.method == "posterior":
            ohm, valid = meaning.decode(checked_codes(codes, self.layout))
            noise, rounding_ohm = meaning.relative_noise, meaning.rounding_ohm
            field = self._posterior.update(ohm, valid, noise, rounding_ohm)
            invalid = valid.size - int(np.count_nonzero(valid))
        else:
            left_out, sent = self._check.left_out, codes
            if left_out is not None:
                sent = np.where(left_out, NO_CODE, checked_codes(codes, self.layout))
            field = self._gate.check(self._exact.update_codes(sent), start)
            invalid = self._exact.invalid_codes
            if left_out is None:
                field = self._checked(field, self._exact.arrays.ohm, start)
            else:
                ohm, valid = meaning.decode(codes)
                invalid -= int(np.count_nonzero(left_out & valid))
                field = self._checked(field, ohm, start, left_out & valid)
        return self._finished(field), invalid

    @property
    def scan(self) -> int | None:
        """Scan number of the next frame, for ``DataFault.since``; if None, frames are counted instead."""
        return self._posterior.check.scan

    @scan.setter
    def scan(self, number: int | None) -> None:
        self._posterior.check.scan = number
        if self._exact is not None:
            self._check.scan = number

    def _note_gap(self) -> None:
        """Forget the frames before a gap in the stream."""
        now, last = self.t_ns, self._last_ns
        self._last_ns = now
        if now is not None and last is not None and not 0 <= now - last <= self._gap_ns:
            self._posterior.forget_past()
            if self._contacts is not None:
                self._contacts.forget()
            if self._skew is not None:
                self._skew.reset()

    def _at_rest(
        self, ohm: Float, valid: NDArray[np.bool_] | None, noise: Float | None, codes: CodeMap | None = None
    ) -> FieldFrame | None:
        """Pass a frame to the detector; return its field if it need not be solved, otherwise None."""
        assert self._rest is not None
        exact = self._exact is not None and self.method == "exact"
        check = self._check if exact else self._posterior.check
        self._rest.t_ns = self.t_ns
        field = self._rest.see(ohm, valid, noise, check.left_out)
        if field is None:
            return None
        check.pass_frame()
        self._posterior.forget_past()  # the next touch need not resemble the last
        if self._contacts is not None:
            self._contacts.forget()
        stated = noise
        if stated is None:
            stated = self._stated if codes is None else self._stated_of_codes
        rounding_ohm = None if codes is None else codes.rounding_ohm
        if not exact:
            self._posterior.see_noise(ohm, stated, rounding_ohm, valid)
        elif self._noise is not None:
            self._noise.see(ohm, stated, rounding_ohm, valid)
        self._follow_noise()
        return field

    def _finished(self, field: FieldFrame) -> FieldFrame:
        """Return the field of a solved frame at one time, with ``precise`` and the detector's results."""
        self._follow_noise()
        field = self._judged(field)
        return self._at_one_time(field if self._rest is None else self._rest.add(field))

    def _at_one_time(self, field: FieldFrame) -> FieldFrame:
        """Return a field at the time at which the first upper wire was sampled, if this option is set."""
        if self._skew is None:
            return field
        moved = self._skew.at_first_wire(field, self.t_ns)
        if moved is field:
            return field
        return amended(moved, precise=is_precise(moved, self._limits))

    def _checked(
        self, field: FieldFrame, ohm: Float, start: float, unsent: NDArray[np.bool_] | None = None
    ) -> FieldFrame:
        """Test the readings of an exact field; return the field with its data faults and trust attributes.

        Args:
            field: The field.
            ohm: (U, K) resistances, in ohms.
            start: Start of the update, as a value of :func:`skinnode.process.clock.perf_counter`, in s.
            unsent: (U, K) mask of valid readings that the solver did not receive, and whose noise it
                therefore does not know; None if there are none.
        """
        exact = self._exact
        assert exact is not None
        its = exact.arrays
        a = ohm * self._problem.gain

        def solved(field: FieldFrame) -> Solved:
            noise = its.noise
            if unsent is not None:
                noise = np.where(unsent, self._factor * self._stated_of_codes, noise)
            return Solved(field, a, noise, its.used > 0)

        def solve_without(left_out: NDArray[np.bool_]) -> Solved:
            return solved(self._gate.check(exact.update_again(left_out), perf_counter(), again=True))

        until = -math.inf if self._gate.hurried else start + self.options.deadline_s
        return self._check.check(solved(field), solve_without, until)

    def _judged(self, field: FieldFrame) -> FieldFrame:
        """Return the field with ``precise`` set and, for the exact method, with its contacts."""
        if field.method == "exact" and self._contacts is not None:
            field = self._contacts.add(field)
        return field if is_precise(field, self._limits) else amended(field, precise=False)

    def _follow_noise(self) -> None:
        """Reconfigure the tracker if the noise estimate has changed."""
        if self._exact is not None and self._noise is not None and self._noise.factor != self._factor:
            self._adapt(self._noise)
        noise = self._posterior.noise_estimate if self._exact is None else self._noise
        if self._rest is not None and noise is not None:
            self._rest.set_noise_factor(noise.factor)

    def _adapt(self, noise: NoiseEstimate) -> None:
        """Set the method and the thresholds of the root check for the estimated noise."""
        assert self._exact is not None
        self._factor = noise.factor
        self._gate.set_noise(noise.factor)
        method, reason = self._chosen
        if self.options.method == "auto" and noise.factor != 1.0:
            actual = np.multiply(noise.factor, self.options.relative_noise)
            method, reason = choose_method(
                self.layout, dataclasses.replace(self.options, relative_noise=actual)
            )
            reason = f"the noise is {noise.factor:.2g} times the stated noise; {reason}"
        changed, self.method, self.reason = method != self.method, method, reason
        if changed and method == "posterior":
            self._posterior.reset()
            self._posterior.stop_at(math.inf)  # the deadline of the last root check has passed
            self._posterior.noise_estimate = noise
        elif changed:
            self._posterior.noise_estimate = None
            self._exact.reset()
            self._gate.reset()
            self._check.reset()
            if self._contacts is not None:
                self._contacts.reset()


def choose_method(layout: PatchLayout, options: TrackerOptions) -> tuple[str, str]:
    """Return the method for a tracker, ``exact`` or ``posterior``, and the reason for this choice.

    Raises:
        ValueError: If the requested method does not support an option that is set.
    """
    nuisances, normal_only = options.nuisances, options.normal_only
    if options.method != "auto":
        refused = nuisances or ["prior 'discs'"] * (options.prior == "discs")
        if options.method == "exact" and refused:
            raise ValueError(f"method: got 'exact' with {refused[0]}, must be posterior or auto")
        return options.method, "requested"
    if nuisances:
        return "posterior", f"{' and '.join(nuisances)} requested"
    unknowns = layout.unknowns // 3 if normal_only else layout.unknowns
    if layout.shape[1] < unknowns:
        return "posterior", f"{layout.shape[1]} lower wires for {unknowns} unknowns per upper wire"
    share = patch_std(layout, options.relative_noise, normal_only)
    chosen = "exact" if share <= EXACT_STD else "posterior"
    return chosen, (
        f"with this noise, the exact inverse has a standard deviation of {100 * share:.2g} % of the "
        f"clearance between the layers at rest; the limit is {100 * EXACT_STD:g} %"
    )
