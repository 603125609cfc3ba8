"""The search for explanations: its gain is the change in the log evidence, computed here with dense matrices.

With S the covariance of the readings, a load of variance τ² and response b adds τ² b bᵀ to S, and a reading
that is wrong is left out of the data. The log evidence is that of a normal distribution (scipy.stats).
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import skinnode as sk
from skinnode.solve.checks import reading_model
from skinnode.solve.checks.greedy_search import CROSSING, LOAD, LOADS, LOWER, STEPS, UPPER, GreedySearch
from skinnode.solve.checks.reading_model import ReadingModel

SCALE = 12
"""Index of κ."""
COST = 9.0


@pytest.fixture(scope="module", params=["stored", "computed"])
def search(request):
    """A search with stored Gram matrices, and one that computes their rows."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "computed":
            patch.setattr(reading_model, "STORED", 0)
        model = ReadingModel(sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3))
        model.loads(SCALE)
        yield model, GreedySearch(model)


def pressed(model, seed, noise=1.0):
    """Changes (U, K) of the readings under four loads of their own, in units of their noise."""
    random = np.random.default_rng(seed)
    q = np.zeros(model.response.shape[1])
    q[random.choice(q.size, 4, replace=False)] = random.normal(0, 30 * model.kappa[SCALE], 4)
    return (model.response @ q + noise * random.standard_normal(len(model.response))).reshape(model.shape)


def run(greedy, z, present, cost, **options):
    return greedy.run(SCALE, z, greedy.products(z, [SCALE])[0], present, cost, **options)


def steps(search):
    count = int((search.kinds >= 0).sum())
    return list(zip(search.kinds[:count].tolist(), search.numbers[:count].tolist(), strict=True))


def with_loads(model, z, present, loads=()):
    """Covariance of the readings with loads that have their likeliest variances."""
    b = model.response
    covariance = np.eye(len(b)) + model.kappa[SCALE] ** 2 * covariance_of(model)
    for load in loads:
        inside = np.ix_(present, present)
        precision = np.linalg.inv(covariance[inside])
        of_load = b[present, load]
        h, fit = of_load @ precision @ of_load, of_load @ precision @ z[present]
        variance = max(fit * fit - h, 0.0) / h**2
        covariance = covariance + variance * np.outer(b[:, load], b[:, load])
    return covariance


def evidence(model, z, present, loads=()):
    """Log evidence of the readings ``present`` with loads that have their likeliest variances."""
    covariance, inside = with_loads(model, z, present, loads), np.ix_(present, present)
    log = multivariate_normal(np.zeros(present.sum()), covariance[inside]).logpdf(z[present])
    return log + 0.5 * present.sum() * math.log(2 * math.pi)


def covariance_of(model):
    """J C Jᵀ, from its eigendecomposition."""
    values = (1 / model.shrink[SCALE] - 1) / model.kappa[SCALE] ** 2
    return model.vectors_t.T @ (values[:, None] * model.vectors_t)


@pytest.mark.parametrize("missing", [0, 3])
def test_loads_gain_what_they_add_to_the_log_evidence(search, missing):
    model, greedy = search
    for seed in range(3):
        z = pressed(model, seed)
        present = np.ones(model.shape, bool)
        present.ravel()[np.random.default_rng(seed).choice(z.size, missing, replace=False)] = False
        gain = run(greedy, z, present, COST, faults=False)
        found = steps(greedy)
        assert 0 < len(found) <= LOADS
        assert {kind for kind, _ in found} == {LOAD}
        loads = [number for _, number in found]
        plain, there = evidence(model, z.ravel(), present.ravel()), present.ravel()
        expected = evidence(model, z.ravel(), there, loads) - plain
        expected -= len(loads) * math.log(model.response.shape[1])
        assert gain == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_readings_gain_what_the_others_are_likelier_without_them(search):
    model, greedy = search
    z = np.random.default_rng(5).standard_normal(model.shape)
    z[2, 3] += 400.0
    z[:, 1] += 90.0 * (-1.0) ** np.arange(len(z))
    gain = run(greedy, z, np.ones(z.shape, bool), COST, faults=True, loads=False)
    found = steps(greedy)
    assert (CROSSING, 2 * z.shape[1] + 3) in found or (UPPER, 2) in found
    assert (LOWER, 1) in found
    assert len(found) <= STEPS
    present, choices = np.ones(z.shape, bool), 0.0
    for kind, number in found:
        where, many = {
            CROSSING: (np.unravel_index(number, z.shape), z.size),
            LOWER: ((slice(None), number), z.shape[1]),
            UPPER: ((number, slice(None)), z.shape[0]),
        }[kind]
        present[where], choices = False, choices + math.log(many)
    plain = evidence(model, z.ravel(), np.ones(z.size, bool))
    expected = evidence(model, z.ravel(), present.ravel()) - plain
    expected -= COST * np.count_nonzero(~present) + choices
    assert gain == pytest.approx(expected, rel=1e-6)


