"""Which samples are solved: evenly spread, one a cycle, or as the wires need them."""

from __future__ import annotations

import numpy as np
import pytest

import skinnode as sk
from skinnode.solve.operators.codes import OPERATORS
from skinnode.solve.paths.corrector import Accuracy
from skinnode.solve.paths.path_tracker import PathTracker
from skinnode.solve.paths.root_selection import keep_likeliest
from skinnode.solve.paths.step_control import shortest_cycle
from skinnode.solve.wires.problem import PatchProblem

from .press import frame_ohm, hertz_press


def staggered(height: float) -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=height * 4e-3)


def press_samples(layout: sk.PatchLayout, depth: float, samples: int, **press: object) -> np.ndarray:
    return np.array(
        [
            frame_ohm(layout, hertz_press(layout, depth * t, **press))
            for t in np.linspace(0, 1, samples + 1)[1:]
        ]
    )


def wire_errors(path: sk.solve.homotopy.PathResult, truth: np.ndarray) -> np.ndarray:
    wires = len(truth)
    error = (path.displacement_m - truth).reshape(wires, -1)
    return np.linalg.norm(error, axis=1) / np.linalg.norm(truth.reshape(wires, -1), axis=1)


def samples_solved(path: sk.solve.homotopy.PathResult) -> np.ndarray:
    """Of the path itself: without the search for a cycle, and without the checks after the last sample."""
    position = path.position[path.searched :]
    last = int(np.argmax((position == np.nanmax(position)).all(axis=1)))
    assert (position[: last + 1] == position[: last + 1, :1]).all()
    return position[: last + 1, 0]


@pytest.fixture(scope="module")
def layout() -> sk.PatchLayout:
    return staggered(0.5)


@pytest.fixture(scope="module")
def fifty(layout: sk.PatchLayout) -> np.ndarray:
    return press_samples(layout, 0.1, 50)


# -- Uniform -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("steps", "solved"),
    [(1, [49]), (2, [24, 49]), (5, [9, 19, 29, 39, 49]), (None, list(range(50))), (80, list(range(50)))],
)
def test_uniform_spreads_its_steps_and_ends_with_the_last_sample(layout, fifty, steps, solved):
    path = sk.solve_path(layout, fifty, schedule=sk.Uniform(steps=steps))
    np.testing.assert_array_equal(samples_solved(path), solved)
    assert wire_errors(path, hertz_press(layout, 0.1)).max() < 1e-6
    assert path.cycle is None


def test_extrapolation_takes_fewer_evaluations_than_the_paper(layout, fifty):
    ours, plain = (sk.solve_path(layout, fifty, schedule=sk.Uniform(plain=p)) for p in (False, True))
    assert ours.stats.evaluations < 0.8 * plain.stats.evaluations
    np.testing.assert_allclose(ours.displacement_m, plain.displacement_m, atol=1e-12)


def test_press_that_stops_and_returns_is_followed(layout):
    there = press_samples(layout, 0.5, 6)
    samples = np.concatenate([there, np.repeat(there[-1:], 3, axis=0), there[::-1][1:4]])
    path = sk.solve_path(layout, samples)
    assert path.status == (sk.Status.CONVERGED,) * 10
    assert wire_errors(path, hertz_press(layout, 0.5 * 3 / 6)).max() < 1e-6


def test_a_wire_lost_on_a_coarse_path_has_a_second_try():
    layout = staggered(1.0)
    truth = hertz_press(layout, 0.5)
    samples = np.array([frame_ohm(layout, truth * t) for t in np.linspace(0, 1, 6)[1:]])
    plain = sk.solve_path(layout, samples, schedule=sk.Uniform(plain=True))
    lost = np.array(plain.status) != sk.Status.CONVERGED
    assert lost.any()
    assert not (wire_errors(plain, truth)[~lost] > 1e-6).any()
    path = sk.solve_path(layout, samples)
    assert path.status == (sk.Status.CONVERGED,) * 10
    assert wire_errors(path, truth).max() < 1e-6


# -- Periodic ------------------------------------------------------------------------------------------


def test_the_cycle_is_the_gap_of_the_wire_solved_most_often():
    often, seldom, never, once = (np.zeros(30, bool) for _ in range(4))
    often[3::4] = True
    often[[7, 8]] = [False, True]  # one late solve does not change the median
    seldom[6::7] = True
    once[20] = True
    assert shortest_cycle(np.stack([seldom, often, never, once], axis=1)) == 4
    assert shortest_cycle(np.stack([never, once], axis=1)) is None
    assert shortest_cycle(np.ones((30, 2), bool)) == 1
    assert shortest_cycle(np.zeros((0, 3), bool)) is None


