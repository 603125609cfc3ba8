"""Each imperfection of the simulated skin by itself, against a closed form or a slow computation."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skinnode.config import SimulationConfig, parse_hand
from skinnode.errors import ConfigError
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import PatchLayout
from skinnode.model.tolerances import ORDINARY
from vcan_sim.default_scene import Scene
from vcan_sim.fleet import Fleet
from vcan_sim.scenes import parse_scene, read_scene
from vcan_sim.sensor import SimulatedPatch
from vcan_sim.skin.hysteresis_and_creep import STEP_S, THRESHOLDS
from vcan_sim.skin.imperfections import EXACT, Imperfections
from vcan_sim.skin.patch import PhysicalPatch

Array = NDArray[np.float64]
LAYOUT = PatchLayout.preset(
    "staggered", upper_wires=4, upper_electrodes=5, lower_wires=12, lower_electrodes=6
)
SCENE = Scene(LAYOUT, SimulationConfig(seed=5, depth=0.2))
TOUCHED_S = SCENE.lead_s + 1.5
ORDINARY_PATCH = Imperfections.ordinary(seed=3)
S = 1_000_000_000


def at_rest(t_s: float) -> Array:
    return LAYOUT.upper_m


def pressed() -> Array:
    return SCENE.upper_m(TOUCHED_S)


def direct_sum(layout: PatchLayout, upper_m: Array) -> Array:
    """What a simulated patch computed before it could be imperfect, operation by operation."""
    lower = np.ascontiguousarray(layout.lower_m.reshape(-1, 3).T)
    distance = np.zeros((upper_m.size // 3, lower.shape[1]))
    for here, there in zip(upper_m.reshape(-1, 3).T, lower, strict=True):
        distance += (here[:, None] - there) ** 2
    np.sqrt(distance, out=distance)
    shape = (*upper_m.shape[:2], *layout.lower_m.shape[:2])
    potential = (1.0 / distance).reshape(shape).sum(axis=(1, 3))
    return np.asarray(layout.resistivity_ohm_per_m / potential)


def pair(height_m: float = 2e-3, aside_m: float = 0.0) -> PatchLayout:
    """One upper and one lower electrode."""
    return PatchLayout(np.array([[[aside_m, 0.0, height_m]]]), np.zeros((1, 1, 3)))


# --- exact


def test_an_exact_patch_is_the_former_patch_to_the_bit() -> None:
    skin = PhysicalPatch(LAYOUT)
    assert skin.rest_m is LAYOUT.upper_m
    assert skin.lower_m is LAYOUT.lower_m
    assert skin.resistance_ohm(0.0, at_rest).tobytes() == direct_sum(LAYOUT, LAYOUT.upper_m).tobytes()
    for t_s in np.linspace(0.0, 6.0, 40):
        upper = SCENE.upper_m(t_s)
        assert skin.resistance_ohm(t_s, SCENE.upper_m).tobytes() == direct_sum(LAYOUT, upper).tobytes()
        assert skin.upper_m(t_s, SCENE.upper_m).tobytes() == upper.tobytes()


def test_a_simulated_patch_reads_the_former_bits() -> None:
    patch = SimulatedPatch(SCENE)
    noise = np.random.default_rng([5, 0])
    patch.start(2 * S)
    for t_ns in (0, 2 * S + int(TOUCHED_S * S), 3 * S):
        expected = direct_sum(LAYOUT, SCENE.upper_m((t_ns - 2 * S) * 1e-9))
        expected = expected * (1.0 + 3e-6 * noise.standard_normal(expected.shape))
        assert patch.read(t_ns).tobytes() == expected.tobytes()


def test_exact_means_that_every_size_is_zero() -> None:
    assert Imperfections(seed=7, creep_s=(1.0, 2.0), warming_s=5.0, temperature_per_k=1e-3).exact
    sizes = {
        field.name: (0.0, 0.1) if field.name == "creep" else 8 if field.name == "bits" else 0.005
        for field in dataclasses.fields(Imperfections)
        if field.name not in ("seed", "creep_s", "warming_s", "temperature_per_k", "readout")
    }
    for name, size in sizes.items():
        readout = "grounded" if name.endswith("_ohm") else "ideal"
        assert not Imperfections(readout=readout, **{name: size}).exact, name  # type: ignore[arg-type]
    assert not Imperfections(readout="floating").exact


# --- geometry


@pytest.mark.parametrize(
    "sizes", [{"placement": 0.02}, {"along": 0.02}, {"thickness": 0.05}, {"tilt": 0.05}], ids=str
)
def test_electrodes_move_in_proportion_and_resistances_are_those_of_the_body(sizes: dict[str, float]) -> None:
    once = PhysicalPatch(LAYOUT, Imperfections(seed=4, **sizes))
    twice = PhysicalPatch(LAYOUT, Imperfections(seed=4, **{name: 2 * size for name, size in sizes.items()}))
    for found, doubled, planned in (
        (once.rest_m, twice.rest_m, LAYOUT.upper_m),
        (once.lower_m, twice.lower_m, LAYOUT.lower_m),
    ):
        np.testing.assert_allclose(doubled - planned, 2 * (found - planned), atol=1e-16)
    assert (once.rest_m != LAYOUT.upper_m).any()
    body = PatchLayout(once.rest_m, once.lower_m, LAYOUT.resistivity_ohm_per_m)
    np.testing.assert_allclose(once.rest_ohm, resistance_ohm(body, body.upper_m), rtol=1e-12)
    truth = once.rest_m + (pressed() - LAYOUT.upper_m)
    np.testing.assert_allclose(once.upper_m(TOUCHED_S, SCENE.upper_m), truth, atol=1e-17)
    found = once.resistance_ohm(TOUCHED_S, SCENE.upper_m)
    np.testing.assert_allclose(found, resistance_ohm(body, truth), rtol=1e-12)


def test_placement_moves_whole_wires_by_independent_normal_shifts() -> None:
    shifts = []
    for seed in range(60):
        skin = PhysicalPatch(LAYOUT, Imperfections(seed=seed, placement=0.02))
        for found, planned in ((skin.rest_m, LAYOUT.upper_m), (skin.lower_m, LAYOUT.lower_m)):
            shift = (found - planned) / LAYOUT.pitch_m
            np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1], shift.shape), atol=1e-13)
            shifts.append(shift[:, 0])
    drawn = np.concatenate(shifts)  # 60 · 16 wires · 3 axes
    assert np.abs(drawn).max() <= 0.06 + 1e-12
    assert np.abs(drawn.mean(axis=0)).max() < 5 * 0.02 / math.sqrt(len(drawn))
    assert drawn.std(axis=0) == pytest.approx(0.02, rel=5 / math.sqrt(2 * len(drawn)))
    assert np.abs(np.corrcoef(drawn.T) - np.eye(3)).max() < 5 / math.sqrt(len(drawn))


def test_electrodes_move_along_straight_wires_only() -> None:
    skin = PhysicalPatch(LAYOUT, Imperfections(along=0.05))
    upper, lower = skin.rest_m - LAYOUT.upper_m, skin.lower_m - LAYOUT.lower_m
    assert (upper[..., 1:] == 0.0).all()  # upper wires run along x
    assert np.abs(lower[..., [0, 2]]).max() < 1e-18  # lower wires run along y
    assert (upper[..., 0] != 0.0).all()
    assert (lower[..., 1] != 0.0).all()
    one = PatchLayout.preset("aligned", upper_wires=2, upper_electrodes=1, lower_electrodes=1)
    assert (PhysicalPatch(one, Imperfections(along=0.05)).rest_m == one.upper_m).all()


def test_thickness_scales_the_clearance_and_tilt_turns_the_plane() -> None:
    thick = PhysicalPatch(LAYOUT, Imperfections(seed=2, thickness=0.05)).rest_m - LAYOUT.upper_m
    assert (thick[..., :2] == 0.0).all()
    np.testing.assert_allclose(thick[..., 2], thick[0, 0, 2], atol=1e-17)
    assert 0.0 < abs(thick[0, 0, 2]) <= 3 * 0.05 * LAYOUT.height_m
    tilted = PhysicalPatch(LAYOUT, Imperfections(seed=2, tilt=0.05)).rest_m - LAYOUT.upper_m
    assert (tilted[..., :2] == 0.0).all()
    x, y = LAYOUT.upper_m[..., 0].ravel(), LAYOUT.upper_m[..., 1].ravel()
    plane = np.stack([np.ones_like(x), x - x.mean(), y - y.mean()], axis=1)
    found, left, *_ = np.linalg.lstsq(plane, tilted[..., 2].ravel(), rcond=None)
    assert math.sqrt(left[0]) < 1e-16
    assert abs(found[0]) < 1e-17
    assert (np.abs(found[1:] * 0.5 * np.array([np.ptp(x), np.ptp(y)])) <= 3 * 0.05 * LAYOUT.height_m).all()


def test_electrodes_that_would_touch_are_refused_in_one_line() -> None:
    close = PatchLayout.preset("symmetric", height_m=1e-4)
    with pytest.raises(ConfigError) as caught:
        PhysicalPatch(close, Imperfections(placement=0.1))
    line = r"placement, along, thickness, tilt: got "
    line += r"random errors that leave -?\d+% of the gap at an electrode, "
    assert re.fullmatch(line + "allowed: at least 10%; use smaller sizes or another seed", str(caught.value))


def disc_charges(center_m: Array, radius_m: float, rings: int = 24, spokes: int = 48) -> tuple[Array, Array]:
    """Positions and weights of a conducting disc's charge 1/√(a² − r²): uniform in √(1 − r²/a²)."""
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    r = radius_m * np.sqrt(1.0 - (0.5 * (nodes + 1.0)) ** 2)
    angle = 2.0 * np.pi * (np.arange(spokes) + 0.5) / spokes
    points = np.stack(
        [np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.zeros((rings, spokes))], axis=-1
    )
    charges = np.broadcast_to((0.5 * weights / spokes)[:, None], (rings, spokes))
    return center_m + points.reshape(-1, 3), charges.ravel()


