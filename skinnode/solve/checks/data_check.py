"""Data check: finds the readings that contradict the others and decides whether to trust the field.

Each frame is first solved with all readings except those with a confirmed fault. The check linearises the
readings about rest and tests them with :mod:`skinnode.solve.checks.reading_model`. If a reading or a whole
wire contradicts the others, the frame is solved again without it. The check stops when no contradiction
remains, or when :data:`ROUNDS` groups of readings have been left out.

Fields of the exact inverse are tested a second time: the change since the last complete field
(:mod:`skinnode.solve.checks.last_field`) must also be consistent with a load.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.data_fault import FaultKind, FaultyPart
from skinnode.model.frames import FieldFrame, amended
from skinnode.model.status import Status
from skinnode.process.clock import perf_counter
from skinnode.solve.checks.examination_time import ExaminationTime
from skinnode.solve.checks.explanations import CLEAR, DOUBT, Explainer, Group
from skinnode.solve.checks.fault_list import FaultList, agree
from skinnode.solve.checks.field_trust import CONTRADICTION, NOISIER, OF_WIRE, UNEXAMINED, assess
from skinnode.solve.checks.last_field import LastField
from skinnode.solve.checks.linearised_readings import Gains, LinearisedReadings, Solved
from skinnode.solve.wires.problem import PatchProblem

ROUNDS: Final = 3
"""Maximum number of groups of readings left out of a frame. Once the limit is reached, the frame is not
solved again."""
SUSPICIOUS: Final = 5.0
"""Gain in log evidence from assuming a fault, in nats, above which a frame is suspicious. The check examines
suspicious frames: it searches for the most likely explanation of their readings."""
EXCUSED: Final = 10.0
"""Amount (nats) by which a frame's gain may exceed that of an examined frame for the two to be considered
similar."""
EXCUSED_FRAMES: Final = 8
"""Number of frames for which the result of an examination also applies to similar frames. An examination
takes about as long as solving and testing two other frames."""
SUSPICIOUS_CHANGE: Final = 20.0
"""Gain in log evidence from assuming that one reading is wrong, in nats, above which the change since the
last field is suspicious. Of 660 frames of moving loads at noise 1e-5, 1.4 % exceeded this limit, under an
edge or a sphere. Of 12 wrong readings that displaced an electrode by more than 12 standard deviations, 10
exceeded it."""
CROSSED_FRAMES: Final = 5
"""Number of frames for which a crossed pair is remembered. If either of its wires is found to be faulty again
within this time, both wires are reported."""
RELINEARISED: Final = 50.0
"""Gain in log evidence from assuming one wrong reading, in nats, above which a frame that loads seem to
explain is linearised again about the field computed without that reading. A field computed from a grossly
wrong reading can be so far off that the linearised readings of its whole wire appear to be caused by loads.
The gain was at most 37 nats in 3,000 healthy frames (``bench trust --seed 1``); in longer streams, a few
narrow presses exceed the limit."""
RELINEARISED_MARGIN: Final = 200.0
"""Minimum margin, in nats, for a fault found by linearising about the field without the suspected reading.
Without the reading, a narrow load is smoothed: in 1.2 million healthy frames at noise 1e-5, the margin
reached 91 nats in six frames; for grossly wrong readings, it was 480 to 6,042 nats (``bench trust --seed
1``)."""
UNRESOLVED_FRAMES: Final = 10
"""Number of frames after an unexplained contradiction during which a gain above :data:`RELINEARISED` makes a
frame doubtful, even if loads seem to explain it."""
COARSE_GROUPS: Final = 3
"""Maximum number of groups of readings left out at once if several upper wires have no solution. If the
search finds more groups, only the first is left out."""
UNSOLVED: Final = 1
"""Maximum number of upper wires without a solution that are reported as faulty. If there are more, none is
reported, because the cause may be a lower wire."""
SPARED: Final = 3
"""Maximum number of upper wires left out by the solver that are reported as faulty. If there are more, none
is reported."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Excuse:
    """Result of examining a suspicious frame that loads clearly explain; it also covers similar frames."""

    gain: float = -math.inf
    """Gain in log evidence from assuming a fault, in nats."""
    where: int = -1
    """Index of the suspected reading."""
    until: int = 0
    """Number of the first frame that is not covered."""

    def covers(self, frame: int, gain: float, where: int) -> bool:
        """Return whether a frame with this number, gain and suspected reading need not be examined."""
        return frame < self.until and gain < self.gain + EXCUSED and where == self.where


