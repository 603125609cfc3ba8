"""One lost frame, or a defect of ours, costs the patch, the bus or the subscriber that it was for, for as
long as it lasts: the others do not notice, and it comes back by itself."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from skinnode.bus_load.timing import BusLoad
from skinnode.cli._run_report import faults_and_notes
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import SkinError
from skinnode.host import Condition, Host, containment, retry_pause
from skinnode.host.code_watch import CodeWatch
from skinnode.host.containment import Defects, keep_on
from skinnode.host.health_watch import HealthWatch
from skinnode.host.node_monitor import NodeMonitor
from skinnode.host.remote_node import RemoteNode
from skinnode.host.retry_pause import Pause
from skinnode.host.scan_solver import ScanSolver
from skinnode.host.supervisor import Supervisor
from skinnode.process import clock
from skinnode.protocol.assembler import ScanAssembler
from skinnode.record import Recorder
from skinnode.transport import CanPort, Frame
from skinnode.transport.receiver import Intake, Receiver
from tests.lanes import some_long

from .conftest import SMALL, Rack, eventually
from .test_roles import changed


class Broken:
    """Raises in place of a method, for one patch, as long as it is ``on``."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, owner: type, name: str, concerns: Callable[[Any], bool]
    ) -> None:
        self.on, self.raised = False, 0
        original = getattr(owner, name)

        def broken(this: Any, *args: Any, **kwargs: Any) -> Any:
            if self.on and concerns(this):
                self.raised += 1
                raise ZeroDivisionError("of ours")
            return original(this, *args, **kwargs)

        monkeypatch.setattr(owner, name, broken)


def streams(host: Host, patch: str) -> bool:
    """Whether a field of a scan that begins from now on comes."""
    since_ns = clock.monotonic_ns()

    def came() -> bool:
        field = host.latest(patch)
        return field is not None and field.stamp is not None and field.stamp.t_sync_ns > since_ns

    return eventually(came)


def undisturbed(host: Host, patch: str) -> tuple[int, int]:
    """What grows where the host had to see to a patch."""
    stats = host.stats()
    return stats.nodes[patch].rejoins, stats.patches[patch].withheld


def is_end_of_block(can_id: int, data: bytes) -> bool:
    return can_id == 0x585 and data[0] & 0xE3 == 0xC1


def test_a_lost_end_of_a_block_read_in_bring_up(
    hand: HandConfig, rack_of: Callable[[HandConfig], Rack]
) -> None:
    rack, lost = rack_of(hand), list[bytes]()

    def lets_through(can_id: int, data: bytes) -> bool:
        if is_end_of_block(can_id, data) and not lost:
            lost.append(data)
            return False
        return True

    rack.plug("p0", lets_through=lets_through)
    rack.plug("p1")
    with Host.from_config(hand) as host:
        assert streams(host, "p0")
        assert streams(host, "p1")
        assert host.stats().defects["p0"].count == 0
    assert len(lost) == 1


def test_a_lost_summary_and_then_the_end_of_the_block_read_that_follows(
    hand: HandConfig, rack_of: Callable[[HandConfig], Rack]
) -> None:
    rack, lost = rack_of(hand), list[bytes]()
    armed = clock.event()

    def lets_through(can_id: int, data: bytes) -> bool:
        if not armed.is_set():
            return True
        if (can_id == 0x285 and not lost) or (is_end_of_block(can_id, data) and len(lost) == 1):
            lost.append(data)
            return False
        return True

    rack.plug("p0", lets_through=lets_through)
    rack.plug("p1")
    with Host.from_config(hand) as host:
        assert streams(host, "p0")
        before = undisturbed(host, "p1")
        armed.set()
        assert eventually(lambda: len(lost) == 2)
        assert streams(host, "p0")
        assert undisturbed(host, "p1") == before
        rack.pull("p1")  # supervision goes on
        rack.plug("p1")
        assert eventually(lambda: host.stats().nodes["p1"].rejoins == 1)
        assert streams(host, "p1")


