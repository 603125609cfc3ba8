"""Scenes against closed forms of contact mechanics, and against what a scene promises."""

from __future__ import annotations

import itertools
import math
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skinnode as sk
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import ConfigError
from vcan_sim.cli import main
from vcan_sim.contact.layer import cell_response
from vcan_sim.fleet import Fleet
from vcan_sim.scenes import PatchScene, bind, bind_scene, load_scene, parse_scene
from vcan_sim.scenes.motions import pose_at
from vcan_sim.scenes.tables import TouchConfig
from vcan_sim.scenes.window import solve_depth

RADIUS_M, DEPTH_M = 20e-3, 50e-6
CENTRE = [18e-3, 18e-3]
"""Middle of a patch of 10 × 10 electrodes, 4 mm apart."""
THICK = {"thickness_m": 1.0, "young_pa": 1e6, "poisson": 0.5}


def hand(patches: int = 1, **layout: Any) -> HandConfig:
    return parse_hand(
        {
            "buses": [{"name": "can0", "interface": "virtual", "channel": uuid.uuid4().hex}],
            "patches": [
                {"name": f"p{i}", "node_id": 4 + i, "layout": layout, "tolerances": "exact"}
                for i in range(patches)
            ],
        }
    )


def one(body: dict[str, Any], touch: dict[str, Any], **scene: Any) -> PatchScene:
    """The scene of one touch on the only patch of a hand."""
    table = {
        "bodies": [{"name": "body", **body}],
        "touches": [{"body": "body", "patch": "p0", "at_m": CENTRE, "from_s": 0.1, "to_s": 1.1, **touch}],
        **scene,
    }
    return bind_scene(parse_scene(table), hand())["p0"]


def sphere(touch: dict[str, Any], friction: float = 0.0, **scene: Any) -> PatchScene:
    return one({"shape": "sphere", "radius_m": RADIUS_M, "friction": friction}, touch, **scene)


@pytest.fixture(scope="module")
def slide() -> PatchScene:
    """A sphere of 2 N that slides 8 mm along x with a friction of 0.5."""
    motion = {"kind": "slide", "by_m": [8e-3, 0.0], "from_s": 0.6, "to_s": 1.6}
    touch = {"at_m": [14e-3, 18e-3], "force_n": 2.0, "to_s": 2.1, "motions": [motion]}
    return one({"shape": "sphere", "radius_m": 10e-3, "friction": 0.5}, touch)


def test_hertz() -> None:
    """Force, depth, radius and pressure of a sphere on a half-space (Johnson, section 4.2)."""
    scene = sphere({"depth_m": DEPTH_M}, skin=THICK, cells=48)
    truth = scene.truth(0.6)
    modulus, contact_m = 1e6 / 0.75, math.sqrt(RADIUS_M * DEPTH_M)
    (contact,) = truth.contacts
    assert contact.depth_m == pytest.approx(DEPTH_M, rel=1e-9)
    assert -contact.force_n[2] == pytest.approx(4 / 3 * modulus * contact_m**3 / RADIUS_M, rel=0.01)
    assert contact.radius_m == pytest.approx(contact_m, rel=0.01)
    r = np.linalg.norm(contact.cells_m - CENTRE, axis=-1)
    peak = 2 * modulus * contact_m / (math.pi * RADIUS_M)
    inner = r < 0.85 * contact_m
    np.testing.assert_allclose(
        contact.pressure_pa[inner], peak * np.sqrt(1 - (r[inner] / contact_m) ** 2), rtol=0.01
    )
    assert not contact.pressure_pa[r > 1.15 * contact_m].any()
    np.testing.assert_allclose(contact.centre_m, CENTRE, atol=1e-7)
    at = np.linalg.norm(scene.layout.upper_m[..., :2] - CENTRE, axis=-1)
    outside = np.maximum(at, contact_m)
    sunk = (2 * contact_m**2 - outside**2) * np.arcsin(contact_m / outside)
    sunk = (sunk + outside * contact_m * np.sqrt(1 - (contact_m / outside) ** 2)) / (math.pi * RADIUS_M)
    far = at > contact_m
    moved = -truth.displacement_m[
        far, 2
    ]  # less than on a half-space, by the same everywhere: it is 1 m thick
    np.testing.assert_allclose(moved - moved[0], sunk[far] - sunk[far][0], atol=0.005 * sunk[far].max())


