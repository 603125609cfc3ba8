"""Data check: finds the readings that contradict the others and decides whether to trust the field.

Each frame is first solved with all readings except those with a confirmed fault. The check linearises the
readings about rest and tests them with :mod:`skinnode.solve.checks.reading_model`. If a reading or a whole
wire contradicts the others, the frame is solved again without it. The check stops when no contradiction
remains, or when :data:`ROUNDS` groups of readings have been left out.
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
from skinnode.model.kernels import potential
from skinnode.model.layout import Float
from skinnode.model.status import Status
from skinnode.process.clock import perf_counter
from skinnode.solve.checks.crossed_wires import likeliest
from skinnode.solve.checks.explanations import DOUBT, Explainer, Group
from skinnode.solve.checks.fault_list import FaultList, agree
from skinnode.solve.checks.field_trust import CONTRADICTION, NOISIER, OF_WIRE, UNEXAMINED, assess
from skinnode.solve.checks.greedy_search import crossing_gain
from skinnode.solve.checks.reading_model import ReadingModel, changes, evidences
from skinnode.solve.checks.wire_tests import GAIN_STD, LEAST, least_fitting
from skinnode.solve.linalg.cholesky import multiply_vector, solve_positive
from skinnode.solve.wires.problem import PatchProblem

ROUNDS: Final = 3
"""Maximum number of groups of readings left out of a frame. Once the limit is reached, the frame is not
solved again."""
WRONG: Final = 0.1
"""Expected relative error of a wrong reading. Not tuned: reducing it to 0.01 would change the cost of a wrong
reading by only 2 nats."""
SUSPICIOUS: Final = 5.0
"""Gain in log evidence from assuming a fault, in nats, above which a frame is suspicious. The check examines
suspicious frames: it searches for the most likely explanation of their readings."""
OFFSETS: Final = (0, 1, 3, 5)
"""Values of κ at which single readings are tested, in steps below the best-fitting value."""
CLEAR: Final = -30.0
"""Log evidence of faults minus that of loads, in nats, below which loads clearly explain a frame. Similar
frames are then not examined for :data:`EXCUSED_FRAMES` frames."""
EXCUSED: Final = 10.0
"""Maximum excess (nats) of a frame's gain over that of an examined frame for the two frames to be similar."""
EXCUSED_FRAMES: Final = 8
"""Number of frames for which the result of an examination also applies to similar frames. Each examination
takes 9 ms."""
PATIENCE: Final = 4
"""Interval, in suspicious frames, at which a frame is examined even if the deadline leaves no time. A fault
makes every subsequent frame suspicious; a press rarely does."""
EXAMINATION_S: Final = 3e-3
"""Assumed duration of the first examination, s. Later examinations are timed."""
CROSSED_FRAMES: Final = 5
"""Number of frames for which a crossed pair is remembered. If either of its wires is found to be faulty again
within this time, both wires are reported."""
NOISE_RATIOS: Final = (2.0, 4.0, 8.0, 16.0)
"""Ratios of actual to stated noise that the check tries as explanations of a suspicious frame."""
COARSE: Final = 0.1
"""Assumed error of the linearised readings if several upper wires have no solution, as a fraction of the 90 %
quantile of the readings' changes since rest."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A field and the readings from which it was computed."""

    field: FieldFrame
    a: Float
    """(U, K) resistances times gain, R · gain, in the units of the :class:`PatchProblem`."""
    noise: Float
    """(U, K) relative standard deviation of the resistances R."""
    used: Mask
    """(U, K) mask of the readings used in the solve."""