@pytest.mark.parametrize(("height_m", "aside_m"), [(2e-3, 0.0), (2e-3, 1.3e-3), (1e-3, 4e-3)])
def test_a_finite_electrode_has_the_potential_of_a_conducting_disc(height_m: float, aside_m: float) -> None:
    """Two discs act to order a² as one disc of radius √2 a, and that disc is exact against a point."""
    layout = pair(height_m, aside_m)
    distance = layout.pitch_m  # of the only pair
    upper, lower = layout.upper_m[0, 0], layout.lower_m[0, 0]
    left: list[float] = []
    effects: list[float] = []
    for radius in (0.02, 0.04, 0.08):
        skin = PhysicalPatch(layout, Imperfections(electrode_radius=radius))
        found = layout.resistivity_ohm_per_m / skin.rest_ohm[0, 0]
        one, charge = disc_charges(lower, math.sqrt(2.0) * radius * distance)
        single = float((charge / np.linalg.norm(one - upper, axis=1)).sum())
        assert found == pytest.approx(single, rel=1e-11)
        above, q = disc_charges(upper, radius * distance)
        below, p = disc_charges(lower, radius * distance)
        both = sum(
            float(each * (p / np.linalg.norm(below - point, axis=1)).sum())
            for point, each in zip(above, q, strict=True)
        )
        left.append(abs(found - both) * distance)
        effects.append(found * distance - 1.0)
        assert left[-1] < radius**4
    assert effects[1] / effects[0] == pytest.approx(4.0, rel=0.01)
    assert left[2] / left[1] == pytest.approx(16.0, rel=0.1)


