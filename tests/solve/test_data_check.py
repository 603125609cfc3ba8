"""Readings that contradict the others: found, left out, named and admitted again; loads are none of them.

The truth is Hertz's closed form, or a dent that no half-space forms; it does not come from the solver.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

import skinnode as sk
from skinnode.bench.truth import RUBBER
from skinnode.config import parse_hand
from skinnode.model.elastic import HertzContact
from skinnode.model.layout import Float
from skinnode.solve.checks import examination_time
from skinnode.solve.checks.examination_time import PATIENCE
from skinnode.solve.checks.fault_list import ADMIT, FRAMES
from skinnode.solve.checks.field_trust import UNEXAMINED
from tests.lanes import some_long
from tests.solve.press import dent, noisy
from vcan_sim.scenes import bind_scene, load_scene
from vcan_sim.scenes.library import shipped_scenes

LAYOUT = sk.PatchLayout.preset("staggered")
NOISE = 1e-5


def press(depth: float, centre_m: tuple[float, float] = (17e-3, 18e-3), radius_m: float = 14e-3) -> Float:
    points = LAYOUT.upper_m[..., :2].reshape(-1, 2)
    contact = HertzContact(RUBBER, radius_m, depth * LAYOUT.height_m, centre_m, (0.2, 0.1))
    return contact.displacement_m(points).reshape(LAYOUT.upper_m.shape)


def readings(moved: Float, rng: np.random.Generator) -> Float:
    return sk.resistance_ohm(LAYOUT, LAYOUT.upper_m + moved) * rng.normal(1.0, NOISE, LAYOUT.shape)


def off(field: sk.FieldFrame, moved: Float) -> float:
    """Return the largest error of the trusted wires, in standard deviations."""
    ratio = np.abs(field.displacement_m - moved) / field.displacement_std_m
    return float(ratio[field.wires_trusted].max())


def spoil(kind: str, frame: Float, rest: Float) -> None:
    match kind:
        case "crossing":
            frame[4, 13] = 0.9 * rest[4, 13]
        case "lower wire open":
            frame[:, 13] = 1.24 * rest[:, 13]
        case "upper wire open":
            frame[4] = 1.24 * rest[4]


PLACES = {"crossing": (4, 13), "lower wire open": (None, 13), "upper wire open": (4, None)}


@pytest.mark.long
@pytest.mark.parametrize(
    ("noise", "seed"), some_long([(3e-6, 0), *((NOISE, seed) for seed in range(4))], (NOISE, 0))
)
def test_a_ball_that_slides_with_friction_over_a_thin_layer_is_no_fault(noise: float, seed: int) -> None:
    """The prior expects such a narrow shear of one wire as little as wrong readings of that wire."""
    hand = parse_hand(
        {
            "buses": [{"name": "can0", "interface": "virtual", "channel": "slide"}],
            "patches": [{"name": "palm", "node_id": 1, "bus": "can0"}],
        }
    )
    scene = bind_scene(load_scene(shipped_scenes()["press"], hand), hand)["palm"]
    rest = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m)
    tracker = sk.Tracker(LAYOUT, method="posterior", relative_noise=noise, baseline_ohm=rest)
    rng = np.random.default_rng(seed)
    for t_s in np.arange(1.6, 3.6, 0.08):
        moved = scene.truth(float(t_s)).displacement_m
        here = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m + moved)
        field = tracker.update(here * rng.normal(1.0, noise, LAYOUT.shape))
        assert field.faults == ()
        assert len(field.contacts) == 1
        assert not field.trusted or off(field, moved) < 5.0


@pytest.mark.parametrize("method", ["exact", "posterior"])
@pytest.mark.parametrize("kind", some_long(PLACES, "crossing"))
def test_wrong_readings_under_a_press_are_named_and_the_rest_goes_on(kind: str, method: str) -> None:
    rng = np.random.default_rng(3)
    tracker = sk.Tracker(LAYOUT, method=method, relative_noise=NOISE)
    rest = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m)
    for share in (0.0, 0.05, 0.1, 0.1):
        field = tracker.update(readings(press(share) if share else np.zeros_like(LAYOUT.upper_m), rng))
        assert field.trusted
        assert field.faults == ()
    for _ in range(FRAMES + 3):
        frame = readings(press(0.1), rng)
        spoil(kind, frame, rest)
        field = tracker.update(frame)
        assert field.trusted
        assert off(field, press(0.1)) < 5.0
    upper, lower = PLACES[kind]
    assert field.faults
    for fault in field.faults:  # a crossing may be named as its whole wire
        assert fault.upper == upper or (upper is not None and fault.upper is None)
        assert fault.lower == lower or (kind == "crossing" and fault.lower is None)
    first = {(fault.upper, fault.lower): fault.since for fault in field.faults}
    assert all(4 < since <= 4 + FRAMES for since in first.values())


@pytest.mark.long
def test_a_fault_is_named_although_the_deadline_never_leaves_time_to_examine_it(monkeypatch) -> None:
    """Until then, no field with the wrong reading is trusted; afterwards all are."""
    monkeypatch.setattr(examination_time, "perf_counter", lambda: time.perf_counter() + 10.0)
    rng = np.random.default_rng(3)
    tracker = sk.Tracker(LAYOUT, method="exact", relative_noise=NOISE, deadline_us=5_000_000)
    rest = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m)
    for share in (0.0, 0.05, 0.1):
        assert tracker.update(readings(press(share) if share else np.zeros_like(LAYOUT.upper_m), rng)).trusted
    fields = []
    for _ in range(PATIENCE * FRAMES + 4):
        frame = readings(press(0.1), rng)
        spoil("crossing", frame, rest)
        fields.append(tracker.update(frame))
    assert UNEXAMINED in {field.distrust for field in fields}
    assert not any(field.trusted and not field.faults for field in fields)
    assert [fault.upper for fault in fields[-1].faults] == [4]  # the crossing or its whole wire
    for field in fields[PATIENCE * FRAMES :]:
        assert field.trusted
        assert off(field, press(0.1)) < 5.0


@pytest.mark.long
def test_a_patch_that_keeps_still_is_examined_when_there_is_time(monkeypatch) -> None:
    tracker = sk.Tracker(LAYOUT, method="exact", relative_noise=NOISE, deadline_us=5_000_000)
    frame = readings(press(0.1), np.random.default_rng(3))
    spoil("crossing", frame, sk.resistance_ohm(LAYOUT, LAYOUT.upper_m))
    with monkeypatch.context() as late:
        late.setattr(examination_time, "perf_counter", lambda: time.perf_counter() + 10.0)
        assert tracker.update(frame).distrust == UNEXAMINED
    field = tracker.update(frame)
    assert [fault.upper for fault in field.faults] == [4]


@pytest.mark.long
def test_named_readings_that_agree_again_are_admitted() -> None:
    rng = np.random.default_rng(4)
    tracker = sk.Tracker(LAYOUT, method="posterior", relative_noise=NOISE)
    rest = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m)
    for _ in range(FRAMES + 1):
        frame = readings(press(0.1), rng)
        spoil("lower wire open", frame, rest)
        field = tracker.update(frame)
    assert field.faults
    for _ in range(ADMIT + FRAMES):
        field = tracker.update(readings(press(0.1), rng))
    assert field.faults == ()
    assert field.trusted
    assert off(field, press(0.1)) < 5.0


def test_a_deep_slide_is_not_taken_for_a_fault() -> None:
    """Under a wide sphere at little noise, a wire's removal explains more than a few loads do."""
    rng = np.random.default_rng(5)
    tracker = sk.Tracker(LAYOUT, relative_noise=5e-6)
    for x_m in np.linspace(10e-3, 26e-3, 25):
        moved = press(0.3, (x_m, 24e-3), radius_m=40e-3)
        field = tracker.update(
            sk.resistance_ohm(LAYOUT, LAYOUT.upper_m + moved) * rng.normal(1.0, 5e-6, LAYOUT.shape)
        )
        assert field.trusted, field.distrust
        assert field.faults == ()