def test_an_electrode_under_the_body_moves_as_the_body() -> None:
    """Also where it lies between cells: the depth minus the height of the sphere above it."""
    for offset_m in ([0.0, 0.0], [0.31e-3, -0.17e-3]):
        at = np.array([16e-3, 16e-3]) + offset_m
        scene = sphere({"depth_m": DEPTH_M, "at_m": at.tolist()}, skin=THICK)
        height = RADIUS_M - math.sqrt(RADIUS_M**2 - np.square(offset_m).sum())
        moved = scene.truth(0.6).displacement_m[4, 4, 2]
        assert -moved == pytest.approx(DEPTH_M - height, rel=0.005)


@pytest.mark.long
def test_a_thin_bonded_film() -> None:
    """An incompressible film: δ − r²/2R = −t³/(3G) ∇²p (Johnson, section 5.8), so F = π G a⁶ / (32 R t³)."""
    contact_m, film_m = 1e-3, 25e-6
    depth = contact_m**2 / (4 * RADIUS_M)
    skin = {"thickness_m": film_m, "young_pa": 1e6, "poisson": 0.5}
    scene = sphere({"depth_m": depth, "to_s": 0.8, "ramp_s": 0.2}, skin=skin, step_s=0.1, cells=40)
    force = -scene.truth(0.5).contacts[0].force_n[2]
    expected = math.pi * (1e6 / 3) * contact_m**6 / (32 * RADIUS_M * film_m**3)
    assert force == pytest.approx(expected, rel=0.01)


def test_a_flat_punch() -> None:
    """The force is 2 a E* δ (Johnson, eq. 3.36); the rim is round only to some cells."""
    punch = {"shape": "punch", "radius_m": 2e-3, "edge_radius_m": 1e-5, "friction": 0.0}
    (contact,) = one(punch, {"depth_m": 1e-5}, skin=THICK, cells=48).truth(0.6).contacts
    assert contact.radius_m == pytest.approx(2e-3, rel=0.01)
    assert -contact.force_n[2] == pytest.approx(2 * 2e-3 * 1e6 / 0.75 * 1e-5, rel=0.01)


