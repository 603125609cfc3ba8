"""The tracker everyone uses: what it passes on, what it chooses, and what it puts to the prior."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skinnode as sk
from skinnode.model.elastic import Rubber
from skinnode.protocol.codes import MISSING, CodeScale, as_baseline, decode, encode
from skinnode.solve.checks.reading_model import ReadingModel
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.inputs import CodeMap
from tests.lanes import some_long

from .press import frame_ohm, hertz_press


@pytest.fixture(scope="module")
def layout() -> sk.PatchLayout:
    return sk.PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=4, lower_electrodes=4)


def test_exact_method_is_the_exact_tracker(layout):
    noise = np.random.default_rng(3).uniform(1e-6, 1e-4, layout.shape)
    baseline = 1.1 * frame_ohm(layout, np.zeros_like(layout.upper_m))
    options = {
        "operator": "dogleg", "relative_noise": noise, "baseline_ohm": baseline, "stiffness_n_per_m": 250.0,
    }  # fmt: skip
    tracker, exact = sk.Tracker(layout, method="exact", **options), ExactTracker(layout, **options)
    assert tracker.layout is layout
    for _ in range(2):
        for depth in (0.0, 0.1, 0.2):
            frame = 1.1 * frame_ohm(layout, hertz_press(layout, depth, centre_m=(6e-3, 6e-3)))
            field = tracker.update(frame, None, 2 * noise)
            expected = exact.update(frame, None, 2 * noise)
            np.testing.assert_array_equal(field.displacement_m, expected.displacement_m)
            np.testing.assert_array_equal(field.displacement_std_m, expected.displacement_std_m)
            np.testing.assert_array_equal(field.force_n, expected.force_n)
            assert field.status == expected.status
        tracker.reset()
        exact.reset()


@pytest.mark.long
def test_a_stream_waits_for_no_table_after_preparation(monkeypatch):
    """Touched, untouched, and with a wrong reading at which explanations are sought, at the stated noise."""
    layout = sk.PatchLayout.preset("staggered", upper_wires=5, upper_electrodes=5, lower_electrodes=5)
    plain, prepared = sk.Tracker(layout), sk.Tracker(layout)
    prepared.prepare()
    computed: list[int] = []
    frames = []
    for step in range(24):
        frame = frame_ohm(layout, hertz_press(layout, 0.02 * max(0, min(step - 4, 24 - step))))
        frames.append(frame * (1 + 1e-5 * np.random.default_rng(step).normal(size=layout.shape)))
        frames[-1][2, 3] *= 1.2 if step % 5 == 4 else 1.0
    for method in ("_compute", "_load_tables"):
        original = getattr(ReadingModel, method)

        def counted(self, number, original=original):
            computed.append(number)
            return original(self, number)

        monkeypatch.setattr(ReadingModel, method, counted)
    fields = [prepared.update(frame) for frame in frames]
    assert not computed
    assert any(field.faults for field in fields)
    for field, frame in zip(fields, frames, strict=True):
        np.testing.assert_array_equal(plain.update(frame).displacement_m, field.displacement_m)


@pytest.mark.long
@pytest.mark.parametrize("depth", [0.0, 0.002])
def test_slight_touches_in_codes_wait_for_no_table_either(monkeypatch, depth):
    """A reading is wrong by 0.2 %; explanations are sought at the smallest prior scales."""
    layout = sk.PatchLayout.preset("staggered", upper_wires=5, upper_electrodes=5, lower_electrodes=5)
    rest, scale, noise = frame_ohm(layout, np.zeros_like(layout.upper_m)), CodeScale(16), 3e-6
    codes = CodeMap(rest, scale.lo, scale.step, scale.steps, scale.relative_std * rest, noise)
    tracker = sk.Tracker(layout, relative_noise=noise, baseline_ohm=rest, codes=codes)
    tracker.prepare()
    computed: list[int] = []
    original = ReadingModel._load_tables

    def counted(self, number):
        computed.append(number)
        return original(self, number)

    monkeypatch.setattr(ReadingModel, "_load_tables", counted)
    found = 0
    for step in range(24):
        frame = frame_ohm(layout, hertz_press(layout, depth * max(0, min(step - 4, 24 - step))))
        frame *= 1 + noise * np.random.default_rng(step).normal(size=layout.shape)
        frame[2, 3] *= 1.002 if step % 5 == 4 else 1.0
        found += bool(tracker.update_codes(encode(frame, rest, scale))[0].faults)
    assert found
    assert not computed


def test_unknown_method_is_named(layout):
    with pytest.raises(ValueError, match="method: got 'magic'"):
        sk.Tracker(layout, method="magic")


def noisy(
    layout: sk.PatchLayout, moved: np.ndarray, rng: np.random.Generator, sigma: float = 1e-5
) -> np.ndarray:
    return np.asarray(frame_ohm(layout, moved) * (1 + sigma * rng.normal(size=layout.shape)))


def deviations(field: sk.FieldFrame, moved: np.ndarray) -> np.ndarray:
    assert np.isfinite(field.displacement_std_m).all()
    return np.asarray((field.displacement_m - moved) / field.displacement_std_m)


FEW = {"upper_wires": 4, "upper_electrodes": 4, "lower_electrodes": 5}


@pytest.mark.parametrize(
    ("name", "sizes", "options", "method", "reason"),
    [
        ("staggered", {}, {}, "exact", r"deviation of 0\.0\d+ % .* the limit is 0\.25 %"),
        (
            "staggered",
            {},
            {"relative_noise": 1e-3},
            "posterior",
            r"deviation of \d.* % .* the limit is 0\.25 %",
        ),
        ("aligned", {}, {}, "posterior", r"deviation of \d.* % .* the limit is 0\.25 %"),
        pytest.param(
            "aligned",
            {},
            {"relative_noise": 1e-9},
            "exact",
            r"deviation of 0\.0\d+ %",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "aligned", {}, {"normal_only": True}, "exact", r"deviation of 0\.\d+ %", marks=pytest.mark.long
        ),
        ("staggered", {"lower_wires": 29}, {}, "posterior", "29 lower wires for 30 unknowns"),
        pytest.param(
            "staggered",
            {"lower_wires": 29},
            {"normal_only": True},
            "exact",
            "deviation of",
            marks=pytest.mark.long,
        ),
        ("staggered", {}, {"drift": "wire"}, "posterior", "drift requested"),
        pytest.param(
            "staggered",
            {},
            {"model_error": 0.01},
            "posterior",
            "model_error requested",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "staggered",
            {},
            {"estimate_noise": True, "drift": "patch"},
            "posterior",
            "drift and estimate_noise",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "staggered", {}, {"method": "posterior"}, "posterior", "requested", marks=pytest.mark.long
        ),
        pytest.param("aligned", {}, {"method": "exact"}, "exact", "requested", marks=pytest.mark.long),
    ],
)
def test_auto_takes_what_the_noise_allows_and_says_why(name, sizes, options, method, reason):
    tracker = sk.Tracker(sk.PatchLayout.preset(name, **sizes), **options)
    assert tracker.method == method
    assert re.search(reason, tracker.reason), tracker.reason
    field = tracker.update(frame_ohm(tracker.layout, np.zeros_like(tracker.layout.upper_m)))
    assert field.method == method


@pytest.mark.parametrize("sigma", [1e-6, 1e-5])
def test_the_reason_is_the_deviation_that_noise_leaves(sigma):
    """300 noisy frames at rest: their scatter over the clearance is the percentage that the reason gives."""
    layout = sk.PatchLayout.preset("staggered", **FEW)
    tracker = sk.Tracker(layout, relative_noise=sigma, hold=False)
    rng = np.random.default_rng(1)
    rest = np.zeros_like(layout.upper_m)
    errors = [tracker.update(noisy(layout, rest, rng, sigma)).displacement_m for _ in range(300)]
    gaps = layout.upper_m[:, :, None, None] - layout.lower_m
    clearance = np.linalg.norm(gaps, axis=-1).min()
    percent = 100 * np.sqrt(np.mean(np.square(errors))) / clearance
    told = float(re.search(r"deviation of (\S+) %", tracker.reason)[1])
    assert told == pytest.approx(percent, rel=0.1)


def test_exact_refuses_what_it_cannot_give(layout):
    refused = [
        ({"drift": "patch"}, "drift"),
        ({"model_error": 0.1}, "model_error"),
        ({"prior": "discs"}, "prior 'discs'"),
    ]
    for options, name in refused:
        with pytest.raises(ValueError, match=f"method: got 'exact' with {name}"):
            sk.Tracker(layout, method="exact", **options)


def test_posterior_method_is_the_posterior(layout):
    rng = np.random.default_rng(2)
    options = {"relative_noise": 1e-4, "rubber": Rubber(1e6), "drift": "patch", "hold": False}
    tracker, alone = sk.Tracker(layout, method="posterior", **options), sk.Posterior(layout, **options)
    for depth in (0.0, 0.1, 0.2):
        frame = noisy(layout, hertz_press(layout, depth, centre_m=(6e-3, 6e-3)), rng, 1e-4)
        field, expected = tracker.update(frame), alone.update(frame)
        np.testing.assert_array_equal(field.displacement_m, expected.displacement_m)
        np.testing.assert_array_equal(field.force_n, expected.force_n)
        np.testing.assert_array_equal(field.gain, expected.gain)
        assert len(field.contacts) == len(expected.contacts)
    tracker.reset()
    alone.reset()
    np.testing.assert_array_equal(tracker.update(frame).displacement_m, alone.update(frame).displacement_m)


@pytest.mark.parametrize("lost", [1, 8, 30])
def test_a_wire_short_of_resistances_is_estimated_with_its_neighbours(lost):
    """Its own equations do not do: by_prior, CONVERGED, right; and exact again in the next complete frame."""
    layout = sk.PatchLayout.preset("staggered")
    rng = np.random.default_rng(3)
    tracker, complete = sk.Tracker(layout), sk.Tracker(layout)
    for depth in (0.0, 0.1, 0.2, 0.2, 0.1):
        moved = hertz_press(layout, depth)
        frame = noisy(layout, moved, rng)
        complete.update(frame)
        assert tracker.update(frame).trusted
        frame = noisy(layout, moved, rng)
        whole = complete.update(frame)
        bad = frame.copy()
        bad[4, rng.permutation(30)[:lost]] = np.nan
        field = tracker.update(bad)
        assert field.trusted
        assert field.method == "exact"
        assert field.by_prior is not None
        assert np.flatnonzero(field.by_prior).tolist() == [4]
        assert np.abs(deviations(field, moved)).max() < 5
        rest = np.arange(10) != 4
        close = 0.1 * whole.displacement_std_m[rest]
        assert (np.abs(field.displacement_m - whole.displacement_m)[rest] <= close + 5e-6 * 4e-3).all()
        frame = noisy(layout, moved, rng)
        back, whole = tracker.update(frame), complete.update(frame)
        assert back.trusted
        assert back.by_prior is None or not back.by_prior.any()
        assert np.abs(deviations(back, moved)).max() < 5


@pytest.mark.parametrize("kind", ["nan", "all alike", "doubled"])
def test_a_wire_that_nobody_can_solve_is_not_trusted_alone(kind):
    layout = sk.PatchLayout.preset("staggered")
    rng = np.random.default_rng(4)
    tracker = sk.Tracker(layout)
    for depth in (0.0, 0.1):
        before = tracker.update(noisy(layout, hertz_press(layout, depth), rng))
    moved = hertz_press(layout, 0.12)
    frame = noisy(layout, moved, rng)
    bad = frame.copy()
    match kind:
        case "nan":
            bad[:] = np.nan
        case "all alike":
            bad[4] = bad[4].mean()
        case _:
            bad[4] *= 2
    field = tracker.update(bad)
    assert np.isfinite(field.displacement_m).all()
    assert not field.wires_trusted[4]
    if kind == "nan":
        assert not field.trusted
        assert np.isinf(field.displacement_std_m).all()
        np.testing.assert_array_equal(field.displacement_m, before.displacement_m)
    else:  # the wire is left out, and its neighbours say where it is
        assert field.trusted
        assert [(fault.part, fault.upper) for fault in field.faults] == [(sk.FaultyPart.UPPER, 4)]
        z = (field.displacement_m - moved) / field.displacement_std_m
        assert (np.abs(z) < 5).all()
    assert tracker.update(frame).trusted


@pytest.mark.parametrize(
    ("name", "height", "depth"),
    some_long(
        [("staggered", 1.0, 0.5), ("staggered", 0.5, 0.4), ("staggered", 1.0, 0.3)], ("staggered", 1.0, 0.3)
    ),
)
def test_a_jump_never_ends_converged_and_wrong(name, height, depth):
    """From rest to a deep press within one frame, each wire that claims to be CONVERGED lies within 6
    deviations, which are a few percent of the layer at most."""
    layout = sk.PatchLayout.preset(name, height_m=height * 4e-3)
    rng = np.random.default_rng(5)
    tracker = sk.Tracker(layout, method="exact")
    claimed = 0
    for _ in range(12):
        tracker.reset()
        tracker.update(noisy(layout, np.zeros_like(layout.upper_m), rng))
        moved = hertz_press(layout, depth, centre_m=tuple(rng.uniform(8e-3, 28e-3, 2)))
        for _ in range(2):
            field = tracker.update(noisy(layout, moved, rng))
            good = np.array(field.status) == sk.Status.CONVERGED
            claimed += int(good.sum())
            error = np.abs(field.displacement_m - moved)[good]
            assert (error < 6 * field.displacement_std_m[good]).all()
            assert error.max(initial=0.0) < 0.15 * layout.height_m
    assert claimed > 120  # of 240


def test_wires_solved_by_prior_carry_the_force_of_their_stiffness():
    layout = sk.PatchLayout.preset("staggered")
    rng = np.random.default_rng(6)
    tracker = sk.Tracker(layout, stiffness_n_per_m=250.0)
    tracker.update(noisy(layout, np.zeros_like(layout.upper_m), rng))
    frame = noisy(layout, hertz_press(layout, 0.1), rng)
    frame[4] = np.nan
    field = tracker.update(frame)
    assert field.by_prior is not None
    assert field.by_prior[4]
    np.testing.assert_allclose(field.force_n, 250.0 * field.displacement_m, rtol=1e-12)


def test_reset_forgets_the_stream_of_both_methods():
    layout = sk.PatchLayout.preset("staggered")
    rng = np.random.default_rng(7)
    frames = [noisy(layout, hertz_press(layout, depth), rng) for depth in (0.0, 0.1, 0.25)]
    frames[1][4] = np.nan
    used, fresh = sk.Tracker(layout), sk.Tracker(layout)
    for frame in reversed(frames):
        used.update(frame)
    used.reset()
    for frame in frames:
        one, two = used.update(frame), fresh.update(frame)
        np.testing.assert_array_equal(one.displacement_m, two.displacement_m)
        np.testing.assert_array_equal(one.displacement_std_m, two.displacement_std_m)
        assert one.status == two.status


def test_what_a_confirmation_left_open_stays_while_a_wire_is_held():
    """Much noise, so that roots lie within it: the same frame again says nothing new of a wire."""
    layout = sk.PatchLayout.preset("staggered")
    rng = np.random.default_rng(5)
    tracker = sk.Tracker(layout, method="exact", relative_noise=1e-3)
    tracker.update(noisy(layout, np.zeros_like(layout.upper_m), rng, 1e-3))
    frame = noisy(layout, hertz_press(layout, 0.2), rng, 1e-3)
    first, again = tracker.update(frame), tracker.update(frame)
    assert first.by_prior is not None
    own = again.held & ~first.by_prior & ~np.isinf(first.displacement_std_m).any(axis=(1, 2))
    assert own.any()
    wide, still = (field.displacement_std_m[own].max(axis=(1, 2)) for field in (first, again))
    assert (still > 0.5 * wide).all()


def doubt_of_the_first_wire(tracker: sk.Tracker) -> Callable[[], bool]:
    def doubtful() -> bool:
        tracker._gate._lost[:], tracker._gate._unsure[:] = False, [True, False, False, False]
        return True

    return doubtful


def test_a_posterior_that_cannot_answer_by_the_deadline_is_not_asked(layout, monkeypatch):
    """A field in doubt takes no time that cannot help it; with time enough it is put right."""
    moved = hertz_press(layout, 0.1, centre_m=(6e-3, 6e-3))
    shortest_s = sk.Tracker(layout, method="exact", deadline_us=1e6)._posterior.from_rest_s
    for deadline_us, asks in ((0.9e6 * shortest_s, 0), (1e7, 3)):
        tracker = sk.Tracker(layout, method="exact", deadline_us=deadline_us)
        tracker._posterior.from_rest_s = shortest_s
        asked, ask = [], tracker._posterior.estimate
        monkeypatch.setattr(tracker._posterior, "estimate", lambda *args: asked.append(1) or ask(*args))  # noqa: B023
        monkeypatch.setattr(tracker._gate, "_doubtful", doubt_of_the_first_wire(tracker))
        for _ in range(3):
            field = tracker.update(frame_ohm(layout, moved))
            assert field.trusted == (asks > 0)
            assert np.isinf(field.displacement_std_m[0]).all() == (asks == 0)
        assert len(asked) == asks


def test_a_posterior_that_missed_the_deadline_is_not_asked_again_at_once(layout, monkeypatch):
    """A wire in doubt all the while stays untrusted, whether the posterior was asked or not."""
    tracker = sk.Tracker(layout, method="exact", deadline_us=1e7)
    ask, asked, answers = tracker._posterior.estimate, [], False

    def update(*arguments: object) -> sk.FieldFrame:
        asked.append(number)
        field = ask(*arguments)
        return field if answers else dataclasses.replace(field, status=(sk.Status.DEADLINE,) * 4)

    monkeypatch.setattr(tracker._posterior, "estimate", update)
    monkeypatch.setattr(tracker._gate, "_doubtful", doubt_of_the_first_wire(tracker))
    moved = hertz_press(layout, 0.1, centre_m=(6e-3, 6e-3))
    for number in range(40):
        answers = number >= 32
        field = tracker.update(frame_ohm(layout, moved))
        assert field.status[1:] == (sk.Status.CONVERGED,) * 3
        if not answers:
            assert field.status[0] is sk.Status.ILL_CONDITIONED
            assert np.isinf(field.displacement_std_m[0]).all()
    assert asked == [0, 16, *range(32, 40)]
    assert field.trusted
    np.testing.assert_allclose(field.displacement_m, moved, atol=1e-3 * layout.height_m)


@pytest.mark.long
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([16, 24]), st.booleans(), st.booleans())
def test_codes_are_solved_as_the_resistances_that_they_stand_for(
    seed: int, bits: int, gained: bool, rough: bool
) -> None:
    """The decoder of the wire format is the other way: a stream of codes, some of them none, by both, to the
    last bit. Near a fold that is worth asking for: there one bit moves a wire by up to 1 % of its deviation.
    """
    rng = np.random.default_rng(seed)
    layout = sk.PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=4, lower_electrodes=4)
    scale = CodeScale(bits)
    baseline = frame_ohm(layout, np.zeros_like(layout.upper_m)) * rng.uniform(0.9, 1.1, layout.shape)
    gain = rng.uniform(0.99, 1.01, (layout.shape[0], 1)) if gained else None
    if rough:
        baseline[0, 0] = np.nan  # a crossing without a baseline
    meaning = CodeMap(
        baseline_ohm=as_baseline(baseline),
        lo=scale.lo,
        step=scale.step,
        steps=scale.steps,
        rounding_ohm=scale.relative_std * baseline,
        relative_noise=1e-5,
        gain=gain,
    )
    options = {"method": "exact", "relative_noise": 1e-5}
    one, two = sk.Tracker(layout, codes=meaning, **options), sk.Tracker(layout, **options)
    for n in range(4):
        ohm = frame_ohm(layout, hertz_press(layout, 0.05 * n, centre_m=(6e-3, 6e-3)))
        seen = ohm if gain is None else ohm / gain
        codes = encode(seen * rng.normal(1.0, 1e-5, ohm.shape), baseline, scale)
        if rough:
            codes[rng.random(codes.shape) < 0.02] = rng.choice([scale.open, scale.short, MISSING])
        resistance, valid = decode(codes, baseline, scale)
        if gain is not None:
            resistance = resistance * gain
        noise = np.sqrt(1e-5 * 1e-5 + (scale.relative_std * baseline / resistance) ** 2)
        field, invalid = one.update_codes(codes)
        expected = two.update(resistance, valid, noise)
        assert invalid == np.count_nonzero(~valid)
        assert field.status == expected.status
        np.testing.assert_array_equal(field.held, expected.held)
        np.testing.assert_array_equal(field.displacement_m, expected.displacement_m)
        np.testing.assert_array_equal(field.displacement_std_m, expected.displacement_std_m)
        np.testing.assert_array_equal(field.residual, expected.residual)


def test_the_posterior_solves_codes_as_the_resistances_that_they_stand_for(layout: sk.PatchLayout) -> None:
    baseline = as_baseline(frame_ohm(layout, np.zeros_like(layout.upper_m)))
    scale, rng = CodeScale(), np.random.default_rng(8)
    meaning = dataclasses.replace(code_map(layout), baseline_ohm=baseline)
    one = sk.Tracker(layout, method="posterior", codes=meaning)
    two = sk.Tracker(layout, method="posterior")
    for depth in (0.0, 0.1, 0.2, 0.1):
        moved = hertz_press(layout, depth, centre_m=(6e-3, 6e-3))
        codes = encode(noisy(layout, moved, rng), baseline, scale)
        codes[1, 2] = scale.open
        resistance, valid = decode(codes, baseline, scale)
        noise = np.sqrt(1e-5**2 + (scale.relative_std * baseline / resistance) ** 2)
        field, invalid = one.update_codes(codes)
        expected = two.update(resistance, valid, noise)
        assert invalid == 1
        assert field.status == expected.status
        np.testing.assert_allclose(field.displacement_m, expected.displacement_m, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(field.displacement_std_m, expected.displacement_std_m, rtol=1e-6)


def code_map(layout: sk.PatchLayout) -> CodeMap:
    scale, baseline = CodeScale(), frame_ohm(layout, np.zeros_like(layout.upper_m))
    rounding = scale.relative_std * baseline
    return CodeMap(baseline, scale.lo, scale.step, scale.steps, rounding, 1e-5)


def test_codes_that_mean_nothing_are_refused(layout: sk.PatchLayout) -> None:
    codes = np.zeros(layout.shape, np.uint32)
    with pytest.raises(ValueError, match="codes: got None, must be a CodeMap passed to the constructor"):
        sk.Tracker(layout, method="exact").update_codes(codes)
    tracker = sk.Tracker(layout, method="exact", codes=code_map(layout))
    for wrong in (codes[:1], codes.astype(np.int64), codes.tolist(), codes.T, None):
        with pytest.raises(ValueError, match=r"codes: got .*, must be uint32 of shape"):
            tracker.update_codes(wrong)
    field, invalid = tracker.update_codes(codes)  # code 0 is R0 times the least ratio
    assert invalid == 0
    assert field.displacement_m.shape == layout.upper_m.shape
