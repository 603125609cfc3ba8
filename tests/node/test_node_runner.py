"""Nodes on a bus, driven by the thread: a manager of another make talks to them."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Iterator

import can
import canopen
import numpy as np
import pytest

from skinnode.config import BusConfig
from skinnode.errors import BusError
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import NmtState, NodeRunner, PatchNode
from skinnode.node.pacing import THRIFTY
from skinnode.protocol.eds_files import eds_text
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort
from skinnode.transport.frame import Frame

WAIT_S = 5.0


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) == before


class Steady:
    def __init__(self, layout: PatchLayout) -> None:
        self.ohm = np.full(layout.shape, 1234.5)
        self.error: Exception | None = None

    def read(self, t_ns: int) -> Float:
        if self.error is not None:
            raise self.error
        return self.ohm


@pytest.fixture(params=["virtual", "udp_multicast"])
def config(request: pytest.FixtureRequest, multicast_group: str) -> BusConfig:
    channel = multicast_group if request.param == "udp_multicast" else uuid.uuid4().hex
    return BusConfig(interface=request.param, channel=channel)


@pytest.fixture
def virtual() -> BusConfig:
    return BusConfig(channel=uuid.uuid4().hex)


def nodes_on(port: CanPort, layout: PatchLayout, *ids: int) -> list[PatchNode]:
    return [PatchNode(i, layout, Steady(layout), send=port.send, serial=100 + i) for i in ids]


def eventually(holds: Callable[[], bool]) -> None:
    """Wait, within a bounded time."""
    end_s = time.monotonic() + WAIT_S
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def collect(bus: can.BusABC, done: Callable[[list[can.Message]], bool]) -> list[can.Message]:
    """Frames until ``done`` says so, within a bounded time."""
    messages: list[can.Message] = []
    end_s = time.monotonic() + WAIT_S
    while not done(messages):
        message = bus.recv(0.1)
        if message is not None:
            messages.append(message)
        assert time.monotonic() < end_s, [str(m) for m in messages]
    return messages


def test_python_can_only(config: BusConfig, layout: PatchLayout, plain_bus) -> None:
    """Boot-up, SDO, start, SYNC, chunks, summary, heartbeat: two nodes, raw frames."""
    with plain_bus(config) as manager, CanPort(config) as port:
        nodes = nodes_on(port, layout, 4, 5)
        with NodeRunner(port, nodes) as runner:

            def send(can_id: int, data: str) -> None:
                payload = bytes.fromhex(data)
                manager.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=payload))

            def from_nodes(messages: list[can.Message], *ids: int) -> list[can.Message]:
                return [m for m in messages if m.arbitration_id in ids]

            boots = collect(manager, lambda ms: len(from_nodes(ms, 0x704, 0x705)) == 2)
            assert [(m.arbitration_id, bytes(m.data)) for m in from_nodes(boots, 0x704, 0x705)] == [
                (0x704, b"\0"),
                (0x705, b"\0"),
            ]
            send(0x605, "40 18 10 04 00 00 00 00")
            answer = collect(manager, lambda ms: bool(from_nodes(ms, 0x585)))
            assert bytes(from_nodes(answer, 0x585)[0].data) == bytes.fromhex("43 18 10 04 69 00 00 00")
            send(0x604, "2b 17 10 00 32 00 00 00")  # heartbeat each 50 ms
            send(0x000, "01 00")
            send(0x080, "")
            ids = {0x184: 4, 0x185: 4, 0x284: 1, 0x285: 1}
            frames = collect(
                manager,
                lambda ms: (
                    len(from_nodes(ms, *ids)) == sum(ids.values())
                    and any(m.data == b"\x05" for m in from_nodes(ms, 0x704))
                ),
            )
            assert {i: len(from_nodes(frames, i)) for i in ids} == ids
            for node_id in (4, 5):
                chunks = from_nodes(frames, 0x180 + node_id)
                assert [bytes(m.data[:2]) for m in chunks] == [bytes((i, 0)) for i in range(4)]
            assert not runner.failed
        assert [node.nmt_state for node in nodes] == [NmtState.INITIALISING] * 2
        while manager.recv(0.0) is not None:
            pass
        send(0x604, "40 00 10 00 00 00 00 00")
        heard = manager.recv(0.15)
        while heard is not None and heard.arbitration_id not in (0x584, 0x704):
            heard = manager.recv(0.05)  # udp_multicast hands a sender its own frame
        assert heard is None


def test_canopen_library_as_manager(virtual: BusConfig, layout: PatchLayout, tmp_path) -> None:
    with CanPort(virtual) as port:
        nodes = nodes_on(port, layout, 4)
        eds = tmp_path / "patch.eds"
        eds.write_text(eds_text(nodes[0].profile), encoding="ascii")
        network = canopen.Network()
        network.connect(interface="virtual", channel=virtual.channel)
        try:
            remote = network.add_node(4, str(eds))
            with NodeRunner(port, nodes):
                # The library's own waiting functions miss what arrives before they are called.
                eventually(lambda: remote.nmt.state == "PRE-OPERATIONAL")
                assert remote.sdo[0x1000].raw == 0
                assert remote.sdo[0x1018][4].raw == 104
                assert remote.sdo[0x1008].raw == "skinnode patch"
                assert remote.sdo[0x2200][1].raw == 1234.5
                assert len(remote.sdo[0x2300].data) > 100
                with pytest.raises(canopen.SdoAbortedError) as caught:
                    remote.sdo[0x1018][4].raw = 1
                assert caught.value.code == 0x06010002
                remote.sdo[0x1017].raw = 30
                remote.nmt.state = "OPERATIONAL"
                remote.nmt.wait_for_heartbeat(WAIT_S)
                assert remote.nmt.state == "OPERATIONAL"

                # The TPDO as the library decodes it, by the mapping it reads from the node itself.
                remote.tpdo.read()
                assert [v.name for v in remote.tpdo[2].map][:2] == [
                    "Scan summary.Summary scan counter",
                    "Scan summary.Flags",
                ]
                received = threading.Event()
                remote.tpdo[2].add_callback(lambda _: received.set())
                network.sync.transmit()
                assert received.wait(WAIT_S)
                assert remote.tpdo[2][2].raw == 4  # chunks sent

                # Remapping by the library's own procedure.
                remote.tpdo[2].clear()
                remote.tpdo[2].add_variable(0x1001)
                remote.tpdo[2].add_variable(0x2011, 1)
                remote.tpdo[2].trans_type = 1
                remote.tpdo[2].enabled = True
                remote.tpdo[2].save()
                received.clear()
                network.sync.transmit()
                assert received.wait(WAIT_S)
                assert len(remote.tpdo[2].data) == 2
                remote.nmt.state = "RESET"
                eventually(lambda: remote.nmt.state == "PRE-OPERATIONAL")
        finally:
            network.disconnect()


def test_canopen_library_configures_spare_pdos(virtual: BusConfig, layout: PatchLayout, tmp_path) -> None:
    """Its own procedure, for a TPDO by SYNC, one by event timer and an RPDO; its own decoding."""
    with CanPort(virtual) as port:
        nodes = nodes_on(port, layout, 4)
        eds = tmp_path / "patch.eds"
        eds.write_text(eds_text(nodes[0].profile), encoding="ascii")
        network = canopen.Network()
        network.connect(interface="virtual", channel=virtual.channel)
        try:
            remote = network.add_node(4, str(eds))
            with NodeRunner(port, nodes):
                eventually(lambda: remote.nmt.state == "PRE-OPERATIONAL")
                remote.tpdo.read()
                remote.rpdo.read()
                codes, errors, mode = remote.tpdo[3], remote.tpdo[4], remote.rpdo[2]
                for pdo, kind, variables in (
                    (codes, 1, [(0x2100, 1), (0x2100, 6), (0x2101, 1), (0x2101, 6)]),
                    (errors, 255, [(0x1001, 0), (0x2011, 1)]),
                    (mode, 255, [(0x2020, 1)]),
                ):
                    pdo.clear()
                    for index, subindex in variables:
                        pdo.add_variable(index, subindex)
                    pdo.trans_type = kind
                    pdo.event_timer = 20 if pdo is errors else None
                    pdo.enabled = True
                    pdo.save()
                received = {pdo: threading.Event() for pdo in (codes, errors)}
                for pdo, event in received.items():
                    pdo.add_callback(lambda _, event=event: event.set())
                remote.nmt.state = "OPERATIONAL"
                assert received[errors].wait(WAIT_S)
                assert [v.raw for v in errors] == [0, 0]
                network.sync.transmit()
                assert received[codes].wait(WAIT_S)
                assert [v.raw for v in codes] == [49149] * 4  # R/R0 = 1
                mode[0].raw = 1
                mode.transmit()
                eventually(lambda: remote.sdo[0x2020][1].raw == 1)
                codes.clear()
                for _ in range(5):
                    codes.add_variable(0x2100, 1)
                with pytest.raises(canopen.SdoAbortedError) as caught:
                    codes.save()
                assert caught.value.code == 0x06040042
        finally:
            network.disconnect()


def test_canopen_library_guards_a_node_and_tells_it_the_time(
    virtual: BusConfig, layout: PatchLayout, tmp_path
) -> None:
    with CanPort(virtual) as port:
        nodes = nodes_on(port, layout, 4)
        eds = tmp_path / "patch.eds"
        eds.write_text(eds_text(nodes[0].profile), encoding="ascii")
        network = canopen.Network()
        network.connect(interface="virtual", channel=virtual.channel)
        try:
            remote = network.add_node(4, str(eds))
            answers: list[int] = []
            network.subscribe(0x704, lambda _id, data, _time: answers.append(data[0]))
            with NodeRunner(port, nodes):
                eventually(lambda: remote.nmt.state == "PRE-OPERATIONAL")
                remote.sdo[0x100C].raw = 100
                remote.sdo[0x100D].raw = 10
                remote.nmt.state = "OPERATIONAL"
                remote.nmt.start_node_guarding(0.02)
                eventually(lambda: len(answers) >= 5)
                assert answers[:5] == [0x00, 0x05, 0x85, 0x05, 0x85]  # boot-up first
                assert remote.nmt.state == "OPERATIONAL"
                assert remote.emcy.log == []
                remote.nmt.stop_node_guarding()
                eventually(lambda: bool(remote.emcy.active))
                assert [(e.code, e.register) for e in remote.emcy.active] == [(0x8130, 0x11)]
                remote.nmt.start_node_guarding(0.02)
                eventually(lambda: not remote.emcy.active)
                assert remote.nmt.state == "PRE-OPERATIONAL"
                remote.nmt.stop_node_guarding()

                remote.sdo[0x1012].raw = 0x8000_0100
                moment_s = 1_700_000_000.25  # 2023-11-14 22:13:20.25 UTC
                network.time.transmit(moment_s)
                eventually(lambda: remote.sdo[0x2022][3].raw == 1)
                days, ms = remote.sdo[0x2022][1].raw, remote.sdo[0x2022][2].raw
                told_s = 441_763_200 + days * 86_400 + ms / 1000  # 1984-01-01 in Unix time
                assert moment_s <= told_s < moment_s + WAIT_S
        finally:
            network.disconnect()


def test_a_node_survives_its_source(virtual: BusConfig, layout: PatchLayout) -> None:
    """From power-on without a converter to the first scan with one: emergencies, no silence."""
    with CanPort(virtual) as port, can.Bus(interface="virtual", channel=virtual.channel) as manager:
        source = Steady(layout)
        source.error = OSError("no converter")
        node = PatchNode(4, layout, source, send=port.send)
        with NodeRunner(port, [node]) as runner:

            def send(can_id: int, data: str) -> None:
                payload = bytes.fromhex(data)
                manager.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=payload))

            told = collect(manager, lambda ms: len(ms) == 2)
            assert [m.arbitration_id for m in told] == [0x704, 0x084]
            send(0x000, "01 00")
            send(0x080, "")
            (summary,) = collect(manager, lambda ms: len(ms) == 1)
            assert (summary.arbitration_id, bytes(summary.data)[1:4]) == (0x284, b"\x30\0\0")
            source.error = None
            send(0x080, "")
            frames = collect(manager, lambda ms: bool(ms) and ms[-1].arbitration_id == 0x284)
            assert [m.arbitration_id for m in frames] == [0x084] + [0x184] * 4 + [0x284]
            assert not runner.failed
        assert (node.source_failures, node.source_error) == (2, "source.read(): OSError: no converter")


def test_bus_that_refuses_frames_for_a_while(virtual: BusConfig, layout: PatchLayout) -> None:
    """A full transmit queue costs frames, not the node."""
    with CanPort(virtual) as port, CanPort(virtual) as manager:
        refuse = threading.Event()
        refused = threading.Event()

        def send(can_id: int, data: bytes) -> None:
            if refuse.is_set():
                refused.set()
                raise BusError("can0: no buffer space available")
            port.send(can_id, data)

        with NodeRunner(port, [PatchNode(4, layout, Steady(layout), send=send)]) as runner:
            assert manager.recv(WAIT_S) is not None
            refuse.set()
            manager.send(0x604, bytes.fromhex("4000100000000000"))
            assert refused.wait(WAIT_S)
            refuse.clear()
            manager.send(0x604, bytes.fromhex("4000100000000000"))
            frame = manager.recv(WAIT_S)
            assert frame is not None
            assert frame.can_id == 0x584
            assert runner.bus_errors >= 1


def test_bus_that_goes_away_and_comes_back(virtual: BusConfig, layout: PatchLayout) -> None:
    """Off to the node: error behaviour at once, 0x8140 as soon as there is somebody to tell."""
    with CanPort(virtual) as port, CanPort(virtual) as manager:
        gone = threading.Event()

        def send(can_id: int, data: bytes) -> None:
            if gone.is_set():
                raise BusError("can0: network is down")
            port.send(can_id, data)

        def heard() -> list[tuple[int, str]]:
            frame = manager.recv(0.01)
            return [] if frame is None else [(frame.can_id, frame.data.hex(" "))]

        node = PatchNode(4, layout, Steady(layout), send=send)
        with NodeRunner(port, [node]):
            manager.send(0x604, bytes.fromhex("2b17100001000000"))  # a heartbeat each ms
            manager.send(0x000, bytes((1, 0)))
            eventually(lambda: (0x704, "05") in heard())
            gone.set()
            eventually(lambda: node.nmt_state is NmtState.PRE_OPERATIONAL)
            gone.clear()
            eventually(lambda: (0x084, "40 81 11 00 00 00 00 00") in heard())
            manager.send(0x000, bytes((1, 0)))
            eventually(lambda: (0x704, "05") in heard())


def test_two_short_faults_far_apart_are_not_a_bus_that_is_off(
    virtual: BusConfig, layout: PatchLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames that got through in between end the first fault, however many the node has heard by then."""
    monkeypatch.setattr("skinnode.node.runner.OFF_AFTER_S", 0.3)
    with CanPort(virtual) as port, CanPort(virtual) as manager:
        refused: list[bytes] = []
        refuse = threading.Event()

        def send(can_id: int, data: bytes) -> None:
            if refuse.is_set():
                refuse.clear()
                refused.append(data)
                raise BusError("can0: no buffer space available")
            port.send(can_id, data)

        def ask(times: int) -> None:
            for _ in range(times):
                manager.send(0x604, bytes.fromhex("4000100000000000"))

        def answered(times: int) -> None:
            for _ in range(times):
                frame = manager.recv(WAIT_S)
                assert frame is not None
                assert frame.can_id == 0x584

        node = PatchNode(4, layout, Steady(layout), send=send)
        with NodeRunner(port, [node]) as runner:
            boot_up = manager.recv(WAIT_S)
            assert boot_up is not None
            assert boot_up.can_id == 0x704
            manager.send(0x000, bytes((1, 0)))
            for _ in range(3):
                manager.send(0x7F0, b"")  # heard, and not answered
            refuse.set()
            ask(1)
            eventually(lambda: len(refused) == 1)
            ask(2)
            answered(2)
            time.sleep(0.4)  # longer than a bus that is off takes to be called that
            refuse.set()
            ask(1)
            eventually(lambda: len(refused) == 2)
            ask(1)
            answered(1)
            assert runner.bus_errors == 2
            assert node.nmt_state is NmtState.OPERATIONAL
            assert manager.recv(0.05) is None  # no emergency


