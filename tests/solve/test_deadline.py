"""The deadline of the exact tracker: wires take turns, and none is forgotten."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import skinnode as sk
from skinnode.solve.exact import stream as patch_stream
from skinnode.solve.exact import tracker as exact
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.wires import arrays as wires
from skinnode.solve.wires.patch_solver import SCALE, PatchSolver

from .press import dent, frame_ohm, hertz_press

MOST_READINGS = 10_000
"""Readings of the clock between two calls of the solver; more would be an endless loop."""


class Clock:
    """Time stands still but for the solver: every wire that has its turn in a call takes ``call_s``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, call_s: float) -> None:
        self.now, self.call_s = 0.0, call_s
        self.calls, self._readings = 0, 0
        for module in (exact, patch_stream):
            monkeypatch.setattr(module, "perf_counter", self._read)
        monkeypatch.setattr(PatchSolver, "solve", self._timed(PatchSolver.solve))
        monkeypatch.setattr(PatchSolver, "advance", self._timed(PatchSolver.advance, clears=SCALE))

    def _read(self) -> float:
        self._readings += 1
        assert self._readings < MOST_READINGS
        return self.now

    def _timed(self, call: Callable[..., Any], clears: int = 0) -> Callable[..., Any]:
        def timed(solver: PatchSolver, *args: Any, **kwargs: Any) -> Any:
            self.calls, self._readings = self.calls + 1, 0
            turns = solver.report[:, wires.TURN]
            before = turns.copy()
            turns[:] = 0
            result = call(solver, *args, **kwargs)
            self.now += self.call_s * np.count_nonzero(turns)
            if not (clears and args[0] & clears):
                turns |= before
            return result

        return timed


