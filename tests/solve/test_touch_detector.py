"""The touch detector on simulated streams: taps, held and slow presses, creep, drift, lost readings.

The presses are Hertz's spheres in closed form and dents that no load on a half-space makes; the resistances
come from the forward model of the benchmarks, not from that of the detector.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest

import skinnode as sk
from skinnode.bench.trust_loads import Dent
from skinnode.bench.truth import Press, Skin
from skinnode.solve.detect.touch_detector import TouchDetector
from tests.lanes import some_long

NOISE, PERIOD_S = 1e-3, 0.08
LAYOUT = sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
SKIN = Skin(LAYOUT)
REST = SKIN.rest_ohm
MIDDLE = (4.3 * LAYOUT.pitch_m, 4.6 * LAYOUT.pitch_m)


@functools.cache
def sphere(depth: float) -> np.ndarray:
    """Resistances under a blunt sphere with a contact radius of two pitches."""
    sunk = depth * LAYOUT.height_m
    load = Press(MIDDLE, (2.0 * LAYOUT.pitch_m) ** 2 / sunk, sunk)
    return SKIN.resistance_ohm(SKIN.displacement_m((load,), 1.0))


class Stream:
    """A patch whose wires' gains drift by 1 % an hour, each up or down."""

    def __init__(self, noise: float = NOISE, seed: int = 1, drift: str = "steady", rest: int = 700) -> None:
        self.noise, self.drift, self.rng = noise, drift, np.random.default_rng(seed)
        upper, lower = LAYOUT.shape
        self.gains = np.zeros((upper, 1)), np.zeros(lower)
        self.signs = self.rng.choice((-1.0, 1.0), (upper, 1)), self.rng.choice((-1.0, 1.0), lower)
        self.detector = TouchDetector(
            LAYOUT, REST, np.full(LAYOUT.shape, noise), np.zeros(LAYOUT.shape),
            period_s=PERIOD_S, false_alarms_per_hour=0.1,
        )  # fmt: skip
        self.see(REST, rest)

    def see(self, ohm: np.ndarray, frames: int = 1, valid: np.ndarray | None = None) -> list[bool | None]:
        """Pass frames; return ``touched`` of each."""
        found = []
        for _ in range(frames):
            for gain, sign in zip(self.gains, self.signs, strict=True):
                step = 0.01 * PERIOD_S / 3600.0 * sign
                if self.drift == "walk":
                    step = 0.01 * np.sqrt(PERIOD_S / 3600.0) * self.rng.standard_normal(sign.shape)
                gain += step
            noisy = ohm * (1.0 + self.noise * self.rng.standard_normal(ohm.shape))
            noisy *= (1.0 + self.gains[0]) * (1.0 + self.gains[1])
            found.append(self.detector.see(noisy, valid).touched)
        return found


def changes(touched: list[bool | None]) -> list[bool | None]:
    """The decisions without repetitions."""
    return [now for now, before in zip(touched, [None, *touched[:-1]], strict=True) if now is not before]


@pytest.mark.long
@pytest.mark.parametrize("drift", some_long(["steady", "walk"], "walk"))
def test_presses_are_found_and_released_once(drift: str) -> None:
    """Spheres of 2 % and dents of 5 % of the layer height, within three frames; one onset, one release."""
    stream = Stream(drift=drift)
    dent = Dent(MIDDLE, 1.4 * LAYOUT.pitch_m, 0.05 * LAYOUT.height_m)
    dented = SKIN.resistance_ohm(SKIN.displacement_m((dent,), 1.0))
    late = 0
    for _ in range(20):
        for ohm in (sphere(0.02), dented):
            touched = stream.see(ohm, 15) + stream.see(REST, 60)
            late += touched.index(True) >= 3
            assert changes(touched)[-2:] == [True, False]
            assert not any(touched[15 + 12 :])
    assert late <= 2  # of 40


def test_a_tap_of_one_scan_is_found() -> None:
    stream = Stream()
    for _ in range(10):
        touched = stream.see(sphere(0.03)) + stream.see(REST, 40)
        assert touched[0] is True
        assert changes(touched) == [True, False]


@pytest.mark.long
@pytest.mark.parametrize("drift", some_long(["steady", "walk"], "walk"))
@pytest.mark.parametrize("noise", some_long([1e-3, 1e-5], 1e-5))
def test_a_press_held_for_ten_minutes_stays_touched(noise: float, drift: str) -> None:
    """Although the gains then differ from those before by more than the press changes the readings."""
    stream = Stream(noise=noise, drift=drift)
    touched = stream.see(sphere(0.02), 7500)
    assert all(touched[3:])
    after = stream.see(REST, 300)
    assert not any(after[20:])


