"""Check of a frame's data: finds readings that contradict the others, solves without them, assesses trust.

A frame is first solved with all readings but those already named. Its field then predicts, at rest geometry,
what every reading should be (:mod:`skinnode.solve.checks.reading_model`). If one reading or wire contradicts
the others, it is left out and the frame is solved again, up to :data:`ROUNDS` times.
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
from skinnode.solve.checks.greedy_search import crossing_gain
from skinnode.solve.checks.reading_model import ReadingModel, changes, evidences
from skinnode.solve.checks.trust import CONTRADICTION, NOISIER, OF_WIRE, UNEXAMINED, assess
from skinnode.solve.checks.wire_tests import GAIN_STD, LEAST, least_fitting
from skinnode.solve.linalg.cholesky import multiply_vector, solve_positive
from skinnode.solve.wires.problem import PatchProblem

ROUNDS: Final = 3
"""Maximum number of times that a frame is solved again without some of its readings."""
WRONG: Final = 0.1
"""Expected relative error of a wrong reading. Not tuned: an error of 0.01 changes the cost of a
reading by 2 nats."""
SUSPICIOUS: Final = 5.0
"""Gain in log evidence at which a reading is suspected and explanations are sought, nats."""
OFFSETS: Final = (0, 1, 3, 5)
"""Steps below the κ that fits a frame at which single readings are tested."""
CLEAR: Final = -30.0
"""Log evidence of faults over loads below which loads explain a frame so well that the next need no
explanation, nats."""
EXCUSED: Final = 10.0
"""Rise of the gain after such a frame that makes a frame suspicious again, nats."""
EXCUSED_FRAMES: Final = 8
"""Number of frames after such a frame that need no explanation; finding one takes 9 ms."""
PATIENCE: Final = 4
"""Number of successive suspicious frames of which one is examined although its deadline does not permit it: a
fault stays suspicious, a press seldom does."""
EXAMINATION_S: Final = 3e-3
"""Expected time of the first examination, s."""
CROSSED_FRAMES: Final = 5
"""Number of frames after one with two exchanged wires in which finding one of them means both."""
NOISE_RATIOS: Final = (2.0, 4.0, 8.0, 16.0)
"""Ratios of the actual to the stated noise that are considered in a suspicious frame."""
COARSE: Final = 0.1
"""Error of the linearised readings, relative to the largest change, if wires could not be solved."""
COARSE_GROUPS: Final = 3
"""Maximum number of groups that are left out at once if wires could not be solved; of more, only the
likeliest is."""
UNSOLVED: Final = 1
"""Number of upper wires without a solution that count as faults of these wires; if there are more, a lower
wire may be the cause."""
SPARED: Final = 3
"""Maximum number of upper wires that the posterior leaves out by itself."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A field with the readings from which it was computed."""

    field: FieldFrame
    a: Float
    """(U, K) R · gain in the units of the problem."""
    noise: Float
    """(U, K) relative standard deviation of R."""
    used: Mask
    """(U, K) readings used."""


