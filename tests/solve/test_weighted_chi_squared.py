"""Tail of a weighted sum of χ² against closed forms and a simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from skinnode.solve.detect.weighted_chi_squared import tail_probability, upper_quantile


@pytest.mark.parametrize("freedom", [5, 40, 96])
@pytest.mark.parametrize("chance", [0.5, 0.1, 1e-3, 1e-7])
def test_equal_weights_are_a_scaled_chi_squared(freedom: int, chance: float) -> None:
    weights = np.full(freedom, 0.3)
    exact = 0.3 * chi2.isf(chance, freedom)
    assert upper_quantile(weights, chance) == pytest.approx(exact, rel=2e-3)
    assert tail_probability(weights, exact) == pytest.approx(chance, rel=0.02)


def test_pairs_of_weights_are_a_sum_of_exponentials() -> None:
    """With each weight twice, P(T > x) = Σ_i exp(−x / 2 w_i) Π_{j ≠ i} w_i / (w_i − w_j)."""
    single = np.array([0.9, 0.6, 0.35, 0.2, 0.1, 0.04])
    for x in (2.0, 8.0, 20.0, 35.0):
        exact = sum(np.exp(-x / (2 * w)) * np.prod([w / (w - v) for v in single if v != w]) for w in single)
        assert tail_probability(np.repeat(single, 2), x) == pytest.approx(exact, rel=0.03)


@pytest.mark.long
def test_quantiles_of_a_typical_test_agree_with_a_simulation() -> None:
    rng = np.random.default_rng(1)
    weights = 1.0 / (1.0 + np.linspace(0.0, 6.0, 60) ** 2)
    drawn = np.concatenate([(rng.standard_normal((50_000, 60)) ** 2) @ weights for _ in range(16)])
    for chance in (0.1, 1e-2, 1e-3, 1e-4):
        found = float(np.mean(drawn > upper_quantile(weights, chance)))
        assert abs(found - chance) < 4.0 * np.sqrt(chance / drawn.size) + 0.01 * chance


def test_impossible_requests_name_the_argument() -> None:
    with pytest.raises(ValueError, match="probability"):
        upper_quantile(np.ones(3), 0.0)
    with pytest.raises(ValueError, match="weights"):
        upper_quantile(np.zeros(3), 0.1)