def test_points_are_the_limit_of_small_electrodes() -> None:
    exact = PhysicalPatch(LAYOUT).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    small, large = (
        PhysicalPatch(LAYOUT, Imperfections(electrode_radius=radius)).resistance_ohm(TOUCHED_S, SCENE.upper_m)
        for radius in (1e-3, 2e-3)
    )
    np.testing.assert_allclose((large - exact) / (small - exact), 4.0, rtol=1e-2)


# --- rubber


def test_strain_changes_the_resistivity_of_each_path() -> None:
    beta = 0.3
    found = PhysicalPatch(LAYOUT, Imperfections(strain=beta)).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    wires, equations = LAYOUT.shape
    upper, lower, rest = pressed(), LAYOUT.lower_m, LAYOUT.upper_m
    for u in range(wires):
        for k in range(equations):
            siemens = 0.0
            for n in range(rest.shape[1]):
                for m in range(lower.shape[1]):
                    d, d0 = math.dist(upper[u, n], lower[k, m]), math.dist(rest[u, n], lower[k, m])
                    siemens += 1.0 / (LAYOUT.resistivity_ohm_per_m * d * (1.0 + beta * (d / d0 - 1.0)))
            assert found[u, k] == pytest.approx(1.0 / siemens, rel=1e-12)
    assert PhysicalPatch(LAYOUT, Imperfections(strain=beta)).rest_ohm == pytest.approx(
        direct_sum(LAYOUT, rest), rel=1e-13
    )


