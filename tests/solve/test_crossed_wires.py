"""Two wires whose readings are exchanged: the likelihood by SciPy, and a patch that was wired wrongly."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import skinnode as sk
from skinnode.bench.truth import RUBBER
from skinnode.model.data_fault import FaultKind, FaultyPart
from skinnode.model.elastic import HertzContact
from skinnode.model.layout import Float
from skinnode.solve.checks.crossed_wires import WirePair, exchanged, likeliest
from skinnode.solve.checks.fault_list import FRAMES
from tests.lanes import some_long

LAYOUT = sk.PatchLayout.preset("staggered")
REST = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m)
NOISE = 1e-5


@pytest.mark.parametrize("far", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_the_likeliest_pair_is_that_of_the_largest_likelihood(seed: int, far: bool) -> None:
    rng, (upper, lower) = np.random.default_rng(seed), (4, 5)
    root = rng.standard_normal((20, 20))
    covariance = root @ root.T + np.eye(20)
    precision, z = np.linalg.inv(covariance), rng.standard_normal((upper, lower))
    present = np.ones((upper, lower), bool)
    present[1, 2] = False
    likelihoods = {}
    for part, count in ((FaultyPart.UPPER, upper), (FaultyPart.LOWER, lower)):
        for one, other in itertools.combinations(range(count), 2):
            if far or other == one + 1:
                turned, there = exchanged(z, present, WirePair(part, one, other))
                turned = np.where(present & there, turned, z)
                likelihoods[part, one, other] = multivariate_normal.logpdf(turned.ravel(), cov=covariance)
    best = max(likelihoods, key=lambda key: likelihoods[key])
    before = multivariate_normal.logpdf(z.ravel(), cov=covariance)
    gain, pair = likeliest(precision, precision @ z.ravel(), z, present, far=far)
    assert (pair.part, pair.one, pair.other) == best
    assert gain == pytest.approx(likelihoods[best] - before - np.log(len(likelihoods)), abs=1e-9)


def press(depth: float) -> Float:
    points = LAYOUT.upper_m[..., :2].reshape(-1, 2)
    contact = HertzContact(RUBBER, 14e-3, depth * LAYOUT.height_m, (17e-3, 18e-3), (0.2, 0.1))
    return contact.displacement_m(points).reshape(LAYOUT.upper_m.shape)


@pytest.mark.long
@pytest.mark.parametrize("method", some_long(["exact", "posterior"], "posterior"))
@pytest.mark.parametrize("layer", ["upper", "lower"])
@pytest.mark.parametrize("other", some_long([1, 2], 1))
def test_wires_crossed_before_the_baseline_was_measured_are_named(
    layer: str, other: int, method: str
) -> None:
    rng, wires = np.random.default_rng(6), [4, 4 + other] if layer == "upper" else [14, 14 + other]
    here, there = (wires, wires[::-1]) if layer == "upper" else (np.s_[:, wires], np.s_[:, wires[::-1]])
    tracker = sk.Tracker(LAYOUT, method=method, relative_noise=NOISE)
    touched = 0
    for share in (0.0, 0.0, 0.1, 0.2, 0.2, 0.2):
        touched += share > 0.0
        moved = press(share) if share else np.zeros_like(LAYOUT.upper_m)
        ratio = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m + moved) / REST
        ratio *= rng.normal(1.0, NOISE, LAYOUT.shape)
        ratio[here] = ratio[there]
        field = tracker.update(ratio * REST)
        if touched < FRAMES:  # one frame is not enough: see the test of a single frame
            assert field.faults == ()
            assert field.trusted == (not touched)
            continue
        assert field.trusted
        off = np.abs(field.displacement_m - moved) / field.displacement_std_m
        assert off[field.wires_trusted].max() < 5.0
    found = {(fault.kind, fault.upper, fault.lower) for fault in field.faults}
    assert found == {
        (FaultKind.CROSSED, wire, None) if layer == "upper" else (FaultKind.CROSSED, None, wire)
        for wire in wires
    }


@pytest.mark.parametrize("method", ["exact", "posterior"])
def test_wires_that_seem_crossed_in_one_frame_are_not_reported(method: str) -> None:
    """A press that one wire has not followed can look like an exchange; the field is not trusted."""
    rng = np.random.default_rng(6)
    tracker = sk.Tracker(LAYOUT, method=method, relative_noise=NOISE)
    for share, crossed in ((0.0, False), (0.1, False), (0.2, True), (0.2, False)):
        moved = press(share) if share else np.zeros_like(LAYOUT.upper_m)
        ratio = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m + moved) / REST
        ratio *= rng.normal(1.0, NOISE, LAYOUT.shape)
        if crossed:
            ratio[[4, 5]] = ratio[[5, 4]]
        field = tracker.update(ratio * REST)
        assert field.faults == ()
        assert field.trusted == (not crossed)
