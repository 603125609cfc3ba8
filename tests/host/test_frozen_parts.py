"""Frozen wires and crossings from codes alone: found by movement and by noise, named once, readmitted."""

from __future__ import annotations

import numpy as np
import pytest

from skinnode.host.code_watch import CodeWatch, Verdict
from skinnode.host.repeat_odds import deviations_of, log_stay, log_stay_anywhere
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.protocol.codes import MISSING, CodeScale
from skinnode.protocol.scan import Scan

SHAPE = (10, 30)
REST = 49149
"""Code of R/R0 = 1."""


class Patch:
    """A patch of which the test sets the codes."""

    def __init__(self, stated: float = 3e-6) -> None:
        self.watch = CodeWatch(CodeScale(), stated)
        self.number = 0

    def see(self, codes: np.ndarray, *, complete: bool = True) -> Verdict:
        self.number += 1
        codes = codes.astype(np.uint32)
        t_ns = self.number * 10_000_000
        valid = codes <= CodeScale().steps
        scan = Scan(codes, valid, 1, self.number, complete, 1, 1, 0, 0, t_ns, t_ns)
        verdict = self.watch.judge(scan)
        self.watch.on_scan(scan)
        return verdict


def press(depth: float, k: float = 14.0) -> np.ndarray:
    """Codes under a dent of ``depth`` codes."""
    rows, columns = np.indices(SHAPE)
    dent = np.exp(-((rows - 4.5) ** 2) / 8.0 - (columns - k) ** 2 / 40.0)
    return np.rint(REST - depth * dent)


PARTS = [
    ((slice(None), 14), FaultyPart.LOWER, None, 14),
    ((slice(None), 0), FaultyPart.LOWER, None, 0),
    ((4, slice(None)), FaultyPart.UPPER, 4, None),
    ((4, 15), FaultyPart.CROSSING, 4, 15),
]


@pytest.mark.parametrize(("at", "part", "upper", "lower"), PARTS)
def test_part_of_the_quietest_patch_that_stays_behind_a_press(at, part, upper, lower) -> None:
    patch = Patch()
    middle = 0.0 if lower == 0 else 14.0
    for _ in range(10):
        assert patch.see(press(0.0)).faults == ()
    for depth in range(0, 2000, 40):
        codes = press(depth, middle)
        codes[at] = REST
        verdict = patch.see(codes)
        if verdict.faults:
            break
    assert depth < (1000 if part is FaultyPart.CROSSING else 300)
    (fault,) = verdict.faults
    assert (fault.part, fault.kind, fault.upper, fault.lower) == (part, FaultKind.FROZEN, upper, lower)
    assert fault.since == patch.number
    assert 3.0 < fault.deviations < 10.0
    left_out = np.zeros(SHAPE, np.bool_)
    left_out[at] = True
    np.testing.assert_array_equal(verdict.left_out, left_out)
    assert verdict.distrust == ""
    for _ in range(5):  # the press goes back: it stays named
        codes = press(0.0, middle)
        assert patch.see(codes).faults == (fault,)
    assert patch.see(press(30.0, middle)).faults == ()


@pytest.mark.parametrize(("at", "part", "upper", "lower"), PARTS[:3])
def test_wire_that_stays_behind_a_fast_press_is_named_in_the_first_scan(at, part, upper, lower) -> None:
    patch = Patch()
    for _ in range(10):
        assert patch.see(press(0.0)).faults == ()
    codes = press(1000.0, 0.0 if lower == 0 else 14.0)
    codes[at] = REST
    (fault,) = patch.see(codes).faults
    assert (fault.part, fault.kind, fault.upper, fault.lower) == (part, FaultKind.FROZEN, upper, lower)


def test_the_scan_that_is_solved_lacks_what_is_frozen() -> None:
    patch = Patch()
    for depth in (*[0] * 10, *range(0, 2000, 40)):
        codes = press(depth)
        codes[:, 14] = REST
        verdict = patch.see(codes)
    codes = codes.astype(np.uint32)
    scan = Scan(codes, codes < 2**32 - 1, 1, 1, True, 1, 1, 0, 0, 0, 0)
    admitted = verdict.admitted(scan)
    assert (admitted.codes[:, 14] == MISSING).all()
    assert not admitted.valid[:, 14].any()
    np.testing.assert_array_equal(np.delete(admitted.codes, 14, axis=1), np.delete(codes, 14, axis=1))
    assert (scan.codes[:, 14] == REST).all()


