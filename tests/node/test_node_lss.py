"""A node is given its node-ID and bit rate: on a desk, by the canopen library, and by python-can alone."""

from __future__ import annotations

import functools
import random
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import can
import canopen
import canopen.lss
import numpy as np
import pytest

from skinnode.config import BusConfig
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NOT_CONFIGURED, FileMemory, NmtState, NodeRunner, PatchNode, VolatileMemory
from skinnode.node.memory import Kept
from skinnode.protocol.eds_files import eds_text
from skinnode.transport import CanPort
from skinnode.transport.bus_state import BusState

MS = 1_000_000
ON, OFF = "04 01 00 00 00 00 00 00", "04 00 00 00 00 00 00 00"
DONE = [(0x7E4, "11 00 00 00 00 00 00 00")]
WAIT_S = 5.0


class TestOnADesk:
    @pytest.fixture
    def blank(self, make: Callable):
        return make(node_id=NOT_CONFIGURED, memory=VolatileMemory())

    def test_without_a_node_id_there_is_lss_and_nothing_else(self, blank) -> None:
        desk = blank
        desk.node.power_off()
        desk.power_on()
        assert desk.take() == []  # no boot-up message
        assert desk.node.nmt_state is NmtState.INITIALISING
        for can_id in (0x000, 0x080, 0x67F, 0x6FF, 0x600, 0x7FF, 0x2FF):
            for data in ("", "01 00", "81 00", "82 00", "40 00 10 00 00 00 00 00"):
                assert desk.frame(can_id, data) == []
        desk.run(1000)
        assert desk.take() == []
        assert desk.frame(0x7E5, "4c 00 00 00 00 00 00 00") == [(0x7E4, "50 00 00 00 00 00 00 00")]

    def test_it_boots_when_it_has_a_node_id_and_is_let_go(self, blank) -> None:
        desk = blank
        desk.frame(0x7E5, ON)
        assert desk.frame(0x7E5, "11 09 00 00 00 00 00 00") == DONE
        assert desk.frame(0x7E5, OFF) == [(0x709, "00")]
        assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL
        assert desk.node.node_id == 9
        assert desk.read(0x1200, 1) == 0x609
        assert desk.read(0x1200, 2) == 0x589
        assert desk.read(0x1014, 0) == 0x089
        assert desk.read(0x1800, 1) == 0x189
        desk.start()
        desk.node.on_frame(0x80, b"", desk.t_ns)
        desk.run(100)
        assert {can_id for can_id, _ in desk.take()} == {0x189, 0x289}

    @pytest.mark.parametrize("command", ["82 00", "82 04"])
    def test_another_node_id_counts_from_the_reset_on(self, desk, command: str) -> None:
        desk.frame(0x7E5, ON)
        assert desk.frame(0x7E5, "11 09 00 00 00 00 00 00") == DONE
        assert desk.frame(0x7E5, OFF) == []
        assert desk.read(0x1200, 1) == 0x604
        assert desk.frame(0, command) == [(0x709, "00")]
        assert desk.read(0x1200, 1) == 0x609
        assert desk.read(0x1800, 1) == 0x189
        assert desk.frame(0x604, "40 00 10 00 00 00 00 00") == []

    @pytest.mark.parametrize("kept", [None, 9])
    def test_reset_node_takes_the_stored_node_id(self, make: Callable, kept: int | None) -> None:
        """The persistent node-ID becomes the pending one; what was configured and never stored is lost."""
        desk = make(memory=VolatileMemory())
        desk.frame(0x7E5, ON)
        if kept is not None:
            desk.frame(0x7E5, f"11 {kept:02x} 00 00 00 00 00 00")
            assert desk.frame(0x7E5, "17 00 00 00 00 00 00 00") == [(0x7E4, "17 00 00 00 00 00 00 00")]
        desk.frame(0x7E5, "11 0a 00 00 00 00 00 00")
        desk.frame(0x7E5, OFF)
        booted = kept or 4
        assert (0x700 + booted, "00") in desk.frame(0, "81 00")
        assert desk.frame(0, "82 00") == [(0x700 + booted, "00")]  # nothing is pending any more

    def test_reset_node_after_reset_communication_takes_the_stored_node_id(self, desk) -> None:
        desk.frame(0x7E5, ON)
        desk.frame(0x7E5, "11 0a 00 00 00 00 00 00")
        assert desk.frame(0, "82 00") == [(0x70A, "00")]
        assert desk.frame(0, "81 00") == [(0x704, "00")]

    def test_a_node_id_can_be_taken_away(self, desk) -> None:
        desk.frame(0x7E5, ON)
        desk.frame(0x7E5, "11 ff 00 00 00 00 00 00")
        assert desk.frame(0, "82 00") == []
        assert desk.node.nmt_state is NmtState.INITIALISING
        assert desk.frame(0x604, "40 00 10 00 00 00 00 00") == []
        assert desk.frame(0x7E5, "4c 00 00 00 00 00 00 00") == [(0x7E4, "50 00 00 00 00 00 00 00")]

    @pytest.mark.parametrize("state", ["01", "02", "80"])
    def test_lss_is_there_in_every_nmt_state(self, desk, state: str) -> None:
        desk.frame(0, f"{state} 00")
        desk.frame(0x7E5, ON)
        assert desk.frame(0x7E5, "5e 00 00 00 00 00 00 00") == [(0x7E4, "5e 04 00 00 00 00 00 00")]

    def test_reset_communication_ends_the_configuration_state(self, desk) -> None:
        desk.frame(0x7E5, ON)
        desk.frame(0, "82 00")
        assert desk.frame(0x7E5, "5e 00 00 00 00 00 00 00") == []

    def test_identity_is_that_of_object_1018(self, make: Callable) -> None:
        desk = make(serial=0x0102_0304)
        desk.frame(0x7E5, ON)
        for command, subindex in (("5a", 1), ("5b", 2), ("5c", 3), ("5d", 4)):
            value = desk.read(0x1018, subindex).to_bytes(4, "little").hex(" ")
            answer = desk.frame(0x7E5, f"{command} 00 00 00 00 00 00 00")
            assert answer == [(0x7E4, f"{command} {value} 00 00 00")]

    def test_stored_configuration_survives(self, layout, blank) -> None:
        desk = blank
        desk.frame(0x7E5, ON)
        desk.frame(0x7E5, "11 09 00 00 00 00 00 00")
        desk.node.power_off()
        desk.power_on()
        assert desk.take() == []  # was not stored
        desk.frame(0x7E5, ON)
        desk.frame(0x7E5, "11 09 00 00 00 00 00 00")
        assert desk.frame(0x7E5, "17 00 00 00 00 00 00 00") == [(0x7E4, "17 00 00 00 00 00 00 00")]
        desk.node.power_off()
        desk.power_on()
        assert desk.take() == [(0x709, "00")]

    def test_without_a_memory_nothing_can_be_stored(self, desk) -> None:
        desk.frame(0x7E5, ON)
        assert desk.frame(0x7E5, "17 00 00 00 00 00 00 00") == [(0x7E4, "17 01 00 00 00 00 00 00")]

    def test_storage_that_fails(self, make: Callable, tmp_path: Path) -> None:
        desk = make(memory=FileMemory(tmp_path / "no such folder" / "n"))
        desk.frame(0x7E5, ON)
        assert desk.frame(0x7E5, "17 00 00 00 00 00 00 00") == [(0x7E4, "17 02 00 00 00 00 00 00")]

    def test_stored_cob_ids_follow_the_node_id(self, make: Callable) -> None:
        """A COB-ID that was the default one is the default one of the next node-ID; another stays."""
        desk = make(memory=VolatileMemory())
        desk.write(0x1801, 1, 0x8000_0284, 4)  # TPDO2 off, its CAN-ID untouched
        desk.write(0x1800, 1, 0x8000_0184, 4)
        desk.write(0x1800, 1, 0x1B5, 4)
        desk.write(0x1010, 1, int.from_bytes(b"save", "little"), 4)
        desk.frame(0x7E5, ON)
        desk.frame(0x7E5, "11 09 00 00 00 00 00 00")
        desk.frame(0, "82 00")
        assert desk.read(0x1801, 1) == 0x8000_0289
        assert desk.read(0x1800, 1) == 0x1B5
        assert desk.read(0x1014, 0) == 0x089

    def test_frames_of_other_lengths(self, desk) -> None:
        for length in (0, 1, 7):
            assert desk.frame(0x7E5, "04 01 00 00 00 00 00 00"[: 3 * length]) == []
        assert desk.frame(0x7E5, "5e 00 00 00 00 00 00 00") == []  # still waiting

    @pytest.mark.long
    def test_whatever_comes(self, blank) -> None:
        """Requests right and wrong, resets and power cycles in any order: the node-ID is always one that was
        asked for, and boot-up messages name it."""
        desk, chance = blank, random.Random(5)
        asked = {NOT_CONFIGURED}
        booted = 0
        for _ in range(20_000):
            kind = chance.random()
            if kind < 0.02:
                desk.node.power_off()
                desk.power_on()
                frames = desk.take()
            elif kind < 0.04:
                frames = desk.frame(0, f"{chance.choice((0x81, 0x82)):02x} 00")
            else:
                command = chance.choice(
                    (0x04, 0x04, 0x11, 0x13, 0x15, 0x17, 0x4C, 0x51, chance.randrange(256))
                )
                argument = chance.choice((0, 1, chance.randrange(256)))
                data = bytes((command, argument)) + bytes(chance.choice((6, 6, 6, 5)))
                if command == 0x11 and len(data) == 8:
                    asked.add(argument)
                frames = desk.frame(0x7E5, data.hex())
            assert len(frames) <= 1
            for can_id, data_hex in frames:
                booted += can_id != 0x7E4
                assert can_id == 0x7E4 or (can_id, data_hex) == (0x700 + desk.node.node_id, "00")
            assert desk.node.node_id in asked & {*range(1, 128), NOT_CONFIGURED}
        assert booted > 100


