"""Electrode coordinates as bytes: exact to the hash, refused when they are not what the sizes say."""

from __future__ import annotations

import numpy as np
import pytest

from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from skinnode.protocol.coordinates import pack_coordinates, unpack_coordinates
from skinnode.protocol.profile import PatchProfile


@pytest.mark.parametrize("name", ["aligned", "staggered"])
def test_a_layout_comes_back_with_its_hash(name: str) -> None:
    layout = PatchLayout.preset(
        name, pitch_m=np.pi * 1e-3, height_m=1.7e-3, upper_wires=4, upper_electrodes=5
    )
    data = pack_coordinates(layout)
    back = unpack_coordinates(data, PatchProfile.from_layout(layout), 2e6, name)
    assert len(data) == 12 * (4 * 5 + 15 * 4)
    assert back.layout_hash == layout.layout_hash
    np.testing.assert_allclose(back.upper_m, layout.upper_m, rtol=0, atol=0.51e-9)
    np.testing.assert_allclose(back.lower_m, layout.lower_m, rtol=0, atol=0.51e-9)
    assert (back.resistivity_ohm_per_m, back.name) == (2e6, name)


def test_the_bytes_are_little_endian_nanometres_upper_first() -> None:
    layout = PatchLayout(np.array([[[1e-9, -2e-9, 3e-6]]]), np.array([[[0.0, 0.0, 256e-9]]]))
    assert pack_coordinates(layout).hex() == "01000000" + "feffffff" + "b80b0000" + "00" * 8 + "00010000"


def test_what_does_not_fit_is_refused() -> None:
    layout = PatchLayout.preset("aligned", upper_wires=2, upper_electrodes=2)
    data = pack_coordinates(layout)
    with pytest.raises(ConfigError, match=r"0x2300.*allowed: \d+ bytes"):
        unpack_coordinates(data[:-1], PatchProfile.from_layout(layout), 1e7)
    with pytest.raises(ConfigError, match=r"allowed: at most 2\.1 m"):
        pack_coordinates(PatchLayout(np.array([[[3.0, 0.0, 1.0]]]), np.array([[[0.0, 0.0, 0.0]]])))
