"""A moving skin whose upper wires are sampled one after the other: the field belongs to one time.

Truths are spheres on rubber in closed form, of which each upper wire is sampled at its own time, and straight
lines, which interpolation must reproduce.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skinnode as sk
from skinnode.model.frames import Contact, FieldFrame, SolveStats, amended
from skinnode.model.status import Status
from skinnode.solve.skew.scan_skew import ScanSkew

from .press import frame_ohm, hertz_press

PERIOD_S, ROW_S = 0.02, 3e-3
SIGMA = 3e-6
SECOND_NS = 1_000_000_000
SMALL = sk.PatchLayout.preset("staggered", upper_wires=5, upper_electrodes=5, lower_wires=24)
WIRES = np.arange(SMALL.shape[0])
REST_OHM = sk.resistance_ohm(SMALL, SMALL.upper_m)

Depth = Callable[[float], float]
"""Depth of a press, in layer heights, as a function of time (s)."""


def tracker(method: str = "exact", row_time_s: float = ROW_S, **options) -> sk.Tracker:
    options = {"relative_noise": SIGMA, "follow_noise": False, "scan_period_s": PERIOD_S} | options
    return sk.Tracker(SMALL, method=method, row_time_s=row_time_s, baseline_ohm=REST_OHM, **options)


def truth_m(depth: Depth, t_s: float) -> np.ndarray:
    return hertz_press(SMALL, depth(t_s), centre_m=(7.1e-3, 9.3e-3))


def reading(depth: Depth, t_s: float, rng: np.random.Generator, row_s: float = ROW_S) -> np.ndarray:
    """Resistances of a scan in which each upper wire is sampled at its own time, with noise."""
    rows = [truth_m(depth, t_s + u * row_s)[u] for u in WIRES]
    return frame_ohm(SMALL, np.stack(rows)) * (1.0 + SIGMA * rng.standard_normal(SMALL.shape))


def solved(
    solver: sk.Tracker, depth: Depth, times_s: np.ndarray, *, stamped: bool = False, row_s: float = ROW_S
) -> list[FieldFrame]:
    rng, fields = np.random.default_rng(1), []
    for t_s in times_s:
        if stamped:
            solver.t_ns = round(t_s * SECOND_NS)
        fields.append(solver.update(reading(depth, t_s, rng, row_s)))
    return fields


def errors_m(fields: list[FieldFrame], depth: Depth, times_s: np.ndarray) -> np.ndarray:
    return np.array(
        [field.displacement_m - truth_m(depth, t) for field, t in zip(fields, times_s, strict=True)]
    )


def largest(fields: list[FieldFrame], errors: np.ndarray) -> float:
    """The largest error, in standard deviations."""
    return max(float((np.abs(e) / f.displacement_std_m).max()) for e, f in zip(errors, fields, strict=True))


def pressing(t_s: float) -> float:
    """A press at 0.8 mm/s from 0.1 s to 0.5 s, held from then on."""
    return 0.4 * float(np.clip(t_s - 0.1, 0.0, 0.4))


# -- on the real road ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["exact", "posterior"])
def test_a_moving_press_is_at_one_time_and_its_standard_deviations_hold(method):
    times = PERIOD_S * np.arange(30)
    without = solved(tracker(method, 0.0), pressing, times)
    corrected = solved(tracker(method), pressing, times)
    before, after = errors_m(without, pressing, times), errors_m(corrected, pressing, times)
    moving = slice(8, 24)
    assert np.sqrt(np.mean(after[moving] ** 2)) < 0.25 * np.sqrt(np.mean(before[moving] ** 2))
    assert largest(without, before) > 8.0
    assert largest(corrected, after) < 5.0
    steady = corrected[moving]
    claims = [np.median(field.displacement_std_m) for field in (*steady, *without[moving])]
    assert np.median(claims[: len(steady)]) < 1.5 * np.median(claims[len(steady) :])
    assert all(field.trusted for field in corrected)


@pytest.mark.parametrize("method", ["exact", "posterior"])
def test_the_first_wire_and_a_patch_at_rest_keep_their_bits(method):
    times = PERIOD_S * np.arange(12)
    without, corrected = (solved(tracker(method, row), pressing, times) for row in (0.0, ROW_S))
    for one, other in zip(without, corrected, strict=True):
        for name in ("displacement_m", "displacement_std_m", "half_width_95_m"):
            np.testing.assert_array_equal(getattr(one, name)[0], getattr(other, name)[0])
    at_rest = [solved(tracker(method, row), lambda _: 0.0, times) for row in (0.0, ROW_S)]
    for one, other in zip(*at_rest, strict=True):
        if not one.displacement_m.any():
            np.testing.assert_array_equal(one.displacement_m, other.displacement_m)
            np.testing.assert_array_equal(one.displacement_std_m, other.displacement_std_m)


def test_lost_scans_are_noticed_by_their_times():
    times = PERIOD_S * np.array([*range(14), 17, 18, 19, 23, 24, 25])
    stamped = solved(tracker(), pressing, times, stamped=True)
    unstamped = solved(tracker(), pressing, times)
    after_gap = [14, 17]
    right, wrong = (errors_m(fields, pressing, times)[after_gap] for fields in (stamped, unstamped))
    assert np.abs(right).max() < 0.5 * np.abs(wrong).max()
    assert largest(stamped, errors_m(stamped, pressing, times)) < 5.0


def test_after_a_gap_the_past_is_not_used():
    solver, rng = tracker(), np.random.default_rng(2)
    solver.t_ns = 0
    solver.update(reading(lambda _: 0.1, 0.0, rng))
    solver.t_ns = 3 * SECOND_NS
    field = solver.update(reading(lambda _: 0.2, 3.0, rng))
    error = np.abs(field.displacement_m - truth_m(lambda _: 0.2, 3.0))
    assert (error < 5.0 * field.displacement_std_m).all()
    assert field.displacement_std_m.max() < 1e-5  # of 0.4 mm


def test_a_long_scan_period_is_no_gap():
    slow = 150.0  # scans every 3 s
    times = slow * PERIOD_S * np.arange(14)
    depth, row_s = (lambda t_s: pressing(t_s / slow)), slow * ROW_S
    pairs = [
        solved(
            tracker(row_time_s=row_s, scan_period_s=slow * PERIOD_S),
            depth,
            times,
            stamped=stamped,
            row_s=row_s,
        )
        for stamped in (True, False)
    ]
    for with_times, without in zip(*pairs, strict=True):
        np.testing.assert_array_equal(with_times.displacement_m, without.displacement_m)
        np.testing.assert_array_equal(with_times.displacement_std_m, without.displacement_std_m)


@pytest.mark.parametrize("jump_s", [0.101, 0.109, 0.113, 0.119])
@pytest.mark.parametrize("method", ["exact", "posterior"])
def test_the_standard_deviations_cover_an_onset_and_a_release_between_two_scans(method, jump_s):
    """The skin jumps before, while and after its wires are sampled; the jump back follows 0.1 s later."""

    def tapping(t_s: float) -> float:
        return 0.2 if jump_s < t_s < jump_s + 0.1 else 0.0

    times = PERIOD_S * np.arange(16)
    fields = solved(tracker(method), tapping, times)
    known = [i for i, field in enumerate(fields) if field.trusted]
    errors = errors_m(fields, tapping, times)
    assert len(known) >= len(times) - 2
    assert largest([fields[i] for i in known], errors[known]) < 5.0
    held = [i for i in known if jump_s + PERIOD_S < times[i] - PERIOD_S and times[i] < jump_s + 0.08]
    for i in held:
        assert np.abs(errors[i]).max() < 1e-5


def test_a_row_time_that_does_not_fit_into_the_period_is_refused():
    with pytest.raises(ValueError, match=r"row_time_s: got 0\.005, must be at most 0\.004, because 5 upper"):
        tracker(row_time_s=5e-3)
    with pytest.raises(ValueError, match=r"row_time_s: got -0\.001, must be finite and at least 0"):
        tracker(row_time_s=-1e-3)


# -- the interpolation --------------------------------------------------------------------------------------


def field_of(
    moved_m: np.ndarray, std_m: np.ndarray | float = 1e-6, contacts: tuple[Contact, ...] = ()
) -> FieldFrame:
    status = (Status.CONVERGED,) * len(moved_m)
    std = np.broadcast_to(std_m, moved_m.shape).copy()
    return FieldFrame(
        moved_m, std, status, np.zeros(len(moved_m)), SolveStats(0, 0, 0, 0.0), force_n=10.0 * moved_m,
        contacts=contacts,
    )  # fmt: skip


def sampled(start_m: np.ndarray, speed_m_s: np.ndarray, t_s: float, row_s: float) -> np.ndarray:
    return start_m + speed_m_s * (t_s + row_s * WIRES[:, None, None])


@pytest.mark.long
@settings(deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(0.0, 1.0),
    st.lists(st.integers(1, 8), min_size=2, max_size=6),
)
def test_a_constant_speed_is_reproduced_whatever_is_lost(seed, share, steps):
    rng = np.random.default_rng(seed)
    start, speed = 1e-4 * rng.standard_normal((2, *SMALL.upper_m.shape))
    row_s = share * PERIOD_S / len(WIRES)
    skew = ScanSkew(SMALL, row_s, PERIOD_S)
    for number, ticks in enumerate(np.cumsum([0, *steps])):
        t_s = PERIOD_S * ticks
        raw = field_of(sampled(start, speed, t_s, row_s))
        found = skew.at_first_wire(raw, round(t_s * SECOND_NS))
        if number == 0:
            assert found is raw
            continue
        np.testing.assert_allclose(found.displacement_m, start + speed * t_s, rtol=0, atol=1e-13)
        np.testing.assert_allclose(found.force_n, 10.0 * (start + speed * t_s), rtol=0, atol=1e-12)
        if number > 1:
            np.testing.assert_allclose(found.displacement_std_m, 1e-6, rtol=1e-6)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1.0))
def test_interpolation_never_leaves_the_two_scans_nor_understates_their_noise(seed, share):
    rng = np.random.default_rng(seed)
    skew = ScanSkew(SMALL, share * PERIOD_S / len(WIRES), PERIOD_S)
    shape = SMALL.upper_m.shape
    raw = [
        field_of(1e-4 * rng.standard_normal(shape), 1e-6 * np.exp(rng.standard_normal(shape)))
        for _ in range(3)
    ]
    *_, found = (skew.at_first_wire(each, None) for each in raw)
    last, new = raw[1:]
    low, high = (edge(last.displacement_m, new.displacement_m) for edge in (np.minimum, np.maximum))
    assert (found.displacement_m >= low - 1e-18).all()
    assert (found.displacement_m <= high + 1e-18).all()
    least = np.minimum(last.displacement_std_m, new.displacement_std_m)
    assert (found.displacement_std_m >= (1.0 - 1e-12) * least).all()


@pytest.mark.long
def test_a_jump_at_a_random_time_has_the_stated_mean_and_at_most_the_stated_variance():
    rng = np.random.default_rng(3)
    row_s = 0.9 * PERIOD_S / len(WIRES)
    errors, claims = [], []
    jump = 1e-4 * np.ones(SMALL.upper_m.shape)
    for at_s in PERIOD_S * rng.uniform(size=2000):
        skew = ScanSkew(SMALL, row_s, PERIOD_S)
        late = row_s * WIRES[:, None, None]
        for number in range(3):  # each wire jumps ``at_s`` after its sample in the second scan
            found = skew.at_first_wire(field_of(jump if number == 2 else 0.0 * jump, 1e-9), None)
        moved = at_s + late < PERIOD_S  # at the time at which the first wire is sampled
        errors.append((found.displacement_m - np.where(moved, jump, 0.0))[:, 0, 0])
        claims.append(found.displacement_std_m[:, 0, 0])
    bias, variance = np.mean(errors, axis=0), np.mean(np.square(errors), axis=0)
    np.testing.assert_allclose(bias, 0.0, atol=4e-6)
    assert (variance <= 1.1 * np.mean(np.square(claims), axis=0) + 1e-18).all()
    assert (variance[1:] >= 0.5 * np.mean(np.square(claims), axis=0)[1:]).all()


@pytest.mark.long
def test_a_motion_that_starts_at_a_random_time_has_at_most_the_stated_variance():
    rng = np.random.default_rng(6)
    row_s = 0.9 * PERIOD_S / len(WIRES)
    late = row_s * WIRES[:, None, None]
    errors, claims = [], []
    for at_s in PERIOD_S * rng.uniform(size=4000):  # relative to the sample of each wire in the second scan
        skew = ScanSkew(SMALL, row_s, PERIOD_S)
        gone = 1e-4 * (PERIOD_S - at_s) * np.ones(SMALL.upper_m.shape)  # until the third scan
        for number in range(3):
            found = skew.at_first_wire(field_of(gone if number == 2 else 0.0 * gone, 1e-12), None)
        true = 1e-4 * np.maximum(PERIOD_S - late - at_s, 0.0)
        errors.append((found.displacement_m - true)[:, 0, 0] / gone[0, 0, 0])
        claims.append(found.displacement_std_m[:, 0, 0] / gone[0, 0, 0])
    assert (np.mean(np.square(errors), axis=0) <= 1.1 * np.mean(np.square(claims), axis=0) + 1e-12).all()


def test_a_wire_without_solution_is_left_alone_and_the_next_frame_uses_the_one_before():
    rng = np.random.default_rng(4)
    start, speed = 1e-4 * rng.standard_normal((2, *SMALL.upper_m.shape))
    skew = ScanSkew(SMALL, ROW_S, PERIOD_S)
    for number in range(6):
        t_s = PERIOD_S * number
        moved, std = sampled(start, speed, t_s, ROW_S), np.full(SMALL.upper_m.shape, 1e-6)
        if number == 3:
            moved[2], std[2] = 7e-3, np.inf
        found = skew.at_first_wire(field_of(moved, std), round(t_s * SECOND_NS))
        expected = start + speed * t_s
        if number == 3:
            np.testing.assert_array_equal(found.displacement_m[2], 7e-3)
            assert np.isinf(found.displacement_std_m[2]).all()
            expected[2] = 7e-3
        if number:
            np.testing.assert_allclose(found.displacement_m, expected, rtol=0, atol=1e-13)
        if number > 1:
            finite = np.isfinite(found.displacement_std_m)
            np.testing.assert_allclose(found.displacement_std_m[finite], 1e-6, rtol=1e-6)


def test_a_field_that_contradicts_its_readings_is_not_used_for_the_next():
    rng = np.random.default_rng(5)
    start, speed = 1e-4 * rng.standard_normal((2, *SMALL.upper_m.shape))
    skew = ScanSkew(SMALL, ROW_S, PERIOD_S)
    for number in range(5):
        t_s = PERIOD_S * number
        raw = field_of(sampled(start, speed, t_s, ROW_S))
        if number == 3:
            none = np.zeros(len(WIRES), bool)
            wrong = amended(
                raw, displacement_m=raw.displacement_m + 1e-3, distrust="wrong", wires_trusted=none
            )
            assert skew.at_first_wire(wrong, None).displacement_m is wrong.displacement_m
        else:
            found = skew.at_first_wire(raw, None)
    np.testing.assert_allclose(found.displacement_m, start + speed * t_s, rtol=0, atol=1e-13)


def contact(centre_m: tuple[float, float], force_n: float) -> Contact:
    height = SMALL.height_m
    return Contact(
        centroid_m=np.array([*centre_m, height]), centroid_std_m=np.full(3, 1e-5), area_m2=1e-5,
        area_std_m2=1e-7, normal_force_n=force_n, normal_force_std_n=1e-3,
        shear_force_n=np.array([0.1, -0.1]) * force_n, shear_force_std_n=np.full(2, 1e-3),
    )  # fmt: skip


def test_a_contact_that_slides_and_presses_harder_is_at_the_time_of_the_first_wire():
    """Each contact is seen at the time of the wire on which it is: wire 1, then wire 3."""
    skew = ScanSkew(SMALL, ROW_S, PERIOD_S)
    pitch, speed_m_s, rate_n_s = SMALL.pitch_m, 0.02, 3.0
    for number in range(5):
        seen, t_s = [], PERIOD_S * number
        for wire in (1, 3):
            at_s = t_s + wire * ROW_S
            seen.append(contact((pitch + speed_m_s * at_s, wire * pitch), wire + rate_n_s * at_s))
        moved = np.full(SMALL.upper_m.shape, 1e-4 * number)
        found = skew.at_first_wire(field_of(moved, contacts=tuple(seen)), round(t_s * SECOND_NS)).contacts
        if number < 2:
            continue
        for wire, each in zip((3, 1), found, strict=True):  # the strongest first
            assert each.centroid_m[0] == pytest.approx(pitch + speed_m_s * t_s, abs=1e-12)
            assert each.normal_force_n == pytest.approx(wire + rate_n_s * t_s, abs=1e-12)
            assert each.normal_force_std_n == pytest.approx(1e-3, rel=1e-6)
            np.testing.assert_allclose(each.centroid_std_m, 1e-5, rtol=1e-6)


def test_a_new_contact_may_not_have_been_there_when_the_first_wire_was_sampled():
    skew, pitch = ScanSkew(SMALL, ROW_S, PERIOD_S), SMALL.pitch_m
    skew.at_first_wire(field_of(np.zeros(SMALL.upper_m.shape)), None)
    pressed = field_of(np.full(SMALL.upper_m.shape, 1e-4), contacts=(contact((pitch, 4 * pitch), 2.0),))
    (found,) = skew.at_first_wire(pressed, None).contacts
    share = 4 * ROW_S / PERIOD_S
    assert found.normal_force_n == pytest.approx(2.0 * (1.0 - share))
    assert found.normal_force_std_n >= 2.0 * np.sqrt(share * (1.0 - share))
    assert found.normal_force_std_n < 2.0
    np.testing.assert_array_equal(found.centroid_m[:2], [pitch, 4 * pitch])


@pytest.mark.parametrize("late", [False, True])
def test_a_field_without_a_solution_does_not_say_that_a_contact_is_gone(late):
    skew, pitch, rate_n_s = ScanSkew(SMALL, ROW_S, PERIOD_S), SMALL.pitch_m, 3.0
    for number in range(6):
        t_s = PERIOD_S * number
        seen = contact((pitch, 3 * pitch), 2.0 + rate_n_s * (t_s + 3 * ROW_S))
        field = field_of(np.full(SMALL.upper_m.shape, 1e-4 * number), contacts=(seen,))
        if number == 4:
            nothing, contradicts = np.zeros(len(WIRES), bool), field_of(field.displacement_m, 1e-6)
            late_field = field_of(field.displacement_m, np.inf)
            field = late_field if late else amended(contradicts, distrust="wrong", wires_trusted=nothing)
        found = skew.at_first_wire(field, None)
    (last,) = found.contacts
    assert last.normal_force_n == pytest.approx(2.0 + rate_n_s * t_s, abs=1e-12)
    assert last.normal_force_std_n == pytest.approx(1e-3, rel=1e-6)