@pytest.mark.long
@pytest.mark.parametrize("depth", [0.05, 0.1, 0.2, 0.3])
def test_no_wire_is_named_under_a_dent_that_no_half_space_forms(depth: float) -> None:
    """Such a dent may make a frame doubtful, which then is not trusted; its wires are not at fault."""
    rng = np.random.default_rng(6)
    for centre in ((4.0, 5.0), (3.5, 4.5), (6.0, 2.0)):
        moved = dent(LAYOUT, depth, centre=centre)
        field = sk.Tracker(LAYOUT, relative_noise=NOISE).update(noisy(LAYOUT, moved, rng, NOISE))
        assert field.faults == ()
        assert (np.abs(field.displacement_m - moved) < 5.0 * field.displacement_std_m).all()


def test_half_of_the_readings_are_not_enough_and_the_reason_says_so() -> None:
    rng = np.random.default_rng(7)
    valid = rng.random(LAYOUT.shape) > 0.5
    field = sk.Tracker(LAYOUT, relative_noise=NOISE).update(readings(press(0.1), rng), valid)
    assert not field.trusted
    assert field.distrust == f"only {valid.mean():.0%} of the readings are usable"


@pytest.mark.long
@pytest.mark.parametrize("method", some_long(["exact", "posterior"], "posterior"))
def test_noise_larger_than_stated_is_not_taken_for_wrong_readings(method: str) -> None:
    """Until it has been estimated, no field is trusted; no reading is ever named."""
    rng = np.random.default_rng(7)
    tracker = sk.Tracker(LAYOUT, method=method, relative_noise=NOISE)
    rest = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m)
    for _ in range(60):
        field = tracker.update(rest * rng.normal(1.0, 10 * NOISE, LAYOUT.shape))
        assert field.faults == ()
        if field.noise_factor == 1.0:
            assert field.distrust == "the readings are noisier than relative_noise states"
        else:
            assert field.trusted
    assert field.noise_factor == pytest.approx(10.0, rel=0.2)