class DataCheck:
    """Checks the readings of one patch frame by frame. Each stream needs its own instance.

    Args:
        problem: The patch.
        sigma: Typical relative noise of a reading, for :meth:`prepare`.
        model_std: Standard deviation of the forward model's error, relative to the largest change in a
            reading; 0 if the patch matches its layout exactly.
        drift: Expected gain errors, which are not reported as faults: ``none``, ``patch`` (one error for the
            patch) or ``wire`` (one for each upper wire).

    Attributes:
        scan: Scan number of the next frame, to be reported with its faults. If None, faults are reported with
            the number of frames checked so far.
    """

    def __init__(
        self, problem: PatchProblem, sigma: float, model_std: float = 0.0, drift: str = "none"
    ) -> None:
        self._problem, self._sigma, self._model_std, self._drift = problem, sigma, model_std, drift
        self._model = ReadingModel.of(problem.layout)
        self._explainer = Explainer(self._model)
        shape = problem.layout.shape
        self._list = FaultList(shape)
        self._z, self._f = np.empty(shape), np.empty(shape)
        self._c, self._alpha = np.empty((2, self._z.size))
        self._row = np.empty(max(shape))
        self._evidence, self._of_noise = np.empty((2, len(self._model.kappa)))
        self._present = np.ones(shape, bool)
        self._all_converged = (Status.CONVERGED,) * shape[0]
        self._all_trusted = np.ones(shape[0], bool)
        self._all_trusted.setflags(write=False)
        self.scan: int | None = None
        self._examination_s = EXAMINATION_S
        every = np.ones(shape, bool)
        at_rest = np.zeros((shape[0], 3 * problem.layout.upper_m.shape[1]))
        changes(self._model.jacobian, at_rest, 1.0, self._z)
        self._residuals(at_rest, np.ones(shape), np.ones(shape[0], bool))
        self._explainer.wrong_readings(self._z, every, self._evidence, 0, 1.0, 1.0)  # compile the kernels
        self._largest_gains(every, self._evidences(every), 1.0, 1.0)
        every[0, 0] = False
        self._evidences(every)  # compile the kernels for missing readings
        self.reset()

    def prepare(self) -> None:
        """Compute the tables in advance, so that the first suspicious frames of a stream are not delayed."""
        self._model.prepare(self._sigma)

    def reset(self) -> None:
        """Discard the state of the stream, including all faults."""
        self._list.reset()
        self._frame, self._doubtful, self._noisy = 0, False, False
        self._lead = 0.0  # gain from assuming more noise if the last frame was noisy, nats; otherwise 0
        self._excused, self._excused_where, self._excused_until = -math.inf, -1, 0
        self._where = -1
        self._crossed: tuple[Group, ...] = ()
        self._crossed_until = 0
        self._last: FieldFrame | None = None
        self._unexamined, self._overdue, self._waiting = False, False, 0
        # gain, suspected reading and number of the last examined frame that had no fault
        self._faultless = 0.0, -1, -EXCUSED_FRAMES

    @property
    def left_out(self) -> Mask | None:
        """(U, K) mask of the readings to leave out of the next frame; None if there are none."""
        return self._list.mask

    def pass_frame(self) -> None:
        """Count a frame that is not checked because the patch is untouched."""
        self._frame += 1

    def check(
        self, solved: Solved, solve_without: Callable[[Mask], Solved], until: float = math.inf
    ) -> FieldFrame:
        """Check the readings of a frame; return its field with the faults found and the trust decision.

        If readings are found to be wrong, the returned field is that of a new solve without them.

        Args:
            solved: The frame, solved without the readings in :attr:`left_out`.
            solve_without: Function that solves the frame without the given readings (U, K) and without those
                in :attr:`left_out`.
            until: Deadline as a value of :func:`skinnode.process.clock.perf_counter`, s. A suspicious frame
                that cannot be examined in time is not trusted; every :data:`PATIENCE`-th such frame is
                examined regardless. Pass −inf if the solver ran out of time: wires without a solution are
                then not considered faulty.
        """
        self._frame += 1
        last = self._last
        if last is not None and last.noise_factor != solved.field.noise_factor:
            self._list.reset()  # the faults were found at a different noise level
            self._lead = 0.0
        if self._list.mask is None and self._is_clean(solved):
            field = amended(solved.field, distrust="", wires_trusted=self._all_trusted)
            self._last = field
            self._unexamined, self._waiting = False, 0
            return field
        known = last is not None and last.faults == self._list.faults and not self._unexamined
        if last is not None and known and _still(solved, last):
            if last.faults:
                self._follow(solved)
            return amended(
                solved.field, faults=last.faults, distrust=last.distrust, wires_trusted=last.wires_trusted
            )
        layout = self._problem.layout
        without = np.zeros(layout.shape, bool)
        solved, groups = _spared(solved)
        self._coarse: tuple[Group, ...] = ()
        self._overdue = self._unexamined = False
        found = self._find(solved, until) if until > -math.inf else ()
        while found and len(groups) < ROUNDS:
            if not self._in_time(0.0, until):
                self._unexamined = True
                break
            groups += found
            for group in found:
                without |= group.mask(layout.shape)
            solved, spared = _spared(solve_without(without))
            groups += spared
            found = self._find(solved, until)
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
        return field

    def _is_clean(self, solved: Solved) -> bool:
        """Return whether a quick test finds no fault in a frame.

        The test applies only to fields of the exact inverse that converged with all readings. A frame that
        passes it is not searched for wrong readings (:meth:`_find`).
        """
        field, layout = solved.field, self._problem.layout
        clean = (
            field.status == self._all_converged
            and field.method == "exact"
            and field.by_prior is None
            and bool(solved.used.all())
        )
        if not clean:
            return False
        if field.held is not None and field.held.all():
            return True
        sigma = float(solved.noise.mean())
        moved = field.displacement_m.reshape(layout.shape[0], -1)
        changes(self._model.jacobian, moved, sigma * layout.pitch_m, self._z)
        best = self._evidences(self._present)
        cost = math.log(max(WRONG / sigma, math.e))
        return self._needs_no_explanation(max(self._largest_gains(self._present, best, cost, sigma)))

    def _needs_no_explanation(self, gain: float) -> bool:
        """Return whether a frame is accepted without examination.

        ``gain`` is the gain in log evidence from assuming a fault, nats. A frame is accepted if the gain is
        small, or if loads clearly explained a recent frame with a similar gain and the same suspected
        reading. If another reading is suspected, the frame is examined, because a reading can become wrong
        during a press. The frame after a noisy frame is always examined.
        """
        excused = (
            self._frame < self._excused_until
            and gain < self._excused + EXCUSED
            and self._where == self._excused_where
        )
        return not self._lead and (gain < SUSPICIOUS or excused)

    def _find(self, solved: Solved, until: float) -> tuple[Group, ...]:
        """Return the groups of readings that contradict the others; empty if there are none."""
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
        sigma = self._linearised(solved, present)
        best = self._evidences(present)
        cost = math.log(max(WRONG / sigma, math.e))
        of_readings, of_wires = self._largest_gains(present, best, cost, sigma)
        gain, where = max(of_readings, of_wires), self._where
        if self._needs_no_explanation(gain):
            self._waiting = 0
            return ()
        noisier = self._noisier()
        lead = noisier - float(self._evidence[best])
        if lead > 0.5 * self._lead > 0.0:
            self._noisy, self._lead = True, lead
            return ()
        if not self._may_examine(gain, until):
            return ()
        start = perf_counter()
        found = self._explainer.wrong_readings(
            self._z, present, self._evidence, best, cost, sigma, noisier,
            whole_wires_only=of_readings < SUSPICIOUS,
        )  # fmt: skip
        self._examination_s = max(perf_counter() - start, 0.8 * self._examination_s)
        found = self._with_both_crossed(found)
        self._doubtful = self._explainer.margin > DOUBT and not found
        self._noisy = self._explainer.is_noisier and not found
        self._lead = lead if self._noisy else 0.0
        if not (found or self._doubtful or self._noisy):
            self._faultless = gain, where, self._frame
        if self._explainer.margin < CLEAR and not self._noisy:
            self._excused, self._excused_where = gain, where
            self._excused_until = self._frame + EXCUSED_FRAMES
        return found

    def _may_examine(self, gain: float, until: float) -> bool:
        """Return whether to examine a suspicious frame, given the deadline.

        If there is no time, the frame is marked as unexamined. It is not marked if a similar frame was
        examined recently and found to be free of faults.
        """
        if self._overdue or perf_counter() + self._examination_s <= until:
            return True
        last, where, frame = self._faultless
        if where == self._where and gain < last + EXCUSED:
            if self._frame - frame < EXCUSED_FRAMES:
                return False
            self._waiting = PATIENCE  # no similar frame was examined recently enough
        self._unexamined = not self._in_time(self._examination_s, until)
        return not self._unexamined

    def _in_time(self, seconds: float, until: float) -> bool:
        """Return whether a step that takes ``seconds`` may be started for a suspicious frame.

        The deadline is ignored for every :data:`PATIENCE`-th suspicious frame that would miss it.
        """
        if self._overdue or perf_counter() + seconds <= until:
            return True
        self._waiting += 1
        self._overdue = self._waiting >= PATIENCE
        if self._overdue:
            self._waiting = 0
        return self._overdue

    def _noisier(self) -> float:
        """Return the log evidence of the frame, assuming that its noise is above the stated level.

        If the noise is ``ratio`` times the stated noise, the log evidence is that of z / ratio, minus
        ln(ratio) for each reading.
        """
        model, z = self._model, self._z.ravel()
        most = -math.inf
        for ratio in NOISE_RATIOS:
            np.divide(z, ratio, out=self._alpha)
            best = evidences(
                model.vectors_t, model.shrink, model.log_det, self._alpha, self._c, self._of_noise
            )
            most = max(most, float(self._of_noise[best]) - z.size * math.log(ratio))
        return most - math.log(len(NOISE_RATIOS))

    def _with_both_crossed(self, found: tuple[Group, ...]) -> tuple[Group, ...]:
        """Return both wires of a recent crossed pair if either is in ``found``; else return ``found``."""
        if any(group.kind is FaultKind.CROSSED for group in found):
            self._crossed, self._crossed_until = found, self._frame + CROSSED_FRAMES
        elif self._frame <= self._crossed_until:
            wires = [(group.part, group.upper, group.lower) for group in self._crossed]
            if any((group.part, group.upper, group.lower) in wires for group in found):
                return self._crossed
        return found

    def _linearised(self, solved: Solved, present: Mask) -> float:
        """Write the linearised changes, in units of the noise, into ``_z``; return the relative noise."""
        field, layout = solved.field, self._problem.layout
        sigma = float(np.median(solved.noise[present]))
        moved = field.displacement_m.reshape(layout.shape[0], -1) / layout.pitch_m
        changes(self._model.jacobian, moved, 1.0, self._z)
        if self._model_std > 0.0:
            sigma = math.hypot(sigma, self._model_std * float(np.abs(self._z[present]).max()))
        inexact = np.ones(len(moved), bool) if field.method == "posterior" else field.by_prior
        if inexact is not None and inexact.any():
            self._z[inexact] -= self._residuals(moved, solved.a, inexact)
            if field.gain is not None:
                self._z[inexact] += field.gain[inexact, None]
        self._z /= sigma
        self._z[~present] = 0.0
        if self._drift != "none":
            self._remove_gain(present, GAIN_STD / sigma)
        return sigma

    def _remove_gain(self, present: Mask, std: float) -> None:
        """Estimate the remaining gain errors with the prior N(0, ``std``²) and subtract them from ``_z``.

        The solver underestimates gain errors, because its prior attributes part of each error to a
        displacement of the wire.
        """
        upper, lower = self._z.shape
        p = self._model.level(self._evidences(present)).precision
        multiply_vector(p, self._z.ravel(), self._alpha)
        sums = self._alpha.reshape(upper, lower).sum(axis=1)
        blocks = p.reshape(upper, lower, upper, lower).sum(axis=(1, 3))
        if self._drift == "wire":
            self._z -= np.linalg.solve(blocks + np.eye(upper) / std**2, sums)[:, None]
        else:
            self._z -= sums.sum() / (blocks.sum() + 1.0 / std**2)
        self._z[~present] = 0.0

    def _residuals(self, moved: Float, a: Float, wires: Mask) -> Float:
        """Return the residuals a F − 1 (n, K) of the n upper wires in the mask ``wires`` (U,)."""
        for u in np.flatnonzero(wires).tolist():
            potential(self._problem.rest[u] + moved[u], self._problem.lower, self._f[u])
        return np.asarray(a[wires] * self._f[wires] - 1.0)

    def _evidences(self, present: Mask) -> int:
        """Fill in missing readings, compute the log evidence at every κ, and return the best κ's index."""
        model, z = self._model, self._z.ravel()
        best = evidences(model.vectors_t, model.shrink, model.log_det, z, self._c, self._evidence)
        missing = np.flatnonzero(~present) if present is not self._present else ()
        if len(missing):  # replace missing readings with their conditional means
            p, count = model.level(best).precision[missing], len(missing)
            block, unknown = np.ascontiguousarray(p[:, missing]), np.empty(count)
            block.flat[:: count + 1] += LEAST
            multiply_vector(p, z, unknown)
            if solve_positive(block, unknown, count):
                z[missing] = -unknown
                best = evidences(model.vectors_t, model.shrink, model.log_det, z, self._c, self._evidence)
        return best

    def _largest_gains(self, present: Mask, best: int, cost: float, sigma: float) -> tuple[float, float]:
        """Return the largest gain from a wrong reading or crossed wires, and that from one faulty wire."""
        most, of_wires, z = -math.inf, -math.inf, self._z.ravel()
        for offset in OFFSETS:
            number = best - offset
            if number < 0:
                break
            level = self._model.level(number)
            p = level.precision
            multiply_vector(p, z, self._alpha)
            gain, where = crossing_gain(level.diagonal, self._alpha, present.ravel(), cost)
            gain += float(self._evidence[number] - self._evidence[best])
            if gain > most:
                most, self._where = gain, where
            if not offset:
                most = max(most, likeliest(p, self._alpha, self._z, present)[0])
                of_wires = least_fitting(level.wires, self._z, self._alpha, present, sigma, self._row).gain
        return most, of_wires

    def _find_coarsely(self, solved: Solved) -> tuple[Group, ...]:
        """Return the most likely wrong readings of a frame in which several upper wires have no solution.

        Loads cannot explain such a frame, so the search considers only wrong readings. :meth:`check` solves
        the frame without the readings found, and reports those that disagree with the new field.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            np.log(self._problem.a_rest / solved.a, out=self._z)
        present = solved.used & np.isfinite(self._z)
        self._z[~present] = 0.0
        if np.count_nonzero(present) < 0.5 * present.size:
            return ()
        sigma = COARSE * float(np.quantile(np.abs(self._z[present]), 0.9))
        sigma = max(sigma, float(np.median(solved.noise[present])))
        self._z /= sigma
        best = self._evidences(present)
        groups = self._explainer.wrong_without_loads(
            self._z, present, self._evidence, best, math.log(max(WRONG / sigma, math.e))
        )
        self._coarse += groups
        return groups if len(groups) <= COARSE_GROUPS else groups[:1]

    def _follow(self, solved: Solved) -> None:
        """Compare the readings that have a confirmed fault with the field and update the fault list."""
        self._list.follow(*self._deviations(solved))

    def _deviations(self, solved: Solved) -> tuple[Float, Mask]:
        """Return the deviations (U, K) of the readings from the field, in standard deviations.

        Also returns a (U, K) mask of the valid deviations. Invalid deviations are infinite.
        """
        layout = self._problem.layout
        moved = solved.field.displacement_m.reshape(layout.shape[0], -1) / layout.pitch_m
        residual = self._residuals(moved, solved.a, np.ones(len(moved), bool))
        std = solved.field.displacement_std_m.reshape(layout.shape[0], -1) / layout.pitch_m
        with np.errstate(invalid="ignore", over="ignore"):
            spread = np.einsum("ukn,un->uk", self._model.jacobian**2, np.minimum(std, 1e3) ** 2)
            deviation = residual / np.sqrt(spread + solved.noise**2)
        known = np.isfinite(deviation) & (solved.noise > 0)
        return np.where(known, deviation, np.inf), known

    def _contradicting(self, groups: list[Group], solved: Solved) -> list[Group]:
        """Return ``groups`` without those from the coarse search whose readings agree with the field."""
        if not self._coarse:
            return groups
        deviation, known = self._deviations(solved)
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