@pytest.mark.parametrize("beta", [-0.4, 0.1, 0.2])
def test_strain_of_a_single_path(beta: float) -> None:
    layout = pair()
    skin = PhysicalPatch(layout, Imperfections(strain=beta, electrode_radius=0.0))
    found = skin.resistance_ohm(1.0, lambda t_s: 0.9 * layout.upper_m)
    assert found[0, 0] == pytest.approx(1e7 * 0.9 * 2e-3 * (1.0 - 0.1 * beta), rel=1e-13)


def test_warming_follows_its_exponential() -> None:
    sizes = Imperfections(warming_k=10.0, temperature_per_k=3e-3, warming_s=50.0)
    skin, exact = PhysicalPatch(LAYOUT, sizes), PhysicalPatch(LAYOUT)
    for t_s in (0.0, 1.0, 50.0, 1e4):
        factor = 1.0 + 3e-3 * 10.0 * (1.0 - math.exp(-t_s / 50.0))
        expected = factor * exact.resistance_ohm(t_s, SCENE.upper_m)
        np.testing.assert_allclose(skin.resistance_ohm(t_s, SCENE.upper_m), expected, rtol=1e-13)
    cold = PhysicalPatch(LAYOUT, dataclasses.replace(sizes, warming_k=-10.0))
    np.testing.assert_allclose(cold.resistance_ohm(1e4, at_rest) / exact.rest_ohm, 0.97, rtol=1e-13)


def moved_to(height_of: Callable[[float], float]) -> Callable[[float], Array]:
    """A patch whose surface moves along z by ``height_of`` the time; the layout itself at zero."""

    def upper_m(t_s: float) -> Array:
        height = height_of(t_s)
        return LAYOUT.upper_m + np.array([0.0, 0.0, height]) if height else LAYOUT.upper_m

    return upper_m


def z_of(skin: PhysicalPatch, t_s: float, motion: Callable[[float], Array]) -> float:
    found = skin.upper_m(t_s, motion) - skin.rest_m
    assert np.ptp(found[..., 2]) < 1e-17
    assert (found[..., :2] == 0.0).all()
    return float(found[0, 0, 2])


def test_creep_after_a_ramp_is_the_closed_form() -> None:
    """For s = A min(t/T, 1) and t > T: q = A (1 − τ/T (exp(T/τ) − 1) exp(−t/τ))."""
    shares, taus = (0.1, 0.05), (0.4, 3.0)
    skin = PhysicalPatch(LAYOUT, Imperfections(creep=shares, creep_s=taus))
    height, ramp = -1e-4, 8 * STEP_S
    motion = moved_to(lambda t_s: height * min(t_s / ramp, 1.0))
    for t_s in (ramp + 0.37 * STEP_S, 0.5, 1.7, 20.0):
        expected = height + sum(
            c * height * (1.0 - tau / ramp * (math.exp(ramp / tau) - 1.0) * math.exp(-t_s / tau))
            for c, tau in zip(shares, taus, strict=True)
        )
        assert z_of(skin, t_s, motion) == pytest.approx(expected, rel=1e-11)
    during = 2.6 * STEP_S
    expected = height * during / ramp + sum(
        c * height / ramp * (during - tau * (1.0 - math.exp(-during / tau)))
        for c, tau in zip(shares, taus, strict=True)
    )
    assert z_of(skin, during, motion) == pytest.approx(expected, rel=1e-11)


def test_creep_is_linear_in_its_size_and_recovers() -> None:
    motion = moved_to(lambda t_s: -1e-4 if 1.0 <= t_s < 3.0 else 0.0)
    one, two = (PhysicalPatch(LAYOUT, Imperfections(creep=(c, 0.0))) for c in (0.1, 0.2))
    plain = PhysicalPatch(LAYOUT)
    for t_s in (0.5, 1.2, 2.9, 3.3, 8.0):
        s = z_of(plain, t_s, motion)
        assert z_of(two, t_s, motion) - s == pytest.approx(2.0 * (z_of(one, t_s, motion) - s), abs=1e-18)
    assert z_of(two, 0.5, motion) == 0.0
    assert z_of(two, 3.3, motion) < -1e-6
    assert abs(z_of(two, 8.0, motion)) < 1e-11


def slow_hysteresis(samples: list[float], share: float) -> float:
    """Output after a list of inputs, one play operator after another."""
    total = 0.0
    for threshold in THRESHOLDS:
        r, p = threshold * LAYOUT.height_m, 0.0
        for s in samples:
            if s - p > r:
                p = s - r
            elif p - s > r:
                p = s + r
        total += p / len(THRESHOLDS)
    return (1.0 - share) * samples[-1] + share * total


