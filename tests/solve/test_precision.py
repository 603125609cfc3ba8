"""Precise or not: the limits that a user sets, and defaults that only a healthy patch keeps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

import skinnode as sk
from skinnode.bench.truth import Press, Skin
from skinnode.solve.precision import PrecisionLimits, is_precise, limits_of

PRESS = Press((0.018, 0.016), 0.03, 4e-4, (0.3, 0.1))


def stream(
    skin: Skin, noise: float, tracker: sk.Tracker, valid: NDArray[np.bool_] | None = None
) -> list[sk.FieldFrame]:
    rng = np.random.default_rng(2)
    fields = []
    for share in (0.0, 0.5, 1.0, 1.0, 0.0):
        ohm = skin.resistance_ohm(skin.displacement_m((PRESS,), share))
        fields.append(tracker.update(ohm * (1 + noise * rng.standard_normal(ohm.shape)), valid))
    return fields


def skin_of(name: str = "staggered", height: float = 0.5, **sizes: int) -> Skin:
    return Skin(sk.PatchLayout.preset(name, pitch_m=4e-3, height_m=4e-3 * height, **sizes))


@pytest.mark.long
@pytest.mark.parametrize(
    ("skin", "noise"),
    [
        (skin_of(), 1e-5),
        (skin_of(), 1e-4),
        (skin_of(height=1.0), 1e-5),
        (skin_of("aligned"), 1e-5),
        (skin_of(lower_wires=20), 1e-5),
    ],
    ids=["exact", "noisy", "thick", "aligned", "K < 3N"],
)
def test_a_healthy_patch_at_its_stated_noise_is_precise(skin: Skin, noise: float) -> None:
    tracker = sk.Tracker(skin.layout, relative_noise=noise, baseline_ohm=skin.rest_ohm)
    assert [field.precise for field in stream(skin, noise, tracker)] == [True] * 5


@pytest.mark.long
def test_a_patch_made_to_ordinary_tolerances_is_precise() -> None:
    skin = skin_of()
    tracker = sk.Tracker(
        skin.layout,
        relative_noise=3e-6,
        baseline_ohm=skin.rest_ohm,
        tolerances=sk.Tolerances(placement=0.02, thickness=0.05, electrode_radius=0.05, gain=0.02),
    )
    assert [field.precise for field in stream(skin, 3e-6, tracker)] == [True] * 5
    exact = limits_of(skin.layout, sk.TrackerOptions(relative_noise=3e-6))
    assert limits_of(skin.layout, tracker.options).std_m > 5 * exact.std_m


@pytest.mark.parametrize("method", ["exact", "posterior"])
def test_a_patch_that_lost_two_fifths_of_its_readings_is_not(method: str) -> None:
    skin = skin_of()
    valid = np.ones(skin.layout.shape, bool)
    valid[:, ::5] = valid[:, 1::5] = False
    tracker = sk.Tracker(skin.layout, relative_noise=1e-5, baseline_ohm=skin.rest_ohm, method=method)
    touched = stream(skin, 1e-5, tracker, valid)[1:4]
    assert [field.precise for field in touched] == [False] * 3


def test_a_patch_noisier_than_stated_is_not_precise_once_its_noise_is_known() -> None:
    skin = skin_of()
    tracker = sk.Tracker(skin.layout, relative_noise=1e-5, baseline_ohm=skin.rest_ohm)
    rng = np.random.default_rng(4)
    ohm = skin.resistance_ohm(skin.displacement_m((PRESS,), 0.5))
    noisy = ohm * (1 + 1e-3 * rng.standard_normal(ohm.shape))
    assert not tracker.update(noisy, relative_noise=1e-3).precise


@pytest.mark.long
def test_the_limits_that_the_user_sets_decide() -> None:
    skin = skin_of()
    for limit_m, precise in ((10e-6, True), (0.1e-6, False)):  # reached at this noise: 3 µm
        tracker = sk.Tracker(skin.layout, relative_noise=1e-5, baseline_ohm=skin.rest_ohm, max_std_m=limit_m)
        pressed = stream(skin, 1e-5, tracker)[2]
        assert (pressed.displacement_std_m.max() <= limit_m, pressed.precise) == (precise, precise)
    for limit_n, precise in ((100.0, True), (1e-6, False)):
        tracker = sk.Tracker(
            skin.layout,
            relative_noise=1e-5,
            baseline_ohm=skin.rest_ohm,
            method="posterior",
            max_std_m=1.0,
            max_force_std_n=limit_n,
        )
        pressed = stream(skin, 1e-5, tracker)[2]
        assert pressed.contacts
        assert pressed.precise is precise


def test_a_wire_that_was_not_solved_is_not_precise() -> None:
    skin = skin_of()
    field = sk.Tracker(skin.layout, baseline_ohm=skin.rest_ohm).update(skin.rest_ohm)
    limits = limits_of(skin.layout, sk.TrackerOptions())
    assert is_precise(field, limits)
    for value in (np.inf, np.nan):
        std = field.displacement_std_m.copy()
        std[3, 2, 1] = value
        assert not is_precise(dataclasses.replace(field, displacement_std_m=std), limits)


def test_only_a_calibrated_force_has_a_limit_by_default() -> None:
    contact = sk.Contact(np.zeros(3), np.zeros(3), 1e-4, 1e-5, 1.0, 0.5, np.zeros(2), np.zeros(2))
    skin = skin_of()
    field = sk.Tracker(skin.layout, baseline_ohm=skin.rest_ohm).update(skin.rest_ohm)
    verdicts = {}
    for calibrated in (True, False):
        touched = dataclasses.replace(
            field, contacts=(dataclasses.replace(contact, force_calibrated=calibrated),)
        )
        for limit_n in (0.4, 0.6):
            limits = PrecisionLimits(1.0, limit_n, np.inf)
            verdicts[calibrated, limit_n] = is_precise(touched, limits)
    assert verdicts == {(True, 0.4): False, (True, 0.6): True, (False, 0.4): True, (False, 0.6): True}
    asked = limits_of(skin.layout, sk.TrackerOptions(max_force_std_n=0.4))
    assert asked.uncalibrated_force_std_n == asked.force_std_n == 0.4


@pytest.mark.parametrize("name", ["max_std_m", "max_force_std_n"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan])
def test_what_is_no_limit(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: got {value}, must be positive and finite"):
        sk.TrackerOptions(**{name: value})