def test_a_reading_that_is_wrong_under_a_press_is_told_from_the_press(search):
    model, greedy = search
    z = pressed(model, 7)
    z[1, 2] += 300.0
    without = np.ones(z.shape, bool)
    gain = run(greedy, z, without, COST, faults=True)
    assert without.all(), "the caller's mask is its own"
    assert (CROSSING, z.shape[1] + 2) in steps(greedy)
    assert gain > run(greedy, z, without, COST, faults=False) + 20


def test_noise_alone_needs_no_explanation(search):
    model, greedy = search
    quiet = np.random.default_rng(3).standard_normal(model.shape)
    assert run(greedy, quiet, np.ones(quiet.shape, bool), COST, faults=True) == 0.0
    assert not steps(greedy)


def wires_of(shape):
    """Mask, kind, number and count of all wires."""
    for upper in range(shape[0]):
        mask = np.zeros(shape, bool)
        mask[upper] = True
        yield mask.ravel(), (UPPER, upper), shape[0]
    for lower in range(shape[1]):
        mask = np.zeros(shape, bool)
        mask[:, lower] = True
        yield mask.ravel(), (LOWER, lower), shape[1]


def gain_of_wires(covariance, z, cost):
    """Gain from leaving out each wire."""
    precision, gains = np.linalg.inv(covariance), {}
    alpha = precision @ z.ravel()
    for mask, wire, many in wires_of(z.shape):
        block = precision[np.ix_(mask, mask)]
        fit = alpha[mask] @ np.linalg.solve(block, alpha[mask])
        gains[wire] = 0.5 * (fit - np.linalg.slogdet(block)[1]) - cost * mask.sum() - math.log(many)
    return gains


@pytest.mark.parametrize("seed", range(24))
def test_a_search_is_abandoned_only_if_it_cannot_gain_enough(search, seed):
    """The bounds must hold for presses, wrong wires and missing readings, at costs high and low."""
    model, greedy = search
    random = np.random.default_rng(100 + seed)
    z, present = (seed % 3 > 0) * pressed(model, seed), np.ones(model.shape, bool)
    wire = int(random.integers(0, model.shape[seed % 2]))
    wrong = np.s_[:, wire] if seed % 2 else np.s_[wire]
    z[wrong] += random.choice([2.0, 20.0, 200.0]) * random.standard_normal(z[wrong].shape)
    present.ravel()[random.choice(z.size, seed % 4, replace=False)] = False
    z[~present] = 0.0
    for faults, cost in ((False, COST), (True, COST), (True, 1.5)):
        full = run(greedy, z, present, cost, faults=faults)
        found = steps(greedy)
        assert run(greedy, z, present, cost, faults=faults, needed=full - 1e-6) == full
        assert steps(greedy) == found
        assert run(greedy, z, present, cost, faults=faults, needed=full + 1e4) == -math.inf


@pytest.mark.parametrize("seed", range(12))
def test_no_wire_is_overlooked(search, seed):
    """A bound spares most wires the test; it must not spare one that would gain."""
    model, greedy = search
    random = np.random.default_rng(seed)
    # little noise, and loads in only some of the frames: a tight bound
    z, all_ = (seed % 3 > 0) * pressed(model, seed, noise=0.03), np.ones(model.shape, bool)
    wire, size = int(random.integers(0, model.shape[seed % 2])), random.uniform(1.0, 6.0)
    wrong = np.s_[:, wire] if seed % 2 else np.s_[wire]
    z[wrong] += size * random.standard_normal(z[wrong].shape)
    cost = 1.5
    run(greedy, z, all_, cost, faults=True)
    found = steps(greedy)
    loads = []
    for kind, number in found:  # until a reading is left out
        gains = gain_of_wires(with_loads(model, z.ravel(), all_.ravel(), loads), z, cost)
        best = max(gains, key=lambda each: gains[each])
        here = float(greedy.gains[len(loads)])
        assert gains[best] <= here + 1e-6
        if kind != LOAD:
            assert kind == CROSSING or gains[kind, number] == pytest.approx(here, rel=1e-6, abs=1e-6)
            return
        loads.append(number)
    assert (
        len(found) == STEPS
        or max(gain_of_wires(with_loads(model, z.ravel(), all_.ravel(), loads), z, cost).values())
        < 1.0 + 1e-6
    )