@pytest.mark.parametrize(("at", "part", "upper", "lower"), PARTS)
def test_part_without_the_noise_of_all_others(at, part, upper, lower) -> None:
    """At 1e-4 a code moves by six; nothing else moves."""
    patch, random = Patch(1e-4), np.random.default_rng(3)
    stuck = None
    for number in range(1, 2000):
        codes = press(500.0) + np.rint(6.5 * random.standard_normal(SHAPE))
        if number > 500:
            stuck = codes[at] if stuck is None else stuck
            codes[at] = stuck
        verdict = patch.see(codes)
        if number <= 500:
            assert verdict.faults == ()
        elif verdict.faults:
            break
    assert number - 500 < 60
    (fault,) = verdict.faults
    assert (fault.part, fault.upper, fault.lower) == (part, upper, lower)
    assert fault.deviations > 6.0
    for _ in range(300):
        codes = press(500.0) + np.rint(6.5 * random.standard_normal(SHAPE))
        assert patch.see(codes).faults == ()


@pytest.mark.long
def test_few_noisy_crossings_do_not_condemn_the_others() -> None:
    """A converter with coarser steps than its codes, of which some values lie on the edge of a step."""
    patch, random = Patch(1e-4), np.random.default_rng(3)
    restless = random.random(SHAPE) < 0.1
    for _ in range(3000):
        codes = press(500.0) + 16 * (restless & (random.random(SHAPE) < 0.5))
        assert patch.see(codes).faults == ()


def test_missing_codes_neither_prove_nor_disprove() -> None:
    patch, random = Patch(), np.random.default_rng(3)
    seen: list[DataFault] = []
    for depth in range(0, 4000, 20):
        codes = press(depth)
        codes[:, 14] = REST
        codes[random.random(SHAPE) < 0.3] = MISSING
        seen += [fault for fault in patch.see(codes, complete=False).faults if fault not in seen]
    assert [(fault.part, fault.lower) for fault in seen] == [(FaultyPart.LOWER, 14)]


def test_wires_that_mark_themselves_are_named_while_they_do() -> None:
    patch = Patch()
    patch.see(press(0.0))
    codes = press(0.0)
    codes[:, 3] = CodeScale().open
    named = [patch.see(codes).faults for _ in range(3)]
    assert named == [(DataFault(FaultyPart.LOWER, FaultKind.OPEN, lower=3, since=2, deviations=np.inf),)] * 3
    codes[:, 3], codes[7] = REST, CodeScale().short
    assert [str(fault) for fault in patch.see(codes).faults] == ["upper wire 7: short since scan 5"]
    assert patch.see(press(0.0)).faults == ()


def odds_by_counting(sigma: float, run: int, place: float | None) -> float:
    random = np.random.default_rng(1)
    true = random.random((200_000, 1)) if place is None else place
    codes = np.floor(true + sigma * random.standard_normal((200_000, run + 1)))
    return float((codes == codes[:, :1]).all(axis=1).mean())


@pytest.mark.parametrize(("sigma", "run"), [(0.02, 5), (0.05, 20), (0.1, 5)])
def test_odds_of_a_code_at_a_random_place(sigma: float, run: int) -> None:
    counted = odds_by_counting(sigma, run, None)
    assert np.exp(log_stay_anywhere(sigma, run)) == pytest.approx(counted, abs=4e-3)


@pytest.mark.parametrize("sigma", [0.2, 0.4, 1.0])
def test_bound_is_reached_in_the_middle_of_a_step(sigma: float) -> None:
    """Given the code of the middle, the next reading has it with this probability; elsewhere with less."""
    random = np.random.default_rng(1)
    for place in (0.5, 0.3, 0.0):
        stays = float((np.floor(place + sigma * random.standard_normal(400_000)) == 0).mean())
        assert stays <= np.exp(log_stay(sigma)) + 4e-3
        if place == 0.5:
            assert stays == pytest.approx(np.exp(log_stay(sigma)), abs=4e-3)


@pytest.mark.parametrize(
    ("log_p", "deviations"), [(np.log(1.35e-3), 3.0), (np.log(2.87e-7), 5.0), (-0.1, 0.0)]
)
def test_deviations_of_a_probability(log_p: float, deviations: float) -> None:
    assert deviations_of(log_p) == pytest.approx(deviations, abs=0.1)