class TestBitRate:
    def test_changes_between_two_delays_of_silence(self, make: Callable) -> None:
        rates: list[tuple[int, int]] = []
        desk = make(memory=VolatileMemory(), set_bit_rate=lambda bps: rates.append((bps, desk.t_ns)))
        desk.write(0x1017, 0, 10, 2)
        start_ns = desk.t_ns
        desk.frame(0x7E5, ON)
        assert desk.frame(0x7E5, "13 00 03 00 00 00 00 00") == [(0x7E4, "13 00 00 00 00 00 00 00")]
        assert rates == []
        assert desk.frame(0x7E5, "15 64 00 00 00 00 00 00") == []  # 100 ms
        desk.run(99)
        assert rates == []
        assert desk.frame(0x604, "40 00 10 00 00 00 00 00") == []
        desk.run(100)
        assert rates == [(250_000, start_ns + 100 * MS)]
        assert desk.take() == []  # no heartbeat either
        desk.run(1)
        assert desk.take() != []
        assert desk.sdo("40 00 10 00 00 00 00 00") == "43 00 10 00 00 00 00 00"

    def test_what_the_controller_says_in_between_is_told_afterwards(self, make: Callable) -> None:
        """While the nodes of a bus change their bit rates one after the other, errors are likely."""
        desk = make(set_bit_rate=lambda _: None)
        desk.frame(0x7E5, ON)
        desk.frame(0x7E5, "13 00 03 00 00 00 00 00")
        desk.frame(0x7E5, "15 64 00 00 00 00 00 00")  # 100 ms
        desk.run(150)
        desk.node.on_bus(BusState.PASSIVE, desk.t_ns)
        desk.run(49)
        assert desk.take() == []
        desk.run(1)
        assert desk.take() == [(0x084, "20 81 11 00 00 00 00 00")]

    def test_delay_of_nothing(self, make: Callable) -> None:
        rates: list[int] = []
        desk = make(set_bit_rate=rates.append)
        desk.frame(0x7E5, ON)
        desk.frame(0x7E5, "13 00 04 00 00 00 00 00")
        desk.frame(0x7E5, "15 00 00 00 00 00 00 00")
        desk.run(0)
        assert rates == [125_000]
        assert desk.sdo("40 00 10 00 00 00 00 00") == "43 00 10 00 00 00 00 00"

    def test_stored_one_is_set_at_power_on(self, make: Callable) -> None:
        rates: list[int] = []
        desk = make(node_id=NOT_CONFIGURED, memory=VolatileMemory(), set_bit_rate=rates.append)
        desk.frame(0x7E5, ON)
        desk.frame(0x7E5, "13 00 02 00 00 00 00 00")
        desk.frame(0x7E5, "17 00 00 00 00 00 00 00")
        assert rates == []
        desk.node.power_off()
        desk.power_on()
        assert rates == [500_000]

    @pytest.mark.parametrize("timing", range(16))
    def test_the_eds_says_which(self, make: Callable, timing: int) -> None:
        desk = make(set_bit_rate=lambda _: None)
        desk.frame(0x7E5, ON)
        (answer,) = desk.frame(0x7E5, f"13 00 {timing:02x} 00 00 00 00 00")
        kbps = {0: 1000, 1: 800, 2: 500, 3: 250, 4: 125, 6: 50, 7: 20, 8: 10}.get(timing)
        supported = f"BaudRate_{kbps}=1\n" in eds_text(desk.node.profile)
        assert answer == (0x7E4, f"13 {int(not supported):02x} 00 00 00 00 00 00")