@given(
    heights=st.lists(st.floats(-2e-4, 2e-4), min_size=1, max_size=12),
    share=st.floats(0.01, 0.5),
    since=st.floats(0.01, 1.0),
)
@settings(max_examples=60, deadline=None)
def test_hysteresis_is_a_sum_of_play_operators(heights: list[float], share: float, since: float) -> None:
    grid = [0.0, *heights]

    def height_of(t_s: float) -> float:
        return float(np.interp(t_s / STEP_S, np.arange(len(grid)), grid))

    skin = PhysicalPatch(LAYOUT, Imperfections(hysteresis=share))
    steps = len(grid) - 2 + since
    whole = [height_of(k * STEP_S) for k in range(math.ceil(steps))]
    t_s = steps * STEP_S
    inputs = [*whole, height_of(t_s)]
    found = (skin.upper_m(t_s, moved_to(height_of)) - skin.rest_m)[0, 0, 2]
    assert found == pytest.approx(slow_hysteresis(inputs, share), abs=1e-17)


def test_a_large_press_leaves_the_mean_threshold_and_does_not_depend_on_its_rate() -> None:
    def press(duration_s: float) -> Callable[[float], Array]:
        return moved_to(lambda t_s: -3e-4 * max(0.0, 1.0 - abs(t_s / duration_s - 1.0)))

    skin = PhysicalPatch(LAYOUT, Imperfections(hysteresis=0.2))
    remanent = -0.2 * np.mean(THRESHOLDS) * LAYOUT.height_m
    for steps in (8, 64, 512):
        assert z_of(skin, 2.5 * steps * STEP_S, press(steps * STEP_S)) == pytest.approx(remanent, rel=1e-12)


TIMES = st.lists(st.floats(0.0, 6.0), min_size=1, max_size=6)


@pytest.mark.long
@given(times=TIMES)
@settings(max_examples=15, deadline=None)
def test_the_order_of_evaluation_does_not_matter(times: list[float]) -> None:
    sizes = dataclasses.replace(
        ORDINARY_PATCH, strain=0.1, warming_k=3.0, readout="grounded", contact_ohm=3.0, upper_wire_ohm=0.5
    )
    seen = PhysicalPatch(LAYOUT, sizes)
    found = {t_s: seen.resistance_ohm(t_s, SCENE.upper_m).tobytes() for t_s in times}
    for t_s in reversed(times):
        fresh = PhysicalPatch(LAYOUT, sizes)
        assert fresh.resistance_ohm(t_s, SCENE.upper_m).tobytes() == found[t_s]
        assert seen.resistance_ohm(t_s, SCENE.upper_m).tobytes() == found[t_s]


@pytest.mark.long
def test_a_time_long_ago_gives_the_same_bytes() -> None:
    """Longer ago than any state of the history that is kept."""
    skin = PhysicalPatch(LAYOUT, Imperfections(creep=(0.1, 0.1), creep_s=(1.0, 1e4), hysteresis=0.1))
    motion = moved_to(lambda t_s: -1e-4 * math.sin(t_s) ** 2)
    times = (3.3, 131.7, 700.0)
    found = [skin.upper_m(t_s, motion).tobytes() for t_s in times]
    assert [skin.upper_m(t_s, motion).tobytes() for t_s in reversed(times)] == found[::-1]
    assert skin._history is not None
    assert len(skin._history._kept) < 310  # of 22,400 states


def test_another_motion_starts_another_history() -> None:
    skin = PhysicalPatch(LAYOUT, Imperfections(creep=(0.2, 0.0)))
    pressing = moved_to(lambda t_s: -1e-4)
    assert z_of(skin, 2.0, pressing) < -1.1e-4
    assert skin.upper_m(3.0, at_rest) is skin.rest_m
    assert z_of(skin, 2.0, pressing) < -1.1e-4


# --- amplifier, converter, sampling


