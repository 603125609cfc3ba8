"""A fleet seen from the bus, by a manager that knows nothing but frames."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable

import numpy as np
import pytest

from skinnode.config import BusConfig, HandConfig, parse_hand
from skinnode.errors import BusError, ConfigError
from skinnode.model.forward import resistance_ohm
from skinnode.node import NmtState
from skinnode.protocol.chunk import unpack_chunk
from skinnode.protocol.codes import CodeScale, encode
from skinnode.protocol.device_time import restore_time_us
from skinnode.protocol.summary import unpack_summary
from skinnode.transport import CanPort, Frame
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

SHAPE = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
PATIENCE_S = 10.0


def hand(*, buses: int = 1, patches: int = 2, **simulation: object) -> HandConfig:
    run = uuid.uuid4().hex[:8]
    return parse_hand(
        {
            "buses": [
                {"name": f"can{i}", "interface": "virtual", "channel": f"{run}-{i}"} for i in range(buses)
            ],
            "patches": [
                {"name": f"p{i}", "node_id": 5 + i, "bus": f"can{i % buses}", "layout": SHAPE}
                for i in range(patches)
            ],
            "simulation": {"seed": 2, **simulation},
        }
    )


class Manager:
    """Frames in and out of one bus."""

    def __init__(self, bus: BusConfig) -> None:
        self.port = CanPort(bus)
        self.frames: list[Frame] = []

    def __enter__(self) -> Manager:
        return self

    def __exit__(self, *_: object) -> None:
        self.port.close()

    def until(self, done: Callable[[list[Frame]], bool]) -> list[Frame]:
        """Frames from the last call on until ``done`` with them."""
        frames: list[Frame] = []
        end = time.monotonic() + PATIENCE_S
        while not done(frames):
            assert time.monotonic() < end, f"waited in vain; got {frames[-5:]}"
            frame = self.port.recv(0.05)
            if frame is not None:
                frames.append(frame)
        return frames

    def booted(self, *node_ids: int) -> None:
        self.until(
            lambda frames: {0x700 + n for n in node_ids} <= {f.can_id for f in frames if f.data == b"\0"}
        )

    def scan(self, *node_ids: int) -> list[Frame]:
        """A SYNC and everything up to the last of the nodes' summaries."""
        self.port.send(0x080, b"")
        return self.until(lambda frames: {0x280 + n for n in node_ids} <= {f.can_id for f in frames})