@pytest.mark.long
def test_a_long_ridge() -> None:
    """The middle of a cylinder has the pressure of a line contact, whose peak is √(E* P' / (π R))."""
    body = {"shape": "ridge", "radius_m": 5e-3, "length_m": 25e-3, "friction": 0.0}
    (contact,) = (
        one(body, {"depth_m": 5e-5, "yaw_rad": math.pi / 2}, skin=THICK, cells=48).truth(0.6).contacts
    )
    middle = contact.pressure_pa[:, contact.pressure_pa.shape[1] // 2]
    line_load = middle.sum() * contact.cell_m
    assert middle.max() == pytest.approx(math.sqrt(1e6 / 0.75 * line_load / (math.pi * 5e-3)), rel=0.01)
    width, length = (np.ptp(contact.cells_m[contact.pressure_pa > 0], axis=0)).tolist()
    assert length > 20 * width / 2


def test_a_fingertip_is_longer_along_its_longer_axis_and_turns() -> None:
    body = {"shape": "fingertip", "radii_m": [8e-3, 16e-3, 8e-3], "friction": 0.0}

    def second_moments(yaw_rad: float) -> np.ndarray:
        (contact,) = one(body, {"depth_m": 2e-4, "yaw_rad": yaw_rad}).truth(0.6).contacts
        places, p = (contact.cells_m - contact.centre_m).reshape(-1, 2), contact.pressure_pa.ravel()
        return (p[:, None] * places).T @ places / p.sum()

    straight, turned = second_moments(0.0), second_moments(0.6)
    assert straight[1, 1] > 2 * straight[0, 0]
    cos, sin = math.cos(0.6), math.sin(0.6)
    rotation = np.array([[cos, -sin], [sin, cos]])
    np.testing.assert_allclose(turned, rotation @ straight @ rotation.T, atol=0.03 * straight[1, 1])


def test_the_edge_of_a_box() -> None:
    """A wedge that is long along x: the contact is an elongated strip, symmetric about the edge."""
    body = {"shape": "box_edge", "length_m": 12e-3, "edge_radius_m": 0.5e-3, "friction": 0.0}
    (contact,) = one(body, {"depth_m": 3e-4}).truth(0.6).contacts
    pressure = contact.pressure_pa
    np.testing.assert_allclose(pressure, pressure[:, ::-1], atol=1e-3 * pressure.max())
    extent = np.ptp(contact.cells_m[pressure > 0], axis=0)
    assert extent[0] == pytest.approx(12e-3, rel=0.1)
    assert extent[1] < 3e-3


@pytest.mark.long
def test_force_is_the_integral_of_the_pressure_at_any_time(slide: PatchScene) -> None:
    for t in np.linspace(0.0, 2.3, 37):
        truth = slide.truth(float(t))
        for contact in truth.contacts:
            force = contact.traction_pa.sum(axis=(1, 2)) * contact.cell_m**2
            np.testing.assert_allclose(contact.force_n, force, rtol=1e-9, atol=1e-12)
            assert (contact.pressure_pa >= 0).all()
            shear = np.hypot(*contact.traction_pa[:2])
            assert (shear <= 0.5 * contact.pressure_pa * (1 + 1e-9) + 1e-6).all()
        assert np.isfinite(truth.displacement_m).all()
        total = sum((contact.force_n for contact in truth.contacts), np.zeros(3))
        np.testing.assert_allclose(truth.wrench[:3], total, atol=1e-12)


@pytest.mark.long
def test_wrench_is_that_of_the_tractions(slide: PatchScene) -> None:
    truth = slide.truth(1.1)
    (contact,) = truth.contacts
    height = float(slide.layout.upper_m[0, 0, 2])
    places = np.concatenate([contact.cells_m, np.full((*contact.cells_m.shape[:2], 1), height)], axis=-1)
    forces = np.moveaxis(contact.traction_pa, 0, -1) * contact.cell_m**2
    moment = np.cross(places, forces).sum(axis=(0, 1))
    np.testing.assert_allclose(truth.wrench[3:], moment, rtol=1e-9, atol=1e-12)


@pytest.mark.long
def test_a_touch_by_force_reaches_the_force(slide: PatchScene) -> None:
    for t in (0.5, 0.8, 1.1, 1.5, 1.7):
        assert -slide.truth(t).contacts[0].force_n[2] == pytest.approx(2.0, rel=0.005)


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(
    gap=st.floats(0.0, 5e-6),
    power=st.floats(0.8, 4.0),
    target=st.floats(1e-5, 100.0),
    stiffness=st.floats(1e2, 1e9),
)
def test_the_depth_of_a_force_is_found_however_steeply_the_force_begins(
    gap: float, power: float, target: float, stiffness: float
) -> None:
    def force_n(depth_m: float) -> float:  # a body whose lowest cells touch only below ``gap``
        return float(1e-4 * stiffness * (max(depth_m - gap, 0.0) / 1e-4) ** power)

    exact = gap + 1e-4 * (target / (1e-4 * stiffness)) ** (1.0 / power)
    depth = solve_depth(force_n, target, (1e-3, force_n(1e-3)))
    assert depth == pytest.approx(exact, rel=2e-4) or force_n(depth) == pytest.approx(target, rel=0.01)


@pytest.mark.long
def test_a_force_ramps_up_from_nothing_on_a_few_cells() -> None:
    truth = sphere({"force_n": 4.0, "ramp_s": 0.5, "to_s": 2.0}, friction=0.3).truth(1.0)
    assert truth.wrench[2] == pytest.approx(-4.0, rel=0.01)


def test_a_full_slide_has_the_shear_of_friction(slide: PatchScene) -> None:
    """Against none before the slide."""
    before, during = slide.truth(0.55).wrench, slide.truth(1.3).wrench
    assert abs(before[0]) < 0.002
    assert during[0] == pytest.approx(0.5 * -during[2], rel=0.002)
    assert abs(during[1]) < 0.002 * during[0]
    (contact,) = slide.truth(1.8).contacts
    assert contact.centre_m[0] == pytest.approx(22e-3, abs=0.3e-3)


def test_a_press_is_symmetric() -> None:
    scene = sphere({"depth_m": 2e-4}, friction=0.5)
    moved = scene.truth(0.6).displacement_m
    scale = np.abs(moved).max()
    np.testing.assert_allclose(moved[:, ::-1] * [-1, 1, 1], moved, atol=2e-4 * scale)
    np.testing.assert_allclose(moved[::-1] * [1, -1, 1], moved, atol=2e-4 * scale)
    np.testing.assert_allclose(np.moveaxis(moved, 0, 1)[..., [1, 0, 2]], moved, atol=2e-4 * scale)


@pytest.mark.long
def test_a_rolling_sphere_has_less_shear_than_a_sliding_one() -> None:
    def shear_n(kind: str) -> float:
        motion = {"kind": kind, "by_m": [4e-3, 0.0], "from_s": 0.3, "to_s": 0.9}
        wrench = (
            sphere({"depth_m": 2e-4, "to_s": 1.2, "motions": [motion], "ramp_s": 0.2}, 0.5).truth(0.7).wrench
        )
        return float(abs(wrench[0] / wrench[2]))

    assert shear_n("slide") == pytest.approx(0.5, rel=0.005)
    assert shear_n("roll") < 0.1


def test_a_small_shear_sticks_and_comes_back() -> None:
    """With a friction of 2 the skin follows the body, and its force ends near zero when the body is back."""
    motion = {"kind": "shear", "by_m": [2e-5, 0.0], "from_s": 0.4, "to_s": 1.0}
    scene = sphere({"depth_m": 2e-4, "to_s": 1.4, "at_m": [16e-3, 16e-3], "motions": [motion]}, 2.0)
    out, back = scene.truth(0.7), scene.truth(1.05)
    before = scene.truth(0.4)
    moved = out.displacement_m[4, 4, 0] - before.displacement_m[4, 4, 0]
    assert moved == pytest.approx(2e-5, rel=0.03)
    assert abs(back.wrench[0]) < 0.05 * abs(out.wrench[0])


@pytest.mark.long
def test_a_turn_twists_the_skin() -> None:
    motion = {"kind": "turn", "by_rad": 0.5, "from_s": 0.4, "to_s": 0.7}
    scene = sphere({"depth_m": 2e-4, "to_s": 1.1, "motions": [motion]}, 0.5)
    truth = scene.truth(0.75)
    x, y = CENTRE
    force_z = truth.wrench[2]
    assert np.abs(truth.wrench[:2]).max() < 1e-3 * abs(force_z)
    about_centre = truth.wrench[5]  # the shear forces sum to zero, so the moment has no arm
    radius = truth.contacts[0].radius_m
    assert 0.3 * 0.5 * -force_z * radius < about_centre < 0.5 * -force_z * radius
    assert x == y


def test_taps() -> None:
    scene = sphere({"depth_m": 1e-4, "to_s": 0.3, "ramp_s": 0.1, "times": 3, "every_s": 0.4}, step_s=0.01)
    depth = np.array([-scene.truth(t).wrench[2] for t in (0.2, 0.35, 0.6, 0.75, 1.0, 1.2)])
    assert (depth[::2] > 0.1).all()
    assert (depth[1::2] == 0.0).all()
    assert depth[2] == pytest.approx(depth[0], rel=1e-6)


@pytest.mark.long
def test_a_harder_press_within_a_touch() -> None:
    motion = {"kind": "press", "force_n": 1.5, "from_s": 0.5, "to_s": 0.8}
    scene = sphere({"force_n": 0.5, "to_s": 1.4, "motions": [motion]})
    assert -scene.truth(0.45).wrench[2] == pytest.approx(0.5, rel=0.005)
    assert -scene.truth(0.95).wrench[2] == pytest.approx(1.5, rel=0.005)


@pytest.mark.long
def test_times_can_be_asked_in_any_order(slide: PatchScene) -> None:
    """Two scenes made from the same tables agree to the byte, whichever time comes first."""
    touch = slide.histories[0].touch.model_dump(exclude_none=True)
    touch["motions"] = list(touch["motions"])
    bind._history.cache_clear()
    other = one({"shape": "sphere", "radius_m": 10e-3, "friction": 0.5}, touch)
    assert other.histories[0] is not slide.histories[0]
    times = np.random.default_rng(3).uniform(0.0, 2.3, 24)
    backwards = {t: other.upper_m(t) for t in sorted(times, reverse=True)}
    for t in times:
        assert backwards[t].tobytes() == slide.upper_m(t).tobytes()
        np.testing.assert_allclose(
            slide.upper_m(t) - slide.layout.upper_m, slide.truth(t).displacement_m, atol=1e-15
        )


@pytest.mark.long
def test_a_touch_is_computed_once_for_the_same_skin_and_body() -> None:
    """Tests of a program start the same scene again and again."""
    first, again = (sphere({"depth_m": 1e-4}, friction=0.3) for _ in range(2))
    assert first.histories == again.histories
    for other in (
        sphere({"depth_m": 1e-4}, friction=0.4),
        sphere({"depth_m": 1.1e-4}, friction=0.3),
        sphere({"depth_m": 1e-4}, friction=0.3, step_s=0.01),
        sphere({"depth_m": 1e-4}, friction=0.3, skin={"thickness_m": 3e-3}),
    ):
        assert other.histories != first.histories
        assert other.upper_m(0.7).tobytes() != first.upper_m(0.7).tobytes()


def test_the_skin_moves_smoothly(slide: PatchScene) -> None:
    """Second differences over a tenth of a step stay small: no corner at the steps."""
    times = np.arange(0.0, 2.3, 0.003)
    moved = np.array([slide.upper_m(t) for t in times]) - slide.layout.upper_m
    corner = np.abs(np.diff(moved, 2, axis=0)).max()
    assert corner < 0.005 * np.abs(moved).max()


def test_the_rest_is_the_layout_itself(slide: PatchScene) -> None:
    assert slide.upper_m(0.0) is slide.layout.upper_m
    assert slide.upper_m(5.0) is slide.layout.upper_m
    assert not slide.truth(5.0).displacement_m.any()
    assert slide.truth(5.0).contacts == ()


def test_a_scene_repeats() -> None:
    scene = sphere({"depth_m": 1e-4}, repeat_s=1.5)
    for t in (0.3, 0.6, 1.0):
        np.testing.assert_allclose(scene.upper_m(t + 3.0), scene.upper_m(t), atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32), reach=st.floats(1e-4, 5e-3), t=st.floats(-1.0, 10.0))