def test_gain_scales_the_change_of_each_resistance_and_offset_shifts_a_wire() -> None:
    exact = PhysicalPatch(LAYOUT).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    rest = direct_sum(LAYOUT, LAYOUT.upper_m)
    skin = PhysicalPatch(LAYOUT, Imperfections(seed=3, gain=0.02))
    assert skin.rest_ohm.tobytes() == rest.tobytes()
    gains = (skin.resistance_ohm(TOUCHED_S, SCENE.upper_m) - rest) / (exact - rest)
    np.testing.assert_allclose(gains, np.broadcast_to(gains[:, :1], gains.shape), rtol=1e-9)
    assert 0.0 < np.abs(gains - 1.0).max() <= 3 * math.sqrt(2.0) * 0.02
    offset = PhysicalPatch(LAYOUT, Imperfections(seed=3, offset=1e-3))
    shift = offset.resistance_ohm(TOUCHED_S, SCENE.upper_m) - exact
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1], shift.shape), atol=1e-9)
    np.testing.assert_allclose(offset.rest_ohm - rest, shift, atol=1e-9)
    assert 0.0 < np.abs(shift).max() <= 3e-3 * np.median(rest)


def test_half_of_the_gains_variance_is_common_to_the_patch() -> None:
    rest, upper = direct_sum(LAYOUT, LAYOUT.upper_m), 0.9 * LAYOUT.upper_m
    change = direct_sum(LAYOUT, upper) - rest
    gains = np.array(
        [
            (
                (
                    PhysicalPatch(LAYOUT, Imperfections(seed=seed, gain=0.02)).resistance_ohm(
                        0.0, lambda t: upper
                    )
                    - rest
                )
                / change
            )[:, 0]
            - 1.0
            for seed in range(300)
        ]
    )
    assert gains.std(axis=0) == pytest.approx(0.02, rel=5 / math.sqrt(2 * 300))
    correlation = np.corrcoef(gains.T)[np.triu_indices(4, 1)]
    assert correlation == pytest.approx(0.5, abs=5 * 0.75 / math.sqrt(300))


def test_the_converter_rounds_to_its_steps() -> None:
    exact = PhysicalPatch(LAYOUT).resistance_ohm(TOUCHED_S, SCENE.upper_m)
    for bits in (10, 16):
        found = PhysicalPatch(LAYOUT, Imperfections(bits=bits)).resistance_ohm(TOUCHED_S, SCENE.upper_m)
        step = 2.0 * direct_sum(LAYOUT, LAYOUT.upper_m).max() / 2**bits
        np.testing.assert_allclose(found / step, np.rint(found / step), atol=1e-9)
        assert np.abs(found - exact).max() <= 0.5000001 * step
    far = PhysicalPatch(LAYOUT, Imperfections(bits=12)).resistance_ohm(0.0, lambda t: 5.0 * LAYOUT.upper_m)
    full = 2.0 * direct_sum(LAYOUT, LAYOUT.upper_m).max()
    assert far.max() == pytest.approx(full * (1.0 - 2.0**-12), rel=1e-12)


def test_noise_is_white_additive_and_decided_by_the_reading() -> None:
    noise = 1e-4
    skin, rest = PhysicalPatch(LAYOUT, Imperfections(noise=noise)), direct_sum(LAYOUT, LAYOUT.upper_m)
    readings = np.array([skin.resistance_ohm(k * 0.01, at_rest) - rest for k in range(300)])
    readings /= 2.0 * rest.max()
    n = readings.size
    assert abs(readings.mean()) < 5 * noise / math.sqrt(n)
    assert readings.std() == pytest.approx(noise, rel=5 / math.sqrt(2 * n))
    assert abs((readings[1:] * readings[:-1]).mean()) < 5 * noise**2 / math.sqrt(n)
    again = PhysicalPatch(LAYOUT, Imperfections(noise=noise)).resistance_ohm(0.05, at_rest)
    np.testing.assert_array_equal(again, skin.resistance_ohm(0.05, at_rest))
    two = PhysicalPatch(LAYOUT, Imperfections(noise=2 * noise)).resistance_ohm(0.05, at_rest)
    np.testing.assert_allclose(two - rest, 2.0 * (again - rest), atol=1e-9)


@pytest.mark.parametrize("row_time_s", [1e-4, 0.4e-3, 2.3e-3])
def test_each_upper_wire_is_read_at_its_own_time(row_time_s: float) -> None:
    skin, exact = PhysicalPatch(LAYOUT, Imperfections(row_time_s=row_time_s)), PhysicalPatch(LAYOUT)
    steady = moved_to(lambda t_s: -3e-3 * t_s)
    for motion, within in ((steady, 1e-12), (SCENE.upper_m, 3e-9)):
        for t_s in (0.05, TOUCHED_S) if motion is SCENE.upper_m else (0.05,):
            found, truth = skin.resistance_ohm(t_s, motion), skin.upper_m(t_s, motion)
            for u in range(4):
                at = t_s + u * row_time_s
                np.testing.assert_allclose(found[u], exact.resistance_ohm(at, motion)[u], rtol=within)
                np.testing.assert_allclose(truth[u], motion(at)[u], atol=1e-3 * within)
    assert skin.upper_m(0.0, at_rest) is LAYOUT.upper_m