class TestTwoNodesWithOneId:
    """CiA 301 v4.2, table 26, has an emergency for it, 0x8150 CAN-ID collision, and no other consequence."""

    def test_boot_up_or_heartbeat_of_the_other_is_told_once(self, desk) -> None:
        assert desk.frame(0x704, "00") == [(0x084, "50 81 11 04 07 00 00 00")]
        assert desk.frame(0x704, "05") == []
        assert desk.node.nmt_state is NmtState.PRE_OPERATIONAL
        assert desk.read(0x1001, 0) == 0x11
        desk.frame(0, "82 00")
        assert desk.read(0x1001, 0) == 0
        assert desk.frame(0x704, "7f") == [(0x084, "50 81 11 04 07 00 00 00")]

    @pytest.mark.parametrize("period_ms", [0, 100, 250])
    def test_it_is_over_after_three_heartbeat_periods_without(self, desk, period_ms: int) -> None:
        desk.write(0x1017, 0, period_ms, 2)
        for _ in range(4):
            desk.frame(0x704, "05")
            desk.run(2.9 * (period_ms or 250))
        assert desk.read(0x1001, 0) == 0x11
        desk.take()
        desk.run(0.2 * (period_ms or 250))
        assert (0x084, "00 00 00 50 81 00 00 00") in desk.take()
        assert desk.read(0x1001, 0) == 0
        assert desk.frame(0x704, "05")[-1:] == [(0x084, "50 81 11 04 07 00 00 00")]  # it is there again

    def test_guarding_and_others_are_no_collision(self, desk) -> None:
        desk.frame(0x704, remote=True)
        desk.frame(0x705, "00")
        assert desk.read(0x1001, 0) == 0


