"""What is drawn of fields whose displacement is known, and where patches are drawn."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest

from skinnode.demo.hand import demo_hand
from skinnode.host import HandFrame
from skinnode.host.skeleton import Skeleton
from skinnode.model.frames import Z_95_TWO_SIDED
from skinnode.monitor.field_map import UNKNOWN_RGB
from skinnode.view.colours import depth_rgba
from skinnode.view.picture import FORCE_M_PER_N, SHEAR, Style, picture_of, stale_picture_of
from skinnode.view.placement import placement_of
from skinnode.view.texts import DrawnCounts, contacts_text, health_text

from .conftest import LAYOUT, a_contact, a_field, a_hand

REST = LAYOUT.upper_m
STYLE = Style(exaggeration=10.0, full_m=4e-4, pitch_m=4e-3)


def test_the_colours_are_those_of_magma() -> None:
    displacement = np.zeros_like(REST)
    displacement[0, :5, 2] = -4e-4 * np.linspace(0.0, 1.0, 5)
    rgba = depth_rgba(-displacement[..., 2], np.zeros((10, 10), bool), 4e-4)
    expected = mpl.colormaps["magma"](np.linspace(0.0, 1.0, 5), bytes=True)
    assert np.abs(rgba[:5].astype(int) - expected.astype(int)).max() <= 1


def test_beyond_the_scale_the_colour_is_the_brightest() -> None:
    displacement = np.zeros_like(REST)
    displacement[0, 0, 2], displacement[0, 1, 2] = -4e-4, -9e-4
    rgba = depth_rgba(-displacement[..., 2], np.zeros((10, 10), bool), 4e-4)
    assert np.array_equal(rgba[0], rgba[1])


def test_the_surface_is_the_enlarged_field_and_unknown_skin_is_grey_and_at_rest() -> None:
    rng = np.random.default_rng(1)
    displacement, std = rng.normal(0.0, 1e-4, REST.shape), np.full(REST.shape, 1e-6)
    displacement[3], std[3] = np.nan, np.inf
    picture = picture_of(a_field(displacement, std), REST, STYLE)
    drawn = picture.points_m.reshape(REST.shape)
    known = np.arange(10) != 3
    assert drawn[known] == pytest.approx((REST + 10.0 * displacement)[known])
    assert np.array_equal(drawn[3], REST[3])
    grey = picture.rgba.reshape(10, 10, 4)[..., :3] == UNKNOWN_RGB
    assert grey[3].all()
    assert np.isfinite(picture.normals).all()


def test_only_certain_shear_is_an_arrow() -> None:
    displacement, std = np.zeros_like(REST), np.full(REST.shape, 1e-6)
    displacement[2, 4] = 6e-5, -8e-5, -3e-4
    displacement[5, 5], std[5, 5] = (1e-4, 0.0, 0.0), 5e-5  # within four standard deviations
    displacement[7, 7] = 1e-6, 0.0, 0.0  # certain but invisible
    picture = picture_of(a_field(displacement, std), REST, STYLE)
    assert picture.shear_m == pytest.approx(SHEAR * np.array([[6e-4, -8e-4, 0.0]]))
    assert np.linalg.norm(picture.shear_origins_m[0] - (REST + 10 * displacement)[2, 4]) < 0.1 * 4e-3


def test_a_force_arrow_ends_at_the_pressed_skin_below_the_contact() -> None:
    displacement = np.zeros_like(REST)
    displacement[3, 4] = 0.0, 0.0, -3e-4
    contact = a_contact(2.0, (0.3, -0.4), centroid_m=REST[3, 4] + [1e-3, -1e-3, 0.0])
    picture = picture_of(a_field(displacement, contacts=(contact,)), REST, STYLE)
    tip = picture.force_origins_m[0] + picture.force_m[0]
    assert tip == pytest.approx(contact.centroid_m + np.array([0.0, 0.0, -3e-3]))
    assert picture.force_m[0] == pytest.approx(FORCE_M_PER_N * np.array([0.3, -0.4, -2.0]))
    assert picture.force_std_m[0] == pytest.approx(
        Z_95_TWO_SIDED * FORCE_M_PER_N * np.array([0.02, 0.03, 0.05])
    )
    assert picture.labels == ("2.00 ± 0.05 N",)
    assert len(picture.rings_m) == 1


def test_a_patch_without_an_up_to_date_field_has_neither_colour_nor_arrows() -> None:
    picture = stale_picture_of(REST)
    assert np.array_equal(picture.points_m, REST.reshape(-1, 3))
    assert (picture.rgba[:, :3] == UNKNOWN_RGB).all()
    assert len(picture.shear_m) == len(picture.force_m) == len(picture.rings_m) == 0


def test_patches_are_drawn_at_their_poses() -> None:
    hand = a_hand()
    layouts = {patch.name: patch.layout.build() for patch in hand.patches}
    placement = placement_of(hand, layouts)
    assert not placement.side_by_side
    assert placement.skeleton.mount("p1").pose.position_m == (0.0, 0.0, 0.1)
    assert placement.path("p1") == ["skin", "hand", "p1"]


@pytest.mark.parametrize("count", [2, 5, 16])
def test_patches_without_poses_are_drawn_side_by_side(count: int) -> None:
    hand = demo_hand(count, seed=1)
    nowhere = tuple(patch.model_copy(update={"pose": hand.patches[0].pose}) for patch in hand.patches)
    hand = hand.model_copy(update={"patches": nowhere})
    layouts = {patch.name: patch.layout.build() for patch in hand.patches}
    placement = placement_of(hand, layouts)
    assert placement.side_by_side
    boxes = []
    for name, layout in layouts.items():
        points = placement.skeleton.mount(name).pose.points_m(layout.upper_m.reshape(-1, 3))
        boxes.append((points.min(axis=0), points.max(axis=0)))
    for (low, high), (other_low, other_high) in itertools.combinations(boxes, 2):
        assert (high < other_low)[:2].any() or (other_high < low)[:2].any()


def test_the_simulated_hand_has_a_place_for_every_patch() -> None:
    hand = demo_hand(127, seed=1)
    layouts = {patch.name: patch.layout.build() for patch in hand.patches}
    assert not placement_of(hand, layouts).side_by_side


def test_contacts_are_told_with_their_deviations() -> None:
    contact = a_contact(2.0, (0.3, -0.4))
    field = a_field(np.zeros_like(REST), contacts=(contact,), patch="p1")
    frame = HandFrame(7, 0, {"p1": field}, {"p0": "lost"}, Skeleton.of(a_hand()))
    lines = contacts_text(frame).splitlines()
    assert "| p1 | 2.00 ± 0.05 N | 0.50 N |" in lines[2]
    x, _, z = frame.contacts[0].position_m
    assert f"{1e3 * x:.1f}, 12.0, {1e3 * z:.1f} ± 0.20 mm" in lines[2]
    total = frame.wrench.force_n
    assert f"| whole hand | {total[0]:.2f}, {total[1]:.2f}, {total[2]:.2f} ±" in lines[-1]


def test_names_are_no_markdown() -> None:
    evil = "[a](http://evil.example) | *b* <img>\n# c"
    frame = HandFrame(7, 0, {evil: a_field(np.zeros_like(REST), contacts=(a_contact(),))}, {}, Skeleton())
    row = contacts_text(frame).splitlines()[2]
    bare = [sign for before, sign in itertools.pairwise(row) if sign in "[]<>#*" and before != "\\"]
    assert bare == []


def test_health_says_what_was_not_drawn() -> None:
    view = SimpleNamespace(patches=(), buses=(), latency_s=0.0042)
    text = health_text(view, DrawnCounts(30, 2, 1), ["ten times"])  # type: ignore[arg-type]
    assert "Fields: 30 drawn, 2 left out, 1 dropped. Latency 4.2 ms" in text
    assert text.endswith("ten times")