class DataCheck:
    """Checks the readings of one patch frame by frame. Each stream needs its own instance.

    Args:
        problem: The patch.
        sigma: Typical relative noise of a reading, for :meth:`prepare`.
        model_std: Standard deviation of the forward model's error, relative to the largest change in a
            reading; 0 if the patch matches its layout exactly.
        noise_varies: Whether each frame has its own noise factor, so that a change says nothing about faults.
        drift: Expected gain errors, which are not reported as faults: ``none``, ``patch`` (one error for the
            patch) or ``wire`` (one for each upper wire).

    Attributes:
        scan: Scan number of the next frame, to be reported with its faults. If None, faults are reported with
            the number of frames checked so far.
    """

    def __init__(
        self,
        problem: PatchProblem,
        sigma: float,
        model_std: float = 0.0,
        drift: str = "none",
        *,
        noise_varies: bool = False,
    ) -> None:
        self._sigma, self._noise_varies = sigma, noise_varies
        self._readings = LinearisedReadings(problem, model_std, drift)
        self._explainer = Explainer(self._readings.model)
        self._time = ExaminationTime()
        shape = self._shape = problem.layout.shape
        self._list = FaultList(shape)
        self._last_field = LastField((shape[0], 3 * problem.layout.upper_m.shape[1]))
        self._all_converged = (Status.CONVERGED,) * shape[0]
        self._all_trusted = np.ones(shape[0], bool)
        self._all_trusted.setflags(write=False)
        self.scan: int | None = None
        self._readings.compile()
        self._explain(-math.inf)  # compiles the kernels
        self._time = ExaminationTime()
        self.reset()

    def prepare(self) -> None:
        """Compute the tables in advance, so that the first suspicious frames of a stream are not delayed."""
        self._readings.model.prepare(self._sigma)

    def reset(self) -> None:
        """Discard the state of the stream, including all faults."""
        self._list.reset()
        self._frame, self._doubtful, self._noisy = 0, False, False
        self._lead = 0.0  # gain from assuming more noise if the last frame was noisy, nats; otherwise 0
        self._excused = self._excused_change = Excuse()
        self._last_field.forget()
        self._suspect: int | None = None  # reading of the frame that is very likely to be wrong
        self._crossed: tuple[Group, ...] = ()
        self._crossed_until = self._unresolved_until = 0
        self._last: FieldFrame | None = None
        self._unexamined = False
        # a frame and its gains, if the linearised readings still describe it or it needs no explanation
        self._tested: tuple[Solved, Gains] | None = None
        self._time.reset()
        # gain, suspected reading and number of the last examined frame that had no fault
        self._faultless = 0.0, -1, -EXCUSED_FRAMES

    @property
    def left_out(self) -> Mask | None:
        """(U, K) mask of the readings to leave out of the next frame; None if there are none."""
        return self._list.mask

    def pass_frame(self) -> None:
        """Count a frame that is not checked because the patch is untouched."""
        self._frame += 1
        self._last_field.forget()

    def check(
        self, solved: Solved, solve_without: Callable[[Mask], Solved], until: float = math.inf
    ) -> FieldFrame:
        """Check the readings of a frame; return its field with the faults found and the trust decision.

        If readings are found to be wrong, the returned field comes from a new solve without them.

        Args:
            solved: The frame, solved without the readings in :attr:`left_out`.
            solve_without: Function that solves the frame without the given readings (U, K) and without those
                in :attr:`left_out`.
            until: Deadline (s) as a value of :func:`skinnode.process.clock.perf_counter`. A suspicious frame
                that cannot be examined in time is not trusted; every :data:`PATIENCE`-th such frame is
                examined regardless. Pass −inf if the solver ran out of time: wires without a solution are
                then not considered faulty.
        """
        self._frame += 1
        self._tested = None
        last = self._last
        if last is not None and not self._noise_varies and last.noise_factor != solved.field.noise_factor:
            self._list.reset()  # the faults were found at a different noise level
            self._lead = 0.0
        if self._list.mask is None and self._is_clean(solved):
            field = amended(solved.field, distrust="", wires_trusted=self._all_trusted)
            self._last = field
            self._last_field.remember(field, self._frame)
            self._unexamined = False
            self._time.nothing_waits()
            return field
        known = last is not None and last.faults == self._list.faults and not self._unexamined
        if last is not None and known and _still(solved, last):
            if last.faults:
                self._follow(solved)
            return amended(
                solved.field, faults=last.faults, distrust=last.distrust, wires_trusted=last.wires_trusted
            )
        solved, groups, found = self._search(solved, solve_without, until)
        scan = self._frame if self.scan is None else self.scan
        before = self._list.faults
        contradicting = [] if found else self._contradicting(groups, solved)
        passing = self._list.add(contradicting, self._frame, scan)
        if before:
            self._follow(solved)
        faults = self._list.faults + passing
        listed = {(fault.upper, fault.lower) for fault in faults}
        unlisted = any((group.upper, group.lower) not in listed for group in contradicting)
        contradiction = (
            CONTRADICTION if found or unlisted or self._doubtful else NOISIER if self._noisy else ""
        )
        contradiction = UNEXAMINED if self._unexamined else contradiction
        reason, wires = assess(solved.field.status, solved.used, faults, contradiction=contradiction)
        field = amended(solved.field, faults=faults, distrust=reason, wires_trusted=wires)
        self._last = field
        if contradiction == CONTRADICTION:
            self._unresolved_until = self._frame + UNRESOLVED_FRAMES
        if not reason and not groups and self._is_complete(solved):
            self._last_field.remember(field, self._frame)
        return field

    def _search(
        self, solved: Solved, solve_without: Callable[[Mask], Solved], until: float
    ) -> tuple[Solved, list[Group], tuple[Group, ...]]:
        """Solve a frame again without contradictory readings, until none remain or the limit is reached.

        Returns:
            The frame as last solved, the groups of readings left out, and the groups that remain in the frame
            although they contradict the others.
        """
        without = np.zeros(self._shape, bool)
        solved, groups = _spared(solved)
        self._coarse: tuple[Group, ...] = ()
        self._suspect, self._unexamined = None, False
        self._time.start_frame()
        found = self._find(solved, until) if until > -math.inf else ()
        if not found and self._suspect is not None:
            solved, found = self._find_without(self._suspect, solved, solve_without, until)
            self._doubtful |= not found and self._frame < self._unresolved_until
        while found and len(groups) < ROUNDS:
            if not self._time.allows(until, 0.0):
                self._unexamined = True
                break
            groups += found
            for group in found:
                without |= group.mask(self._shape)
            solved, spared = _spared(solve_without(without))
            groups += spared
            found = self._find(solved, until)
        return solved, groups, found

    def _is_clean(self, solved: Solved) -> bool:
        """Return whether a quick test finds no fault in a frame.

        The test applies only to fields of the exact inverse that converged with all readings. A frame that
        passes it is not searched for wrong readings (:meth:`_find`).
        """
        field = solved.field
        if not self._is_complete(solved):
            return False
        if field.held is not None and field.held.all() and not self._doubted:
            return True
        self._readings.set_complete(solved)
        gains = self._readings.gains()
        self._tested = solved, gains
        return self._needs_no_explanation(gains) and self._unusual_change(solved) is None

    @property
    def _doubted(self) -> bool:
        """Whether the last field was not trusted or not examined, so that holding it needs a test."""
        return self._last is not None and (bool(self._last.distrust) or self._unexamined)

    def _is_complete(self, solved: Solved) -> bool:
        """Return whether the exact inverse computed the field from all readings."""
        field = solved.field
        return (
            field.status == self._all_converged
            and field.method == "exact"
            and field.by_prior is None
            and bool(solved.used.all())
        )

    def _unusual_change(self, solved: Solved) -> Gains | None:
        """Return the gains from assuming a wrong reading if the change since the last field is suspicious.

        The linearised readings then describe the change.
        """
        change = self._last_field.change(solved.field, self._frame)
        if change is None:
            return None
        self._readings.set_change(change, float(solved.noise.mean()))
        gain, suspect = self._readings.reading_gain()
        if gain < SUSPICIOUS_CHANGE or self._excused_change.covers(self._frame, gain, suspect):
            return None
        return Gains(gain, -math.inf, suspect)

    def _needs_no_explanation(self, gains: Gains) -> bool:
        """Return whether a frame is accepted without examination.

        A frame is accepted if the gain in log evidence from assuming a fault is
        small, or if loads clearly explained a recent frame with a similar gain and the same suspected
        reading. If another reading is suspected, the frame is examined, because a reading can become wrong
        during a press. The frame after a noisy frame is always examined.
        """
        excused = self._excused.covers(self._frame, gains.largest, gains.suspect)
        return not self._lead and (gains.largest < SUSPICIOUS or excused)

    def _find(self, solved: Solved, until: float) -> tuple[Group, ...]:
        """Return the groups of readings that contradict the others; empty if there are none.

        The readings are tested as changes since rest. If they pass, the changes since the last field are
        tested.
        """
        found = self._find_since_rest(solved, until)
        if found or self._doubtful or self._noisy or self._unexamined or not self._is_complete(solved):
            return found
        return self._find_in_change(solved, until)

    def _find_in_change(self, solved: Solved, until: float) -> tuple[Group, ...]:
        """Return the groups of readings whose changes since the last field contradict the other changes.

        Crossed wires are not reported, because they would have been found in the changes since rest; the
        frame is considered doubtful instead.
        """
        gains = self._unusual_change(solved)
        if gains is None or not self._may_examine(gains, until):
            return ()
        found = self._explain(self._readings.noisier())
        if any(group.kind is FaultKind.CROSSED for group in found):
            found = ()
        self._doubtful = self._explainer.margin > DOUBT and not found
        if self._explainer.margin < CLEAR:
            self._excused_change = self._excuse(gains)
        return found

    def _find_since_rest(self, solved: Solved, until: float) -> tuple[Group, ...]:
        self._doubtful = self._noisy = self._unexamined = False
        status = np.array(solved.field.status)
        enough = solved.used.mean(axis=1) >= OF_WIRE
        unsolved = np.flatnonzero(enough & (status != Status.CONVERGED) & (status != Status.DEADLINE))
        if 0 < unsolved.size <= UNSOLVED:
            return tuple(Group(FaultyPart.UPPER, int(u), None, math.inf) for u in unsolved)
        present = solved.used & (status == Status.CONVERGED)[:, None]
        if unsolved.size:
            return self._find_coarsely(solved)
        if np.count_nonzero(present) < 0.5 * present.size:
            return ()
        readings = self._readings
        gains = self._gains(solved, present)
        if self._needs_no_explanation(gains):
            self._time.nothing_waits()
            return ()
        noisier = readings.noisier()
        lead = noisier - float(readings.evidence[readings.best])
        if lead > 0.5 * self._lead > 0.0:
            self._noisy, self._lead = True, lead
            return ()
        if not self._may_examine(gains, until):
            return ()
        found = self._explain(noisier, whole_wires_only=gains.readings < SUSPICIOUS)
        found = self._with_both_crossed(found)
        self._doubtful = self._explainer.margin > DOUBT and not found
        self._noisy = self._explainer.is_noisier and not found
        self._lead = lead if self._noisy else 0.0
        if not (found or self._doubtful or self._noisy):
            self._faultless = gains.largest, gains.suspect, self._frame
        if self._explainer.margin < CLEAR and not self._noisy:
            self._excused = self._excuse(gains)
        if gains.readings > RELINEARISED and not self._noisy:
            self._suspect = gains.suspect
        return found

    def _gains(self, solved: Solved, present: Mask) -> Gains:
        """Return the gains of a frame's readings since rest. The test of a complete frame is not repeated."""
        tested, self._tested = self._tested, None
        if tested is not None and tested[0] is solved:
            return tested[1]
        self._readings.set_frame(solved, present)
        return self._readings.gains()

    def _explain(self, noisier: float, *, whole_wires_only: bool = False) -> tuple[Group, ...]:
        """Examine the linearised readings: return the groups of wrong readings that explain them."""
        start, readings = perf_counter(), self._readings
        found = self._explainer.wrong_readings(
            readings.z, readings.present, readings.evidence, readings.best, readings.cost, readings.sigma,
            noisier, whole_wires_only,
        )  # fmt: skip
        self._time.took(perf_counter() - start)
        return found

    def _excuse(self, gains: Gains) -> Excuse:
        return Excuse(gains.largest, gains.suspect, self._frame + EXCUSED_FRAMES)

    def _find_without(
        self, suspect: int, solved: Solved, solve_without: Callable[[Mask], Solved], until: float
    ) -> tuple[Solved, tuple[Group, ...]]:
        """Search a frame, linearised about its field without the reading ``suspect``, for wrong readings.

        Returns:
            The frame, solved with the suspect if no fault was found, and the groups of readings that
            contradict the others.
        """
        without = np.zeros(self._shape, bool)
        without.flat[suspect] = True
        other = solve_without(without)
        if all(status is Status.CONVERGED for status in other.field.status):
            found = self._find(dataclasses.replace(other, used=solved.used), until)
            if found and self._explainer.margin > RELINEARISED_MARGIN:
                return other, found
            self._doubtful |= bool(found)
        without.flat[suspect] = False
        return solve_without(without), ()

    def _may_examine(self, gains: Gains, until: float) -> bool:
        """Return whether to examine a suspicious frame, given the deadline.

        If there is no time, the frame is marked as unexamined. It is not marked if a similar frame was
        examined recently and found to be free of faults.
        """
        if self._time.is_in_time(until):
            return True
        last, suspect, frame = self._faultless
        if suspect == gains.suspect and gains.largest < last + EXCUSED:
            if self._frame - frame < EXCUSED_FRAMES:
                return False
            self._time.insist()  # no similar frame was examined recently enough
        self._unexamined = not self._time.allows(until)
        return not self._unexamined

    def _with_both_crossed(self, found: tuple[Group, ...]) -> tuple[Group, ...]:
        """Return both wires of a recent crossed pair if either is in ``found``; else return ``found``."""
        if any(group.kind is FaultKind.CROSSED for group in found):
            self._crossed, self._crossed_until = found, self._frame + CROSSED_FRAMES
        elif self._frame <= self._crossed_until:
            wires = [(group.part, group.upper, group.lower) for group in self._crossed]
            if any((group.part, group.upper, group.lower) in wires for group in found):
                return self._crossed
        return found

    def _find_coarsely(self, solved: Solved) -> tuple[Group, ...]:
        """Return the readings most likely to be wrong if several upper wires of a frame have no solution.

        Loads cannot explain such a frame, so the search considers only wrong readings. :meth:`check` solves
        the frame without the readings found, and reports those that disagree with the new field.
        """
        readings = self._readings
        if not readings.set_raw(solved):
            return ()
        groups = self._explainer.wrong_without_loads(
            readings.z, readings.present, readings.evidence, readings.best, readings.cost
        )
        self._coarse += groups
        return groups if len(groups) <= COARSE_GROUPS else groups[:1]

    def _follow(self, solved: Solved) -> None:
        """Compare the readings that have a confirmed fault with the field and update the fault list."""
        self._list.follow(*self._readings.deviations(solved))

    def _contradicting(self, groups: list[Group], solved: Solved) -> list[Group]:
        """Return ``groups`` without the groups from the coarse search whose readings agree with the field."""
        if not self._coarse:
            return groups
        deviation, known = self._readings.deviations(solved)
        kept = []
        for group in groups:
            here = group.mask(known.shape) & known
            agrees = here.any() and agree(deviation[here])
            if not (group in self._coarse and agrees):
                kept.append(group)
        return kept


def _spared(solved: Solved) -> tuple[Solved, list[Group]]:
    """Return the frame without the wires that the solver left out, and these wires as groups."""
    field = solved.field
    status = np.array(field.status)
    out = (status != Status.CONVERGED) & (solved.used.mean(axis=1) >= OF_WIRE)
    out &= np.isfinite(field.displacement_std_m).all(axis=(1, 2))
    if not 0 < np.count_nonzero(out) <= SPARED:
        return solved, []
    groups = [Group(FaultyPart.UPPER, int(u), None, math.inf) for u in np.flatnonzero(out)]
    return dataclasses.replace(solved, used=solved.used & ~out[:, None]), groups


def _still(solved: Solved, last: FieldFrame) -> bool:
    """Return whether all wires were held and no status has changed since the last field."""
    held = solved.field.held
    return held is not None and bool(held.all()) and solved.field.status == last.status