def test_periodic_finds_a_cycle_and_keeps_one_sample_of_each(layout, fifty):
    path = sk.solve_path(layout, fifty, schedule=sk.Periodic())
    assert path.cycle is not None
    assert 2 <= path.cycle <= 10  # the paper's is 7
    np.testing.assert_array_equal(samples_solved(path), [*range(path.cycle - 1, 49, path.cycle), 49])
    assert path.status == (sk.Status.CONVERGED,) * 10
    assert wire_errors(path, hertz_press(layout, 0.1)).max() < 1e-6
    assert path.stats.steps == path.steps.sum()


def test_the_cycle_is_proportional_to_the_number_of_samples(layout, fifty):
    fine = sk.solve_path(layout, press_samples(layout, 0.1, 100), schedule=sk.Periodic())
    coarse = sk.solve_path(layout, fifty, schedule=sk.Periodic())
    assert fine.cycle / coarse.cycle == pytest.approx(2, abs=0.5)


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize(
    ("cycle", "solved"), [(7, [6, 13, 20, 27, 34, 41, 48, 49]), (8, [7, 15, 23, 31, 39, 47, 49])]
)
def test_a_known_cycle_is_not_looked_for(layout, fifty, cycle, solved, plain):
    path = sk.solve_path(layout, fifty, schedule=sk.Periodic(cycle=cycle, plain=plain))
    uniform = sk.solve_path(layout, fifty, schedule=sk.Uniform(plain=plain))
    assert path.searched == 0
    assert path.cycle == cycle
    np.testing.assert_array_equal(samples_solved(path), solved)
    assert path.stats.steps < 0.5 * uniform.stats.steps
    assert wire_errors(path, hertz_press(layout, 0.1)).max() < 1e-6


@pytest.mark.parametrize(("depth", "samples"), [(0.1, 1), (0.5, 4)])
def test_no_cycle_means_every_sample(layout, depth, samples):
    """Too few samples to have a period, or too far apart to pass over any."""
    path = sk.solve_path(layout, press_samples(layout, depth, samples), schedule=sk.Periodic())
    assert path.cycle is None
    np.testing.assert_array_equal(samples_solved(path), range(samples))
    assert wire_errors(path, hertz_press(layout, depth)).max() < 1e-6


# -- Adaptive ------------------------------------------------------------------------------------------

CELLS = [(height, depth) for height in (0.3, 0.5) for depth in (0.1, 0.3, 0.5, 0.7)]
CELLS += [(1.0, depth) for depth in (0.1, 0.3, 0.5)]


@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize(("height", "depth"), CELLS)
def test_adaptive_needs_only_the_first_and_the_last_sample(height, depth, operator):
    layout = staggered(height)
    truth = hertz_press(layout, depth)
    rest, last = (frame_ohm(layout, u) for u in (np.zeros_like(truth), truth))
    for samples in ([rest, last], [last]):
        path = sk.solve_path(layout, samples, operator=operator, schedule=sk.Adaptive())
        assert path.status == (sk.Status.CONVERGED,) * 10
        assert wire_errors(path, truth).max() < 1e-6


def random_presses(seed: int, count: int) -> list[dict[str, object]]:
    rng = np.random.default_rng(seed)
    return [
        {
            "shear": rng.uniform(-0.6, 0.6),
            "centre_m": tuple(rng.uniform(0, 36e-3, 2)),
            "radius_m": rng.uniform(4e-3, 16e-3),
        }
        for _ in range(count)
    ]


@pytest.mark.parametrize(("height", "depth"), [(0.3, 0.7), (0.5, 0.5), (0.5, 0.7), (1.0, 0.1)])
def test_adaptive_solves_presses_anywhere(height, depth):
    layout = staggered(height)
    for press in random_presses(11, 8):
        truth = hertz_press(layout, depth, **press)
        path = sk.solve_path(layout, [frame_ohm(layout, truth)], schedule=sk.Adaptive())
        assert path.status == (sk.Status.CONVERGED,) * 10, press
        assert wire_errors(path, truth).max() < 1e-6, press


@pytest.mark.parametrize("schedule", [sk.Adaptive(), sk.Uniform()])
@pytest.mark.parametrize("depth", [0.3, 0.5])
@pytest.mark.long
def test_a_wrong_root_is_never_called_converged(depth, schedule):
    """Thick layer: presses that cross a fold of F = b have another root, smooth too, on this side of it."""
    layout = staggered(1.0)
    flagged = 0
    for press in random_presses(0, 20):
        truth = hertz_press(layout, depth, **press)
        path = sk.solve_path(layout, [frame_ohm(layout, truth)], schedule=schedule)
        converged = np.array(path.status) == sk.Status.CONVERGED
        assert (wire_errors(path, truth)[converged] < 1e-6).all(), press
        flagged += (~converged & (path.residual < 1e-9)).sum()
    assert flagged > 0  # roots they are, so this test would notice
    assert flagged < 30  # of 200


