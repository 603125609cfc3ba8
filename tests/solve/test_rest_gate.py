"""An untouched patch is not solved: its fields agree with the solvers', and faults are still found."""

from __future__ import annotations

import numpy as np
import pytest

import skinnode as sk
from skinnode.bench.trust_loads import draw
from skinnode.bench.truth import Converter, Skin, stream
from skinnode.protocol.codes import CodeScale, encode
from skinnode.solve.inputs import CodeMap
from tests.lanes import some_long

LAYOUT = sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
SKIN = Skin(LAYOUT)
REST = SKIN.rest_ohm
SHARES = np.concatenate([np.zeros(20), np.linspace(0, 1, 6), np.ones(8), np.linspace(1, 0, 6), np.zeros(30)])


def tracker(noise: float, **options: object) -> sk.Tracker:
    return sk.Tracker(LAYOUT, relative_noise=noise, baseline_ohm=REST, **options)  # type: ignore[arg-type]


@pytest.mark.long
@pytest.mark.parametrize(
    ("noise", "method"),
    some_long(
        [(1e-5, "exact"), (1e-3, "posterior"), (1e-4, "posterior")], (1e-5, "exact"), (1e-4, "posterior")
    ),
)
@pytest.mark.parametrize("kind", some_long(["punch", "dent"], "punch"))
def test_fields_with_and_without_the_detector_agree(noise: float, method: str, kind: str) -> None:
    """Within five standard deviations of their difference, and each with the truth."""
    rng = np.random.default_rng(4)
    load = draw(kind, LAYOUT, rng, 0.1)
    frames = stream(SKIN, (load,), SHARES, Converter(noise), rng)
    with_it, without = tracker(noise), tracker(noise, detect=False)
    assert with_it.method == method
    solved, touched = 0, []
    for ohm, truth in zip(frames.frames_ohm, frames.truth_m, strict=True):
        one, other = with_it.update(ohm), without.update(ohm)
        std = np.hypot(one.displacement_std_m, other.displacement_std_m)
        assert (np.abs(one.displacement_m - other.displacement_m) <= 5.0 * std).all()
        assert (np.abs(one.displacement_m - truth) <= 5.0 * one.displacement_std_m).all()
        assert one.trusted
        assert other.touched is None
        assert other.touch_odds is None
        solved += one.stats.evaluations > 0
        touched.append(one.touched)
    onsets = sum(now and not before for before, now in zip([False, *touched], touched, strict=False))
    assert onsets == 1
    assert not any(touched[:20])
    assert all(touched[26:34])
    assert not any(touched[-20:])
    assert solved < 35  # of 70 frames, 20 of which are touched


def test_the_field_at_rest_is_zero_and_says_so() -> None:
    rng = np.random.default_rng(5)
    follower = tracker(1e-3, stiffness_n_per_m=100.0)
    fields = [follower.update(REST * (1.0 + 1e-3 * rng.standard_normal(REST.shape))) for _ in range(30)]
    field = fields[-1]
    assert field.touched is False
    assert field.touch_odds is not None
    assert 0.0 < field.touch_odds < 1.0
    assert (field.displacement_m == 0.0).all()
    assert field.force_n is not None
    assert (field.force_n == 0.0).all()
    assert field.contacts == ()
    assert field.trusted
    assert field.held is not None
    assert field.held.all()
    assert (field.displacement_std_m > 0.0).all()
    assert np.isfinite(field.displacement_std_m).all()
    np.testing.assert_allclose(field.residual, 1e-3, rtol=0.6)


@pytest.mark.long
def test_the_deviations_at_rest_follow_the_noise_of_the_stream() -> None:
    rng = np.random.default_rng(10)
    follower = tracker(1e-4)
    std = []
    for noise in (1e-4, 1e-3):
        for _ in range(80):
            field = follower.update(REST * (1.0 + noise * rng.standard_normal(REST.shape)))
        std.append(float(np.median(field.displacement_std_m)))
        assert field.stats.evaluations == 0
    assert std[1] > 3.0 * std[0]


@pytest.mark.long
@pytest.mark.parametrize("noise", [1e-5, 1e-3])
def test_a_reading_that_goes_wrong_at_rest_is_found(noise: float) -> None:
    """As it is without the detector, which at a noise of 1e-3 names the whole wire."""
    rng = np.random.default_rng(6)
    with_it, without = tracker(noise), tracker(noise, detect=False)
    for step in range(52):
        ohm = REST * (1.0 + noise * rng.standard_normal(REST.shape))
        ohm[3, 12] *= 1.0 + 40.0 * noise * (step >= 40)
        field, other = with_it.update(ohm), without.update(ohm)
    assert field.faults
    places = [(fault.part, fault.upper, fault.lower) for fault in field.faults]
    assert places == [(fault.part, fault.upper, fault.lower) for fault in other.faults]
    assert all(fault.upper == 3 for fault in field.faults)


def test_lost_readings_at_rest_are_not_trusted_as_before() -> None:
    rng = np.random.default_rng(7)
    with_it, without = tracker(1e-3), tracker(1e-3, detect=False)
    valid = np.ones(REST.shape, bool)
    for step in range(30):
        if step == 10:
            valid[:4] = False  # less than three quarters remain
        if step == 20:
            valid[:] = True
        ohm = REST * (1.0 + 1e-3 * rng.standard_normal(REST.shape))
        one, other = with_it.update(ohm, valid), without.update(ohm, valid)
        assert one.trusted == other.trusted == (step < 10 or step >= 20)