@pytest.mark.parametrize("row_time_s", [0.3e-3, 0.4e-3, 1.2e-3])
def test_motion_between_rows_is_linear_over_a_millisecond_at_most(row_time_s: float) -> None:
    """Under a constant acceleration a, the chord of an interval h is at most a h²/8 off."""
    skin, acceleration = PhysicalPatch(LAYOUT, Imperfections(row_time_s=row_time_s)), -2.0
    motion = moved_to(lambda t_s: 0.5 * acceleration * t_s * t_s)
    truth = skin.upper_m(0.01, motion)
    off = [float(np.abs(truth[u] - motion(0.01 + u * row_time_s)[u]).max()) for u in range(4)]
    interval_s = 3 * row_time_s / math.ceil(3 * row_time_s / 1e-3)
    assert max(off) <= abs(acceleration) * interval_s**2 / 8
    assert off[0] < 1e-17
    assert off[3] < 1e-17


def test_a_single_upper_wire_is_read_at_the_time_of_the_scan() -> None:
    layout = PatchLayout.preset("staggered", upper_wires=1, upper_electrodes=5)

    def sinking(t_s: float) -> Array:
        return np.asarray(layout.upper_m - np.array([0.0, 0.0, 1e-4 * t_s]))

    skin = PhysicalPatch(layout, Imperfections(row_time_s=1e-3))
    np.testing.assert_array_equal(skin.upper_m(0.5, sinking), sinking(0.5))
    expected = resistance_ohm(layout, sinking(0.5))
    np.testing.assert_allclose(skin.resistance_ohm(0.5, sinking), expected, rtol=1e-12)
    assert np.isfinite(PhysicalPatch(layout, ORDINARY_PATCH).resistance_ohm(0.5, sinking)).all()


def test_each_upper_wire_has_the_temperature_of_its_own_time() -> None:
    sizes = Imperfections(warming_k=20.0, temperature_per_k=5e-3, warming_s=0.1, row_time_s=0.02)
    found = PhysicalPatch(LAYOUT, sizes).resistance_ohm(0.05, at_rest) / direct_sum(LAYOUT, LAYOUT.upper_m)
    expected = 1.0 + 0.1 * (1.0 - np.exp(-(0.05 + 0.02 * np.arange(4)) / 0.1))
    np.testing.assert_allclose(found, np.broadcast_to(expected[:, None], found.shape), rtol=1e-13)


# --- seeds


def test_the_seed_and_the_number_decide_the_patch() -> None:
    def rest(seed: int, number: int = 0, **sizes: Any) -> bytes:
        made = dataclasses.replace(ORDINARY_PATCH, seed=seed, **sizes)
        return PhysicalPatch(LAYOUT, made, number).rest_m.tobytes()

    assert rest(1) == rest(1)
    assert len({rest(seed, number) for seed in range(3) for number in range(3)}) == 9
    assert rest(1, gain=0.0, electrode_radius=0.0, creep=(0.0, 0.0), bits=0) == rest(1)


def test_an_ordinary_patch_has_the_ordinary_tolerances() -> None:
    sizes = Imperfections.ordinary(8)
    assert sizes.seed == 8
    for name in ("placement", "thickness", "electrode_radius", "gain"):
        assert getattr(sizes, name) == getattr(ORDINARY, name), name


# --- values


def test_a_table_of_a_file() -> None:
    assert Imperfections.from_table({}) == EXACT
    table = {"ordinary": True, "seed": 4, "thickness": 0, "creep": [0.1, 0.2]}
    expected = dataclasses.replace(Imperfections.ordinary(4), thickness=0.0, creep=(0.1, 0.2))
    assert Imperfections.from_table(table) == expected