def test_adaptive_goes_by_the_samples_there_are(layout):
    """A press that slides from one place to another: its first and last sample alone are no path."""

    def slide(t: float) -> np.ndarray:
        return hertz_press(layout, 0.5, centre_m=(6e-3 + 24e-3 * t, 17e-3))

    samples = [frame_ohm(layout, slide(t)) for t in np.linspace(0, 1, 13)]
    path = sk.solve_path(layout, samples, schedule=sk.Adaptive())
    assert path.status == (sk.Status.CONVERGED,) * 10
    assert wire_errors(path, slide(1)).max() < 1e-6
    between = np.isfinite(path.position) & (path.position < 12)
    assert between.any()


def test_a_step_that_leaves_the_branch_is_taken_back():
    layout = staggered(1.0)
    problem = PatchProblem.of(layout)
    truth = hertz_press(layout, 0.5)
    tracker = PathTracker(problem, frame_ohm(layout, truth)[None] * problem.gain, 2)
    everywhere, there = np.ones(10, bool), np.zeros(10)
    arrived = tracker.step(everywhere, there, Accuracy(1e-9, 6))
    assert 0 < arrived.sum() < 10
    at = problem.displacement_m(tracker.solver.x)
    np.testing.assert_array_equal(at[~arrived], 0)
    np.testing.assert_allclose(at[arrived], truth[arrived], atol=1e-9)
    halfway = tracker.predict(np.full(10, -0.5)) - problem.rest  # as if the step had never been tried
    fresh = PathTracker(problem, frame_ohm(layout, truth)[None] * problem.gain, 2)
    expected = fresh.predict(np.full(10, -0.5)) - problem.rest
    np.testing.assert_array_equal(halfway[~arrived], expected[~arrived])


@pytest.mark.parametrize("second_tries", [True, False])
def test_the_likelier_of_two_roots_is_kept_and_neither_of_equals_is_believed(second_tries):
    """Thick layer: most wires have a second root across a fold.

    The energy is a multiple of the squared distance from the truth. The truth is the likelier root if the
    multiple is positive, the other root if it is negative, and neither if it is zero.
    """
    layout = staggered(1.0)
    problem = PatchProblem.of(layout)
    truth = hertz_press(layout, 0.3)
    samples = press_samples(layout, 0.3, 10)
    pitches = (truth / layout.pitch_m).reshape(10, -1)
    doubted = {}
    for weight in (1, -1, 0):
        tracker = PathTracker(problem, samples * problem.gain, list(OPERATORS).index("dogleg"))
        sk.Uniform().follow(tracker)
        assert (tracker.end.status == sk.Status.CONVERGED).all()
        tracker.second_tries = second_tries
        none = np.zeros((0, *pitches.shape))
        keep_likeliest(
            tracker,
            none,
            lambda moved, w=weight: w * 1e9 * ((moved - pitches) ** 2).sum(),
            np.ones(10),
            Accuracy(1e-9, 100),
        )
        at = problem.displacement_m(tracker.solver.x)
        stayed = np.abs(at - truth).max(axis=(1, 2)) < 1e-9 * layout.height_m
        doubted[weight] = tracker.end.status != sk.Status.CONVERGED
        if weight == -1 and second_tries:
            assert 4 < np.count_nonzero(~stayed) < 10
            np.testing.assert_allclose(frame_ohm(layout, at), samples[-1], rtol=1e-8)  # a root too
            assert not doubted[weight][stayed].any()
        else:
            assert stayed.all()
    assert not doubted[1].any()
    assert doubted[0].sum() >= doubted[-1].sum() > 4


def test_adaptive_is_bounded_where_there_is_no_solution(layout):
    rest = frame_ohm(layout, np.zeros_like(layout.upper_m))
    with np.errstate(all="ignore"):
        path = sk.solve_path(layout, [rest, rest * 0.2], schedule=sk.Adaptive(points=10, final_steps=50))
    assert sk.Status.CONVERGED not in path.status
    assert np.isfinite(path.upper_m).all()
    assert path.steps.sum(axis=0).max() < 10 * 6 + 3 * 50
    assert len(path.steps) <= 10 + 5


# -- arguments -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [sk.Uniform, sk.Periodic])
def test_bad_options_are_named(kind):
    for name in ("intermediate_tolerance", "final_tolerance"):
        with pytest.raises(ValueError, match=f"^{name}: got 0"):
            kind(**{name: 0.0})
    for name in ("intermediate_steps", "final_steps"):
        with pytest.raises(ValueError, match=f"^{name}: got 0, must be an integer"):
            kind(**{name: 0})


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (sk.Uniform, "steps", 0),
        (sk.Uniform, "steps", 2.5),
        (sk.Periodic, "cycle", 0),
        (sk.Adaptive, "points", 0),
        (sk.Adaptive, "final_tolerance", float("nan")),
        (sk.Adaptive, "final_steps", -1),
    ],
)
def test_bad_counts_are_named(kind, name, value):
    with pytest.raises(ValueError, match=f"^{name}: got {value}, must be"):
        kind(**{name: value})
