"""``skinnode bench stability``: the truth is the truth, the verdict names what is wrong and only that."""

from __future__ import annotations

import dataclasses
import json
import zlib

import numpy as np
import pytest
from click.testing import Result
from scipy import stats
from typer.testing import CliRunner

from skinnode.bench import stability as _bench_stability
from skinnode.bench.case import DRIFT, Case
from skinnode.bench.cases import all_cases
from skinnode.bench.methods import solver_of
from skinnode.bench.truth import Converter, Press, Skin, Stream, random_press, stream
from skinnode.bench.verdict import CHANCE, Solved, Tally, allowed_seeds, beyond, limit_of, named
from skinnode.cli.bench import app
from skinnode.model.elastic import HertzContact
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import PatchLayout

SHAPE = (6, 10, 10, 3)
STD_M = 1e-6
TRUTH = np.full(SHAPE, 1e-4)
ALL = np.ones(SHAPE[:2], bool)


def solved(error_m: np.ndarray, converged: np.ndarray = ALL, std_m: float = STD_M) -> Solved:
    return Solved(TRUTH + error_m, np.full(SHAPE, std_m), converged)


def one(frame: int, wire: int, error_m: float) -> np.ndarray:
    error = np.zeros(SHAPE)
    error[frame, wire, 3, 2] = error_m
    return error


# --- verdict


def test_honest_gaussian_errors_are_accurate() -> None:
    random, tally = np.random.default_rng(1), Tally(exact=False)
    for seed in range(200):  # 360,000 coordinates, of which 0.2 lie beyond 5 deviations
        tally.add(seed, solved(STD_M * random.standard_normal(SHAPE)), TRUTH)
    row = tally.row()
    assert (row["accurate"], row["flagged"], row["wrong"]) == (200 * 60, 0, 0)
    assert row["expected_beyond_5"] == pytest.approx(360_000 * 5.733e-7, rel=1e-3)
    assert row["median_error"] == pytest.approx(1e-2, rel=0.01)  # 1 µm of 100
    assert row["reported"] == pytest.approx(1e-2)


def test_chance_in_a_long_run_is_no_fault_and_a_gross_error_is_one() -> None:
    tally = Tally(exact=False)
    for seed in range(50):
        tally.add(seed, solved(one(0, 0, 5.3e-6 if seed == 7 else 0.0)), TRUTH)
    row = tally.row()
    assert row["wrong"] == 0
    assert row["beyond_5"] == 1
    tally.add(50, solved(one(2, 4, 1e-5)), TRUTH)
    row = tally.row() | {"case": "a case", "method": "a method"}
    assert row["wrong"] == 1
    assert row["worst"] == {"deviations": pytest.approx(10.0), "seed": 50, "frame": 2, "wire": 4}
    assert named(row).startswith("a case by a method: 1 of 3060 wires wrong, worst 10 standard deviations")


def test_tails_too_heavy_are_wrong_though_none_is_far_out() -> None:
    tally = Tally(exact=False)
    for seed in range(50):
        tally.add(seed, solved(one(1, 2, 5.3e-6 if seed % 10 == 0 else 0.0)), TRUTH)
    assert limit_of(50 * TRUTH.size) > 5.3
    assert tally.row()["wrong"] == 5


def test_what_is_not_claimed_is_flagged_whatever_its_error() -> None:
    converged = ALL.copy()
    converged[3, 4] = False
    tally = Tally(exact=False)
    tally.add(0, solved(one(3, 4, 1e-3), converged), TRUTH)
    row = tally.row()
    assert (row["accurate"], row["flagged"], row["wrong"]) == (59, 1, 0)
    assert row["worst_error"] == 0.0  # errors are of what was claimed


def test_numbers_that_are_not_finite_are_wrong_under_any_status() -> None:
    tally = Tally(exact=False)
    tally.add(0, solved(one(3, 4, np.nan), ~ALL), TRUTH)
    row = tally.row()
    assert (row["flagged"], row["wrong"]) == (59, 1)


def test_exact_data_leaves_nothing_to_chance() -> None:
    for error, std, wrong in ((0.9e-10, 1e-14, 0), (1.1e-10, 1e-14, 1), (4e-8, 1e-8, 0), (6e-8, 1e-8, 1)):
        tally = Tally(exact=True)
        tally.add(0, solved(one(5, 9, error), std_m=std), TRUTH)  # a millionth of the displacement: 1e-10
        assert tally.row()["wrong"] == wrong


