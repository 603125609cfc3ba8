"""The score must not flatter: known errors and deviations in, known figures out."""

from __future__ import annotations

import numpy as np
import pytest

from skinnode.bench.score import Scorer, bound_std_m
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import FieldFrame, SolveStats
from skinnode.model.layout import Float, PatchLayout
from skinnode.model.status import Status

LAYOUT = PatchLayout.preset("staggered")
CODE_STD = 4.4e-6


def field(displacement_m: Float, std_m: float, status: Status = Status.CONVERGED) -> FieldFrame:
    wires = LAYOUT.shape[0]
    return FieldFrame(
        displacement_m=displacement_m,
        displacement_std_m=np.full(displacement_m.shape, std_m),
        status=(status,) * wires,
        residual=np.zeros(wires),
        stats=SolveStats(0, 0, 0, 0.0),
    )


def test_the_bound_is_what_a_linear_estimate_scatters_by() -> None:
    """Monte Carlo: a Newton step from the truth on noisy resistances, by finite differences of the model."""
    wire = PatchLayout(LAYOUT.upper_m[4:5], LAYOUT.lower_m, LAYOUT.resistivity_ohm_per_m)
    relative = np.full(wire.shape, 1e-5)
    exact = resistance_ohm(wire, wire.upper_m).ravel()
    slopes = np.empty((wire.shape[1], wire.unknowns))
    for unknown in range(wire.unknowns):
        moved = np.zeros(wire.unknowns)
        moved[unknown] = 1e-8
        moved = moved.reshape(wire.upper_m.shape)
        difference = resistance_ohm(wire, wire.upper_m + moved) - resistance_ohm(wire, wire.upper_m - moved)
        slopes[:, unknown] = difference.ravel() / 2e-8
    noise = 1e-5 * exact[:, None] * np.random.default_rng(3).standard_normal((wire.shape[1], 20_000))
    scatter = np.linalg.solve(slopes, noise).std(axis=1)
    assert bound_std_m(wire, wire.upper_m, relative).ravel() == pytest.approx(scatter, rel=0.03)


def test_a_singular_layout_has_no_bound() -> None:
    wire = PatchLayout(LAYOUT.upper_m[:1], LAYOUT.lower_m[:20])
    assert np.isinf(bound_std_m(wire, wire.upper_m, np.full(wire.shape, 1e-5))).all()


def scored(error_std_m: float, reported_m: float, status: Status = Status.CONVERGED) -> Scorer:
    random = np.random.default_rng(5)
    scorer = Scorer(LAYOUT, CODE_STD)
    truth = LAYOUT.upper_m + np.array([0.0, 0.0, -1e-4])
    for _ in range(50):
        error = error_std_m * random.standard_normal(truth.shape)
        scorer.add(field(truth - LAYOUT.upper_m + error, reported_m, status), truth)
    return scorer


def test_honest_errors_pass() -> None:
    score = scored(1e-6, 1e-6).score()
    assert score.within_uncertainty
    assert score.coverage95 == pytest.approx(0.95, abs=0.01)
    assert score.error_rms_m == pytest.approx(1e-6, rel=0.02)
    assert score.deepest_m == pytest.approx(1e-4)


def test_an_error_above_its_uncertainty_fails() -> None:
    assert not scored(1.3e-6, 1e-6).score().within_uncertainty


def test_a_single_gross_error_fails() -> None:
    scorer = scored(1e-6, 1e-6)
    ghost = np.zeros(LAYOUT.upper_m.shape)
    ghost[3, 4, 2] = -7e-6
    scorer.add(field(ghost, 1e-6), LAYOUT.upper_m)
    assert not scorer.score().within_uncertainty


def test_a_wire_that_did_not_converge_fails() -> None:
    assert not scored(1e-6, 1e-6, Status.MAX_STEPS).score().within_uncertainty


def test_nothing_scored_is_not_a_pass() -> None:
    assert not Scorer(LAYOUT, CODE_STD).score().within_uncertainty