# --- on a bus


@pytest.fixture
def bus() -> BusConfig:
    return BusConfig(channel=uuid.uuid4().hex)


class _Flat:
    def __init__(self, layout: PatchLayout) -> None:
        self.ohm: Float = np.full(layout.shape, 1000.0)

    def read(self, t_ns: int) -> Float:
        return self.ohm


@pytest.fixture
def network(bus: BusConfig, monkeypatch: pytest.MonkeyPatch) -> Iterator[canopen.Network]:
    """The canopen library as master. Its pauses for slow slaves, 10 and 200 ms after each frame, are left
    out, and silence, which is an answer in a fastscan, counts as such after 0.2 s."""
    monkeypatch.setattr(canopen.lss, "time", SimpleNamespace(sleep=lambda _: None))
    network = canopen.Network()
    network.connect(interface="virtual", channel=bus.channel)
    network.lss.RESPONSE_TIMEOUT = 0.2
    yield network
    network.disconnect()


def eventually(holds: Callable[[], bool]) -> None:
    end_s = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def test_canopen_library_finds_and_numbers_new_nodes(
    bus: BusConfig, network: canopen.Network, layout: PatchLayout
) -> None:
    """Fastscan among a configured node and two that are not, beside each other on one bus."""
    lss, memories = network.lss, [VolatileMemory(), VolatileMemory()]
    with CanPort(bus) as port:
        old = PatchNode(1, layout, _Flat(layout), send=port.send, serial=1)
        new = [
            PatchNode(NOT_CONFIGURED, layout, _Flat(layout), send=port.send, serial=serial, memory=memory)
            for serial, memory in zip((0x8000_0001, 0x2), memories, strict=True)
        ]
        with NodeRunner(port, [old, *new]):
            eventually(lambda: 1 in network.scanner.nodes)
            for node_id, serial in ((20, 0x2), (21, 0x8000_0001)):
                assert lss.fast_scan() == (True, [0, 0x534B494E, 0x10001, serial])
                assert lss.inquire_node_id() == NOT_CONFIGURED
                assert lss.inquire_lss_address(canopen.lss.CS_INQUIRE_SERIAL_NUMBER) == serial
                lss.configure_node_id(node_id)
                lss.store_configuration()
                lss.send_switch_state_global(lss.WAITING_STATE)
                eventually(functools.partial(network.scanner.nodes.__contains__, node_id))
            assert lss.fast_scan() == (False, None)
            for node_id, serial in ((20, 0x2), (21, 0x8000_0001)):
                remote = network.add_node(node_id, canopen.ObjectDictionary())
                assert remote.sdo.upload(0x1018, 4) == serial.to_bytes(4, "little")
    assert [kept.node_id for kept in map(_loaded, memories)] == [21, 20]


