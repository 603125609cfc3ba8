"""The forward model against hand calculations, extended precision, and its compiled twin."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skinnode as sk
from skinnode.model.kernels import lower_rows, potential, potential_jacobian


@st.composite
def patches(draw: st.DrawFn) -> tuple[sk.PatchLayout, np.ndarray]:
    """A random layout, in any unit of length, and random electrode positions above it."""
    wires, electrodes = draw(st.integers(1, 3)), draw(st.integers(1, 6))
    lower_wires, lower_electrodes = draw(st.integers(1, 13)), draw(st.integers(1, 5))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    scale = 10.0 ** draw(st.integers(-4, 1))
    upper = rng.uniform(-4, 4, (wires, electrodes, 3))
    upper[..., 2] = rng.uniform(0.3, 2.0, (wires, electrodes))
    lower = rng.uniform(-4, 4, (lower_wires, lower_electrodes, 3))
    lower[..., 2] = rng.uniform(-0.5, 0.0, (lower_wires, lower_electrodes))
    layout = sk.PatchLayout(upper * scale, lower * scale, 10.0 ** rng.uniform(0, 8))
    moved = upper + rng.uniform(-0.2, 0.2, upper.shape)
    return layout, moved * scale


def potential_extended(layout: sk.PatchLayout, upper: np.ndarray) -> np.ndarray:
    """F (U, K) in 80-bit floats, summed pair by pair."""
    total = np.zeros(layout.shape, np.longdouble)
    lower = layout.lower_m.astype(np.longdouble)
    for i in range(upper.shape[1]):
        for j in range(lower.shape[1]):
            gap = upper[:, None, i] - lower[None, :, j]
            total += 1 / np.sqrt((gap * gap).sum(axis=-1))
    return total


def difference_jacobian(layout: sk.PatchLayout, upper_m: np.ndarray) -> np.ndarray:
    """∂F/∂x (U, K, N, 3) by central differences in 80-bit floats, extrapolated twice (Richardson).

    At a step of 1e-3 clearances the rest of the series is of the order of 1e-18, rounding of 1e-15.
    """
    upper = upper_m.astype(np.longdouble)
    gaps = np.linalg.norm(upper_m[:, None, None] - layout.lower_m[None, :, :, None], axis=-1)
    step = np.longdouble(1e-3 * gaps.min())
    out = np.empty((*layout.shape, upper.shape[1], 3), np.longdouble)
    for i in range(upper.shape[1]):
        for c in range(3):
            table = []
            for h in (step, step / 2, step / 4):
                there, back = upper.copy(), upper.copy()
                there[:, i, c] += h
                back[:, i, c] -= h
                table.append((potential_extended(layout, there) - potential_extended(layout, back)) / (2 * h))
            once = [(4 * b - a) / 3 for a, b in itertools.pairwise(table)]
            out[:, :, i, c] = (16 * once[1] - once[0]) / 15
    return out


def compiled(layout: sk.PatchLayout, upper_m: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """F (U, K) and J (U, K, N, 3) by the kernels, in lengths of ``unit``."""
    lower = lower_rows(layout.lower_m / unit)
    f, j = np.empty(layout.shape), np.empty((*layout.shape, upper_m.shape[1], 3))
    for u, wire in enumerate(upper_m):
        x = np.ascontiguousarray(wire.ravel() / unit)
        jt = np.empty((x.size, layout.shape[1]))
        potential_jacobian(x, lower, f[u], jt)
        j[u] = jt.T.reshape(layout.shape[1], -1, 3)
    return f / unit, j / unit**2


def assert_close(value: np.ndarray, truth: np.ndarray, relative: float) -> None:
    """Within ``relative`` of the largest derivative of the same resistance."""
    size = np.abs(truth).max(axis=tuple(range(2, truth.ndim)), keepdims=True)
    assert (np.abs(value - truth) <= relative * size).all()


@settings(max_examples=40, deadline=None)
@given(patches())
def test_jacobian_is_the_derivative(patch):
    layout, upper = patch
    truth = difference_jacobian(layout, upper)
    assert_close(sk.jacobian(layout, upper), truth, 1e-9)
    assert_close(compiled(layout, upper, layout.pitch_m)[1], truth, 1e-9)


@settings(max_examples=60, deadline=None)
@given(patches())
def test_compiled_model_is_the_model(patch):
    layout, upper = patch
    f, j = compiled(layout, upper, layout.pitch_m)
    np.testing.assert_allclose(layout.resistivity_ohm_per_m / f, sk.resistance_ohm(layout, upper), rtol=1e-9)
    assert_close(j, sk.jacobian(layout, upper), 1e-9)
    alone = np.empty(layout.shape[1])
    potential(upper[0].ravel() / layout.pitch_m, lower_rows(layout.lower_m / layout.pitch_m), alone)
    np.testing.assert_allclose(alone / layout.pitch_m, f[0], rtol=1e-14)


@settings(max_examples=30, deadline=None)
@given(patches())
def test_model_is_right_in_extended_precision(patch):
    layout, upper = patch
    truth = layout.resistivity_ohm_per_m / potential_extended(layout, upper.astype(np.longdouble))
    np.testing.assert_allclose(sk.resistance_ohm(layout, upper), truth.astype(float), rtol=1e-13)


@pytest.mark.parametrize("decades", [3, 150])
def test_compiled_distances_are_right_to_two_ulps(decades):
    """1 / d at distances of 10^±decades, and its derivative where that is a number."""
    rng = np.random.default_rng(decades)
    distance = 10.0 ** rng.uniform(-decades, decades, 20_011)
    lower = np.zeros((3, 1, distance.size))
    lower[2, 0] = -distance
    f, alone, jt = np.empty(distance.size), np.empty(distance.size), np.full((3, distance.size), np.nan)
    potential_jacobian(np.zeros(3), lower, f, jt)
    potential(np.zeros(3), lower, alone)
    truth = (1 / distance.astype(np.longdouble)).astype(float)
    assert (np.abs(f - truth) <= 2 * np.spacing(truth)).all()
    np.testing.assert_array_equal(alone, f)
    usual = (distance > 1e-75) & (distance < 1e75)
    np.testing.assert_allclose(jt[2, usual], -(truth[usual] ** 2), rtol=4e-15)


@pytest.mark.parametrize("distance", [0.0, 1e-300, 1e-160, 1e160, 1e300, np.inf, np.nan])
def test_distance_out_of_range_is_no_number(distance):
    """The steps see that r is not finite; a number that is wrong would pass for a potential."""
    lower = np.zeros((3, 2, 9))
    lower[1] = -1.0
    lower[1, 1, 4] = distance
    f, jt = np.empty(9), np.empty((3, 9))
    potential_jacobian(np.zeros(3), lower, f, jt)
    assert not np.isfinite(f[4])
    assert not np.isfinite(jt[1, 4])
    others = np.arange(9) != 4
    np.testing.assert_array_equal(f[others], 2.0)


def test_one_path_is_resistivity_times_distance():
    layout = sk.PatchLayout(np.array([[[3.0, 0, 4.0]]]), np.zeros((1, 1, 3)), 2.0)
    assert sk.resistance_ohm(layout, layout.upper_m) == pytest.approx(10.0)
    np.testing.assert_allclose(sk.jacobian(layout, layout.upper_m), [[[[-3 / 125, 0, -4 / 125]]]])


def test_paths_are_in_parallel():
    """Two electrodes above, two below, at distances 3, 5, 5, 3: R = 1 / (1/3 + 1/5 + 1/5 + 1/3)."""
    upper, lower = [[[0.0, 0, 3], [4.0, 0, 3]]], [[[0.0, 0, 0], [4.0, 0, 0]]]
    layout = sk.PatchLayout(np.array(upper), np.array(lower), 1.0)
    assert sk.resistance_ohm(layout, layout.upper_m) == pytest.approx(15 / 16)


def test_frame_is_upper_wire_by_lower_wire():
    layout = sk.PatchLayout.preset("aligned", upper_wires=2, upper_electrodes=3, lower_wires=5)
    frame = sk.resistance_ohm(layout, layout.upper_m)
    assert frame.shape == (2, 5)
    alone = sk.PatchLayout(layout.upper_m[1:], layout.lower_m[3:4], layout.resistivity_ohm_per_m)
    assert sk.resistance_ohm(alone, alone.upper_m) == pytest.approx(frame[1, 3])


def test_touching_electrodes_short_the_wires():
    layout = sk.PatchLayout(np.array([[[0.0, 0, 1]]]), np.zeros((1, 1, 3)), 1.0)
    assert sk.resistance_ohm(layout, np.zeros((1, 1, 3))) == 0.0


@pytest.mark.parametrize("function", [sk.resistance_ohm, sk.jacobian])
def test_positions_of_the_wrong_shape_are_named(function):
    layout = sk.PatchLayout.preset("staggered")
    with pytest.raises(ValueError, match=r"upper_m: got shape \(10, 3\), must be \(10, 10, 3\)"):
        function(layout, layout.upper_m[0])
    with pytest.raises(ValueError, match=r"upper_m: got nan at \[0, 0, 0\], must be finite"):
        function(layout, np.full_like(layout.upper_m, np.nan))
