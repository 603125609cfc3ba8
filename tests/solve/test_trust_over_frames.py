"""What the check and the detector carry from frame to frame: doubts, faults, noise and touches."""

from __future__ import annotations

import numpy as np
import pytest

import skinnode as sk
from skinnode.model.data_fault import FaultyPart
from skinnode.model.layout import Float
from skinnode.process import clock
from skinnode.solve.checks.explanations import Group
from skinnode.solve.checks.fault_list import FaultList
from skinnode.solve.inputs import CodeMap

LAYOUT = sk.PatchLayout.preset("staggered", upper_wires=6, upper_electrodes=5)
NOISE = 1e-5


def resistance_ohm(moved_m: Float) -> Float:
    """R = ρ / Σ 1/d over all pairs of electrodes of two wires."""
    apart_m = (LAYOUT.upper_m + moved_m)[:, :, None, None] - LAYOUT.lower_m
    pairs = 1.0 / np.linalg.norm(apart_m, axis=-1)
    return np.asarray(LAYOUT.resistivity_ohm_per_m / pairs.sum(axis=(1, 3)))


REST_OHM = resistance_ohm(np.zeros_like(LAYOUT.upper_m))


def press_m(depth: float) -> Float:
    """A round dent with some shear, ``depth`` in units of the layer."""
    r2 = ((LAYOUT.upper_m[..., :2] - 9e-3) ** 2).sum(axis=-1) / 6e-3**2
    down_m = depth * LAYOUT.height_m / (1 + r2) ** 1.5
    return np.stack([0.1 * down_m, 0.05 * down_m, -down_m], axis=-1)


def reading_ohm(moved_m: Float, rng: np.random.Generator, noise: float = NOISE) -> Float:
    return np.asarray(resistance_ohm(moved_m) * rng.normal(1.0, noise, LAYOUT.shape))


def tracker(**options: object) -> sk.Tracker:
    base = {"method": "exact", "relative_noise": NOISE, "baseline_ohm": REST_OHM, "contacts": False}
    return sk.Tracker(LAYOUT, **(base | options))  # type: ignore[arg-type]


REST_M = np.zeros_like(LAYOUT.upper_m)


def test_the_forward_model_is_that_of_the_package() -> None:
    assert sk.resistance_ohm(LAYOUT, LAYOUT.upper_m) == pytest.approx(REST_OHM, rel=1e-12)


@pytest.mark.parametrize("share", [2.5e-3, 3e-3, 3.5e-3])
def test_a_field_that_contradicts_its_readings_is_not_trusted_when_it_is_held(share: float) -> None:
    rng, stream, moved_m = np.random.default_rng(3), tracker(), press_m(0.1)
    for _ in range(3):
        stream.update(reading_ohm(REST_M, rng))
    held = 0
    for _ in range(12):
        ohm = reading_ohm(moved_m, rng)
        ohm[2, 7] *= 1 + share
        field = stream.update(ohm)
        held += field.held is not None and bool(field.held.all())
        off = np.abs(field.displacement_m - moved_m) / field.displacement_std_m
        assert not field.trusted or off.max() < 6, (share, field.distrust, off.max())
    assert held or share > 3e-3  # the field is held in some of these frames


@pytest.mark.parametrize("by_codes", [False, True])
def test_a_reading_that_has_become_right_is_used_again(by_codes: bool) -> None:
    least, most, steps = 0.25, 1.25, 2**24 - 4
    step = (most - least) / steps
    codes = CodeMap(REST_OHM, least, step, steps, step / np.sqrt(12) * REST_OHM, NOISE)
    rng, moved_m = np.random.default_rng(3), press_m(0.1)
    stream = tracker(codes=codes, detect=False, follow_noise=False)
    listed = []
    for number in range(90):
        ohm = reading_ohm(moved_m if number > 2 else REST_M, rng)
        if 5 <= number < 12:
            ohm[2, 7] = 0.9 * REST_OHM[2, 7]
        if by_codes:
            field, _ = stream.update_codes(np.rint((ohm / REST_OHM - least) / step).astype(np.uint32))
        else:
            field = stream.update(ohm)
        listed.append(bool(field.faults))
    assert listed[11]
    assert not listed[80]