def test_frames_without_a_truth_are_not_judged() -> None:
    truth = TRUTH.copy()
    truth[2] = np.nan
    tally = Tally(exact=False)
    tally.add(0, solved(one(2, 0, 1.0)), truth)
    row = tally.row()
    assert (row["wires"], row["wrong"]) == (50, 0)


def test_limits_are_those_of_the_normal_distribution() -> None:
    assert beyond(5.0) == pytest.approx(2 * stats.norm.sf(5.0))
    for count in (10_000, 1_000_000):
        assert count * 2 * stats.norm.sf(limit_of(count)) == pytest.approx(CHANCE)
    assert limit_of(10) == 5.0  # never stricter than what is asked for
    allowed = allowed_seeds(1_000_000, 50)
    rate = 1e6 / 50 * beyond(5.0)
    assert stats.binom.sf(allowed, 50, rate) <= CHANCE < stats.binom.sf(allowed - 1, 50, rate)


# --- truth


def pair(**options: float) -> Skin:
    """One electrode above one other, 2 mm apart."""
    layout = PatchLayout(np.array([[[0.0, 0.0, 2e-3]]]), np.zeros((1, 1, 3)), 1e7)
    return Skin(layout, **options)


def test_strain_and_series_resistance_of_one_pair() -> None:
    down = np.array([[[0.0, 0.0, -0.5e-3]]])
    assert pair().resistance_ohm(down)[0, 0] == pytest.approx(1e7 * 1.5e-3)
    strained = pair(strain=0.05).resistance_ohm(down)[0, 0]
    assert strained == pytest.approx(1e7 * 1.5e-3 * (1 - 0.05 * 0.25))
    assert pair(series=0.01).resistance_ohm(down)[0, 0] == pytest.approx(1e7 * (1.5e-3 + 2e-5))
    assert pair(height=1.05).rest_ohm[0, 0] == pytest.approx(1e7 * 2.1e-3)


def test_plain_skin_is_the_reference_model() -> None:
    layout = PatchLayout.preset("aligned", lower_wires=7, upper_electrodes=4)
    moved = 1e-4 * np.random.default_rng(0).standard_normal(layout.upper_m.shape)
    expected = resistance_ohm(layout, layout.upper_m + moved)
    np.testing.assert_allclose(Skin(layout).resistance_ohm(moved), expected, rtol=1e-14)


def test_a_finite_electrode_is_the_mean_over_two_discs_rims() -> None:
    skin = pair(electrode=0.1)  # the pitch of a single electrode is its gap
    radius = 0.2e-3
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    gap = radius * (np.exp(1j * angle)[:, None] - np.exp(1j * angle)[None, :])
    mean = (1 / np.sqrt(np.abs(gap) ** 2 + 4e-6)).mean()
    assert skin.rest_ohm[0, 0] == pytest.approx(1e7 / mean, rel=1e-6)
    assert abs(skin.rest_ohm[0, 0] / pair().rest_ohm[0, 0] - 1) > 1e-3


def test_shear_only_moves_the_skin_along_and_carries_no_normal_force() -> None:
    press = Press((0.0, 0.0), 8e-3, 1e-3, (0.5, 0.0), shear_only=True)
    moved = press.displacement_m(np.array([[0.0, 0.0], [3e-3, 1e-3]]), 1.0)
    assert moved[:, 2] == pytest.approx(0.0, abs=1e-15)
    assert (moved[:, 0] > 1e-4).all()
    normal = HertzContact(press.contacts(1.0)[0][1].rubber, 8e-3, 1e-3).force_n[2]
    assert press.force_n(1.0) == pytest.approx([-0.5 * normal, 0.0, 0.0])


@pytest.mark.parametrize("bits", [12, 14, 16, 24])
def test_codes_are_within_half_a_step_and_saturate(bits: int) -> None:
    rest = np.array([[1000.0]])
    values = np.linspace(100.0, 1400.0, 2001).reshape(-1, 1, 1)
    read, valid, noise = Converter(bits=bits).read(values, rest, np.random.default_rng(0))
    step = 1000.0 / ((1 << bits) - 4)
    inside = (values >= 250.0) & (values <= 1250.0)
    np.testing.assert_array_equal(valid, inside)
    assert np.abs(read - values)[inside].max() <= 0.5000001 * step
    assert noise[inside] * read[inside] == pytest.approx(step / np.sqrt(12))