def test_a_walk_stays_within_its_reach(seed: int, reach: float, t: float) -> None:
    walk = {"kind": "walk", "seed": seed, "reach_m": reach, "every_s": 0.3, "from_s": 1.0, "to_s": 7.0}
    touch = TouchConfig.model_validate(
        {
            "body": "b",
            "patch": "p",
            "at_m": CENTRE,
            "from_s": 0.5,
            "to_s": 8.0,
            "depth_m": 1e-4,
            "motions": [walk],
        }
    )
    pose = pose_at(touch, t)
    assert math.dist(pose.place_m, CENTRE) <= reach * (1 + 1e-9)
    assert pose == pose_at(touch, t)
    if t <= 1.0:
        assert pose.place_m == tuple(CENTRE)


def test_two_bodies_add_up() -> None:
    """On one patch, far from each other; a patch that nothing touches has no steps."""
    body = {"shape": "sphere", "radius_m": 8e-3, "friction": 0.0}
    times = {"from_s": 0.1, "to_s": 1.1, "depth_m": 2e-4, "patch": "p0"}
    touches = [{"body": "a", "at_m": [8e-3, 8e-3], **times}, {"body": "b", "at_m": [28e-3, 26e-3], **times}]
    bodies = [{"name": "a", **body}, {"name": "b", **body}]
    both = bind_scene(parse_scene({"bodies": bodies, "touches": touches}), hand(2))
    each = [
        bind_scene(parse_scene({"bodies": bodies, "touches": [touch]}), hand())["p0"] for touch in touches
    ]
    moved = sum(scene.truth(0.6).displacement_m for scene in each)
    np.testing.assert_allclose(both["p0"].truth(0.6).displacement_m, moved, atol=1e-15)
    assert [contact.body for contact in both["p0"].truth(0.6).contacts] == ["a", "b"]
    assert both["p1"].histories == ()
    assert both["p1"].upper_m(0.6) is both["p1"].layout.upper_m


