"""The paper's path: exact resistances of a press lead to its displacement."""

from __future__ import annotations

import numpy as np
import pytest

import skinnode as sk
from skinnode.model.elastic import HertzContact, Rubber
from skinnode.solve.operators.codes import OPERATORS
from tests.lanes import some_long

from .press import frame_ohm, hertz_press


@pytest.fixture(scope="module")
def staggered() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)


def press_samples(layout: sk.PatchLayout, depth: float, samples: int) -> np.ndarray:
    return np.array(
        [frame_ohm(layout, hertz_press(layout, depth * t)) for t in np.linspace(0, 1, samples + 1)[1:]]
    )


def wire_errors(path: sk.PathResult, truth: np.ndarray) -> np.ndarray:
    wires = len(truth)
    error = (path.displacement_m - truth).reshape(wires, -1)
    return np.linalg.norm(error, axis=1) / np.linalg.norm(truth.reshape(wires, -1), axis=1)


@pytest.fixture(scope="module")
def pressed(staggered: sk.PatchLayout) -> tuple[np.ndarray, np.ndarray]:
    return press_samples(staggered, 0.3, 20), hertz_press(staggered, 0.3)


GRID = [(height, depth, 5) for height in (0.3, 0.5) for depth in (0.1, 0.3, 0.5, 0.7)]
GRID += [(1.0, depth, 10) for depth in (0.1, 0.3, 0.5)]


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize(("height", "depth", "fewest"), some_long(GRID, (0.5, 0.5, 5), (1.0, 0.3, 10)))
def test_uniform_samples_recover_every_wire(height, depth, fewest, operator):
    layout = sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=height * 4e-3)
    truth = hertz_press(layout, depth)
    for samples in (fewest, 4 * fewest):
        path = sk.solve_path(layout, press_samples(layout, depth, samples), operator=operator)
        assert path.status == (sk.Status.CONVERGED,) * 10, samples
        assert wire_errors(path, truth).max() < 1e-6, samples
        np.testing.assert_allclose(path.upper_m, layout.upper_m + truth, atol=1e-6 * np.abs(truth).max())


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("depth", [0.1, 0.3])
def test_the_path_as_the_paper_walks_it(staggered, depth, operator):
    path = sk.solve_path(
        staggered, press_samples(staggered, depth, 20), operator=operator, schedule=sk.Uniform(plain=True)
    )
    assert path.status == (sk.Status.CONVERGED,) * 10
    assert wire_errors(path, hertz_press(staggered, depth)).max() < 1e-6


def test_error_estimate_covers_what_rounding_leaves(staggered, pressed):
    samples, truth = pressed
    path = sk.solve_path(staggered, samples)
    actual = np.abs(path.displacement_m - truth).max(axis=(1, 2))
    assert (actual <= path.error_estimate_m).all()
    assert path.error_estimate_m.max() < 1e-9 * staggered.pitch_m


def test_measured_baseline_cancels_resistivity_and_gain(staggered, pressed):
    samples, truth = pressed
    gain = np.random.default_rng(7).uniform(0.5, 2.0, staggered.shape)  # of each pair's front end
    rest = frame_ohm(staggered, np.zeros_like(truth))
    path = sk.solve_path(staggered, samples * gain, baseline_ohm=rest * gain)
    assert wire_errors(path, truth).max() < 1e-6


def test_intermediate_samples_within_tolerance_are_skipped(staggered):
    rest = frame_ohm(staggered, np.zeros_like(staggered.upper_m))
    samples = np.concatenate([np.repeat(rest[None], 4, axis=0), press_samples(staggered, 0.1, 1)])
    path = sk.solve_path(staggered, samples)
    assert (path.steps[:4] == 0).all()
    assert (path.steps[4] > 0).all()
    assert path.stats.steps == path.steps.sum()
    assert path.stats.evaluations == path.evaluations.sum()


def test_tall_patches_are_solved_too():
    layout = sk.PatchLayout.preset(
        "staggered", upper_wires=4, upper_electrodes=4, lower_wires=16, lower_electrodes=4
    )
    centre = (6.2e-3, 5.5e-3)
    samples = [frame_ohm(layout, hertz_press(layout, 0.2 * t, centre_m=centre)) for t in (0.25, 0.5, 0.75, 1)]
    truth = hertz_press(layout, 0.2, centre_m=centre)
    for operator in OPERATORS:
        path = sk.solve_path(layout, samples, operator=operator)
        assert path.status == (sk.Status.CONVERGED,) * 4, operator
        assert wire_errors(path, truth).max() < 1e-6


def test_one_electrode_needs_three_lower_wires():
    upper = np.array([[[0.1e-3, -0.2e-3, 2e-3]]])
    lower = np.array([[[0.0, 0, 0]], [[4e-3, 0, 0]], [[0, 4e-3, 0]]])
    layout = sk.PatchLayout(upper, lower)
    truth = np.array([[[2e-4, 1e-4, -5e-4]]])
    path = sk.solve_path(layout, [frame_ohm(layout, truth)])
    np.testing.assert_allclose(path.displacement_m, truth, rtol=1e-9)
    underdetermined = sk.PatchLayout(upper, lower[:2])
    with pytest.raises(ValueError, match="layout: got 2 lower wires for 3 unknowns"):
        sk.solve_path(underdetermined, [frame_ohm(underdetermined, truth)])


