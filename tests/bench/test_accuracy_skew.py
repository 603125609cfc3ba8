"""The scenes of ``skinnode bench accuracy --only skew``: when the body moves, and what a sum counts."""

from __future__ import annotations

import numpy as np
import pytest

from skinnode.bench import accuracy_skew
from skinnode.bench.case import preset
from skinnode.bench.truth import Skin

PERIOD_S = 0.08


@pytest.mark.parametrize("speed_m_s", accuracy_skew.SPEEDS_M_S)
def test_a_body_is_pressed_slides_and_is_released_at_the_stated_speed(speed_m_s):
    skin = Skin(preset(*accuracy_skew.LAYOUT))
    body = accuracy_skew.motion("sphere", 0, skin, speed_m_s, PERIOD_S)
    (press, pressed, _), (slide, slid, _), (release, released, _) = body.parts
    depth_m = accuracy_skew.DEPTH * skin.layout.height_m
    assert depth_m / (pressed - press) == pytest.approx(speed_m_s)
    assert released - release == pytest.approx(pressed - press)
    assert (slid - slide) * speed_m_s <= accuracy_skew.FARTHEST * skin.layout.pitch_m * (1.0 + 1e-9)
    assert body.at(press) is body.upper_m
    assert body.at(released + 1e-9) is body.upper_m
    held, moved = (body.at(t_s) - body.upper_m for t_s in (0.5 * (pressed + slide), 0.5 * (slid + release)))
    assert -held[..., 2].min() == pytest.approx(depth_m, rel=0.25)  # at the electrode nearest to the centre
    assert np.linalg.norm(moved - held) > 0.0
    np.testing.assert_allclose(body.at(0.5 * (pressed + slide) + 1e-3) - body.upper_m, held)
    assert not body.moves(0.0, press)
    assert body.moves(0.5 * (press + pressed), pressed + 1.0)
    assert not body.moves(pressed, slide)


@pytest.mark.long
def test_a_scan_contains_each_wire_at_its_own_time():
    skin = Skin(preset(*accuracy_skew.LAYOUT))
    body = accuracy_skew.motion("punch", 1, skin, 1e-2, 0.02)
    scans = accuracy_skew._scans(body, skin, 0.02, 1e-3)
    number = next(i for i, scan in enumerate(scans) if scan.moves and scan.truth_m.any())
    at_once = skin.resistance_ohm(scans[number].truth_m)
    np.testing.assert_allclose(scans[number].ohm[0], at_once[0], rtol=1e-9)
    later = skin.resistance_ohm(body.at(0.02 * number + 9e-3) - skin.layout.upper_m)
    np.testing.assert_allclose(scans[number].ohm[9], later[9], rtol=1e-9)
