"""An SDO answer about another object than was asked for: somebody else has part in the talk."""

from __future__ import annotations

import pytest

from skinnode.errors import NodeError
from skinnode.host.sdo_client import RemoteOd, SkinNetwork


def test_answer_for_another_object_names_who_may_have_caused_it() -> None:
    def answer(can_id: int, data: bytes) -> None:
        if can_id == 0x605 and data[0] == 0x40:  # upload request: 0x1A00:3 comes, whatever was asked
            network.notify(0x585, bytearray.fromhex("43 00 1a 03 10 00 00 20"), 0.0)

    network = SkinNetwork(answer)
    with pytest.raises(NodeError) as caught:
        RemoteOd(network, 5).read(0x1A00, 4, "u32")
    assert str(caught.value) == (
        "node 5: read of object 0x1A00:4: got the response for another object; "
        "two nodes respond with node-ID 5, or another SDO client is using it"
    )