class TestDeadline:
    def test_wires_take_turns_and_hold_still_between(self, staggered, stream, monkeypatch):
        tracker = ExactTracker(staggered, deadline_us=70.0)
        clock = Clock(monkeypatch, 20e-6)
        served, last = [], np.zeros_like(staggered.upper_m)
        for moved, frame in stream[:6]:
            begin = clock.now
            field = tracker.update(frame)
            assert clock.now - begin <= 90e-6
            late = np.array([status is sk.Status.DEADLINE for status in field.status])
            served.append(set(np.flatnonzero(~late).tolist()))
            assert (np.array(field.status)[~late] == sk.Status.CONVERGED).all()
            np.testing.assert_array_equal(field.displacement_m[late], last[late])
            assert np.isinf(field.displacement_std_m[late]).all()
            assert np.isfinite(field.displacement_std_m[~late]).all()
            z = ((field.displacement_m - moved) / field.displacement_std_m)[~late]
            assert np.abs(z).max() < 1
            last = field.displacement_m
        assert served == [
            {0, 1, 2, 3}, {4, 5, 6, 7}, {8, 9, 0, 1}, {2, 3, 4, 5}, {6, 7, 8, 9}, {0, 1, 2, 3},
        ]  # fmt: skip
        clock.call_s = 0.0
        field = tracker.update(stream[6][1])
        assert field.trusted
        assert np.isfinite(field.displacement_std_m).all()

    def test_the_next_frame_goes_on_as_if_nothing_had_happened(self, staggered, stream, monkeypatch):
        tracker = ExactTracker(staggered, deadline_us=50.0, hold=False)
        witness = ExactTracker(staggered, hold=False)
        clock = Clock(monkeypatch, 0.0)
        for n, (_, frame) in enumerate(stream[:24]):
            clock.call_s = 20e-6 if n % 3 == 1 else 0.0
            field, expected = tracker.update(frame), witness.update(frame)
            if clock.call_s == 0.0:
                assert field.trusted
                np.testing.assert_allclose(field.displacement_m, expected.displacement_m, atol=1e-12)

    def test_bridges_obey_too_and_every_wire_gets_its_turn(self, staggered, rest, monkeypatch):
        moved = hertz_press(staggered, 0.5)
        frame = frame_ohm(staggered, moved)
        garbage = frame * np.random.default_rng(2).uniform(0.2, 3.0, frame.shape)
        tracker = ExactTracker(staggered, deadline_us=400.0)
        clock = Clock(monkeypatch, 20e-6)
        for bad in (garbage, garbage, frame, garbage):
            begin = clock.now
            field = tracker.update(bad)
            assert clock.now - begin <= 420e-6
            assert np.isfinite(field.displacement_m).all()
            if bad is garbage:
                assert sk.Status.DEADLINE in field.status
        for _ in range(40):
            field = tracker.update(frame)
            if field.trusted:
                break
        assert field.trusted
        np.testing.assert_allclose(field.displacement_m, moved, atol=1e-9 * staggered.height_m)

    @pytest.mark.parametrize("deadline_us", [95.0, 105.0, 115.0])
    def test_joining_electrodes_obey(self, staggered, monkeypatch, deadline_us):
        """Wires cut short before, or between, their sets of electrodes: the next frame does without."""
        options = {"active_only": True, "relative_noise": 1e-8}
        tracker = ExactTracker(staggered, deadline_us=deadline_us, **options)
        clock = Clock(monkeypatch, 0.0)
        cut = 0
        for n, depth in enumerate(0.2 * np.sin(np.linspace(0, np.pi, 30)) ** 2):
            moved = dent(staggered, depth, centre=(4.0, 2 + n / 6))
            clock.call_s = 10e-6 if n % 2 else 0.0
            begin = clock.now
            field = tracker.update(frame_ohm(staggered, moved))
            assert clock.now - begin <= deadline_us * 1e-6 + 10e-6
            assert np.isfinite(field.displacement_m).all()
            cut += sk.Status.DEADLINE in field.status
            if clock.call_s == 0.0:
                assert field.trusted
                assert np.abs(field.displacement_m - moved).max() < 1e-4 * staggered.height_m
        assert cut > 0

    def test_an_impossible_deadline_still_serves_a_wire_a_frame(self, staggered, stream, monkeypatch):
        tracker = ExactTracker(staggered, deadline_us=1e-3)
        Clock(monkeypatch, 20e-6)
        for n in range(12):
            field = tracker.update(stream[5][1])
            done = [u for u, status in enumerate(field.status) if status is sk.Status.CONVERGED]
            assert done == [n % 10]

    def test_no_deadline_asks_no_clock_for_the_result(self, staggered, stream, monkeypatch):
        free, bound = ExactTracker(staggered), ExactTracker(staggered, deadline_us=1e6)
        Clock(monkeypatch, 20e-6)
        for _, frame in stream[:12]:
            a, b = free.update(frame), bound.update(frame)
            np.testing.assert_array_equal(a.displacement_m, b.displacement_m)
            np.testing.assert_array_equal(a.displacement_std_m, b.displacement_std_m)

    @pytest.mark.parametrize("deadline_us", [None, 1e6])
    def test_all_wires_of_a_frame_with_time_to_spare_are_solved_in_one_call(
        self, staggered, stream, monkeypatch, deadline_us
    ):
        tracker = ExactTracker(staggered, deadline_us=deadline_us, hold=False)
        clock = Clock(monkeypatch, 20e-6)
        for number, (_, frame) in enumerate(stream[:12], 1):
            assert tracker.update(frame).trusted
            assert clock.calls == number

    def test_an_interrupted_frame_keeps_the_contacts(self, staggered, stream, monkeypatch):
        """Contacts of a few wires take longer than the wires themselves, and the time is up."""
        tracker = sk.Tracker(staggered, relative_noise=1e-5, deadline_us=50.0, method="exact")
        clock = Clock(monkeypatch, 0.0)
        for _, frame in stream[:9]:
            before = tracker.update(frame)
        clock.call_s = 20e-6
        cut = [tracker.update(frame) for _, frame in stream[9:14]]
        clock.call_s = 0.0
        after = tracker.update(stream[14][1])
        (kept,) = before.contacts
        for field in cut:
            assert sk.Status.DEADLINE in field.status
            assert not field.trusted
            assert not field.precise
        for field in cut[:3]:
            assert field.contacts == before.contacts
            np.testing.assert_array_equal(field.force_n, before.force_n)
        # with a deadline that is always too short, contacts must not be those of long ago
        assert cut[3].contacts != before.contacts
        assert cut[4].contacts == cut[3].contacts
        (contact,) = after.contacts
        assert after.trusted
        assert contact.normal_force_n != kept.normal_force_n

    @pytest.mark.parametrize("between", ["gap", "rest"])
    def test_contacts_do_not_survive_a_gap_nor_a_time_at_rest(
        self, staggered, rest, stream, monkeypatch, between
    ):
        tracker = sk.Tracker(staggered, relative_noise=1e-5, deadline_us=50.0, method="exact")
        clock = Clock(monkeypatch, 0.0)
        tracker.t_ns = 0
        for _, frame in stream[:12]:
            tracker.t_ns += 80_000_000
            assert tracker.update(frame).trusted
        if between == "gap":
            tracker.t_ns += 60_000_000_000
        else:
            for _ in range(8):
                tracker.t_ns += 80_000_000
                tracker.update(rest)
        clock.call_s = 20e-6
        tracker.t_ns += 80_000_000
        field = tracker.update(stream[36][1])
        assert sk.Status.DEADLINE in field.status
        assert field.contacts == ()