@pytest.mark.parametrize("reset", [False, True])
def test_one_noisy_frame_leaves_the_detector_as_sensitive_as_before(reset: bool) -> None:
    rng, stream = np.random.default_rng(1), tracker()
    for _ in range(4):
        stream.update(reading_ohm(REST_M, rng))
    stream.update(reading_ohm(REST_M, rng, 1e-2), relative_noise=1e-2)
    if reset:
        stream.reset()
    for _ in range(2):
        stream.update(reading_ohm(REST_M, rng))
    for _ in range(5):
        field = stream.update(reading_ohm(press_m(0.02), rng))
    assert field.touched
    assert -1e6 * field.displacement_m[..., 2].min() == pytest.approx(37, abs=2)


def test_a_held_press_is_no_creep_of_a_touch_in_less_noise() -> None:
    rng, stream, moved_m = np.random.default_rng(5), tracker(scan_period_s=1.0), press_m(0.1)
    for now_m, frames, noise in (
        (REST_M, 4, 1e-5), (moved_m, 6, 1e-5), (REST_M, 6, 1e-5), (REST_M, 2, 1e-4),
    ):  # fmt: skip
        for _ in range(frames):
            stream.update(reading_ohm(now_m, rng, noise), relative_noise=noise)
    touched = [stream.update(reading_ohm(moved_m, rng, 1e-4), relative_noise=1e-4).touched for _ in range(25)]
    assert all(touched)


def test_a_touch_ends_although_every_third_frame_is_partial() -> None:
    rng, stream, moved_m = np.random.default_rng(5), tracker(), press_m(0.1)
    touched = []
    for number in range(40):
        valid = np.ones(LAYOUT.shape, bool)
        if number % 3 == 2:
            valid[:, ::2] = valid[0] = False
        field = stream.update(reading_ohm(moved_m if 6 <= number < 15 else REST_M, rng), valid)
        touched.append(field.touched)
    assert touched[9:15].count(True) >= 3
    assert True not in touched[25:]
    assert touched[25:].count(False) > 8


def test_a_fault_stays_listed_while_the_noise_is_estimated_in_each_frame() -> None:
    rng, moved_m = np.random.default_rng(3), press_m(0.1)
    posterior = sk.Posterior(LAYOUT, relative_noise=NOISE, estimate_noise=True, contacts=False)
    since = set()
    for number in range(24):
        ohm = reading_ohm(moved_m if number > 2 else REST_M, rng)
        if number >= 5:
            ohm[2, 7] = 0.9 * REST_OHM[2, 7]
        field = posterior.update(ohm)
        if number >= 9:
            since |= {fault.since for fault in field.faults}
            assert posterior.check.left_out is not None
    assert len(since) == 1


@pytest.mark.long
def test_a_repaired_reading_is_used_again_however_often_it_was_wrong() -> None:
    shape = LAYOUT.shape
    faults, group = FaultList(shape), Group(FaultyPart.CROSSING, 2, 7, 50.0)
    right, known = np.zeros(shape), np.ones(shape, bool)
    number = 0
    for _ in range(12):  # a loose contact
        while faults.mask is None:
            faults.add([group], number, number)
            number += 1
        waited = 0
        while faults.mask is not None and waited < 10_000:
            faults.follow(right, known)
            number, waited = number + 1, waited + 1
    assert faults.mask is None
    assert waited == 4096


class FrameClock(clock.SystemClock):
    """Time passes from frame to frame, but not during a frame."""

    now_ns = 0

    def monotonic_ns(self) -> int:  # type: ignore[override]
        return self.now_ns


