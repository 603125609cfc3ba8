"""Patches made to tolerances: wires placed off, a thicker layer, finite electrodes, a wrong gain.

The resistances come from :class:`skinnode.bench.truth.Skin`, which computes every distance of the patch as it
was made, in NumPy.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import skinnode as sk
from skinnode.bench.cases import fingertip
from skinnode.bench.truth import Converter, Skin, random_press, stream
from skinnode.model.status import Status
from skinnode.model.tolerances import EXACT, ORDINARY, Tolerances
from skinnode.solve.posterior import geometry_error as geometry
from skinnode.solve.posterior.elastic_prior import ElasticPrior
from skinnode.solve.wires.problem import PatchProblem
from tests.lanes import some_long

SMALL = sk.PatchLayout.preset(
    "staggered", upper_wires=3, upper_electrodes=4, lower_wires=12, lower_electrodes=5
)
NOISE = 1e-5
COMMON, UPPER = geometry.COMMON, geometry.UPPER


def columns(u: int, k: int, wires: int) -> list[int]:
    """Nuisances on which the residual of these wires depends, in the order of its effects."""
    upper, lower = COMMON + UPPER * u, COMMON + UPPER * wires + geometry.LOWER * k
    return [*range(COMMON), *range(upper, upper + UPPER), *range(lower, lower + geometry.LOWER)]


def dense(effect: np.ndarray) -> np.ndarray:
    """H (U K, nuisances) with its zeros."""
    wires, equations, _ = effect.shape
    h = np.zeros((wires, equations, geometry.nuisances(wires, equations)))
    for u in range(wires):
        for k in range(equations):
            h[u, k, columns(u, k, wires)] = effect[u, k]
    return h.reshape(wires * equations, -1)


def made(layout: sk.PatchLayout, tolerances: Tolerances, g: np.ndarray, skin: Skin | None = None) -> Skin:
    """The patch with these errors of its geometry."""
    wires, pitch = layout.shape[0], layout.pitch_m
    upper = g[COMMON : COMMON + UPPER * wires].reshape(wires, UPPER)[:, :3]
    lower = g[COMMON + UPPER * wires :].reshape(-1, 3)
    return dataclasses.replace(
        skin or Skin(layout),
        height=1.0 + tolerances.thickness * g[geometry.THICKNESS],
        electrode=tolerances.electrode_radius * np.sqrt(g[geometry.RADIUS]),
        upper_shift_m=tolerances.placement * pitch * upper,
        lower_shift_m=tolerances.placement * pitch * lower,
    )


def readings(layout: sk.PatchLayout, skin: Skin, moved_m: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """What the solver makes of the resistances, R · gain, with a relative error of their changes (U, 1)."""
    change = skin.resistance_ohm(moved_m) / skin.rest_ohm - 1.0
    return (1.0 + change * (1.0 + gain)) * PatchProblem.of(layout).a_rest


def press_m(layout: sk.PatchLayout, skin: Skin | None = None, depth: float = 0.3) -> np.ndarray:
    """The displacement (U, N, 3) under a sphere."""
    return (skin or Skin(layout)).displacement_m(
        (random_press(np.random.default_rng(3), layout, depth),), 1.0
    )


def linearised(layout: sk.PatchLayout, tolerances: Tolerances, moved_m, g, a):
    problem = PatchProblem.of(layout)
    model = geometry.GeometryError(problem, ElasticPrior.of(layout), tolerances)
    wires, equations = layout.shape
    r, jt = np.zeros((wires, equations)), np.zeros((wires, layout.unknowns, equations))
    effect = np.zeros((wires, equations, geometry.EFFECTS))
    moved = moved_m.reshape(wires, -1) / layout.pitch_m
    model.linearise(np.arange(wires), moved, a, np.ones_like(a), g, r, jt, effect)
    return r, jt, effect


@pytest.mark.parametrize(
    ("which", "within"), [("shifts", 1e-12), ("thickness", 1e-12), ("radius", 0.02), ("gain", 1e-12)]
)
@pytest.mark.parametrize("shape", ["flat", "fingertip"])
def test_at_the_truth_no_residual_is_left(shape, which, within):
    """``within``: relative to the residual without the nuisance; a rim has higher orders."""
    skin = fingertip() if shape == "fingertip" else Skin(SMALL)
    layout = skin.layout
    wires, equations = layout.shape
    rng = np.random.default_rng(1)
    g = np.zeros(geometry.nuisances(wires, equations))
    if which == "shifts":
        g[COMMON:] = rng.normal(size=g.size - COMMON)
        g[COMMON + 3 : COMMON + UPPER * wires : UPPER] = 0.0
    elif which == "thickness":
        g[geometry.THICKNESS] = -1.3
    elif which == "radius":
        g[geometry.RADIUS] = 0.2
    else:
        g[geometry.GAIN], g[COMMON + 3 : COMMON + UPPER * wires : UPPER] = 0.7, rng.normal(size=wires)
    if shape == "fingertip" and which == "radius":
        pytest.skip("the truth's rims lie in a plane")
    if shape == "fingertip" and which == "thickness":
        within = 0.1  # the solver's normals are those of the chords
    body, moved = made(layout, ORDINARY, g, skin), press_m(layout, skin)
    upper = g[COMMON + 3 : COMMON + UPPER * wires : UPPER]
    gain = np.expm1(ORDINARY.gain * np.sqrt(0.5) * (g[geometry.GAIN] + upper)[:, None])
    a = readings(layout, body, moved, gain)
    left, _, _ = linearised(layout, ORDINARY, moved, g, a)
    without, _, _ = linearised(layout, ORDINARY, moved, np.zeros_like(g), a)
    assert np.abs(without).max() > 5 * NOISE
    assert np.abs(left).max() < within * np.abs(without).max() + 1e-13


def test_the_effects_are_derivatives_of_the_residuals():
    """By central differences, at a press and with errors of one tolerance; a zero of H is a zero."""
    wires, equations = SMALL.shape
    rng = np.random.default_rng(2)
    g = rng.normal(size=geometry.nuisances(wires, equations))
    g[geometry.RADIUS] = 0.5
    moved = press_m(SMALL)
    a = readings(SMALL, made(SMALL, ORDINARY, g), moved, np.zeros((wires, 1)))
    _, jt, effect = linearised(SMALL, ORDINARY, moved, g, a)

    def r(of: np.ndarray, at: np.ndarray = moved) -> np.ndarray:
        return linearised(SMALL, ORDINARY, at, of, a)[0].ravel()

    step = 1e-4
    slopes = np.stack([(r(g + e) - r(g - e)) / (2 * step) for e in step * np.eye(g.size)], axis=1)
    h = dense(effect)
    np.testing.assert_allclose(-slopes, h, rtol=1e-5, atol=1e-6 * np.abs(h).max())
    np.testing.assert_array_equal(slopes[h == 0.0], 0.0)
    nudge = np.zeros_like(moved)
    nudge[1, 2, 0] = step * SMALL.pitch_m
    slope = ((r(g, moved + nudge) - r(g, moved - nudge)) / (2 * step)).reshape(wires, equations)
    np.testing.assert_allclose(slope[1], jt[1, 6], rtol=1e-4)


def test_sparse_sums_are_those_of_the_dense_matrix():
    """Covariance, estimate and variance, for two of three wires."""
    rng = np.random.default_rng(4)
    members, wires, equations, n = np.array([0, 2]), 3, 5, 7
    effect = rng.normal(size=(wires, equations, geometry.EFFECTS))
    h = dense(effect).reshape(wires, equations, -1)[members].reshape(10, -1)
    g = rng.normal(size=h.shape[1])
    y, s = np.zeros(12), np.zeros((12, 12))
    geometry.add_covariance(members, effect, g, y, s)
    np.testing.assert_allclose(s[:10, :10], np.triu(h @ h.T), atol=1e-12)
    np.testing.assert_allclose(y[:10], -h @ g, atol=1e-12)
    v, gain_t = rng.normal(size=10), rng.normal(size=(10, n))
    geometry.estimate(members, effect, v, g)
    np.testing.assert_allclose(g, -h.T @ v, atol=1e-12)
    variance = np.ones(n)
    geometry.add_variance(members, effect, gain_t, np.empty((geometry.EFFECTS, n)), variance)
    np.testing.assert_allclose(variance, 1.0 + ((gain_t.T @ h) ** 2).sum(axis=1), rtol=1e-12)


def scattered(layout: sk.PatchLayout, rng: np.random.Generator, tolerances: Tolerances, skin=None) -> Skin:
    """A patch whose errors are drawn from the tolerances."""
    g = rng.normal(size=geometry.nuisances(*layout.shape))
    g[geometry.RADIUS] = rng.uniform(0.0, 1.0)
    return made(layout, tolerances, g, skin)


def off(field: sk.FieldFrame, truth_m: np.ndarray) -> np.ndarray:
    """Errors of the solved wires in reported standard deviations."""
    solved = np.array([status is Status.CONVERGED for status in field.status])
    assert solved.any()
    return np.abs((field.displacement_m - truth_m)[solved] / field.displacement_std_m[solved])


@pytest.mark.long
@pytest.mark.parametrize("kind", some_long(["staggered", "aligned"], "staggered"))
def test_the_claim_covers_a_patch_made_to_its_tolerances(kind):
    """Without tolerances, the same readings are dozens of deviations off."""
    layout = sk.PatchLayout.preset(kind)
    rng = np.random.default_rng(7)
    skin = scattered(layout, rng, ORDINARY)
    taken = stream(skin, (random_press(rng, layout, 0.3),), np.linspace(0, 1, 4), Converter(NOISE), rng)
    found = {}
    for tolerances in (EXACT, ORDINARY):
        solver = sk.Posterior(
            layout, relative_noise=NOISE, baseline_ohm=skin.rest_ohm, tolerances=tolerances, contacts=False
        )
        for frame in taken.frames_ohm:
            field = solver.update(frame)
        found[tolerances] = off(field, taken.truth_m[-1])
    assert found[ORDINARY].max() < 5.0
    assert np.mean(found[ORDINARY] < 2.0) > 0.9
    assert found[EXACT].max() > 15.0


@pytest.mark.long
def test_a_press_in_small_steps_has_the_claim_of_a_sudden_one():
    """The effects grow with the press, and the factors must follow them."""
    layout = SMALL
    rng = np.random.default_rng(7)
    skin = scattered(layout, rng, ORDINARY)
    taken = stream(skin, (random_press(rng, layout, 0.3),), np.linspace(0, 1, 80), Converter(NOISE), rng)
    options = {"relative_noise": NOISE, "baseline_ohm": skin.rest_ohm, "tolerances": ORDINARY}
    slow, sudden = sk.Posterior(layout, **options), sk.Posterior(layout, **options)
    for frame in taken.frames_ohm:
        field = slow.update(frame)
    ratio = field.displacement_std_m / sudden.update(taken.frames_ohm[-1]).displacement_std_m
    assert 0.7 < np.median(ratio) < 1.4
    assert off(field, taken.truth_m[-1]).max() < 5.0


def test_an_untouched_patch_claims_what_an_exact_one_does():
    """The rest resistances are measured, so errors of the geometry change nothing at rest."""
    rng = np.random.default_rng(8)
    skin = scattered(SMALL, rng, ORDINARY)
    frame, _, _ = Converter(NOISE).read(skin.rest_ohm, skin.rest_ohm, rng)
    fields = [
        sk.Posterior(SMALL, relative_noise=NOISE, baseline_ohm=skin.rest_ohm, tolerances=each).update(frame)
        for each in (None, ORDINARY)
    ]
    ratio = fields[1].displacement_std_m / fields[0].displacement_std_m
    assert 0.9 < np.median(ratio) < 1.1
    assert ((ratio > 0.7) & (ratio < 1.3)).all()


def test_auto_chooses_the_posterior_for_a_patch_with_tolerances():
    tracker = sk.Tracker(SMALL, relative_noise=1e-7, tolerances=ORDINARY)
    assert (tracker.method, tracker.reason) == ("posterior", "tolerances requested")
    assert sk.Tracker(SMALL, relative_noise=1e-7, tolerances=EXACT).method == "exact"
    with pytest.raises(ValueError, match="method: got 'exact' with tolerances"):
        sk.Tracker(SMALL, method="exact", tolerances=ORDINARY)
    with pytest.raises(ValueError, match="tolerances: got 'ordinary', must be Tolerances or None"):
        sk.Tracker(SMALL, tolerances="ordinary")