def test_the_thread_waits_for_its_timers_and_does_not_turn_idly(
    virtual: BusConfig, layout: PatchLayout
) -> None:
    """Beats of 10 ms of a thrifty node: the thread wakes once for each, up to 2 ms late, and never early."""
    turns: list[None] = []

    class Counted(CanPort):
        def recv(self, timeout_s: float) -> Frame | None:
            turns.append(None)
            return super().recv(timeout_s)

    with Counted(virtual) as port, CanPort(virtual) as manager:
        node = PatchNode(4, layout, Steady(layout), send=port.send, pacing=THRIFTY)
        with NodeRunner(port, [node]):
            manager.send(0x604, bytes.fromhex("2b1710000a000000"))
            beats = 0
            end_s = time.monotonic() + WAIT_S
            while beats < 30:
                frame = manager.recv(0.1)
                beats += frame is not None and (frame.can_id, frame.data) == (0x704, b"\x7f")
                assert time.monotonic() < end_s
        assert len(turns) < 3 * beats + 10


@pytest.mark.parametrize("heartbeat", ["05 00", "c8 00"])  # 5 ms; 200 ms, with turns of nothing between
def test_bus_that_is_away_for_long_is_opened_anew(
    virtual: BusConfig, layout: PatchLayout, monkeypatch: pytest.MonkeyPatch, heartbeat: str
) -> None:
    """An adapter that is pulled and plugged in again is another one: it takes frames when it is opened."""
    monkeypatch.setattr("skinnode.node.runner.REOPEN_S", 0.3)
    there, tries = threading.Event(), []

    class Adapter(CanPort):
        gone = False

        def send(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
            if self.gone:
                raise BusError("can0: no such device")
            super().send(can_id, data)

        def reopen(self) -> None:
            tries.append(time.monotonic())
            if not there.is_set():
                raise BusError("can0: does not open")
            super().reopen()
            self.gone = False

    with Adapter(virtual) as port, CanPort(virtual) as manager:

        def heard() -> list[tuple[int, str]]:
            frame = manager.recv(0.01)
            return [] if frame is None else [(frame.can_id, frame.data.hex(" "))]

        node = PatchNode(4, layout, Steady(layout), send=port.send)
        with NodeRunner(port, [node]) as runner:
            manager.send(0x604, bytes.fromhex(f"2b171000 {heartbeat} 0000"))
            manager.send(0x000, bytes((1, 0)))
            eventually(lambda: (0x704, "05") in heard())
            port.gone = True
            eventually(lambda: node.nmt_state is NmtState.PRE_OPERATIONAL)
            eventually(lambda: len(tries) >= 3)
            assert runner.bus_error == "can0: no such device"
            there.set()
            eventually(lambda: (0x084, "40 81 11 00 00 00 00 00") in heard())
            eventually(lambda: (0x704, "7f") in heard())


def test_heartbeats_that_came_while_the_thread_was_kept_busy_were_not_missed(
    virtual: BusConfig, layout: PatchLayout
) -> None:
    class Slow(Steady):
        def __init__(self, layout: PatchLayout) -> None:
            super().__init__(layout)
            self.reading, self.go_on = threading.Event(), threading.Event()
            self.go_on.set()

        def read(self, t_ns: int) -> Float:
            self.reading.set()
            assert self.go_on.wait(WAIT_S)
            return super().read(t_ns)

    with CanPort(virtual) as port, CanPort(virtual) as manager:
        source = Slow(layout)
        node = PatchNode(4, layout, source, send=port.send)
        heard: list[tuple[int, str]] = []

        def listen() -> list[tuple[int, str]]:
            while (frame := manager.recv(0.0)) is not None:
                heard.append((frame.can_id, frame.data.hex(" ")))
            return heard

        with NodeRunner(port, [node]):
            eventually(lambda: (0x704, "00") in listen())
            manager.send(0x604, bytes.fromhex("2316100190017f00"))  # node 127 within 400 ms
            manager.send(0x000, bytes((1, 0)))
            source.reading.clear()
            source.go_on.clear()
            manager.send(0x77F, b"\x05")
            manager.send(0x080, b"")
            assert source.reading.wait(WAIT_S)
            for _ in range(12):
                time.sleep(0.05)
                manager.send(0x77F, b"\x05")
            source.go_on.set()
            manager.send(0x604, bytes.fromhex("4000100000000000"))
            eventually(lambda: (0x584, "43 00 10 00 00 00 00 00") in listen())
            assert [data for can_id, data in listen() if can_id == 0x084] == []
            eventually(lambda: (0x084, "30 81 11 7f 00 00 00 00") in listen())  # it did listen


def test_frames_that_are_not_classic_data_are_no_frames_to_a_node(
    virtual: BusConfig, layout: PatchLayout
) -> None:
    with (
        can.Bus(interface="virtual", channel=virtual.channel) as manager,
        CanPort(virtual) as port,
        NodeRunner(port, nodes_on(port, layout, 4)),
    ):
        assert manager.recv(WAIT_S) is not None
        request = bytes.fromhex("4000100000000000")
        for options in (
            {"is_extended_id": True},
            {"is_extended_id": False, "is_fd": True},
            {"is_extended_id": False, "is_error_frame": True},
        ):
            manager.send(can.Message(arbitration_id=0x604, data=request, **options))
        manager.send(can.Message(arbitration_id=0x604, is_extended_id=False, is_remote_frame=True, dlc=8))
        assert manager.recv(0.1) is None
        manager.send(can.Message(arbitration_id=0x604, is_extended_id=False, data=request))
        answer = manager.recv(WAIT_S)
        assert answer is not None
        assert answer.arbitration_id == 0x584


def test_a_node_on_a_bus_of_can_fd(virtual: BusConfig, layout: PatchLayout) -> None:
    """Chunks are FD frames with bit-rate switch, and an RPDO may be one, padded as FD frames are."""
    config = virtual.model_copy(update={"fd": True})
    profile = PatchProfile.from_layout(layout, 16, "fd")
    with (
        can.Bus(interface="virtual", channel=virtual.channel) as manager,
        CanPort(config) as port,
        NodeRunner(port, [PatchNode(4, layout, Steady(layout), send=port.send, profile=profile)]) as runner,
    ):

        def send(can_id: int, data: str, *, fd: bool = False) -> None:
            payload = bytes.fromhex(data)
            message = can.Message(arbitration_id=can_id, is_extended_id=False, data=payload, is_fd=fd)
            manager.send(message)

        assert manager.recv(WAIT_S) is not None
        send(0x000, "01 00")
        send(0x080, "")
        messages = collect(manager, lambda ms: bool(ms) and ms[-1].arbitration_id == 0x284)
        shapes = [(m.arbitration_id, m.is_fd, m.bitrate_switch, m.dlc) for m in messages]
        assert shapes == [(0x184, True, True, 16)] * 2 + [(0x284, False, False, 8)]
        # five mapped bytes more than a classic frame has: 12 bytes in the frame
        send(0x604, "23 00 14 01 04 02 00 80")
        send(0x604, "2f 00 16 00 00 00 00 00")
        for slot in range(1, 12):
            send(0x604, f"23 00 16 {slot:02x} 08 01 20 20")  # send mode, again and again
        send(0x604, "2f 00 16 00 0b 00 00 00")
        send(0x604, "23 00 14 01 04 02 00 00")
        answers = collect(manager, lambda ms: len(ms) == 15)
        assert {bytes(m.data)[:1] for m in answers} == {b"\x60"}
        send(0x204, "01" * 11 + "00", fd=True)
        send(0x604, "40 20 20 01 00 00 00 00")
        (answer,) = collect(manager, lambda ms: len(ms) == 1)  # no EMCY: one byte of padding is no excess
        assert (answer.arbitration_id, bytes(answer.data)[4]) == (0x584, 1)
        assert not runner.failed


def test_nodes_must_differ(virtual: BusConfig, layout: PatchLayout) -> None:
    with CanPort(virtual) as port:
        with pytest.raises(ValueError, match=r"node-IDs \[4, 4\], must all be different"):
            NodeRunner(port, nodes_on(port, layout, 4, 4))
        with pytest.raises(ValueError, match="got none"):
            NodeRunner(port, [])


def test_stop_without_start(virtual: BusConfig, layout: PatchLayout) -> None:
    with CanPort(virtual) as port:
        NodeRunner(port, nodes_on(port, layout, 4)).stop()