@pytest.mark.parametrize("share", some_long([0.0, 0.15], 0.15))
def test_a_grossly_wrong_reading_never_moves_a_trusted_wire(share: float) -> None:
    """It can move its whole wire so far that the readings, linearised at rest, seem to be caused by loads."""
    rng = np.random.default_rng(8)
    tracker = sk.Tracker(LAYOUT, method="exact", relative_noise=NOISE)
    moved = press(share) if share else np.zeros_like(LAYOUT.upper_m)
    for _ in range(24):
        frame = readings(moved, rng)
        frame[rng.integers(10), rng.integers(30)] *= rng.choice([0.4, 0.6, 0.8, 0.93, 1.1, 1.3, 1.7])
        field = tracker.update(frame)
        assert not field.trusted or off(field, moved) < 5.0
        assert field.faults or not field.trusted
        tracker.reset()
        tracker.update(readings(moved, rng))


@pytest.mark.long
def test_a_reading_that_jumps_during_a_press_is_left_out() -> None:
    """The error is small for a press, but no load changes so small a part of the patch in one frame."""
    rng = np.random.default_rng(9)
    tracker = sk.Tracker(LAYOUT, method="exact", relative_noise=NOISE)
    wrong = 0
    for number, share in enumerate(np.linspace(0.1, 0.35, 60)):
        frame = readings(press(share), rng)
        is_bad = number % 3 == 2
        if is_bad:
            frame[rng.integers(10), rng.integers(30)] *= (
                1.0 + rng.choice([-1, 1]) * rng.uniform(80, 150) * NOISE
            )
        field = tracker.update(frame)
        if is_bad:
            wrong += field.trusted and off(field, press(share)) > 5.0
        else:
            assert field.trusted, field.distrust
            assert off(field, press(share)) < 5.0
    assert wrong <= 1