class DataCheck:
    """Check of the data of one patch, frame by frame. Do not share an instance between owners.

    Args:
        problem: The patch.
        sigma: Usual noise of a reading, for :meth:`prepare`.
        model_std: Standard deviation of the forward model's error, relative to the largest change of a
            reading: 0 for a patch that equals its layout.
        drift: Gain errors that are expected and no fault: ``none``, ``patch`` or ``wire``.

    Attributes:
        scan: Number by which the user knows the next frame; by default, frames are counted.
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
        self._explainer.wrong_readings(self._z, every, self._evidence, 0, 1.0, 1.0)  # compiles the kernels
        self._largest_gains(every, self._evidences(every), 1.0, 1.0)
        every[0, 0] = False
        self._evidences(every)  # compiles what a missing reading needs
        self.reset()

    def prepare(self) -> None:
        """Compute tables that the first suspicious frames of a stream would otherwise wait for."""
        self._model.prepare(self._sigma)

    def reset(self) -> None:
        """Forget the stream."""
        self._list.reset()
        self._frame, self._doubtful, self._noisy = 0, False, False
        self._lead = 0.0  # log evidence of more noise over the plain frame, if the last frame was noisy
        self._excused, self._excused_where, self._excused_until = -math.inf, -1, 0
        self._where = -1
        self._crossed: tuple[Group, ...] = ()
        self._crossed_until = 0
        self._last: FieldFrame | None = None
        self._unexamined, self._overdue, self._waiting = False, False, 0
        self._faultless = 0.0, -1, -EXCUSED_FRAMES  # gain, reading and frame of the last examination

    @property
    def left_out(self) -> Mask | None:
        """(U, K) readings to leave out of the next frame; None if there are none."""
        return self._list.mask

    def check(
        self, solved: Solved, solve_without: Callable[[Mask], Solved], until: float = math.inf
    ) -> FieldFrame:
        """Return the field of a frame with its faults and the verdict on trust.

        Args:
            solved: The frame, solved without the readings of :attr:`left_out`.
            solve_without: Solves the frame without these readings (U, K) and those of :attr:`left_out`.
            until: Value of :func:`skinnode.process.clock.perf_counter` by which this should return; −inf if
                some wires are unsolved for lack of time, which proves nothing. A suspicious frame that cannot
                be examined by then is not trusted; every :data:`PATIENCE` frames in succession one takes
                longer.
        """
        self._frame += 1
        last = self._last
        if last is not None and last.noise_factor != solved.field.noise_factor:
            self._list.reset()  # what contradicted the stated noise may not contradict the actual noise
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
        passing = self._list.add([] if found else self._contradicting(groups, solved), self._frame, scan)
        if before:
            self._follow(solved)
        faults = self._list.faults + passing
        contradiction = CONTRADICTION if found or self._doubtful else NOISIER if self._noisy else ""
        contradiction = UNEXAMINED if self._unexamined else contradiction
        reason, wires = assess(solved.field.status, solved.used, faults, contradiction=contradiction)
        field = amended(solved.field, faults=faults, distrust=reason, wires_trusted=wires)
        self._last = field
        return field

    def _is_clean(self, solved: Solved) -> bool:
        """Return whether an exact field with all readings passes the test of single readings.

        This is the fast path of :meth:`_find`, which most frames take.
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
        """Return whether a gain is small, or hardly larger than one that loads explained just before.

        Never after a noisy frame. The latter only if the likeliest wrong reading is that one: another may be
        wrong under a press.
        """
        excused = (
            self._frame < self._excused_until
            and gain < self._excused + EXCUSED
            and self._where == self._excused_where
        )
        return not self._lead and (gain < SUSPICIOUS or excused)

    def _find(self, solved: Solved, until: float) -> tuple[Group, ...]:
        """Return the readings that contradict the others; none if there are none."""
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
        """Return whether a suspicious frame is examined.

        Without time for that, it is unexamined, unless it resembles one examined just before.
        """
        if self._overdue or perf_counter() + self._examination_s <= until:
            return True
        last, where, frame = self._faultless
        if where == self._where and gain < last + EXCUSED:
            if self._frame - frame < EXCUSED_FRAMES:
                return False
            self._waiting = PATIENCE  # it is time for another examination
        self._unexamined = not self._in_time(self._examination_s, until)
        return not self._unexamined

    def _in_time(self, seconds: float, until: float) -> bool:
        """Return whether to take ``seconds`` for a suspicious frame: if there is time, or others had none."""
        if self._overdue or perf_counter() + seconds <= until:
            return True
        self._waiting += 1
        self._overdue = self._waiting >= PATIENCE
        if self._overdue:
            self._waiting = 0
        return self._overdue

    def _noisier(self) -> float:
        """Return the log evidence of the frame if all its readings are noisier than stated.

        It is that of z divided by the ratio of the noise, minus ln of that ratio for each reading.
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
        """Return both of two wires that were exchanged just before if one of them is found alone."""
        if any(group.kind is FaultKind.CROSSED for group in found):
            self._crossed, self._crossed_until = found, self._frame + CROSSED_FRAMES
        elif self._frame <= self._crossed_until:
            wires = [(group.part, group.upper, group.lower) for group in self._crossed]
            if any((group.part, group.upper, group.lower) in wires for group in found):
                return self._crossed
        return found

    def _linearised(self, solved: Solved, present: Mask) -> float:
        """Write the changes of the readings, as if F were linear, into ``_z``; return the noise."""
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
        """Subtract the gain errors, N(0, ``std``²) each, that the readings still show.

        The solver's estimate is not enough: its prior takes part of a gain for a displacement of the wire.
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
        """Return a F − 1 of these wires, (n, K)."""
        for u in np.flatnonzero(wires).tolist():
            potential(self._problem.rest[u] + moved[u], self._problem.lower, self._f[u])
        return np.asarray(a[wires] * self._f[wires] - 1.0)

    def _evidences(self, present: Mask) -> int:
        """Write the evidence at every κ; return the index of the largest. Fills in the missing readings."""
        model, z = self._model, self._z.ravel()
        best = evidences(model.vectors_t, model.shrink, model.log_det, z, self._c, self._evidence)
        missing = np.flatnonzero(~present) if present is not self._present else ()
        if len(missing):  # with their expectation, given the others
            p, count = model.level(best).precision[missing], len(missing)
            block, unknown = np.ascontiguousarray(p[:, missing]), np.empty(count)
            block.flat[:: count + 1] += LEAST
            multiply_vector(p, z, unknown)
            if solve_positive(block, unknown, count):
                z[missing] = -unknown
                best = evidences(model.vectors_t, model.shrink, model.log_det, z, self._c, self._evidence)
        return best

    def _largest_gains(self, present: Mask, best: int, cost: float, sigma: float) -> tuple[float, float]:
        """Return the largest gain from a wrong reading or crossed wires, and that from an unfit wire."""
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
        """Return the likeliest wrong readings if several upper wires have no solution.

        No load explains such a frame, so loads are no alternative here; :meth:`check` compares the readings
        left out with the field of the others before it names them.
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
        """Compare the named readings with the field."""
        self._list.follow(*self._deviations(solved))

    def _deviations(self, solved: Solved) -> tuple[Float, Mask]:
        """Return the readings (U, K) minus the field, divided by its std, and which of them exist."""
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
        """Return the groups without those found coarsely that agree with the field of the others."""
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
    """Return the frame without the upper wires that its solver left out by itself, and these wires."""
    field = solved.field
    status = np.array(field.status)
    out = (status != Status.CONVERGED) & (solved.used.mean(axis=1) >= OF_WIRE)
    out &= np.isfinite(field.displacement_std_m).all(axis=(1, 2))
    if not 0 < np.count_nonzero(out) <= SPARED:
        return solved, []
    groups = [Group(FaultyPart.UPPER, int(u), None, math.inf) for u in np.flatnonzero(out)]
    return dataclasses.replace(solved, used=solved.used & ~out[:, None]), groups


def _still(solved: Solved, last: FieldFrame) -> bool:
    """Return whether no wire was solved in this frame and the last field was assessed with its status."""
    held = solved.field.held
    return held is not None and bool(held.all()) and solved.field.status == last.status
