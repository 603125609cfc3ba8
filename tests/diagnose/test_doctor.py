"""The doctor at work on simulated hands: what was broken is what it finds, and a hand that runs goes on."""

from __future__ import annotations

import html.parser
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinnode.canopen import indices as od
from skinnode.config import BusConfig, load_hand
from skinnode.diagnose import collect_facts, discovery
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.host import Host
from skinnode.process import clock
from skinnode.protocol.eds_files import eds_text
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet

from .conftest import LAYOUT, Done, Rest, run

SCANS = 25
"""Enough to judge noise that is a thousand times what it should be; the doctor takes more."""

HandFile = Callable[..., Path]
On = Callable[[Any], Any]


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes of these tests beat often, or not at all, and their faults are plain."""
    monkeypatch.setattr(discovery, "LISTEN_S", 0.5)
    monkeypatch.setattr(discovery, "PACE_S", 0.0001)
    monkeypatch.setattr(collect_facts, "SCANS", SCANS)


@pytest.fixture
def hand_file(hand_file: HandFile, on: On) -> HandFile:
    """At 40 scans a second, beside another device, without which no node could send its boot-up message."""

    def make(*arguments: Any) -> Path:
        file = hand_file(*arguments)
        file.write_text(file.read_text().replace("period_ms = 50", "period_ms = 25"))
        on(CanPort(load_hand(file).buses[0]))
        return file

    return make


def examine(file: Path, *options: str) -> tuple[int, dict[str, tuple[str, str]]]:
    """Exit status; findings as where: what to how sure and evidence. Those of timing and losses are the test
    machine's own: they are tested on facts made up."""
    clock.sleep(0.1)  # nodes that were just switched on have then sent their boot-up messages
    done = run(["doctor", file, "--json", *options])
    found = findings(done)
    return done.status if found else 0, found


def findings(done: Done) -> dict[str, tuple[str, str]]:
    told = done.json["findings"]
    found = [f for f in told if f["area"] not in ("timing", "losses") and "8110" not in f["evidence"]]
    found = [f for f in found if "overrun" not in f["evidence"]]
    return {f"{f['where']}: {f['what']}": (f["sure"], f["evidence"]) for f in found}


def test_a_healthy_hand(hand_file: HandFile, on: On) -> None:
    file = hand_file()
    on(Fleet(load_hand(file)))
    assert examine(file) == (0, {})
    assert examine(file, "--active") == (0, {})


@pytest.mark.long
def test_a_running_hand_is_judged_and_not_disturbed(hand_file: HandFile, on: On) -> None:
    file = hand_file()
    with file.open("a") as text:  # a machine that stands still for half a second loses no node
        text.write("[bring_up]\nheartbeat_ms = 500\n")
    hand = load_hand(file)
    on(Fleet(hand))
    host = on(Host.from_config(hand))
    listener = on(CanPort(hand.buses[0]))
    done = run(["doctor", file, "--json"])
    assert findings(done) == {}
    assert min(p["scans"] for p in done.json["buses"][0]["patches"].values()) >= SCANS
    written = []
    while (frame := listener.recv(0.0)) is not None:
        download = frame.can_id & 0x780 == 0x600 and frame.data[:1] and frame.data[0] & 0xE0 in (0x20, 0x00)
        if download or frame.can_id == od.NMT_COB_ID:
            written.append((hex(frame.can_id), frame.data.hex()))
    assert written == []
    for health in (host.health(patch.name) for patch in hand.patches):
        held_up = health.last_emergency == 0x8110  # the machine kept a simulated node from sending in time
        assert health.condition == "operational" or held_up
    assert {host.health(patch.name).rejoins for patch in hand.patches} == {0}


