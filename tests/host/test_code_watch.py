"""Frozen converters and bad wires from codes alone, and no false alarm at rest."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from skinnode.config import SimulationConfig
from skinnode.host.code_watch import CodeWatch, Verdict
from skinnode.host.converter_liveness import Alive
from skinnode.host.open_and_shorted_wires import WireFault, WireState
from skinnode.host.repeated_codes import LEAST_RUN
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.model.layout import Float, PatchLayout
from skinnode.protocol.codes import MISSING, CodeScale, encode
from skinnode.protocol.scan import Scan
from skinnode.protocol.summary import SummaryFlag
from tests.lanes import some_long
from vcan_sim.default_scene import Scene
from vcan_sim.sensor import SimulatedPatch

SHAPE = (4, 12)
NOISE = 3e-6
PERIOD_NS = 12_500_000
REST = np.full(SHAPE, 1000.0)


def scan_of(codes: np.ndarray, scale: CodeScale, flags: int = 0, number: int = 1) -> Scan:
    return Scan(
        codes=codes,
        valid=codes <= scale.steps,
        counter=1,
        scan=number,
        complete=True,
        chunks_expected=1,
        chunks_received=1,
        device_time_us=0,
        flags=flags,
        t_first_ns=number * PERIOD_NS,
        t_last_ns=number * PERIOD_NS,
    )


class Patch:
    """A patch at rest with a converter of ``noise``, watched by a host that believes in NOISE."""

    def __init__(self, noise: float = NOISE, bits: int = 16, stated: float = NOISE) -> None:
        self.scale = CodeScale(bits)
        self.watch = CodeWatch(self.scale, stated)
        self.number = 0
        self._random = np.random.default_rng(7)
        self._noise = noise

    def read(self, ohm: Float = REST) -> np.ndarray:
        noisy = ohm * (1.0 + self._noise * self._random.standard_normal(ohm.shape))
        return encode(noisy, np.full(ohm.shape, 1000.0), self.scale)

    def see(self, codes: np.ndarray, flags: int = 0) -> Verdict:
        self.number += 1
        scan = scan_of(codes, self.scale, flags, self.number)
        verdict = self.watch.judge(scan)
        self.watch.on_scan(scan)
        return verdict


PRESSED = 1000.0 * np.random.default_rng(2).uniform(0.8, 0.95, (10, 30))


@pytest.mark.parametrize(
    ("bits", "noise", "ohm"), [(24, 3e-6, REST), (16, 3e-6, PRESSED), (16, 1e-5, REST), (16, 1e-4, REST)]
)
def test_frozen_after_noise_was_seen(bits: int, noise: float, ohm: Float) -> None:
    patch = Patch(noise, bits, stated=noise)
    for _ in range(200):
        assert patch.see(patch.read(ohm)).faults == ()
    assert patch.watch.alive is Alive.YES
    stuck = patch.read(ohm)
    first = next(scan for scan in range(2000) if patch.see(stuck).distrust)
    assert first < 1000
    more = max(1, LEAST_RUN - first)  # a field is not trusted at once, a patch is frozen later
    for _ in range(more):
        verdict = patch.see(stuck)
    assert patch.watch.frozen
    assert f"its codes have not changed for {first + more} scans" == verdict.distrust
    (fault,) = verdict.faults
    assert (fault.part, fault.kind, fault.since) == (FaultyPart.PATCH, FaultKind.FROZEN, 201 + first)
    assert 5.0 < fault.deviations < 100.0
    assert patch.see(patch.read(ohm * 1.01)).faults == ()
    assert not patch.watch.frozen


@pytest.mark.parametrize("counts", [False, True])
def test_movement_that_ends_at_once_is_doubted_unless_the_patch_counts(counts: bool) -> None:
    patch = Patch(3e-5, stated=1e-6)  # as stated, noise would hardly show in the codes
    for _ in range(100):
        patch.see(patch.read(), (patch.number % 3 + 1) << 6 if counts else 0)
    pressed = patch.read(0.9 * REST)
    for expected in (
        "",
        "stopped changing mid-movement, 1 scan ago",
        "stopped changing mid-movement, 2 scans ago",
    ):
        verdict = patch.see(pressed, (patch.number % 3 + 1) << 6 if counts else 0)
        assert verdict.distrust.endswith(expected) if expected and not counts else not verdict.distrust
        assert not verdict.faults
        assert not patch.watch.frozen


def test_a_repeated_scan_is_not_trusted_and_the_patch_is_not_frozen() -> None:
    patch = Patch(1e-4, stated=1e-4)
    for _ in range(100):
        patch.see(patch.read())
    once = patch.read()
    assert patch.see(once).distrust == ""
    assert patch.see(once).distrust == "its codes have not changed for 1 scan"
    assert not patch.watch.frozen
    assert patch.see(patch.read()).distrust == ""


def test_a_converter_at_half_the_rate_of_the_scans_is_soon_trusted() -> None:
    patch = Patch(1e-4, stated=1e-4)
    for _ in range(100):
        patch.see(patch.read())
    distrusted = 0
    for _ in range(100):
        codes = patch.read()
        distrusted += sum(patch.see(codes).distrust != "" for _ in range(2))
        assert not patch.watch.frozen
    assert distrusted == 1


@pytest.mark.long
def test_quiet_patch_at_rest_that_says_nothing() -> None:
    """At rest every code is in the middle of its step: what is live at 2e-6 looks as what is frozen."""
    patch = Patch()
    for _ in range(200):
        patch.see(patch.read())
    stuck = patch.read()
    for _ in range(5000):
        assert patch.see(stuck).faults == ()
        assert patch.watch.alive is not Alive.NO
    assert patch.watch.alive is Alive.CANNOT_TELL
    assert patch.watch.words == "cannot tell whether its converter is running: no code has changed for 63 s"
    patch.see(patch.read(REST * 1.01))
    assert (patch.watch.alive, patch.watch.words) == (Alive.YES, "")


def test_phase_proves_life_and_death_of_the_quietest_patch() -> None:
    patch = Patch(noise=0.0)
    phase = 1
    for _ in range(300):
        phase = phase % 3 + 1
        assert patch.see(patch.read(), phase << 6).faults == ()
    assert patch.watch.alive is Alive.YES
    verdict = patch.see(patch.read(), phase << 6)
    assert verdict.distrust == "its converter has completed no conversion for 1 scan"
    assert verdict.faults == (DataFault(FaultyPart.PATCH, FaultKind.FROZEN, since=301, deviations=np.inf),)
    assert patch.watch.alive is Alive.YES  # a scan late
    for _ in range(2):
        patch.see(patch.read(), phase << 6)
    assert patch.watch.alive is Alive.NO
    assert patch.see(patch.read(), (phase % 3 + 1) << 6).faults == ()
    assert patch.watch.alive is Alive.YES


def test_a_code_that_was_missing_before_is_no_sign_of_life() -> None:
    patch = Patch(1e-4, stated=1e-4)
    for phase in (1, 2, 3, 1):
        assert patch.see(patch.read(), phase << 6).faults == ()
    last = patch.read()
    lossy = last.copy()
    lossy[1, 3:6] = MISSING
    assert patch.see(lossy, 2 << 6).faults == ()
    assert patch.see(last, 2 << 6).distrust == "its converter has completed no conversion for 1 scan"
    assert patch.see(patch.read(), 3 << 6).faults == ()
    assert patch.see(patch.read(), 3 << 6).faults == ()  # three conversions, or six


def test_equal_phase_after_lost_scans_or_a_lost_summary_says_nothing() -> None:
    patch = Patch(noise=0.0)
    for phase in (1, 2, 3):
        patch.see(patch.read(), phase << 6)
    for missed in (1, 2, 3, 5, 240):
        patch.number += missed
        assert patch.see(patch.read(), 3 << 6).faults == ()
    patch.number += 1
    lost = replace(scan_of(patch.read(), patch.scale, 0, patch.number), device_time_us=None)
    assert patch.watch.judge(lost).faults == ()
    assert patch.see(patch.read(), 3 << 6).faults == ()
    assert patch.watch.alive is Alive.CANNOT_TELL  # the newest proof is seconds old


def test_failed_source_is_not_frozen() -> None:
    patch = Patch(noise=0.0)
    missing = np.full(SHAPE, MISSING, np.uint32)
    patch.see(patch.read(), 1 << 6)
    for _ in range(5):
        assert patch.see(missing, 1 << 6 | SummaryFlag.SOURCE_FAILED).faults == ()
    assert not patch.watch.frozen


@pytest.mark.parametrize("noise", some_long([0.0, 3e-7, 2e-6, 3e-6, 1e-5], 3e-6))
def test_no_false_alarm_at_rest_of_quiet_and_noisy_converters(noise: float) -> None:
    """Quiet ones keep their codes for thousands of scans, also after a touch that rubber creeps back from."""
    patch = Patch(noise)
    for k in range(3000):
        touch = 1.0 - 0.05 * np.exp(-(k - 500) / 40.0) * (k >= 500)
        patch.see(patch.read(REST * touch))
        assert not patch.watch.frozen


def test_scans_of_changed_chunks_alone_say_nothing() -> None:
    patch = Patch()
    for _ in range(200):
        patch.see(patch.read())
    same = patch.read()
    for _ in range(500):
        patch.see(same, SummaryFlag.CHANGED_ONLY)
    assert not patch.watch.frozen


@pytest.mark.parametrize(("ohm", "state"), [(np.inf, WireState.OPEN), (0.0, WireState.SHORT)])
def test_broken_wires_are_named_at_once_and_until_they_are_well(ohm: float, state: WireState) -> None:
    patch = Patch()
    broken = REST.copy()
    broken[2], broken[:, 7] = ohm, ohm
    patch.see(patch.read())
    patch.see(encode(broken, REST, patch.scale))
    assert patch.watch.wires == (WireFault("lower", 7, state), WireFault("upper", 2, state))
    patch.see(patch.read())
    assert patch.watch.wires == ()


def test_one_open_crossing_is_no_open_wire() -> None:
    patch = Patch()
    broken = REST.copy()
    broken[2, 3] = np.inf
    for _ in range(3):
        patch.see(encode(broken, REST, patch.scale))
    assert patch.watch.wires == ()


def test_noisy_wire() -> None:
    patch = Patch()
    random = np.random.default_rng(3)
    for _ in range(100):
        ohm = REST.copy()
        ohm[:, 5] *= 1.0 + 1e-3 * random.standard_normal()
        patch.see(patch.read(ohm))
    assert patch.watch.wires == (WireFault("lower", 5, WireState.NOISY),)


def test_drifting_wire_and_a_hand_that_warms_up() -> None:
    patch = Patch()
    for k in range(200):
        ohm = REST * (1.0 + 1e-4 * k)  # all of it: no wire's fault
        ohm[1] *= 1.0 + 5e-5 * k
        patch.see(patch.read(ohm))
    assert patch.watch.wires == (WireFault("upper", 1, WireState.DRIFTING),)


def test_a_touch_is_neither_noise_nor_drift() -> None:
    patch = Patch()
    dent = np.exp(-((np.arange(4)[:, None] - 1.5) ** 2) - (np.arange(12)[None, :] - 6) ** 2 / 9.0)
    for k in range(400):
        depth = 0.05 * np.sin(k / 8.0) ** 2 if k < 200 else 0.04  # moved, then held
        patch.see(patch.read(REST * (1.0 - depth * dent)))
        assert patch.watch.wires == ()


@pytest.mark.long
@pytest.mark.parametrize("radius_m", some_long([None, 0.005, 0.04, 0.3], 0.005))
def test_nothing_is_wrong_with_a_patch_that_is_pressed_or_left_alone(
    radius_m: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Strokes of 4 s and of a minute, light and deep, on few wires and on many; converters of all noises."""
    for layout in (
        PatchLayout.preset(
            "staggered", upper_wires=4, lower_wires=12, upper_electrodes=4, lower_electrodes=4
        ),
        PatchLayout.preset("aligned"),
    ):
        for depth, cycle_s in ((0.1, 4.0), (0.5, 60.0)):
            strokes = {} if radius_m is None else {"indenter_radius_m": radius_m}
            scene = Scene(layout, SimulationConfig(depth=depth, cycle_s=cycle_s, **strokes))
            without_noise = functools.cache(pressed_from(scene, 0.0, radius_m is not None).exact_ohm)
            for noise in (0.0, 1e-6, 3e-6, 1e-4):
                patch = pressed_from(scene, noise, False)
                scale = CodeScale(16)
                watch = CodeWatch(scale, NOISE)
                rest_ohm = np.mean([patch.read(0) for _ in range(16)], axis=0)
                monkeypatch.setattr(patch, "exact_ohm", without_noise)
                for k in range(600):
                    codes = encode(patch.read(k * 25_000_000), rest_ohm, scale)
                    assert watch.judge(scan_of(codes, scale, 0, k)).faults == (), noise
                    watch.on_scan(scan_of(codes, scale, 0, k))
                    assert watch.wires == (), noise


def pressed_from(scene: Scene, noise: float, pressed: bool) -> SimulatedPatch:
    patch = SimulatedPatch(scene, converter_noise=noise)
    if pressed:
        patch.start(0)
    return patch