def test_a_press_that_deepens_in_ten_seconds_is_found() -> None:
    stream = Stream()
    steps = [sphere(0.05 * (n + 1) / 25) for n in range(25)]
    touched: list[bool | None] = []
    for ohm in steps:
        touched += stream.see(ohm, 5)
    assert touched.index(True) < 100
    assert all(touched[100:])


@pytest.mark.long
@pytest.mark.parametrize("noise", some_long([1e-3, 1e-5], 1e-5))
def test_creep_after_a_release_ends(noise: float) -> None:
    """A tenth of a press of 30 % remains and decays in half a minute; a new press is found all the same."""
    stream = Stream(noise=noise)
    assert all(stream.see(sphere(0.3), 200))
    left = np.log(sphere(0.3) / REST)
    touched: list[bool | None] = []
    for t in range(3000):
        touched += stream.see(REST * np.exp(0.1 * np.exp(-t * PERIOD_S / 30.0) * left))
    assert not any(touched[1600:])
    assert stream.see(sphere(0.05), 10)[-1]


@pytest.mark.long
def test_an_hour_of_drift_is_not_a_touch() -> None:
    stream = Stream()
    assert not any(stream.see(REST, 20_000))  # 27 minutes
    errors = (1.0 + stream.gains[0]) * (1.0 + stream.gains[1]) - 1.0
    upper, lower = LAYOUT.shape
    estimated = stream.detector.gains
    estimated = estimated[:upper, None] + estimated[upper : upper + lower] + estimated[-1]
    assert np.abs(errors).max() > 5.0 * NOISE
    # what the offsets of the readings follow is not in the gains, but no press either
    assert np.sqrt(np.mean((estimated - errors) ** 2)) < np.sqrt(np.mean(errors**2))


def test_lost_readings_neither_alarm_nor_hide_a_press() -> None:
    stream = Stream()
    valid = np.ones(LAYOUT.shape, bool)
    valid[7] = valid[:, 20] = False
    assert not any(stream.see(REST, 500, valid))
    assert all(stream.see(sphere(0.03), 10, valid)[3:])
    assert not any(stream.see(REST, 100, valid)[20:])
    valid[:] = False
    valid[0] = True
    assert stream.see(REST, 2, valid) == [None, None]
    assert not any(stream.see(REST, 50))
    assert all(stream.see(np.where(np.arange(30) == 4, np.nan, sphere(0.03)), 10)[3:])


@pytest.mark.long
@pytest.mark.parametrize("lost", some_long([True, False], True))
def test_drift_while_no_scan_is_usable_is_no_touch(lost: bool) -> None:
    """For five minutes, scans are lost or without readings; the gains drift as much as the prior expects."""
    stream = Stream(noise=1e-4, drift="walk")
    frames = round(300.0 / PERIOD_S)
    touched: list[bool | None] = []
    for _ in range(10):
        for gain in stream.gains:
            gain += 0.01 * np.sqrt(300.0 / 3600.0) * stream.rng.standard_normal(gain.shape)
        if lost:
            stream.detector.miss(frames)
        else:
            for _ in range(frames):
                stream.detector.see(np.full(REST.shape, np.nan))
        touched += stream.see(REST, 60)
        pressed = stream.see(sphere(0.05), 10)
        assert all(pressed[3:])
        assert not any(stream.see(REST, 60)[30:])
    assert not any(touched)


@pytest.mark.long
def test_noise_that_is_not_as_stated_is_neither_a_touch_nor_hides_one() -> None:
    """From 0.7 to 1.4 times the stated noise, where the noise estimate of the tracker does not act."""
    for factor in (0.7, 1.4):
        stream = Stream(rest=0)
        stream.noise = factor * NOISE
        assert not any(stream.see(REST, 3000)[200:])
        assert all(stream.see(sphere(0.05), 10)[3:])
        assert not any(stream.see(REST, 200)[20:])


def test_the_odds_say_what_the_decision_says() -> None:
    stream = Stream()
    rng = stream.rng
    quiet = [
        stream.detector.see(REST * (1.0 + NOISE * rng.standard_normal(REST.shape))).odds for _ in range(200)
    ]
    assert np.quantile(quiet, 0.95) < 1.0
    pressed = stream.detector.see(sphere(0.3) * (1.0 + NOISE * rng.standard_normal(REST.shape)))
    assert pressed.touched
    assert pressed.odds > 1e6