def test_the_deadline_of_an_exact_frame_does_not_end_the_frames_of_the_posterior() -> None:
    rng, frames = np.random.default_rng(1), FrameClock()
    with clock.use(frames):
        stream = tracker(method="auto", deadline_us=5e4)

        def solved(moved_m: Float, noise: float) -> sk.FieldFrame:
            frames.now_ns += 80_000_000
            return stream.update(reading_ohm(moved_m, rng, noise))

        for moved_m in (REST_M, press_m(0.6)):  # the posterior checks the roots of such a jump
            assert solved(moved_m, NOISE).method == "exact"
        for _ in range(60):
            solved(REST_M, 3e-4)
        assert stream.method == "posterior"
        moved_m = press_m(0.5)
        field = solved(moved_m, 3e-4)
    assert set(field.status) == {sk.Status.CONVERGED}
    assert (np.abs(field.displacement_m - moved_m) < 5 * field.displacement_std_m).all()


def test_a_field_without_a_solved_wire_has_no_contacts() -> None:
    rng = np.random.default_rng(5)
    posterior = sk.Posterior(LAYOUT, relative_noise=1e-4, baseline_ohm=REST_OHM)
    assert posterior.update(reading_ohm(press_m(0.2), rng, 1e-4)).contacts
    posterior.stop_at(0.0)
    late = posterior.update(reading_ohm(press_m(0.3), rng, 1e-4))
    assert set(late.status) == {sk.Status.DEADLINE}
    assert late.contacts == ()
    posterior.stop_at(np.inf)
    assert posterior.update(reading_ohm(press_m(0.3), rng, 1e-4)).contacts


@pytest.mark.long
def test_faults_of_the_exact_method_do_not_return_after_the_posterior() -> None:
    least, most, steps = 0.25, 1.25, 2**24 - 4
    step = (most - least) / steps
    codes = CodeMap(REST_OHM, least, step, steps, step / np.sqrt(12) * REST_OHM, NOISE)
    rng, stream = np.random.default_rng(1), tracker(method="auto", codes=codes, detect=False)

    def field(noise: float, wrong: float = 1.0) -> sk.FieldFrame:
        ohm = reading_ohm(REST_M, rng, noise)
        ohm[2, 7] *= wrong
        return stream.update_codes(np.rint((ohm / REST_OHM - least) / step).astype(np.uint32))[0]

    for _ in range(8):
        assert field(NOISE, wrong=0.9).method == "exact"
    assert field(NOISE, wrong=0.9).faults
    methods = [field(3e-4).method for _ in range(60)]
    assert methods[-1] == "posterior"
    for _ in range(120):
        last = field(NOISE)
        if last.method == "exact":
            break
    assert last.method == "exact"
    assert not last.faults
    assert last.trusted


@pytest.mark.parametrize("method", ["exact", "posterior"])
def test_after_a_reset_the_first_frame_is_judged_by_the_stated_noise(method: str) -> None:
    rng, used, new = np.random.default_rng(4), tracker(method=method), tracker(method=method)
    for _ in range(60):
        used.update(reading_ohm(REST_M, rng, 20 * NOISE))
    used.reset()
    ohm = reading_ohm(press_m(0.003), rng)
    again, expected = used.update(ohm), new.update(ohm)
    assert expected.touched
    assert again.touched
    assert again.touch_odds == expected.touch_odds
    np.testing.assert_array_equal(again.displacement_std_m, expected.displacement_std_m)


@pytest.mark.parametrize("every", [2, 3])
@pytest.mark.parametrize("given", [False, True])
def test_a_touch_ends_although_the_noise_alternates(every: int, given: bool) -> None:
    rng, stream, moved_m = np.random.default_rng(5), tracker(), press_m(0.1)
    touched = []
    for number in range(40):
        noise = NOISE if number % every else 3 * NOISE
        ohm = reading_ohm(moved_m if 6 <= number < 15 else REST_M, rng, noise)
        field = stream.update(ohm, relative_noise=noise if given or noise > NOISE else None)
        touched.append(field.touched)
    assert all(touched[6:15])
    assert not any(touched[:6])
    assert not any(touched[20:])
