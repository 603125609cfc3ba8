"""Patch layouts: where the electrodes are, what is refused, and what a layout is worth."""

from __future__ import annotations

import numpy as np
import pytest

import skinnode as sk
from skinnode.model.layout import PRESETS


def test_reference_patch_is_ten_by_ten_over_thirty():
    for name in PRESETS:
        layout = sk.PatchLayout.preset(name)
        assert layout.upper_m.shape == (10, 10, 3)
        assert layout.lower_m.shape == (30, 10, 3)
        assert (layout.shape, layout.unknowns) == ((10, 30), 30)
        assert layout.name == name


def test_upper_wires_run_along_x_one_pitch_apart():
    layout = sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
    u, i = 3, 7
    np.testing.assert_allclose(layout.upper_m[u, i], [i * 4e-3, u * 4e-3, 2e-3])
    assert layout.pitch_m == pytest.approx(4e-3)
    assert layout.height_m == pytest.approx(2e-3)
    assert (layout.lower_m[..., 2] == 0).all()


def test_staggered_is_wider_coarser_and_shifted():
    lower = sk.PatchLayout.preset("staggered", pitch_m=1.0, height_m=0.5).lower_m
    np.testing.assert_allclose([lower[0, 0, 0], lower[-1, 0, 0]], [-0.25, 9.25])  # 9.5 pitches, centred
    np.testing.assert_allclose(np.diff(lower[:, 0, 0]), 9.5 / 29)
    np.testing.assert_allclose(np.diff(lower[..., 1], axis=1), 1.2)
    np.testing.assert_allclose(lower[..., 1].mean(axis=1) - 4.5, 0.43 * (np.arange(30) % 3 - 1.0))


def test_aligned_and_symmetric_differ_by_a_quarter_pitch():
    aligned, symmetric = (sk.PatchLayout.preset(n, pitch_m=2.0).lower_m for n in ("aligned", "symmetric"))
    np.testing.assert_allclose(aligned - symmetric, np.broadcast_to([0, 0.5, 0], aligned.shape))
    np.testing.assert_allclose(symmetric[[0, -1], 0, 0], [0.0, 18.0])


def displacement_bound(name: str, height: float) -> float:
    """Cramér-Rao bound at a noise of 1e-5, median over the wires, as a share of a 10 % press."""
    layout = sk.PatchLayout.preset(name, pitch_m=1.0, height_m=height)
    noise = 1e-5 * layout.resistivity_ohm_per_m / sk.resistance_ohm(layout, layout.upper_m)
    bounds = []
    for u, j in enumerate(sk.jacobian(layout, layout.upper_m).reshape(10, 30, 30)):
        spread = np.linalg.inv(j) * noise[u]
        bounds.append(np.sqrt((spread**2).sum() / 30) / (0.1 * height))
    return float(np.median(bounds))


def test_the_staggered_layout_is_worth_its_stagger():
    """Below one per cent where the aligned one gives two thirds of the press."""
    assert displacement_bound("staggered", 0.3) < 0.006
    assert displacement_bound("staggered", 0.5) < 0.01
    assert displacement_bound("staggered", 1.0) < 0.12
    assert displacement_bound("aligned", 0.5) > 50 * displacement_bound("staggered", 0.5)


def test_layouts_cannot_be_changed_behind_the_back_of_a_solver():
    upper = np.array([[[0.0, 0, 1]]])
    layout = sk.PatchLayout(upper, np.zeros((1, 1, 3)))
    upper[:] = 5.0
    assert layout.upper_m[0, 0, 2] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        layout.lower_m[0, 0, 0] = 1.0


def test_hash_names_a_geometry():
    base = sk.PatchLayout.preset("staggered")
    assert base.layout_hash == sk.PatchLayout.preset("staggered").layout_hash
    assert 0 <= base.layout_hash < 2**32
    others = [sk.PatchLayout.preset(n) for n in ("aligned", "symmetric")]
    others += [sk.PatchLayout.preset("staggered", height_m=1.9e-3)]
    moved = base.lower_m.copy()
    moved[3, 4, 1] += 2e-9
    others += [sk.PatchLayout(base.upper_m, moved)]
    assert len({base.layout_hash, *(o.layout_hash for o in others)}) == 5
    moved[3, 4, 1] -= 1.9e-9
    assert sk.PatchLayout(base.upper_m, moved).layout_hash == base.layout_hash


def test_scale_of_a_wire_with_one_electrode_is_its_clearance():
    layout = sk.PatchLayout(np.array([[[0.0, 0, 2e-3]]]), np.array([[[0.0, 0, 0]], [[5e-3, 0, 0]]]))
    assert layout.pitch_m == pytest.approx(2e-3)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (([[0.0, 0, 1]], np.zeros((1, 1, 3))), r"upper_m: got shape \(1, 3\), must be \(U, N, 3\)"),
        ((np.ones((1, 1, 3)), np.zeros((1, 2, 2))), r"lower_m: got shape \(1, 2, 2\), must be \(K, M, 3\)"),
        ((np.ones((0, 1, 3)), np.zeros((1, 1, 3))), "every length must be at least 1"),
        ((np.full((1, 1, 3), np.nan), np.zeros((1, 1, 3))), r"upper_m: got nan at \[0, 0, 0\]"),
        ((np.zeros((1, 1, 3)), np.zeros((1, 1, 3))), "upper_m: an electrode is 0.0 m from a lower electrode"),
        (
            (np.ones((1, 1, 3)), np.zeros((1, 1, 3)), -1.0),
            "resistivity_ohm_per_m: got -1.0, must be positive",
        ),
        ((np.ones((25, 41, 3)), np.zeros((1, 1, 3))), "upper_electrodes: got 25 × 41, must be at most 1024"),
        ((["a"], np.zeros((1, 1, 3))), "upper_m: not an array of real numbers"),
    ],
)
def test_bad_geometry_is_named(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        sk.PatchLayout(*arguments)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"name": "hexagonal"}, "name: got 'hexagonal', must be one of aligned, symmetric, staggered"),
        ({"pitch_m": 0.0}, "pitch_m: got 0.0, must be positive"),
        ({"height_m": float("nan")}, "height_m: got nan"),
        ({"upper_wires": 0}, "upper_wires: got 0, must be at least 1"),
        ({"lower_wires": 10**6, "lower_electrodes": 10**6}, "must be at most 41943 with 100 upper"),
    ],
)
def test_bad_presets_are_named(options, complaint):
    with pytest.raises(ValueError, match=complaint):
        sk.PatchLayout.preset(**{"name": "staggered"} | options)


@pytest.mark.parametrize("value", [1j * np.ones((2, 2, 3)), np.zeros((2, 2, 3), "datetime64[s]")])
def test_what_a_cast_would_change_is_refused(value):
    with pytest.raises(ValueError, match="upper_m: not an array of real numbers"):
        sk.PatchLayout(value, np.zeros((6, 2, 3)))
