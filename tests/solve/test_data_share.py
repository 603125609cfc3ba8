"""How much of a displacement comes from the data: against the full covariances, and as readings are lost."""

from __future__ import annotations

import numpy as np
import pytest

import skinnode as sk
from skinnode.bench.truth import Press, Skin

NOISE = 1e-4


def pressed(skin: Skin, posterior: sk.Posterior, valid: np.ndarray | None = None) -> sk.FieldFrame:
    rng = np.random.default_rng(6)
    press = Press((0.018, 0.016), 0.03, 4e-4, (0.3, 0.1))
    for share in (0.5, 1.0):
        ohm = skin.resistance_ohm(skin.displacement_m((press,), share))
        field = posterior.update(ohm * (1 + NOISE * rng.standard_normal(ohm.shape)), valid)
    return field


def a_posterior(skin: Skin, **options: object) -> sk.Posterior:
    return sk.Posterior(skin.layout, relative_noise=NOISE, baseline_ohm=skin.rest_ohm, **options)


@pytest.fixture(scope="module")
def skin() -> Skin:
    return Skin(sk.PatchLayout.preset("staggered"))


def test_the_share_is_that_of_the_full_covariances(skin: Skin) -> None:
    """One minus posterior variance by prior variance, from the matrices, at a fixed scale of the prior."""
    scale_m = 1e-4
    posterior = a_posterior(skin, scale_m=scale_m)
    field = pressed(skin, posterior)
    assert field.data_share is not None
    after = posterior.covariance_m2().diagonal()
    from skinnode.solve.posterior.elastic_prior import ElasticPrior

    before = ElasticPrior.of(skin.layout).covariance.diagonal() * scale_m**2
    np.testing.assert_allclose(field.data_share.ravel(), 1.0 - after / before, atol=1e-6)
    assert field.data_share.min() >= 0.0
    assert field.data_share.max() <= 1.0


@pytest.mark.long
def test_the_more_readings_are_lost_the_less_comes_from_the_data(skin: Skin) -> None:
    shares = []
    for kept in (30, 15, 5):
        valid = np.zeros(skin.layout.shape, bool)
        valid[:, :: 30 // kept] = True
        field = pressed(skin, a_posterior(skin), valid)
        assert field.data_share is not None
        deepest = np.unravel_index(field.displacement_m[..., 2].argmin(), field.displacement_m.shape[:2])
        shares.append(float(field.data_share[(*deepest, 2)]))
    assert shares[0] > 0.9
    assert shares[0] > shares[1] > shares[2] > 0.0


def test_without_readings_nothing_comes_from_the_data(skin: Skin) -> None:
    posterior = a_posterior(skin)
    pressed(skin, posterior)
    field = posterior.update(np.full(skin.layout.shape, np.nan))
    assert field.data_share is not None
    assert not field.data_share.any()


def test_an_axis_that_is_not_solved_for_has_none_of_the_data(skin: Skin) -> None:
    field = pressed(skin, a_posterior(skin, normal_only=True))
    assert field.data_share is not None
    assert not field.data_share[..., :2].any()
    assert field.data_share[..., 2].max() > 0.9


def test_an_exact_field_rests_on_the_data_except_for_replaced_wires(skin: Skin) -> None:
    tracker = sk.Tracker(skin.layout, relative_noise=1e-5, baseline_ohm=skin.rest_ohm, method="exact")
    assert tracker.update(skin.rest_ohm).data_share is None
    valid = np.ones(skin.layout.shape, bool)
    valid[4, ::2] = False  # 15 equations for 30 unknowns
    ohm = skin.resistance_ohm(skin.displacement_m((Press((0.018, 0.016), 0.03, 2e-4),), 1.0))
    field = tracker.update(ohm, valid)
    assert field.by_prior is not None
    assert field.by_prior[4]
    assert field.data_share is not None
    assert (field.data_share[4] < 1.0).any()
    assert (field.data_share[~field.by_prior] == 1.0).all()