def test_gaussian_noise_is_as_told() -> None:
    values = np.full((400, 10, 30), 1e4)
    read, _, noise = Converter(sigma=1e-3).read(values, values[0], np.random.default_rng(0))
    assert noise == pytest.approx(1e-3)
    assert np.std(read / values - 1) == pytest.approx(1e-3, rel=0.01)


def test_a_stream_is_the_press_it_says() -> None:
    """Positions and resistances written out again, from Johnson's closed form and Ohm's law."""
    layout = PatchLayout.preset("staggered")
    press = random_press(np.random.default_rng(4), layout, 0.3, shear=0.0)
    taken = stream(Skin(layout), (press,), np.array([0.0, 1.0]), Converter(), np.random.default_rng(0))
    a2 = press.radius_m * press.depth_m
    away = ((layout.upper_m[..., :2] - press.center_m) ** 2).sum(axis=-1)
    depth = press.depth_m * (1 - away / (2 * a2))
    inside = away < a2
    assert inside.any()
    assert taken.truth_m[1, ..., 2][inside] == pytest.approx(-depth[inside])
    upper = layout.upper_m[2] + taken.truth_m[1, 2]
    paths = [1 / np.linalg.norm(x - y) for x in upper for y in layout.lower_m[7]]
    assert taken.frames_ohm[1, 2, 7] == pytest.approx(layout.resistivity_ohm_per_m / sum(paths))
    assert not taken.truth_m[0].any()


# --- cases


CASES = {case.name: case for case in all_cases()}


def test_every_hard_case_is_there_under_a_name_of_its_own() -> None:
    assert {case.number for case in CASES.values()} == set(range(1, 17))
    assert len(CASES) == len(all_cases())