@pytest.mark.long
def test_scans_of_a_hand_with_a_long_sync_period_are_judged(
    hand_file: HandFile, on: On, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An open wire shows in a single scan, even if the time for several would be too long."""
    monkeypatch.setattr(collect_facts, "LONGEST_S", 0.4)
    file = hand_file()
    file.write_text(file.read_text().replace("period_ms = 25", "period_ms = 500"))
    on(Fleet(load_hand(file))).patches["thumb"].fault = _cut_wire
    done = run(["doctor", file, "--json", "--active"])
    assert "thumb: upper wires open: 2" in findings(done)


def _cut_wire(ohm: np.ndarray, t_ns: int) -> np.ndarray:
    ohm[2, :] = np.inf
    return ohm


def _short_crossing(ohm: np.ndarray, t_ns: int) -> np.ndarray:
    ohm[1, 3] = 0.0
    return ohm


def _noisy_wire(ohm: np.ndarray, t_ns: int) -> np.ndarray:
    ohm[:, 4] *= 1.0 + 3e-3 * np.random.default_rng(t_ns).standard_normal(len(ohm))
    return ohm


def _warm(ohm: np.ndarray, t_ns: int) -> np.ndarray:
    return 0.98 * ohm


THUMB_AND_INDEX = [
    (_cut_wire, "upper wires open: 2", "certain", _noisy_wire, "noise on lower wire 4", "likely"),
    (_short_crossing, "1 crossing shorted", "certain", _warm, "the baseline no longer", "likely"),
]


@pytest.mark.long
@pytest.mark.parametrize("faults", THUMB_AND_INDEX)
def test_faults_of_the_skin(hand_file: HandFile, on: On, faults: tuple[Any, ...]) -> None:
    fault, what, sure, other_fault, other_what, other_sure = faults
    file = hand_file()
    hand = load_hand(file)
    fleet = on(Fleet(hand))
    on(Host.from_config(hand))
    fleet.patches["thumb"].fault, fleet.patches["index"].fault = fault, other_fault
    status, found = examine(file)
    assert status == 1
    for name, expected, how_sure in (("thumb", what, sure), ("index", other_what, other_sure)):
        told = {key: value for key, value in found.items() if key.startswith(f"{name}: {expected}")}
        assert [value[0] for value in told.values()] == [how_sure]


@pytest.mark.long
def test_a_second_master(hand_file: HandFile, on: On) -> None:
    file = hand_file()
    hand = load_hand(file)
    on(Fleet(hand))
    on(Host.from_config(hand))
    other, over = on(CanPort(hand.buses[0])), clock.event()

    def command() -> None:
        number = 100
        while not over.wait(0.5 * hand.sync.period_s):
            number = number % 240 + 1
            other.send(od.SYNC_COB_ID, bytes((number,)))
            other.send(od.NMT_COB_ID, bytes((1, 77)))  # starts a node that there is not

    thread = clock.thread(command, "second master")
    thread.start()
    try:
        found = examine(file)[1]
    finally:
        over.set()
        thread.join()
    assert found["can0: two SYNC producers"][0] == "certain"
    assert "can0: another device sends NMT commands" in found


@pytest.mark.long
def test_another_layout_serial_and_eds(hand_file: HandFile, on: On, tmp_path: Path) -> None:
    right = hand_file()
    text = right.read_text()
    on(Fleet(load_hand(right)))
    eds, wrong = tmp_path / "other.eds", tmp_path / "wrong.toml"
    eds.write_text(eds_text(PatchProfile(5, 12, 4, 4)))
    text = text.replace('layout = { preset = "staggered"', 'layout = { preset = "aligned"', 1)
    wrong.write_text(text.replace("node_id = 5\n", 'node_id = 5\nserial = 99\neds = "other.eds"\n'))
    status, found = examine(wrong)
    assert status == 1
    assert found.keys() == {
        "thumb: the serial number differs from the hand file",
        "thumb: the EDS in the hand file describes another patch",
        "thumb: the layout differs from the hand file",
    }


def test_a_node_that_is_gone_and_a_bus_without_any(hand_file: HandFile, on: On) -> None:
    file = hand_file()
    hand = load_hand(file)
    assert examine(file)[1].keys() == {"can0: none of the hand's nodes answers"}
    on(Fleet(hand.model_copy(update={"patches": hand.patches[1:]})))
    assert examine(file)[1].keys() == {"thumb: the node is missing"}


@pytest.mark.system_time  # on a bus with exact times, the two answers collide
def test_two_nodes_with_one_node_id(hand_file: HandFile, on: On) -> None:
    file = hand_file()
    hand = load_hand(file)
    on(Fleet(hand))
    on(Fleet(hand.model_copy(update={"patches": hand.patches[:1]})))
    assert "thumb: two nodes have the patch's node-ID" in examine(file)[1]


def test_an_interface_that_does_not_open(hand_file: HandFile) -> None:
    file = hand_file()
    file.write_text(file.read_text().replace('"timed"', '"socketcan"'))
    status, found = examine(file)
    assert status == 1
    assert found.keys() == {"can0: the interface does not work"}


@pytest.mark.long
def test_chunks_too_far_apart(hand_file: HandFile, on: On) -> None:
    file = hand_file()
    hand = load_hand(file)
    on(Fleet(hand))
    bus = hand.buses[0]
    assert run(["od", "5", "1800:3", "--write", "100"], bus).status == 2  # only while it is off (CiA 301)
    assert run(["od", "5", "1800:1", "--write", "0x80000185"], bus).status == 0
    assert run(["od", "5", "1800:3", "--write", "100"], bus).status == 0
    status, found = examine(file)
    assert status == 1
    assert found["thumb: the chunk PDO (TPDO1) is not at its COB-ID"][1] == "off, expected 0x185"
    assert "160 ms; the period is 25 ms" in found["thumb: a scan takes longer than a SYNC period"][1]


@pytest.mark.long
@pytest.mark.real_time
def test_a_node_that_no_host_has_configured_is_no_fault(hand_file: HandFile, on: On) -> None:
    """Its default inhibit time suits the default period; bring-up writes one that suits the hand's period."""
    file = hand_file()
    file.write_text(file.read_text().replace("period_ms = 25", "period_ms = 10"))
    hand = load_hand(file)
    on(Fleet(hand))
    assert examine(file) == (0, {})
    late = {"a scan takes longer than a SYNC period", "scans end after the next scan has begun"}
    for _ in range(5):  # an inhibit time that is too long delays every scan; a busy machine delays some
        findings = run(["doctor", file, "--json", "--active"]).json["findings"]
        slow = [f for f in findings if f["what"] in late or "overrun" in f["evidence"]]
        if not slow:
            break
    assert not slow


@pytest.mark.long
def test_a_default_inhibit_time_is_a_fault_once_the_node_runs(hand_file: HandFile, on: On) -> None:
    """Another master may have started it without configuring it."""
    file = hand_file()
    file.write_text(file.read_text().replace("period_ms = 25", "period_ms = 10"))
    hand = load_hand(file)
    on(Fleet(hand))
    on(CanPort(hand.buses[0])).send(od.NMT_COB_ID, b"\x01\x05")
    found = examine(file)[1]
    assert "thumb: a scan takes longer than a SYNC period" in found
    assert "index: a scan takes longer than a SYNC period" not in found


class _Page(html.parser.HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.outside: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.outside += [value for name, value in attrs if name in ("src", "href") and value]


@pytest.mark.long
def test_the_report_needs_nothing_else(
    hand_file: HandFile, on: On, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    file, report = hand_file(), tmp_path / "report.html"
    fleet = on(Fleet(load_hand(file)))
    fleet.patches["index"].fault = _noisy_wire
    done = run(["doctor", file, "--active", "--html", report])
    assert done.status == 1
    assert max(map(len, done.stdout.splitlines())) <= 80
    page = _Page()
    page.feed(report.read_text())
    assert page.tags.count("svg") == 4  # maps and timeline of each patch
    assert not [address for address in page.outside if not address.startswith(("#", "data:"))]
    assert "index: noise on lower wire 4" in report.read_text()


@pytest.mark.long
def test_load_is_that_of_the_time_in_which_scans_came(
    hand_file: HandFile, on: On, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where they ended before the doctor did: a node that restarted sends none."""
    monkeypatch.setattr(collect_facts, "SCANS", 60)  # waited for twice as long, 3 s
    file = hand_file()
    fleet = on(Fleet(load_hand(file)))
    over = clock.event()

    def unplug() -> None:
        while fleet.injected("thumb").pdos < 120 and not over.wait(0.01):
            pass
        fleet.inject(Faults(unplugged=True))

    thread = clock.thread(unplug, "unplug")
    thread.start()
    done = run(["doctor", file, "--active", "--json"])
    over.set()
    thread.join()
    (bus,) = done.json["buses"]
    assert 0 < bus["patches"]["thumb"]["scans"] < 60
    assert bus["load"] > 0.01  # our SYNC alone takes 0.3 %


def test_a_report_that_cannot_be_written_is_known_first(hand_file: HandFile, tmp_path: Path) -> None:
    done = run(["doctor", hand_file(), "--html", tmp_path / "no" / "report.html"])
    assert done.status == 2
    assert "--html" in done.stderr


def test_on_every_interface_without_a_hand(any_bus: BusConfig, powered: Callable[..., Any]) -> None:
    skin = Rest(LAYOUT)
    powered(any_bus, 5, source=skin)
    skin.change = lambda ohm: 0.98 * ohm
    done = run(["doctor", "--active", "--json"], any_bus)
    assert done.status == 1
    found = {f"{f['where']}: {f['what']}": f["sure"] for f in done.json["findings"]}
    assert found["node 5: the baseline no longer matches the skin at rest"] == "likely"
    assert done.json["buses"][0]["patches"]["node 5"]["scans"] >= SCANS
    with BusConnection(any_bus) as connection:  # as it was before
        assert str(connection.state(5, 0, guarding=True)) == "pre-operational"
