"""What the host asks of a node while it runs."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from skinnode.canopen.indices import LSS_REQUEST_COB_ID
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import BusError, NodeError
from skinnode.host import Condition, Host
from skinnode.process import clock
from skinnode.transport import CanPort

from .conftest import Rack, eventually, heard


@pytest.mark.long
def test_a_node_that_sends_scans_is_asked_nothing(hand: HandConfig, rack: Rack, listener: CanPort) -> None:
    """Its configuration is read back only if its scans stop: see 0.4 s in the remote node."""
    with Host.from_config(hand) as host:
        assert eventually(lambda: all(patch.solved > 2 for patch in host.stats().patches.values()))
        for _ in range(10):
            heard(listener)
            clock.sleep(0.7)
            traffic = {frame.can_id for frame in heard(listener)}
            if not {0x085, 0x086} & traffic:  # a node that was too slow for its scans is asked for its errors
                break
        assert {0x185, 0x186, 0x285, 0x286} <= traffic
        assert not {0x605, 0x606} & traffic
        assert {name: defects.count for name, defects in host.stats().defects.items() if defects.count} == {}


@pytest.mark.long
def test_the_configuration_of_a_node_that_sends_no_scan_is_read_back_once_a_second(
    hand: HandConfig, rack_of: Callable[[HandConfig], Rack], listener: CanPort
) -> None:
    """It is as it was set, so nothing is to be done about it."""
    rack, mute = rack_of(hand), clock.event()
    rack.plug("p0", lets_through=lambda can_id, data: not (mute.is_set() and can_id in (0x185, 0x285)))
    rack.plug("p1")
    with Host.from_config(hand) as host:
        assert host.fields(timeout_s=10, patch="p0").get(10) is not None
        heard(listener)
        mute.set()
        read: list[bytes] = []

        def reads() -> list[bytes]:
            read.extend(frame.data for frame in heard(listener) if frame.can_id == 0x605)
            return read

        overflow = bytes.fromhex("40 19 10 00 00 00 00 00")
        assert eventually(lambda: overflow in reads())
        clock.sleep(0.7)
        assert reads().count(overflow) == 1
        assert {data[0] for data in read} == {0x40}  # nothing is written
        assert host.stats().nodes["p0"].rejoins == 0


def test_a_search_that_the_bus_does_not_take_is_no_defect_of_the_host(
    hand: HandConfig, rack_of: Callable[[HandConfig], Rack]
) -> None:
    """The patch is waited for, as if the search had not found it."""
    table = hand.model_dump(mode="json")
    table["patches"][1]["serial"] = 0xCAFE
    hand = parse_hand({**table, "bring_up": {"missing": "wait"}})
    rack = rack_of(hand)
    rack.plug("p0")
    refused: list[int] = []

    class Full(CanPort):
        def send(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
            if can_id == LSS_REQUEST_COB_ID:
                refused.append(can_id)
                raise BusError("can0: 0x7E5 not sent (no buffer space)")
            super().send(can_id, data, remote=remote)

    with Host.from_config(hand, boot_deadline_s=0.2, open_port=Full) as host:
        assert refused
        assert host.fields(timeout_s=10, patch="p0").get(10) is not None
        assert host.health("p1").condition is Condition.NEVER_SEEN
        assert host.stats().defects["p1"].count == 0


@pytest.mark.long
def test_a_node_that_does_not_answer_when_it_comes_back_is_not_refused(
    hand: HandConfig, rack_of: Callable[[HandConfig], Rack]
) -> None:
    """Nothing is known against it; the reason says what is waited for."""
    hand = parse_hand({**hand.model_dump(mode="json"), "bring_up": {"missing": "wait"}})
    rack = rack_of(hand)
    rack.plug("p0")
    with Host.from_config(hand, boot_deadline_s=0.2) as host:
        rack.plug("p1", lets_through=lambda can_id, data: can_id != 0x586)
        assert eventually(lambda: host.stats().nodes["p1"].failures > 0)
        health = host.health("p1")
        assert (health.condition is Condition.REFUSED, health.refusal) == (False, None)
        assert "no response" in health.reason


def test_a_node_that_left_operational_is_not_tared(hand: HandConfig, rack: Rack) -> None:
    """It would not hear the command."""
    with Host.from_config(hand) as host:
        assert host.fields(timeout_s=10, patch="p0").get(10) is not None
        host._nodes["p0"].monitor.on_heartbeat(b"\x7f", clock.monotonic_ns())
        with pytest.raises(NodeError, match=r"patch 'p0' on can0: not tared: it is not operational$"):
            host.tare("p0", deadline_s=0.0)