def test_bodies_as_near_as_allowed_hardly_move_each_others_skin() -> None:
    """The contacts do not see each other; the displacement that this neglects is small."""
    scene = one({"shape": "sphere", "radius_m": 40e-3, "friction": 0.0}, {"depth_m": 3e-4})
    half = max(scene.histories[0].window.half_m)
    gap = 3 * 2e-3
    electrodes = scene.histories[0]._electrodes
    step = scene.histories[0].step(20)
    assert step is not None
    grid = scene.histories[0].window.grid
    loaded = step.traction_pa.any(axis=0)
    cells = grid.centres_m(scene.histories[0].cell_m(step.first))[loaded]
    force = step.traction_pa[:, loaded] * grid.size_m**2
    at = np.array([[CENTRE[0] + half + gap, CENTRE[1]]])
    moved = electrodes._under_forces(at, cells, force)
    assert abs(moved[0, 2]) < 0.03 * 3e-4


@pytest.mark.long
@pytest.mark.parametrize("cells", [20, 40])
def test_the_electrodes_move_as_the_response_of_each_cell_says(cells: int) -> None:
    """Against the sum over all cells of the response of a cell, for each electrode, while the body slides."""
    motion = {"kind": "slide", "by_m": [4e-3, 0.0], "from_s": 0.3, "to_s": 0.6}
    touch = {"at_m": [16.03e-3, 18.02e-3], "depth_m": 2.5e-4, "to_s": 0.9, "ramp_s": 0.2, "motions": [motion]}
    scene = one({"shape": "sphere", "radius_m": 10e-3, "friction": 0.5}, touch, cells=cells)
    history = scene.histories[0]
    step, grid = history.step(16), history.window.grid
    assert step is not None
    cells_m = grid.centres_m(history.cell_m(step.first))
    places = scene.layout.upper_m[2:8, 2:8, :2].reshape(-1, 2)
    response = cell_response(grid.layer, places[:, None, None] - cells_m, grid.size_m, 0.05)
    moved = np.einsum("exyij,jxy->ei", response, step.traction_pa)
    found = step.electrodes_m.reshape(10, 10, 3)[2:8, 2:8].reshape(-1, 3)
    outside = (np.abs(places - cells_m.mean(axis=(0, 1))) > 0.5 * grid.size_m * cells).any(axis=1)
    scale = np.abs(moved).max()
    assert 20 < outside.sum() < 36
    np.testing.assert_allclose(found[outside], moved[outside], atol=5e-4 * scale)
    np.testing.assert_allclose(found, moved, atol=1e-3 * scale)