def codes_of(frames: list[Frame], node_id: int, shape: tuple[int, int]) -> np.ndarray:
    codes = np.zeros(-(-shape[0] * shape[1] // 3) * 3, dtype=np.int64)
    for frame in frames:
        if frame.can_id == 0x180 + node_id:
            index, _, chunk = unpack_chunk(frame.data)
            codes[3 * index : 3 * index + 3] = chunk
    return codes[: shape[0] * shape[1]].reshape(shape)


def test_scans_on_the_bus_are_the_truth_in_codes() -> None:
    plan = hand(cycle_s=0.5)
    with Manager(plan.buses[0]) as manager, Fleet(plan) as fleet:
        manager.booted(5, 6)
        manager.port.send(0x000, b"\x01\x00")
        moved = 0.0
        end = time.monotonic() + 1.6  # the lead-in and into the first stroke of both
        while time.monotonic() < end:
            frames = manager.scan(5, 6)
            for node_id, name in ((5, "p0"), (6, "p1")):
                layout = plan.patch(name).layout.build()
                summary = next(unpack_summary(f.data) for f in frames if f.can_id == 0x280 + node_id)
                assert summary.chunks == 16
                now_us = time.monotonic_ns() // 1000
                truth = fleet.truth_m(name, restore_time_us(summary.device_time_us, now_us))
                rest = resistance_ohm(layout, layout.upper_m)
                expected = encode(resistance_ohm(layout, truth), rest, CodeScale(16))
                # noise of converter and baseline is a fifth of a code: rounding differs by one, rarely two
                got = codes_of(frames, node_id, layout.shape)
                assert np.abs(got - expected.astype(np.int64)).max() <= 2
                moved = max(moved, float(np.abs(truth - layout.upper_m).max()))
            time.sleep(0.03)
    assert moved > 50e-6


def test_counters_are_those_of_the_bus_and_a_tare_is_no_scan() -> None:
    plan = hand()
    with Manager(plan.buses[0]) as manager, Fleet(plan) as fleet:
        manager.booted(5, 6)
        before = fleet.report()
        assert [r.scans_sent for r in before] == [0, 0]
        assert {r.nmt_state for r in before} == {NmtState.PRE_OPERATIONAL}
        assert not any(
            patch.started for patch in fleet.patches.values()
        )  # the scene waits for the first scan
        manager.port.send(0x000, b"\x01\x00")
        frames = [frame for _ in range(3) for frame in manager.scan(5, 6)]
        after = fleet.report()
        assert fleet.injected("p0").pdos >= 3 * 17
        assert fleet.counts() == {"p0": {}, "p1": {}, "can0": {}}  # no faults
    assert [(r.patch, r.node_id, r.nmt_state, r.scans_sent) for r in after] == [
        ("p0", 5, NmtState.OPERATIONAL, 3),
        ("p1", 6, NmtState.OPERATIONAL, 3),
    ]
    for old, new in zip(before, after, strict=True):
        seen = [f for f in frames if f.can_id in (0x180 + new.node_id, 0x280 + new.node_id)]
        assert new.frames_sent - old.frames_sent >= len(seen) == 3 * 17


def test_a_scan_of_a_frozen_converter_has_the_truth_of_its_time() -> None:
    plan = hand(patches=1)
    with Manager(plan.buses[0]) as manager, Fleet(plan) as fleet:
        manager.booted(5)
        manager.port.send(0x000, b"\x01\x00")
        fleet.inject(Faults(frozen=True))
        for _ in range(2):
            summary = unpack_summary(manager.scan(5)[-1].data)
            device_us = restore_time_us(summary.device_time_us, time.monotonic_ns() // 1000)
            fleet.truth_m("p0", device_us)  # raises LookupError for a time that is not a scan's
            assert 0 <= device_us - fleet.patches["p0"].last_read_ns // 1000 + 63 < 64
    assert fleet.injected("p0").frozen >= 2


def test_truth_of_a_scan_nobody_sent() -> None:
    with Fleet(hand()) as fleet:
        with pytest.raises(LookupError, match="p1: no reading at device time 7"):
            fleet.truth_m("p1", 7)
        with pytest.raises(LookupError):
            fleet.truth_m("nobody", 7)


def test_leaving_ends_in_silence() -> None:
    plan = hand()
    threads = set(threading.enumerate())
    with Manager(plan.buses[0]) as manager:
        with Fleet(plan) as fleet:
            manager.booted(5, 6)
            manager.port.send(0x000, b"\x01\x00")
            manager.scan(5, 6)
        assert {r.nmt_state for r in fleet.report()} == {NmtState.INITIALISING}
        while manager.port.recv(0.05) is not None:
            pass
        manager.port.send(0x080, b"")
        assert manager.port.recv(0.2) is None
    assert set(threading.enumerate()) == threads


def test_patches_sit_on_their_own_buses() -> None:
    plan = hand(buses=2, patches=3)
    with Manager(plan.buses[0]) as first, Manager(plan.buses[1]) as second, Fleet(plan) as fleet:
        first.booted(5, 7)
        second.booted(6)
        for manager in (first, second):
            manager.port.send(0x000, b"\x01\x00")
        assert {f.can_id & 0x7F for f in first.scan(5, 7)} == {5, 7}
        assert {f.can_id & 0x7F for f in second.scan(6)} == {6}
        assert not fleet.failed


@pytest.mark.long
def test_all_buses_stop_at_the_same_time() -> None:
    """A node thread notices the end within 0.1 s; ten threads, one after the other, would take a second."""
    with VirtualClock() as virtual:
        fleet = Fleet(hand(buses=10, patches=10).on("timed", None))
        fleet.start()
        before_ns = virtual.now_ns
        fleet.stop()
        assert virtual.now_ns - before_ns <= 100_000_000
        fleet.stop()


def test_a_bus_that_does_not_open_leaves_nothing_running() -> None:
    plan = hand(buses=2)
    threads = set(threading.enumerate())
    bad = plan.model_copy(
        update={"buses": (plan.buses[0], plan.buses[1].model_copy(update={"interface": "no-such-thing"}))}
    )
    fleet = Fleet(bad)
    with pytest.raises(BusError, match="no-such-thing"):
        fleet.start()
    assert set(threading.enumerate()) == threads
    with pytest.raises(ConfigError, match="--channel"):
        Fleet(plan, channel="other")


def test_a_patch_without_checks_must_exist() -> None:
    with pytest.raises(ConfigError, match="unchecked: got 'p7', allowed: a patch of the hand: p0, p1"):
        Fleet(hand(), unchecked=["p0", "p7"])
