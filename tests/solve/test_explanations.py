"""The search for explanations stops early where the result cannot matter; decisions must not depend on it."""

from __future__ import annotations

import math

import numpy as np
import pytest

import skinnode as sk
from skinnode.solve.checks.explanations import CLEAR, Explainer
from skinnode.solve.checks.greedy_search import GreedySearch
from skinnode.solve.checks.reading_model import ReadingModel, evidences
from tests.lanes import some_long

KINDS = ("healthy", "reading", "upper", "lower", "gain", "crossed", "noisy", "missing")


@pytest.fixture(scope="module")
def model():
    return ReadingModel.of(sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3))


class Thorough(GreedySearch):
    """A search that is never abandoned."""

    def run(self, *args, needed=-math.inf, **options):
        return super().run(*args, **options)


def frame(model, kind, sigma, seed):
    """Changes (U, K) of the readings under a press, in units of their noise, and which are available."""
    random = np.random.default_rng(seed)
    cells = model.response.shape[1] // 4  # three loads of the half-space a cell, then one of the thin layer
    loads = np.zeros(model.response.shape[1])
    near = random.integers(0, cells) + np.arange(-1, 2)
    depth = random.uniform(0.3, 1.0) * 10.0 ** random.uniform(-4, -0.2)
    loads[3 * np.clip(near, 0, cells - 1) + 2] = depth / sigma
    z = (model.response @ loads + random.standard_normal(len(model.response))).reshape(model.shape)
    present = np.ones(model.shape, bool)
    upper, lower = (int(random.integers(0, size - 1)) for size in model.shape)
    size = 10.0 ** random.uniform(1, 3)
    if kind == "reading":
        z[upper, lower] += size
    elif kind == "upper":
        z[upper] = random.permutation(z[upper]) + 0.1 * size * random.standard_normal(z.shape[1])
    elif kind == "lower":
        z[:, lower] += size * random.standard_normal(len(z))
    elif kind == "gain":
        z[upper] += size
    elif kind == "crossed":
        z[:, [lower, lower + 1]] = z[:, [lower + 1, lower]]
    elif kind == "noisy":
        z += 4.0 * random.standard_normal(z.shape)
    elif kind == "missing":
        present[upper], z[upper] = False, 0.0
    return z, present


@pytest.mark.long
@pytest.mark.parametrize("sigma", some_long([1e-5, 1e-6], 1e-6))
@pytest.mark.parametrize("kind", some_long(KINDS, "healthy", "reading", "crossed"))
def test_decisions_do_not_depend_on_stopping_early(model, kind, sigma):
    """At little noise and deep presses, loads are nearly free, and the bounds of the searches do not hold."""
    quick, thorough = Explainer(model), Explainer(model)
    thorough._search = Thorough(model)
    found = 0
    for seed in range(20):
        z, present = frame(model, kind, sigma, seed)
        evidence, scratch = np.empty(len(model.kappa)), np.empty((2, z.size))
        best = evidences(model.vectors_t, model.shrink, model.log_det, z.ravel(), scratch, evidence)
        arguments = present, evidence, best, math.log(0.1 / sigma), sigma
        groups = quick.wrong_readings(z.copy(), *arguments)
        expected = thorough.wrong_readings(z.copy(), *arguments)
        assert [(each.part, each.upper, each.lower, each.kind) for each in groups] == [
            (each.part, each.upper, each.lower, each.kind) for each in expected
        ]
        assert quick.is_noisier == thorough.is_noisier
        assert (quick.margin < CLEAR) == (thorough.margin < CLEAR)
        if thorough.margin >= CLEAR:
            assert quick.margin == pytest.approx(thorough.margin, abs=1e-6)
        found += bool(groups)
    if kind in {"reading", "upper", "lower", "gain", "crossed"}:
        assert found > 8
    elif kind == "healthy":
        assert found == 0