def _loaded(memory: VolatileMemory) -> Kept:
    kept = memory.load()
    assert kept is not None
    return kept


def test_canopen_library_configures_one_of_two(
    bus: BusConfig, network: canopen.Network, layout: PatchLayout
) -> None:
    lss = network.lss
    with CanPort(bus) as port:
        nodes = [
            PatchNode(i, layout, _Flat(layout), send=port.send, serial=0x100 + i, memory=VolatileMemory())
            for i in (4, 5)
        ]
        with NodeRunner(port, nodes):
            eventually(lambda: {4, 5} <= set(network.scanner.nodes))
            assert lss.send_switch_state_selective(0, 0x534B494E, 0x10001, 0x105)
            assert lss.inquire_node_id() == 5
            with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
                lss.configure_node_id(128)
            with pytest.raises(canopen.lss.LssError, match="LSS Error: 1"):
                lss.configure_bit_timing(0)  # a virtual bus has none
            lss.configure_node_id(50)
            lss.store_configuration()
            lss.send_switch_state_global(lss.WAITING_STATE)
            network.nmt.send_command(130)  # reset communication
            eventually(lambda: [node.node_id for node in nodes] == [4, 50])
            with pytest.raises(canopen.lss.LssError, match="No LSS response"):
                lss.send_switch_state_selective(0, 0x534B494E, 0x10001, 0x106)
            lss.send_switch_state_global(lss.CONFIGURATION_STATE)
            assert lss.inquire_node_id() in (4, 50)  # both answer, as after any global switch
            lss.send_switch_state_global(lss.WAITING_STATE)