@pytest.mark.parametrize(
    ("table", "line"),
    [
        ({"placement": 0.5}, "skin.placement: got 0.5, allowed: a number from 0 to 0.15 pitches"),
        ({"gain": -0.1}, "skin.gain: got -0.1, allowed: a number from 0 to 0.25"),
        ({"thickness": math.nan}, "skin.thickness: got nan, allowed: a number from 0 to 0.25 clearances"),
        ({"strain": True}, "skin.strain: got True, allowed: a number from -0.5 to 0.5"),
        ({"noise": "much"}, "skin.noise: got 'much', allowed: a number from 0 to 0.01"),
        ({"creep": 0.1}, "skin.creep: got 0.1, allowed: two numbers, each a number from 0 to 0.5"),
        ({"creep": [0.1, 0.9]}, "skin.creep[1]: got 0.9, allowed: a number from 0 to 0.5"),
        ({"creep_s": [0.0, 1]}, "skin.creep_s[0]: got 0.0, allowed: a number from 0.01 to 100000 s"),
        ({"seed": -1}, "skin.seed: got -1, allowed: a non-negative integer"),
        ({"bits": 24.0}, "skin.bits: got 24.0, allowed: a non-negative integer"),
        ({"bits": 4}, "skin.bits: got 4, allowed: 0, or an integer from 8 to 32"),
        ({"readout": "open"}, "skin.readout: got 'open', allowed: ideal or grounded or floating"),
        ({"contact_ohm": 2}, "skin.contact_ohm: got 2.0, allowed: 0 unless readout is grounded or floating"),
        ({"ordinary": 1}, "skin.ordinary: got 1, allowed: true or false"),
    ],
    ids=str,
)
def test_a_bad_value_is_one_line(table: dict[str, Any], line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Imperfections.from_table(table, "skin")
    assert str(caught.value) == line


def test_an_unknown_key_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^imperfections\.thicknes: got an unknown key, allowed: a key of"):
        Imperfections.from_table({"thicknes": 0.1})


TOUCH = {"where": "palm", "fault": "silent", "from_s": 1.0}
"""A scene must have a touch or a fault."""


@pytest.mark.parametrize(
    ("given", "made"),
    [
        ({}, Imperfections()),
        ({"imperfections": "ordinary"}, Imperfections.ordinary()),
        ({"imperfections": {"ordinary": True, "seed": 3}}, Imperfections.ordinary(seed=3)),
        ({"imperfections": {"placement": 0.01, "creep": [0.1, 0.2]}},
         Imperfections(placement=0.01, creep=(0.1, 0.2))),
    ],
)  # fmt: skip
def test_a_scene_names_the_imperfections_of_its_patches(given: dict[str, Any], made: Imperfections) -> None:
    assert parse_scene({"faults": [TOUCH], **given}).patch_imperfections() == made


def test_a_fleet_is_made_as_its_scene_says() -> None:
    hand = parse_hand(
        {"buses": [{"name": "can0", "interface": "virtual"}], "patches": [{"name": "palm", "node_id": 4}]}
    )
    scene = parse_scene({"faults": [TOUCH], "imperfections": "ordinary"})
    rest_m = hand.patches[0].layout.build().upper_m
    shifts = [
        np.abs(Fleet(hand, scene=scene, **options).patches["palm"].skin.rest_m - rest_m)
        for options in ({}, {"imperfections": Imperfections()})
    ]  # fmt: skip
    assert shifts[0].max() > 1e-6
    assert shifts[1].max() == 0.0


def test_the_text_form_of_the_command_line() -> None:
    made = Imperfections.from_text("ordinary, placement=0.05, seed=3")
    assert made == dataclasses.replace(Imperfections.ordinary(seed=3), placement=0.05)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("perfect", "imperfections: got 'perfect', allowed: ordinary, or NAME=NUMBER"),
        ("gain=much", "imperfections.gain: got 'much', allowed: a number from 0 to 0.25"),
        ("bits=4", "imperfections.bits: got 4, allowed: 0, or an integer from 8 to 32"),
        ("gian=0.1", "imperfections.gian: got an unknown key"),
        ("gain=5", "imperfections.gain: got 5"),
    ],
)
def test_a_bad_text_is_one_line(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(says)):
        Imperfections.from_text(text)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('imperfections = "perfect"', "scene.toml:1:1: imperfections: got 'perfect', allowed: \"ordinary\""),
        ("[imperfections]\ngain = 5", "scene.toml:2:1: imperfections.gain: got 5"),
        ("[imperfections]\nseed = 2\ngian = 1", "scene.toml:3:1: imperfections.gian: got an unknown key"),
    ],
)
def test_bad_imperfections_of_a_scene_file_have_their_place(tmp_path: Path, line: str, says: str) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(line + '\n[[faults]]\nwhere = "palm"\nfault = "silent"\n')
    with pytest.raises(ConfigError, match=re.escape(says)):
        read_scene(file)