BODY = '[[bodies]]\nname = "ball"\nshape = "sphere"\nradius_m = 0.01\n'
TOUCH = (
    '[[touches]]\nbody = "ball"\npatch = "p0"\nat_m = [0.018, 0.018]\nfrom_s = 1.0\nto_s = 2.0\n'
    "depth_m = 2e-4\n"
)
HAND = (
    '[[buses]]\nname = "can0"\ninterface = "virtual"\nchannel = "c"\n\n'
    '[[patches]]\nname = "p0"\nnode_id = 4\n'
)
SLIDE = '[[touches.motions]]\nkind = "slide"\nby_m = [0.001, 0.0]\nfrom_s = 1.3\nto_s = 1.7\n'


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        (BODY + TOUCH.replace("[0.018, 0.018]", "[0.05, 0.018]"), "8:1", ["touches[0].at_m", "stays on"]),
        (BODY + TOUCH + SLIDE.replace("0.001", "0.03"), "14:1", ["motions[0].by_m", "stays on"]),
        (BODY + TOUCH.replace("2e-4", "2e-3"), "11:1", ["touches[0].depth_m", "0.0018 m"]),
        (BODY + TOUCH.replace("depth_m = 2e-4", "force_n = 5000"), "11:1", ["force_n", "5000", "at most"]),
        (BODY + TOUCH + "sliding = 1\n", "12:1", ["touches[0].sliding", "unknown key"]),
        (BODY + TOUCH.replace('"p0"', '"p9"'), "7:1", ["touches[0].patch", "'p9'", "p0"]),
        (BODY + TOUCH.replace('"ball"', '"bell"'), "6:1", ["touches[0].body", "'bell'", "ball"]),
        (BODY + TOUCH.replace("to_s = 2.0", "to_s = 0.5"), "10:1", ["to_s", "0.5", "later than from_s"]),
        (BODY + TOUCH + SLIDE.replace("to_s = 1.7", "to_s = 1.2"), "16:1", ["motions[0].to_s", "1.2"]),
        (BODY + TOUCH + SLIDE.replace("to_s = 1.7", "to_s = 2.7"), "16:1", ["motions[0].to_s", "2.7"]),
        (
            BODY + TOUCH.replace("to_s = 2.0", "to_s = 1.05") + "ramp_s = 0.02\n",
            "10:1",
            ["touches[0].to_s", "1.05", "at least 1.06 s, two time steps"],
        ),
        (BODY + TOUCH + "ramp_s = 0.8\n", "12:1", ["ramp_s", "0.8", "at most half"]),
        (BODY + TOUCH + "force_n = 1.0\n", "12:1", ["force_n", "either"]),
        (BODY + TOUCH.replace("2e-4", "nan"), "11:1", ["depth_m", "nan", "(m)"]),
        (BODY + TOUCH.replace("0.018]", "inf]"), "8:16", ["at_m[1]", "inf"]),
        (BODY.replace('"sphere"', '"cube"') + TOUCH, "3:1", ["bodies[0].shape", "'cube'", "sphere"]),
        (BODY + "length_m = 0.01\n" + TOUCH, "5:1", ["bodies[0].length_m", "only with shape"]),
        (BODY.replace("radius_m = 0.01\n", "") + TOUCH, "1:1", ["bodies[0].radius_m", "nothing"]),
        (BODY + BODY + TOUCH, "6:1", ["bodies[1].name", "'ball'"]),
        (BODY + TOUCH + TOUCH, "16:1", ["touches[1].from_s", "does not use the body"]),
        (
            BODY
            + BODY.replace("ball", "two")
            + TOUCH
            + TOUCH.replace("ball", "two").replace("[0.018", "[0.021"),
            "19:1",
            ["touches[1].at_m", "mm from the contact of touches[0]"],
        ),
        (BODY + TOUCH + "times = 2\n", "5:1", ["touches[0].every_s", "nothing"]),
        ("repeat_s = 1.5\n" + BODY + TOUCH, "11:1", ["touches[0].to_s", "repeat_s"]),
        (
            BODY.replace("sphere", "punch") + TOUCH + SLIDE.replace('"slide"', '"roll"'),
            "13:1",
            ["motions[0].kind", "requires a sphere or a ridge"],
        ),
    ],
)
def test_a_bad_scene_is_one_line_with_its_place(
    text: str, place: str, words: list[str], tmp_path: Path
) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_scene(file, hand())
    message = str(error.value)
    assert message.startswith(f"{file}:{place}: ")
    assert "\n" not in message
    for word in words:
        assert word in message


