"""A recording, and its replay with the recorded timing, in virtual time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import skinnode as sk
from skinnode.config import BusConfig, HandConfig, parse_hand
from skinnode.errors import BusError, ConfigError
from skinnode.process import clock
from skinnode.transport import CanPort
from skinnode.transport.frame_log_reader import FrameLogReader
from vcan_sim.fleet import Fleet
from vcan_sim.recording import FAULTS, SCENE, TRACE, TRUTH, Recording
from vcan_sim.replay import FROM_NODES, Replayed, channels_in, replay, trace_of
from vcan_sim.scenes import parse_scene
from vcan_sim.tally import kind_of
from vcan_sim.timed_bus import BitRates
from vcan_sim.timed_interface import segment
from vcan_sim.trace import Trace
from vcan_sim.virtual_time import READINGS, VirtualClock

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
SCENE_OF_TEST = parse_scene(
    {
        "bodies": [{"name": "ball", "shape": "sphere", "radius_m": 0.004}],
        "touches": [
            {
                "body": "ball",
                "patch": "palm",
                "at_m": [0.006, 0.006],
                "depth_m": 1e-4,
                "from_s": 0.5,
                "to_s": 1.5,
            }
        ],
        "faults": [{"where": "palm", "fault": "lost=0.5", "from_s": 1.0, "to_s": 1.5}],
    }
)


def hand(interface: str = "timed") -> HandConfig:
    return parse_hand(
        {
            "buses": [{"name": "left hand", "interface": interface, "channel": "can0"}],
            "patches": [
                {"name": "palm", "node_id": 4, "bus": "left hand", "layout": SMALL, "tolerances": "exact"}
            ],
            "sync": {"period_ms": 20},
        }
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, dict[int, Any]]:
    """A recording of three seconds, the trace of the bus itself, and the truth of each field of the host."""
    folder = tmp_path_factory.mktemp("recordings") / "run"
    truths = {}
    with VirtualClock() as time:
        trace = Trace(segment("can0", time, BitRates(1_000_000)))
        fleet = Fleet(hand(), scene=SCENE_OF_TEST)
        with (
            Recording(folder, fleet, SCENE_OF_TEST) as recording,
            fleet,
            sk.Host.from_config(hand()) as host,
        ):
            fields = host.fields(timeout_s=5)
            for _ in range(100):
                field = fields.get()
                assert field.stamp is not None
                truths[field.stamp.device_time_us] = fleet.truth("palm", field.stamp.device_time_us)
                recording.poll()
            clock.sleep(1.0)
    return folder, trace.text(), truths


@pytest.mark.long
def test_the_trace_is_that_of_the_bus(recorded: tuple[Path, str, Any]) -> None:
    folder, text, _ = recorded
    found, expected = (folder / TRACE).read_text().split(), text.replace(" can0 ", " left_hand ").split()
    assert [found[i::3] for i in (1, 2)] == [expected[i::3] for i in (1, 2)]
    for one, two in zip(found[::3], expected[::3], strict=True):  # a received frame's time is rounded
        assert float(one.strip("()")) == pytest.approx(float(two.strip("()")), abs=1.5e-6, rel=0)
    assert channels_in(folder / TRACE) == ["left_hand"]


@pytest.mark.long
def test_the_truth_of_each_scan(recorded: tuple[Path, str, dict[int, Any]]) -> None:
    folder, _, truths = recorded
    with np.load(folder / TRUTH) as file:
        found = dict(file)
    assert sorted(found) == [
        "palm device_time_us", "palm displacement_m", "palm time_ns", "palm wrench"
    ]  # fmt: skip
    rows = {int(us) // 64: row for row, us in enumerate(found["palm device_time_us"])}
    pressed = 0
    for device_time_us, truth in truths.items():
        row = rows[device_time_us // 64]
        np.testing.assert_allclose(found["palm displacement_m"][row], truth.displacement_m, atol=1e-10)
        np.testing.assert_array_equal(found["palm wrench"][row], truth.wrench)
        pressed += bool(truth.contacts)
    assert pressed > 30
    assert (np.diff(found["palm time_ns"]) > 0).all()


@pytest.mark.long
def test_the_faults_and_the_scene(recorded: tuple[Path, str, Any]) -> None:
    folder = recorded[0]
    lines = [json.loads(line) for line in (folder / FAULTS).read_text().splitlines()]
    assert [(line["scene_s"], line["place"], line["fault"], line["value"], line["on"]) for line in lines] == [
        (1.0, "palm", "lost", 0.5, True),
        (1.5, "palm", "lost", 0.5, False),
    ]
    assert lines[1]["time_s"] - lines[0]["time_s"] == pytest.approx(0.5)
    again = parse_scene(json.loads((folder / SCENE).read_text()))
    assert again.model_dump() == SCENE_OF_TEST.model_dump()


def play(folder: Path, **options: Any) -> tuple[Replayed, list[Any]]:
    """Replay in virtual time; also the trace of the bus."""
    with VirtualClock() as time:
        trace = Trace(segment("can0", time, BitRates(1_000_000)))
        bus = hand().buses[0]
        with CanPort(bus) as port, CanPort(bus):
            wait = clock.event().wait
            done = replay(FrameLogReader(folder / TRACE), {"left_hand": port}, wait=wait, **options)
            clock.sleep(0.1)
    file = folder.parent / "replayed.log"
    file.write_text(trace.text())
    return done, list(FrameLogReader(file))


def test_a_replay_has_the_recorded_timing(recorded: tuple[Path, str, Any]) -> None:
    folder = recorded[0]
    done, frames = play(folder)
    originals = list(FrameLogReader(folder / TRACE))
    assert (done.sent, done.left_out, done.refused) == (len(originals), 0, 0)
    assert [(f.frame.can_id, f.frame.data) for f in frames] == [
        (f.frame.can_id, f.frame.data) for f in originals
    ]
    shifts = np.array([f.frame.t_ns for f in frames]) - np.array([f.frame.t_ns for f in originals])
    assert np.ptp(shifts) < 150_000  # ns: a frame is sent when it had ended
    assert done.seconds == pytest.approx((originals[-1].frame.t_ns - originals[0].frame.t_ns) * 1e-9)


def test_a_replay_of_the_nodes_alone(recorded: tuple[Path, str, Any]) -> None:
    done, frames = play(recorded[0], from_nodes=True)
    originals = list(FrameLogReader(recorded[0] / TRACE))
    kinds = [kind_of(f.frame.can_id, f.frame.data) for f in originals]
    assert done.sent == len(frames) == sum(kind in FROM_NODES for kind in kinds)
    assert done.left_out == len(originals) - done.sent > 0


def test_a_replay_hears_a_full_bus_without_polling(recorded: tuple[Path, str, Any]) -> None:
    """An endpoint that takes thousands of waiting frames is not taken for one that polls."""
    with VirtualClock() as time:
        bus = hand().buses[0]
        with CanPort(bus) as sender, CanPort(bus) as reader:
            for _ in range(READINGS // 2):
                sender.send(0x123, b"")
            clock.sleep(2.0)
            begin_ns, frames = time.now_ns, 0
            while reader.recv(0.0) is not None:
                frames += 1
            assert (frames, time.now_ns) == (READINGS // 2, begin_ns)


def test_a_replay_can_be_stopped(recorded: tuple[Path, str, Any]) -> None:
    with VirtualClock(), CanPort(hand().buses[0]) as port, CanPort(hand().buses[0]):
        done = replay(FrameLogReader(recorded[0] / TRACE), {"left_hand": port}, wait=lambda _: True)
    assert done.sent == 1


def test_what_cannot_be_recorded_or_replayed(tmp_path: Path) -> None:
    plan = hand("virtual")
    with pytest.raises(ConfigError, match=r"--record: .*a new folder"), Recording(tmp_path, Fleet(plan)):
        pass
    with pytest.raises(ConfigError, match=r"RECORDING: .*or a trace"):
        trace_of(tmp_path)
    empty = tmp_path / "trace.log"
    empty.write_text("nothing\n")
    assert trace_of(tmp_path) == empty
    with pytest.raises(ConfigError, match="at least one frame"):
        channels_in(empty)


def test_a_bus_that_cannot_be_opened_leaves_no_folder(tmp_path: Path) -> None:
    plan, folder = hand("virtual"), tmp_path / "run"
    closed = plan.on("timed", None)  # needs virtual time
    scene = parse_scene({"faults": [{"where": "palm", "fault": "silent"}]})
    for _ in range(2):
        with pytest.raises(BusError), Recording(folder, Fleet(closed), scene):
            pass
        assert not folder.exists()
    with Recording(folder, Fleet(plan)):
        pass
    assert trace_of(folder).read_text() == ""


def test_a_fleet_that_does_not_start_leaves_no_folder(tmp_path: Path) -> None:
    plan, folder = hand("virtual"), tmp_path / "run"
    closed = Fleet(plan.on("timed", None))  # needs virtual time
    for _ in range(2):
        with pytest.raises(BusError), Recording(folder, Fleet(plan)), closed:
            pass
        assert not folder.exists()


FOREIGN = """(1.000000) can0 00000123#00
(1.000000) can0 18FF0104#00
(1.000000) can0 20000004#0000000000000000
(1.000000) can0 184##1000000000000000000000000
(1.000100) can0 704#05
(1.000200) can1 704#05
"""
"""Two extended frames, an error frame, a CAN FD frame, a classic frame, and a frame of another bus."""


@pytest.mark.parametrize(("fd", "sent"), [(False, [0x704]), (True, [0x184, 0x704])])
@pytest.mark.parametrize("from_nodes", [False, True])
def test_frames_that_cannot_be_sent_are_left_out(
    tmp_path: Path, fd: bool, sent: list[int], from_nodes: bool
) -> None:
    file = tmp_path / "a.log"
    file.write_text(FOREIGN)
    bus = BusConfig(interface="virtual", channel=str(tmp_path), fd=fd)
    with CanPort(bus) as port, CanPort(bus) as reader:
        done = replay(FrameLogReader(file), {"can0": port}, wait=lambda _: False, from_nodes=from_nodes)
        assert (done.sent, done.left_out) == (len(sent), 6 - len(sent))
        heard = [reader.recv(1.0) for _ in sent]
    assert [frame and frame.can_id for frame in heard] == sent