def test_a_seed_gives_the_same_stream_and_another_seed_another() -> None:
    make = CASES["missing chunks"].make
    first, again, other = (make(np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.frames_ohm, again.frames_ohm)
    np.testing.assert_array_equal(first.valid, again.valid)
    assert not np.array_equal(first.truth_m, other.truth_m)
    assert (~first.valid).sum(axis=(1, 2)).tolist() == [15] * len(first.valid)


@pytest.mark.parametrize("name", ["swapped electrodes, staggered h=0.5", "mirror branch, staggered h=1.5"])
def test_a_detour_ends_at_the_resistances_of_rest(name: str) -> None:
    case = CASES[name]
    taken = case.make(np.random.default_rng(2))
    odd = np.flatnonzero(np.isnan(taken.truth_m[:, 0, 0, 0]))
    assert odd.tolist() == list(range(1, 6))
    assert taken.frames_ohm[6] == pytest.approx(case.skin.rest_ohm, rel=1e-4)
    assert np.abs(taken.frames_ohm[3] / case.skin.rest_ohm - 1).max() > 0.01


def test_drift_is_what_its_name_says() -> None:
    taken = CASES["drift of every wire to 2%, staggered h=0.5"].make(np.random.default_rng(0))
    gain = taken.frames_ohm[-1] / CASES["drift of every wire to 2%, staggered h=0.5"].skin.rest_ohm - 1
    assert np.ptp(gain, axis=1).max() < 1e-4  # one gain a wire
    assert 1e-3 < np.abs(gain).max() <= DRIFT * 1.01


def test_the_fingertip_is_the_flat_patch_bent() -> None:
    skin = CASES["fingertip, 30%"].skin
    assert skin.layout.pitch_m == pytest.approx(4e-3, rel=0.02)
    taken = CASES["fingertip, 30%"].make(np.random.default_rng(1))
    deepest = np.unravel_index(np.linalg.norm(taken.truth_m[2], axis=-1).argmax(), (10, 10))
    out = skin.axes[deepest][2]
    assert taken.truth_m[2][deepest] @ out < -0.8 * np.linalg.norm(taken.truth_m[2][deepest])


# --- command


def small_case(off_m: float) -> Case:
    """Wires of one electrode, solved at once; the truth is off by ``off_m`` from what the frames say."""
    skin = Skin(PatchLayout.preset("staggered", upper_electrodes=1, lower_wires=6))
    press = Press((0.0, 16e-3), 8e-3, 2e-4)

    def make(rng: np.random.Generator) -> Stream:
        taken = stream(skin, (press,), np.array([0.0, 0.5, 1.0]), Converter(sigma=1e-5), rng)
        return dataclasses.replace(taken, truth_m=taken.truth_m + off_m)

    return Case(12, f"off by {off_m:g}", skin, make, ("exact",))


def stability(monkeypatch, tmp_path, cases: list[Case], *options: str) -> tuple[Result, dict]:
    monkeypatch.setattr(_bench_stability, "all_cases", lambda: cases)
    file = tmp_path / "figures.json"
    result = CliRunner().invoke(app, ["stability", "--seeds", "2", "--json", str(file), *options])
    return result, json.loads(file.read_text(encoding="utf-8"))


def test_a_wrong_case_is_named_and_ends_with_status_1(monkeypatch, tmp_path) -> None:
    result, figures = stability(monkeypatch, tmp_path, [small_case(0.0), small_case(1e-4)])
    assert result.exit_code == 1, result.output
    good, bad = figures["rows"]
    assert (good["wrong"], bad["wrong"]) == (0, 60)  # 2 seeds of 3 frames of 10 wires
    assert figures["wrong"] == 60
    assert "1 converged and wrong" in result.output
    assert "off by 0.0001 by exact: 60 of 60 wires wrong" in result.output


@pytest.mark.long
def test_honest_cases_end_with_status_0_and_every_figure(monkeypatch, tmp_path) -> None:
    picture = tmp_path / "picture.png"
    result, figures = stability(monkeypatch, tmp_path, [small_case(0.0)], "--plot", str(picture))
    assert result.exit_code == 0, result.output
    assert figures["benchmark"] == "stability"
    assert figures["seeds"] == 2
    (row,) = figures["rows"]
    assert {"number", "case", "method", "median_error", "worst_error", "reported", "limit"} <= set(row)
    assert (row["wires"], row["accurate"], row["flagged"], row["converged"]) == (60, 60, 0, 1.0)
    assert 0 < row["median_error"] < 5 * row["reported"] < 0.5
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("different_at", "calls"), [(None, 2), (1, 5)])
def test_auto_is_not_run_twice_where_it_is_what_it_chose(monkeypatch, different_at, calls) -> None:
    seen = dict.fromkeys(("exact", "posterior", "auto"), 0)

    def of(case: Case, name: str):
        def solve(taken: Stream) -> Solved:
            odd = name == "exact" or (name == "auto" and seen[name] == different_at)
            seen[name] += 1
            moved = taken.truth_m + (1e-7 if odd else 2e-7)
            return Solved(moved, np.full(moved.shape, 1e-6), np.ones(moved.shape[:2], bool))

        return solve

    monkeypatch.setattr(_bench_stability.methods, "set_up", of)
    case = dataclasses.replace(small_case(0.0), methods=("exact", "posterior", "auto"))
    rows = {row["method"]: row for row in _bench_stability.run(5, cases=[case])["rows"]}
    assert seen == {"exact": 5, "posterior": 5, "auto": calls}
    assert rows["auto"]["same_as"] == (None if different_at else "posterior")
    assert rows["auto"]["wires"] == rows["posterior"]["wires"] == 150


@pytest.mark.parametrize(
    "options", [("--seeds", "0"), ("--plot", "picture.nonsense"), ("--json", "no/such/folder/file")]
)
def test_bad_options_are_refused_before_the_work(monkeypatch, options: tuple[str, str]) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("ran")

    monkeypatch.setattr(_bench_stability, "run", never)
    result = CliRunner().invoke(app, ["stability", *options])
    assert result.exit_code != 0
    assert not isinstance(result.exception, AssertionError)


@pytest.mark.long
def test_a_press_after_two_electrodes_seemed_to_swap_is_not_expected_elsewhere() -> None:
    """A load of many expected deviations makes the prior anew, though little else has changed: 7.1 deviations
    before."""
    (case,) = (c for c in all_cases() if c.name == "swapped electrodes, staggered h=0.5")
    stream = case.make(np.random.default_rng([17, zlib.crc32(case.name.encode())]))
    posterior = solver_of(case, "posterior")
    worst = 0.0
    for frame, valid, noise, truth in zip(
        stream.frames_ohm, stream.valid, stream.noise, stream.truth_m, strict=True
    ):
        field = posterior.update(frame, valid, noise)
        if np.isfinite(truth).all():
            worst = max(worst, np.abs((field.displacement_m - truth) / field.displacement_std_m).max())
    assert 1.0 < worst < 5.0