def test_the_command_reports_a_bad_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "hand.toml").write_text(HAND)
    scene = tmp_path / "scene.toml"
    scene.write_text(BODY + TOUCH.replace("2e-4", "2e-3"))
    for options in (["--seconds", "0"], ["--plot", str(tmp_path / "a.png")]):
        with pytest.raises(SystemExit) as ended:
            main([str(tmp_path / "hand.toml"), "--scene", str(scene), *options])
        out, err = capsys.readouterr()
        assert (ended.value.code, out) == (2, "")
        assert err.count("\n") == 1
        assert "scene.toml:11:1" in err
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "hand.toml"), "--plot", str(tmp_path / "a.png")])
    assert ended.value.code == 2
    assert "only with --scene" in capsys.readouterr().err


@pytest.mark.long
def test_the_preview_is_a_png(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "hand.toml").write_text(HAND)
    (tmp_path / "scene.toml").write_text(BODY + TOUCH)
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / name) for name in ("hand.toml",)] + ["--scene", str(tmp_path / "scene.toml"),
             "--plot", str(tmp_path / "a.png")])  # fmt: skip
    assert not ended.value.code
    assert "wrote" in capsys.readouterr().out
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_a_scene_reaches_the_host() -> None:
    """Through the real nodes: the depth that the host decodes is the depth of the truth."""
    plan = hand(2, upper_wires=5, upper_electrodes=5)
    table = {
        "bodies": [{"name": "ball", "shape": "sphere", "radius_m": 10e-3}],
        "touches": [
            {
                "body": "ball",
                "patch": "p1",
                "at_m": [8e-3, 8e-3],
                "from_s": 0.2,
                "to_s": 60.0,
                "depth_m": 2e-4,
            }
        ],
    }
    with Fleet(plan, scene=parse_scene(table)) as fleet, sk.Host.from_config(plan) as host:
        for field in itertools.islice(host.fields(timeout_s=10), 2000):
            assert field.stamp is not None
            name = field.stamp.patch
            truth = fleet.truth(name, field.stamp.device_time_us)
            moved = fleet.truth_m(name, field.stamp.device_time_us)
            layout = fleet.patches[name].scene.layout
            np.testing.assert_allclose(truth.displacement_m, moved - layout.upper_m, atol=1e-15)
            if name == "p0":
                assert truth.contacts == ()
            elif truth.contacts and truth.contacts[0].depth_m > 1.99e-4:
                assert abs(field.displacement_m - truth.displacement_m).max() < 2e-5
                break
        else:
            pytest.fail("the host decoded no pressed skin")
        with pytest.raises(LookupError, match="p1"):
            fleet.truth("p1", 1)
    with pytest.raises(LookupError, match="no scene"):
        Fleet(plan).truth("p0", 1)