def test_a_layout_that_cannot_be_inverted_is_never_called_converged():
    """Lower wires symmetric to the upper one: y of every electrode has no first-order effect."""
    layout = sk.PatchLayout.preset("symmetric", upper_wires=1, lower_electrodes=1)
    moved = np.zeros_like(layout.upper_m)
    moved[..., 1] = 1e-4
    moved[..., 2] = -2e-4
    with np.errstate(all="ignore"):
        for operator in OPERATORS:
            path = sk.solve_path(layout, [frame_ohm(layout, moved * t) for t in (0.5, 1)], operator=operator)
            assert path.status != (sk.Status.CONVERGED,), operator


@pytest.mark.long
def test_a_fold_that_the_skin_itself_passes_is_followed():
    """On thick layers a deep press turns the sign of det J of some wires; ten samples lead across."""
    layout = sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=4e-3)

    def sides(displacement: np.ndarray) -> np.ndarray:
        slopes = sk.jacobian(layout, layout.upper_m + displacement).reshape(10, 30, 30)
        return np.linalg.slogdet(slopes)[0]

    passed = 0
    for centre in ((18.3e-3, 17.1e-3), (12e-3, 20e-3), (22e-3, 9e-3)):
        press = [hertz_press(layout, 0.07 * k, centre_m=centre) for k in range(1, 11)]
        path = sk.solve_path(layout, [frame_ohm(layout, moved) for moved in press])
        converged = np.array([status is sk.Status.CONVERGED for status in path.status])
        assert (wire_errors(path, press[-1])[converged] < 1e-6).all()
        passed += np.count_nonzero(converged & (sides(press[-1]) != sides(np.zeros_like(press[-1]))))
    assert passed >= 3


DRAGGED = (
    ((23.48, 17.41), 12.96, -1.15),
    ((13.23, 19.24), 6.74, 1.21),
    ((16.06, 17.78), 6.04, -1.76),
    ((26.4966, 12.8967), 14.2644, 1.0314),
)
"""Centre and radius of a sphere, mm, and the direction in which it is dragged, rad: on each of these presses
the skin crosses a fold, and a start from the smoothest displacement finds a smoother root that is wrong. On
the last, the posterior moves two wires away from the ends of their paths, and only one path is smooth."""


@pytest.mark.long
@pytest.mark.parametrize(
    "schedule", some_long([sk.Uniform(), sk.Periodic(cycle=1), sk.Adaptive()], sk.Adaptive())
)
def test_a_smooth_root_to_which_the_samples_do_not_lead_is_not_converged(schedule):
    layout = sk.PatchLayout.preset("aligned", pitch_m=4e-3, height_m=2e-3)
    points = layout.upper_m[..., :2].reshape(-1, 2)
    found = kept = 0
    for centre, radius, turn in DRAGGED:
        traction = (0.8 * np.cos(turn), 0.8 * np.sin(turn))
        centre_m = (centre[0] * 1e-3, centre[1] * 1e-3)
        press = [
            HertzContact(Rubber(), radius * 1e-3, 0.7 * t * 2e-3, centre_m, traction)
            .displacement_m(points)
            .reshape(layout.upper_m.shape)
            for t in np.linspace(0, 1, 21)[1:]
        ]
        path = sk.solve_path(
            layout,
            [frame_ohm(layout, moved) for moved in press],
            operator="levenberg_marquardt",
            schedule=schedule,
        )
        converged = np.array([status is sk.Status.CONVERGED for status in path.status])
        error = wire_errors(path, press[-1])
        assert (error[converged] < 1e-6).all(), centre
        found += converged.sum()
        kept += (error[~converged] < 1e-6).sum()
    assert found >= 32  # of 40
    assert kept >= 5  # the best iterate of a wire that is refused is the end of its path


@pytest.mark.parametrize("operator", OPERATORS)
def test_the_mirrored_root_is_never_called_converged(operator):
    """One electrode and three single charges: three distances, so one root above their plane, one below."""
    lower = np.array([[[0.0, 0, 0]], [[4e-3, 0, 0]], [[0, 4e-3, 0]]])
    layout = sk.PatchLayout(np.array([[[0.5e-3, 0.4e-3, 1e-3]]]), lower)
    rng = np.random.default_rng(3)
    below = 0
    for attempt in range(120):
        truth = np.array([[[*rng.uniform(-5e-4, 5e-4, 2), rng.uniform(-9.9e-4, 0)]]])
        schedule = sk.Uniform(plain=attempt % 2 == 0)
        with np.errstate(all="ignore"):
            path = sk.solve_path(layout, [frame_ohm(layout, truth)], operator=operator, schedule=schedule)
        if path.status == (sk.Status.CONVERGED,):
            np.testing.assert_allclose(path.displacement_m, truth, atol=1e-9)
        if path.upper_m[0, 0, 2] < 0 and path.residual[0] < 1e-9:
            below += 1
            assert path.status == (sk.Status.ILL_CONDITIONED,)
    if operator == "gauss_newton":
        assert below > 0  # full steps do land there, so this test would notice


@pytest.mark.parametrize(
    ("samples", "options", "complaint"),
    [
        (np.ones((2, 3, 30)), {}, r"samples_ohm: got shape \(2, 3, 30\), must be \(T, 10, 30\)"),
        (np.full((1, 10, 30), np.nan), {}, r"samples_ohm: got nan at \[0, 0, 0\]"),
        (np.zeros((1, 10, 30)), {}, r"samples_ohm: got 0.0 at \[0, 0, 0\], must be positive"),
        (np.ones((1, 10, 30)), {"operator": "newton"}, "operator: got 'newton', must be one of gauss_newton"),
        (np.ones((1, 10, 30)), {"baseline_ohm": -np.ones((10, 30))}, "baseline_ohm: got -1.0"),
    ],
)
def test_bad_arguments_are_named(staggered, samples, options, complaint):
    with pytest.raises(ValueError, match=complaint):
        sk.solve_path(staggered, samples, **options)