def test_a_lost_start_command(hand: HandConfig, rack: Rack) -> None:
    class Lossy(CanPort):
        lost = 0

        def send(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
            if can_id == 0 and data == bytes([1, 5]) and not Lossy.lost:
                Lossy.lost += 1
                return
            super().send(can_id, data, remote=remote)

    with Host.from_config(hand, open_port=Lossy) as host:
        assert streams(host, "p0")
    assert Lossy.lost == 1


OF_PATCH: list[tuple[type, str, Callable[[Any], bool], str]] = [
    (ScanSolver, "solve", lambda this: this.facts.config.name == "p0", "solving"),
    (ScanAssembler, "on_chunk", lambda this: this._node_id == 5, "frame 0x185"),
    (ScanAssembler, "on_summary", lambda this: this._node_id == 5, "frame 0x285"),
    (NodeMonitor, "on_heartbeat", lambda this: this.node_id == 5, "frame 0x705"),
    (NodeMonitor, "said_since", lambda this: this.node_id == 5, "supervision"),
    (RemoteNode, "configure", lambda this: this.patch.name == "p0", "bring-up"),
]


@pytest.mark.long
@pytest.mark.parametrize(
    ("owner", "name", "concerns", "doing"),
    some_long(OF_PATCH, OF_PATCH[0], OF_PATCH[-1]),
    ids=[f"{o.__name__}.{n}" for o, n, _, _ in OF_PATCH],
)
def test_a_defect_in_serving_a_patch_costs_that_patch_while_it_lasts(
    hand: HandConfig,
    rack: Rack,
    listener: CanPort,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    owner: type,
    name: str,
    concerns: Callable[[Any], bool],
    doing: str,
) -> None:
    broken = Broken(monkeypatch, owner, name, concerns)
    with caplog.at_level(logging.DEBUG, containment.__name__), Host.from_config(hand) as host:
        events = host.events()
        assert streams(host, "p0")
        before = undisturbed(host, "p1")
        broken.on = True
        listener.send(0, bytes([0x81, 5]))  # has it brought up again, where nothing else meets the defect
        assert eventually(lambda: broken.raised >= 3)
        assert eventually(lambda: host.health("p0").condition is Condition.FAULTY)
        defect = f"{doing}: ZeroDivisionError: of ours"
        assert eventually(lambda: host.health("p0").defect == defect)
        assert eventually(lambda: host.stats().defects["p0"].count >= 3)
        assert streams(host, "p1")
        broken.on = False
        assert streams(host, "p0")
        assert eventually(lambda: host.health("p0").condition is Condition.OPERATIONAL)
        assert host.health("p0").defect is None
        assert any(line.startswith("p0: ") and line.endswith(defect) for line in faults_and_notes(host)[0])
        assert undisturbed(host, "p1") == before
        assert (host.stats().defects["p1"].count, host.stats().defects["host"].count) == (0, 0)
        told = [(event.subject, event.what, event.text) for event in iter(lambda: events.get(0.0), None)]
    assert ("p0", "faulty") in [event[:2] for event in told]
    assert any(event[:2] == ("p0", "defects") and event[2].endswith(defect) for event in told)
    lines = [record for record in caplog.records if defect in record.message]
    assert [record.levelno for record in lines] == [logging.WARNING, logging.DEBUG]
    assert lines[1].exc_info


@pytest.mark.long
def test_what_only_a_bring_up_mends_is_mended(
    hand: HandConfig, rack: Rack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every chunk meets a defect, those during the bring-up too, until the assembler is reset."""
    broken = Broken(monkeypatch, ScanAssembler, "on_chunk", lambda this: this._node_id == 5)
    reset = ScanAssembler.reset

    def mended(assembler: ScanAssembler, **options: bool) -> None:
        if assembler._node_id == 5 and broken.raised > 3:
            broken.on = False
        reset(assembler, **options)

    monkeypatch.setattr(ScanAssembler, "reset", mended)
    with Host.from_config(hand) as host:
        assert streams(host, "p0")
        broken.on = True
        assert eventually(lambda: broken.raised > 3)
        assert eventually(lambda: not broken.on)
        assert streams(host, "p0")


@pytest.mark.long
def test_a_patch_that_cannot_be_solved_is_brought_up_anew_ever_more_seldom(
    hand: HandConfig, rack: Rack, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: list[float] = []
    original = Pause.next_s

    def next_s(pause: Pause) -> float:
        taken = original(pause)
        if pause._longest_s == retry_pause.LONGEST_PAUSE_S:
            pauses.append(taken)
        return taken

    monkeypatch.setattr(Pause, "next_s", next_s)
    broken = Broken(monkeypatch, ScanSolver, "solve", lambda this: this.facts.config.name == "p0")
    with Host.from_config(hand) as host:
        assert streams(host, "p0")
        broken.on = True
        assert eventually(lambda: 1.0 in pauses, 20)
        assert streams(host, "p1")
        broken.on = False
        assert streams(host, "p0")
    assert pauses[:1] == [0.1]
    assert set(pauses) <= {0.1, 0.2, 0.4, 0.8, 1.0}


OF_HOST: list[tuple[type, str, str, str]] = [
    (BusLoad, "add_all", "can0", "counting frames|measuring the load"),
    (Receiver, "wait", "host", "the mainline"),
    (Intake, "take", "can0", "dispatching frames"),
    (CodeWatch, "on_scan", "p0", "polling"),
    (HealthWatch, "_compare_bus", "host", "watching the health"),
    (Supervisor, "_beat", "host", "supervision"),
]


@pytest.mark.parametrize(
    ("owner", "name", "subject", "doing"),
    some_long(OF_HOST, OF_HOST[0], OF_HOST[-1]),
    ids=[f"{o.__name__}.{n}" for o, n, _, _ in OF_HOST],
)
def test_a_defect_in_serving_a_bus_or_the_host_is_over_when_it_is_over(
    hand: HandConfig,
    rack: Rack,
    monkeypatch: pytest.MonkeyPatch,
    owner: type,
    name: str,
    subject: str,
    doing: str,
) -> None:
    broken = Broken(monkeypatch, owner, name, lambda this: True)
    with Host.from_config(hand) as host:
        events = host.events()
        assert streams(host, "p0")
        broken.on = True
        assert eventually(lambda: broken.raised >= 3)
        broken.on = False
        assert streams(host, "p0")
        assert streams(host, "p1")
        newest = host.stats().defects[subject].newest
        assert newest in [f"{one}: ZeroDivisionError: of ours" for one in doing.split("|")]
        assert eventually(
            lambda: any((event.subject, event.what) == (subject, "defects") for event in taken(events))
        )


def test_defects_of_a_bus_are_told_although_a_patch_has_its_name(
    make_hand: Callable[..., HandConfig],
    rack_of: Callable[[HandConfig], Rack],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hand = changed(make_hand(patches=1), patch={"name": "can0"})
    rack_of(hand).plug("can0")
    broken = Broken(monkeypatch, BusLoad, "add_all", lambda this: True)
    with Host.from_config(hand) as host:
        broken.on = True
        assert eventually(lambda: broken.raised >= 3)
        broken.on = False
        assert host.stats().defects["can0"].count >= 3
        assert any("defects in the host" in fault for fault in faults_and_notes(host)[0])


def taken(events: Any) -> Iterator[Any]:
    return iter(lambda: events.get(0.0), None)


@pytest.mark.long
def test_a_bus_whose_receiving_is_defective_is_opened_again(
    make_hand: Callable[..., HandConfig], rack_of: Callable[[HandConfig], Rack]
) -> None:
    class Defective(CanPort):
        due = 0

        def recv_batch(self, timeout_s: float, most: int = 1) -> list[Frame]:
            if Defective.due and self.config.name == "can0":
                Defective.due -= 1
                raise ZeroDivisionError("of ours")
            return super().recv_batch(timeout_s, most)

    table = make_hand().model_dump(mode="json")
    table["buses"] = [
        {"name": f"can{i}", "interface": "timed", "channel": f"{table['buses'][0]['channel']}-{i}"}
        for i in range(2)
    ]
    made = {"layout": SMALL, "tolerances": "exact"}
    table["patches"] = [{"name": f"p{i}", "node_id": 5, "bus": f"can{i}", **made} for i in range(2)]
    hand = parse_hand(table)
    rack = rack_of(hand)
    for name in ("p0", "p1"):
        rack.plug(name)
    with Host.from_config(hand, open_port=Defective) as host:
        events = host.events()
        assert streams(host, "p0")
        before = undisturbed(host, "p1")
        Defective.due = 3
        told: list[tuple[str, str]] = []

        def back() -> bool:
            told.extend((event.subject, event.what) for event in taken(events))
            return ("can0", "back") in told

        assert eventually(back)
        assert ("can0", "away") in told
        assert streams(host, "p0")
        assert undisturbed(host, "p1") == before
        stats = host.stats()
        assert stats.buses["can0"].outages >= 1
        assert stats.buses["can1"].outages == 0
        assert stats.defects["can0"].newest == "receiving: ZeroDivisionError: of ours"


def test_a_tap_that_raises_costs_itself(hand: HandConfig, rack: Rack, tmp_path: Path) -> None:
    class Bad(Recorder):
        def received(self, bus: str, frames: Sequence[Frame]) -> None:
            raise ZeroDivisionError("of the tap")

        def sent(self, bus: str, frame: Frame) -> None:
            raise ZeroDivisionError("of the tap")

    with Bad(hand, tmp_path / "run.log") as tap, Host.from_config(hand, tap=tap) as host:
        assert streams(host, "p0")
        assert host.stats().defects["host"].newest == "recording traffic: ZeroDivisionError: of the tap"
        assert host.stats().nodes["p0"].rejoins == 0


def test_an_entry_that_cannot_be_recorded_is_lost_and_counted(
    hand: HandConfig, rack: Rack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = Broken(monkeypatch, Recorder, "_write_frames", lambda this: True)
    with Recorder(hand, tmp_path / "run.log") as recorder, Host.from_config(hand, tap=recorder) as host:
        assert streams(host, "p0")
        broken.on = True
        assert eventually(lambda: broken.raised >= 3)
        broken.on = False
        written = recorder.stats().frames
        assert streams(host, "p0")
        assert eventually(lambda: recorder.stats().frames > written)
    stats = recorder.stats()
    assert stats.dropped >= broken.raised  # an entry contains one frame or more
    assert stats.failure is None


def test_a_subscriber_that_cannot_be_told_costs_itself(hand: HandConfig, rack: Rack) -> None:
    with Host.from_config(hand) as host:
        fields, others = host.fields(timeout_s=10), host.fields(timeout_s=10)

        def wake() -> None:
            raise ZeroDivisionError("of the loop")

        fields._wakers[wake] = wake
        for _, _ in zip(range(10), others, strict=False):
            pass
        newest = host.stats().defects["host"].newest
        assert newest == "passing a field to a subscriber: ZeroDivisionError: of the loop"
        assert host.stats().nodes["p0"].rejoins == 0


def test_pauses_grow_to_a_second_and_begin_anew_after_a_second_of_success(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = [100.0]
    monkeypatch.setattr(retry_pause.clock, "monotonic", lambda: now_s[0])
    pause, pauses = Pause(), []
    for _ in range(6):
        pauses.append(pause.next_s())
        now_s[0] += pauses[-1] + 0.5  # tried, and failed soon after
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]
    now_s[0] += 0.6
    assert pause.next_s() == 0.1


def test_a_loop_goes_on_until_it_says_so_whatever_it_raises() -> None:
    failures: list[SkinError] = []
    turns = iter([True, RuntimeError("a"), RuntimeError("a"), True, ValueError("b\n  c"), False])

    def turn() -> bool:
        outcome = next(turns)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    defects = Defects("thumb", failures.append)
    keep_on(turn, defects, "something")
    assert [str(failure) for failure in failures] == [
        "thumb: something: RuntimeError: a",
        "thumb: something: ValueError: b c",
    ]
    assert defects.stats() == containment.DefectStats(3, "something: ValueError: b c")


def test_a_log_that_raises_does_not_end_a_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(containment._log, "warning", fail)
    defects = Defects("thumb", fail)
    defects.report("something", RuntimeError("a"))
    assert defects.count == 1