def test_commissioning_with_python_can_alone(bus: BusConfig, layout: PatchLayout, tmp_path: Path) -> None:
    """A patch from the box: found, numbered, configured, saved, power cycled, and it measures."""
    path = tmp_path / "patch.json"

    def node(port: CanPort) -> PatchNode:
        memory = FileMemory(path)
        return PatchNode(NOT_CONFIGURED, layout, _Flat(layout), send=port.send, serial=7, memory=memory)

    with can.Bus(interface="virtual", channel=bus.channel) as master:

        def send(can_id: int, data: str, length: int = 8) -> None:
            payload = bytes.fromhex(data).ljust(length, b"\0")
            master.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=payload))

        def receive() -> tuple[int, str]:
            message = master.recv(WAIT_S)
            assert message is not None
            return message.arbitration_id, bytes(message.data).hex(" ")

        with CanPort(bus) as port, NodeRunner(port, [node(port)]):
            time.sleep(0.05)
            assert master.recv(0.0) is None  # it says nothing until it is asked
            send(0x7E5, "4c")
            assert receive() == (0x7E4, "50 00 00 00 00 00 00 00")
            for question in ("40", "41 4e 49 4b 53", "42 01 00 01", "43 07"):
                send(0x7E5, question)
            assert receive() == (0x7E4, "44 00 00 00 00 00 00 00")
            send(0x7E5, "11 2a")
            assert receive() == (0x7E4, "11 00 00 00 00 00 00 00")
            send(0x7E5, "17")
            assert receive() == (0x7E4, "17 00 00 00 00 00 00 00")
            send(0x7E5, "04 00")
            assert receive() == (0x72A, "00")
            send(0x62A, "2b 20 20 02 09 00")  # delta threshold of 9 codes
            assert receive() == (0x5AA, "60 20 20 02 00 00 00 00")
            send(0x62A, "23 10 10 01 73 61 76 65")
            assert receive() == (0x5AA, "60 10 10 01 00 00 00 00")

        with CanPort(bus) as port, NodeRunner(port, [node(port)]):  # another day
            assert receive() == (0x72A, "00")
            send(0x62A, "40 20 20 02")
            assert receive() == (0x5AA, "4b 20 20 02 09 00 00 00")
            send(0x000, "01 2a", 2)
            send(0x080, "", 0)
            frames = [receive() for _ in range(5)]
            assert [can_id for can_id, _ in frames] == [0x1AA] * 4 + [0x2AA]


def test_canopen_library_changes_the_bit_rate_of_an_interface(
    bus: BusConfig, network: canopen.Network, layout: PatchLayout
) -> None:
    """The node's own interface is opened anew at the new bit rate, also after a power cycle."""
    memory = VolatileMemory()

    def node(port: CanPort) -> PatchNode:
        source = _Flat(layout)
        return PatchNode(4, layout, source, send=port.send, memory=memory, set_bit_rate=port.set_bitrate)

    with CanPort(bus) as port, NodeRunner(port, [node(port)]):
        eventually(lambda: 4 in network.scanner.nodes)
        network.lss.send_switch_state_global(network.lss.CONFIGURATION_STATE)
        network.lss.configure_bit_timing(4)  # 125 kbit/s
        network.lss.store_configuration()
        assert port.config.bitrate_bps == 1_000_000
        network.lss.activate_bit_timing(10)
        eventually(lambda: port.config.bitrate_bps == 125_000)
        remote = network.add_node(4, canopen.ObjectDictionary())
        time.sleep(0.1)  # it keeps silent, and hears nothing, for another delay of 10 ms
        assert remote.sdo.upload(0x1000, 0) == bytes(4)
    with CanPort(bus) as port, NodeRunner(port, [node(port)]):
        eventually(lambda: port.config.bitrate_bps == 125_000)