@pytest.mark.parametrize("own", [1e-5, 1e-3])
def test_codes_at_rest_are_no_touch_and_a_press_is(own: float) -> None:
    """With 16-bit codes; at a noise of 1e-5, two thirds of a code, rounding matters as much as noise."""
    rng = np.random.default_rng(8)
    scale = CodeScale(16)
    codes = CodeMap(
        baseline_ohm=REST,
        lo=scale.lo,
        step=scale.step,
        steps=scale.steps,
        rounding_ohm=scale.relative_std * REST,
        relative_noise=own,
    )
    follower = tracker(own, codes=codes)
    pressed = SKIN.resistance_ohm(SKIN.displacement_m((draw("punch", LAYOUT, rng, 0.05),), 1.0))

    def update(ohm: np.ndarray) -> sk.FieldFrame:
        noisy = ohm * (1.0 + own * rng.standard_normal(ohm.shape))
        field, invalid = follower.update_codes(encode(noisy, REST, scale))
        assert invalid == 0
        return field

    assert not any(update(REST).touched for _ in range(300))
    assert all([update(pressed).touched for _ in range(10)][3:])
    assert not any([update(REST).touched for _ in range(60)][10:])


def test_codes_that_change_in_place_are_decoded_again() -> None:
    """A host passes the same array again if no code has changed; any other program may reuse its array."""
    own, scale, rng = 1e-3, CodeScale(16), np.random.default_rng(8)
    codes = CodeMap(REST, scale.lo, scale.step, scale.steps, scale.relative_std * REST, own)
    reusing, fresh = tracker(own, codes=codes), tracker(own, codes=codes)
    array = np.zeros(REST.shape, np.uint32)
    frozen = array.view()
    frozen.flags.writeable = False
    for number in range(40):
        array[:] = encode(REST * (1.0 + own * rng.standard_normal(REST.shape)), REST, scale)
        passed = array if number % 2 else frozen
        one, other = reusing.update_codes(passed)[0], fresh.update_codes(array.copy())[0]
        np.testing.assert_array_equal(one.residual, other.residual)
        assert one.touch_odds == other.touch_odds


@pytest.mark.long
@pytest.mark.parametrize("timed", some_long([True, False], True))
def test_drift_during_a_gap_is_no_touch_if_the_times_are_known(timed: bool) -> None:
    """The scans pause for eight hours, in which the gain of each wire changes by 3 %, up or down."""
    rng = np.random.default_rng(11)
    follower = tracker(1e-3)
    gains = 1.0 + 0.03 * rng.choice((-1.0, 1.0), (REST.shape[0], 1))
    touched = []
    for number in range(90):
        paused_s = 0.0 if number < 50 else 8 * 3600.0
        follower.t_ns = round(1e9 * (0.08 * number + paused_s)) if timed else None
        ohm = REST * (1.0 if number < 50 else gains)
        touched.append(follower.update(ohm * (1.0 + 1e-3 * rng.standard_normal(REST.shape))).touched)
    assert not any(touched[:50])
    assert any(touched[50:]) is not timed


def test_times_of_a_stream_without_gaps_change_nothing() -> None:
    """Also if they jitter, and if a second is missing."""
    rng = np.random.default_rng(12)
    timed, untimed = tracker(1e-3), tracker(1e-3)
    for number in range(120):
        missing = 12 if number > 60 else 0
        timed.t_ns = round(1e9 * 0.08 * (number + missing + rng.uniform(-0.4, 0.4)))
        ohm = REST * (1.0 + 1e-3 * rng.standard_normal(REST.shape))
        one, other = timed.update(ohm), untimed.update(ohm)
        assert (one.touched, one.touch_odds) == (other.touched, other.touch_odds)
        np.testing.assert_array_equal(one.displacement_std_m, other.displacement_std_m)


def test_options_of_the_detector_are_checked() -> None:
    with pytest.raises(ValueError, match=r"relative_noise: got 0\.0, must be positive and finite"):
        tracker(0.0)
    for name in ("false_alarms_per_hour", "scan_period_s"):
        with pytest.raises(ValueError, match=name):
            tracker(1e-3, **{name: 0.0})


@pytest.mark.long
def test_more_false_alarms_find_slighter_touches() -> None:
    found = {}
    for rate in (0.01, 1000.0):
        rng = np.random.default_rng(9)
        follower = tracker(1e-3, false_alarms_per_hour=rate)
        found[rate] = 0
        for _ in range(25):
            for _ in range(20):
                follower.update(REST * (1.0 + 1e-3 * rng.standard_normal(REST.shape)))
            load = draw("dent", LAYOUT, rng, 0.015)
            ohm = SKIN.resistance_ohm(SKIN.displacement_m((load,), 1.0))
            found[rate] += bool(follower.update(ohm * (1.0 + 1e-3 * rng.standard_normal(ohm.shape))).touched)
    assert found[0.01] + 2 < found[1000.0]
