"""Wires that do not fit the others: the evidence by SciPy, and a patch with such wires."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import skinnode as sk
from skinnode.bench.truth import RUBBER
from skinnode.model.elastic import HertzContact
from skinnode.model.layout import Float
from skinnode.solve.checks.wire_tests import GAIN_STD, WireTables, least_fitting
from tests.lanes import some_long

LAYOUT = sk.PatchLayout.preset("staggered")
REST = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m)
NOISE = 1e-5


def log_pdf(values: Float, covariance: Float) -> float:
    return float(multivariate_normal.logpdf(values, cov=covariance))


@pytest.mark.parametrize("seed", range(8))
def test_the_wire_that_fits_least_is_that_of_the_largest_evidence(seed: int) -> None:
    rng, (upper, lower), sigma = np.random.default_rng(seed), (4, 5), 0.01
    root = rng.standard_normal((20, 20))
    covariance = root @ root.T + np.eye(20)
    z, tau = 2.0 * rng.standard_normal(20), GAIN_STD / sigma
    if seed % 2:
        z[rng.integers(upper) * lower :][:lower] += 5.0
    before, best = log_pdf(z, covariance), (-math.inf, 0, math.nan)
    for wire in range(upper + lower):
        here = np.zeros(20)
        here.reshape(upper, lower)[wire if wire < upper else np.s_[:, wire - upper]] = 1.0
        own, others = np.flatnonzero(here), np.flatnonzero(here == 0.0)
        unrelated = sum(log_pdf(z[part], covariance[np.ix_(part, part)]) for part in (own, others)) - before
        off = log_pdf(z, covariance + tau**2 * np.outer(here, here)) - before
        weights = np.linalg.solve(covariance + tau**2 * np.outer(here, here), tau**2 * here)
        best = max(best, (unrelated, wire, math.nan), (off, wire, float(weights @ z)), key=lambda it: it[0])
    precision = np.linalg.inv(covariance)
    tables = WireTables.of(precision, covariance, (upper, lower))
    grid, every = z.reshape(upper, lower), np.ones((upper, lower), bool)
    finding = least_fitting(tables, grid, precision @ z, every, sigma, np.empty(5))
    assert finding.gain == pytest.approx(best[0] - math.log(18), abs=1e-6)
    assert finding.wire == best[1]
    assert finding.factor == pytest.approx(best[2], abs=1e-6, nan_ok=True)


def press(depth: float) -> Float:
    points = LAYOUT.upper_m[..., :2].reshape(-1, 2)
    contact = HertzContact(RUBBER, 14e-3, depth * LAYOUT.height_m, (17e-3, 18e-3), (0.2, 0.1))
    return contact.displacement_m(points).reshape(LAYOUT.upper_m.shape)


@pytest.mark.long
@pytest.mark.parametrize("method", ["exact", "posterior"])
@pytest.mark.parametrize("layer", some_long(["upper", "lower"], "upper"))
def test_a_wire_whose_gain_changes_by_one_percent_is_named_at_once(layer: str, method: str) -> None:
    rng, wire = np.random.default_rng(6), 4 if layer == "upper" else 14
    here = np.s_[wire] if layer == "upper" else np.s_[:, wire]
    tracker = sk.Tracker(LAYOUT, method=method, relative_noise=NOISE)
    for number in range(8):
        moved = press(0.02 * number)
        ohm = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m + moved) * rng.normal(1.0, NOISE, REST.shape)
        if number > 2:
            ohm[here] *= 1.01
        field = tracker.update(ohm)
        assert field.trusted
        off = np.abs(field.displacement_m - moved) / field.displacement_std_m
        assert off[field.wires_trusted].max() < 5.0
        found = {(each.upper, each.lower) for each in field.faults}
        assert found == ({(wire, None) if layer == "upper" else (None, wire)} if number > 2 else set())


@pytest.mark.parametrize("layer", ["upper", "lower"])
def test_a_wire_that_lags_far_behind_is_named(layer: str) -> None:
    """By four scans, in which the press deepens by 1 % each: found when 3 % behind, an upper one too."""
    rng, wire = np.random.default_rng(6), 4 if layer == "upper" else 14
    here = np.s_[wire] if layer == "upper" else np.s_[:, wire]
    tracker, scans = sk.Tracker(LAYOUT, relative_noise=NOISE), []
    for number in range(12):
        moved = press(0.01 * number)
        scans.append(sk.resistance_ohm(LAYOUT, LAYOUT.upper_m + moved) * rng.normal(1.0, NOISE, REST.shape))
        ohm = scans[-1].copy()
        if number > 2:
            ohm[here] = scans[max(number - 4, 2)][here]
        field = tracker.update(ohm)
        if number > 4:
            assert field.trusted
            off = np.abs(field.displacement_m - moved) / field.displacement_std_m
            assert off[field.wires_trusted].max() < 5.0
            assert ((wire, None) if layer == "upper" else (None, wire)) in {
                (each.upper, each.lower) for each in field.faults
            }
