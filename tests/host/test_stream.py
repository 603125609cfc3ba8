"""A running hand on the real road: simulated front ends, the real node code, a virtual bus, the host."""

from __future__ import annotations

import gc
import logging
import uuid
import weakref
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack

import can
import numpy as np
import pytest

from skinnode.canopen.nmt import NmtState
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import ConfigError
from skinnode.host import Condition, Host, Subscription
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import FieldFrame, ScanStamp
from skinnode.model.layout import Float
from skinnode.node import NodeRunner, PatchNode
from skinnode.process import clock
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort
from vcan_sim.fleet import Fleet

from .conftest import SMALL, Rack, eventually, heard


def take(fields: Subscription, count: int) -> list[FieldFrame]:
    taken = []
    for field in fields:
        taken.append(field)
        if len(taken) == count:
            break
    return taken


def stamp(field: FieldFrame) -> ScanStamp:
    assert field.stamp is not None
    return field.stamp


def test_every_scan_from_the_first_on_every_patch(hand: HandConfig, fleet: Fleet) -> None:
    with Host.from_config(hand) as host:
        fields = take(host.fields(timeout_s=10, capacity=1000), 60)
        numbers = defaultdict(list)
        for field in fields:
            numbers[stamp(field).patch].append(stamp(field).scan)
        stats = host.stats()
        # The subscription began after the SYNC: what came before it is in the counters.
        for patch in ("p0", "p1"):
            between = numbers[patch][-1] + 1 - numbers[patch][0] - len(numbers[patch])
            assert numbers[patch] == sorted(set(numbers[patch]))
            assert between <= stats.patches[patch].skipped  # overtaken while the machine stood still
    for stream in stats.patches.values():
        assembler = stream.assembler
        assert stream.skipped < stream.offered / 10
        assert assembler.scans_torn == assembler.scans_missed == assembler.chunks_lost == 0
        assert assembler.late == assembler.duplicates == assembler.resyncs == 0
        assert assembler.scans_complete == stream.offered
    assert (stats.buses["can0"].dropped, stats.buses["can0"].foreign) == (0, 0)


def test_one_number_names_one_instant_on_all_patches(hand: HandConfig, fleet: Fleet) -> None:
    with Host.from_config(hand) as host:
        fields = take(host.fields(timeout_s=10), 20)
    sync_of: dict[int, set[int]] = defaultdict(set)
    for field in fields:
        when = stamp(field)
        assert when.counter == (when.scan - 1) % 240 + 1
        assert 0 < when.t_sync_ns < when.t_receive_ns <= when.t_solved_ns
        sync_of[when.scan].add(when.t_sync_ns)
    assert all(len(times) == 1 for times in sync_of.values())


def test_field_agrees_with_the_truth_within_what_it_claims(make_hand: Callable[..., HandConfig]) -> None:
    """The simulator knows where the electrodes really are; the host knows nothing but the frames."""
    hand = make_hand(simulation={"cycle_s": 2.0})
    scores: list[float] = []
    with Fleet(hand) as fleet, Host.from_config(hand) as host:
        for field in host.fields(timeout_s=10, capacity=1000):
            if stamp(field).device_time_us == 0:  # its summary came too late: nobody knows when it was taken
                continue
            rest_m = hand.patch(stamp(field).patch).layout.build().upper_m
            truth_m = fleet.truth_m(stamp(field).patch, stamp(field).device_time_us) - rest_m
            if (
                np.abs(truth_m).max() > 50e-6
            ):  # at rest a code has no rounding error, and the claim is generous
                assert field.trusted
                error_m = field.displacement_m - truth_m
                assert np.abs(error_m).max() < 0.2 * np.abs(truth_m).max()
                scores.append(float(np.mean((error_m / field.displacement_std_m) ** 2)))
            if len(scores) == 60:
                break
    # Normalised errors of a Gaussian have RMS 1; over these many, which hang together, about 1 ± 0.1.
    assert 0.7 < float(np.sqrt(np.mean(scores))) < 1.4


@pytest.mark.long
def test_discs_reduce_the_error_of_a_noisy_patch() -> None:
    """The key ``solver.prior`` of the hand file reaches the solver."""
    error_m = {}
    patch = {"name": "p0", "node_id": 5, "relative_noise": 1e-3, "tolerances": "exact"}
    for prior in ("cells", "discs"):
        hand = parse_hand(
            {
                "buses": [{"name": "can0", "interface": "timed", "channel": uuid.uuid4().hex[:8]}],
                "patches": [patch],
                "solver": {"prior": prior, "past": "off"},
                "simulation": {"converter_noise": 1e-3, "depth": 0.3, "indenter_radius_m": 0.01},
            }
        )
        errors = []
        with Fleet(hand) as fleet, Host.from_config(hand) as host:
            rest_m = hand.patches[0].layout.build().upper_m
            for field in host.fields(timeout_s=10, capacity=1000):
                if stamp(field).device_time_us:
                    truth_m = fleet.truth_m("p0", stamp(field).device_time_us) - rest_m
                    if np.abs(truth_m).max() > 200e-6:
                        errors.append(float(np.sqrt(((field.displacement_m - truth_m) ** 2).mean())))
                if len(errors) == 6:
                    break
        error_m[prior] = float(np.median(errors))
    assert error_m["discs"] < 0.8 * error_m["cells"]


def test_latest_is_there_for_a_control_loop(hand: HandConfig, fleet: Fleet) -> None:
    with Host.from_config(hand) as host:
        assert eventually(lambda: host.latest("p0") is not None and host.latest("p1") is not None)
        first = host.latest("p1")
        assert first is not None
        assert stamp(first).patch == "p1"
        with pytest.raises(ValueError, match="patch: got 'p9', must be one of p0, p1"):
            host.latest("p9")


def test_loop_ends_with_the_host(hand: HandConfig, fleet: Fleet) -> None:
    seen: list[FieldFrame] = []
    with Host.from_config(hand) as host:
        fields = host.fields()
        reader = clock.thread(lambda: seen.extend(fields), "reader")
        reader.start()
        assert eventually(lambda: len(seen) > 3)
    reader.join(10)
    assert not reader.is_alive()


def test_host_is_freed_with_its_last_reference(hand: HandConfig, fleet: Fleet) -> None:
    with Host.from_config(hand) as host:
        fields = host.fields(timeout_s=10)
        take(fields, 4)
    gone = weakref.ref(host)
    del host
    gc.collect()
    assert gone() is None
    assert fields.dropped == 0  # a subscription outlives its host


def test_pdo_of_wrong_length_is_rejected_counted_and_said_once(
    hand: HandConfig, fleet: Fleet, listener: CanPort, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING), Host.from_config(hand) as host:
        take(host.fields(timeout_s=10), 4)
        for _ in range(3):
            listener.send(0x185, bytes.fromhex("00 01 02 03 04 05 06"))
        listener.send(0x286, b"")
        assert eventually(lambda: host.stats().buses["can0"].malformed == 4)
        take(host.fields(timeout_s=10), 4)  # it goes on
        stats = host.stats()
    line = "COB-ID 0x185: got 7 bytes (00 01 02 03 04 05 06), allowed: 8 bytes (chunk)"
    assert [str(error) for error in stats.malformed] == [line]
    assert stats.patches["p0"].assembler.bad_length == 3
    assert stats.patches["p1"].assembler.bad_length == 1
    assert [record.getMessage() for record in caplog.records] == [
        f"can0: {line}; further malformed frames with this COB-ID are counted but not logged",
        "can0: COB-ID 0x286: got 0 bytes (nothing), allowed: 8 bytes (scan summary); "
        "further malformed frames with this COB-ID are counted but not logged",
    ]


def test_foreign_and_remote_frames_do_no_harm(hand: HandConfig, fleet: Fleet, listener: CanPort) -> None:
    with Host.from_config(hand) as host:
        for _ in range(5):
            listener.send(0x3F0, b"abc")
        listener.send(0x185, b"", remote=True)
        assert eventually(lambda: host.stats().buses["can0"].foreign == 5)
        assert host.stats().buses["can0"].ignored == 1
        take(host.fields(timeout_s=10), 4)
        assert host.stats().buses["can0"].malformed == 0


def test_subscriber_that_does_not_read_costs_nobody_else(hand: HandConfig, fleet: Fleet) -> None:
    with Host.from_config(hand) as host:
        asleep, awake = host.fields(capacity=1), host.fields(timeout_s=10, capacity=1000)
        take(awake, 20)
        assert awake.dropped == 0
        assert asleep.dropped >= 19
        assert sum(patch.skipped for patch in host.stats().patches.values()) == 0


def test_silence_is_a_timeout_and_a_lost_patch(hand: HandConfig) -> None:
    with Fleet(hand) as fleet, Host.from_config(hand) as host:
        fields = host.fields(timeout_s=0.5)
        take(fields, 4)
        assert eventually(lambda: host.health("p0").condition is Condition.OPERATIONAL)
        fleet.stop()
        with pytest.raises(TimeoutError, match=r"^no field within 0\.5 s$"):
            take(fields, 1000)
        assert eventually(lambda: host.health("p0").condition is Condition.LOST)


@pytest.mark.long
def test_node_that_restarts_by_itself(hand: HandConfig, rack: Rack, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), Host.from_config(hand) as host:
        take(host.fields(timeout_s=10), 4)
        boot_ups = host.health("p1").boot_ups
        rack.pull("p1")
        rack.plug("p1")
        assert eventually(lambda: host.health("p1").boot_ups == boot_ups + 1)
        assert eventually(lambda: host.health("p0").condition is Condition.OPERATIONAL)
        assert eventually(lambda: host.health("p1").rejoins == 1)
        take(host.fields(timeout_s=10, patch="p1"), 4)
        assert eventually(lambda: host.health("p1").condition is Condition.OPERATIONAL)
    said = [record.getMessage() for record in caplog.records if record.name.startswith("skinnode.")]
    assert said == ["node 6 (p1) restarted without a command", "node 6 (p1) was brought up and is running"]


def test_bus_that_fails_is_opened_again_and_the_stream_goes_on(
    hand: HandConfig, fleet: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> None:
        raise can.CanOperationError("Network is down")

    with caplog.at_level(logging.WARNING), Host.from_config(hand) as host:
        fields = host.fields(timeout_s=10)
        take(fields, 4)
        bus = host._buses["can0"].link._port._bus  # where a driver would fail
        monkeypatch.setattr(bus, "read_frames", broken)
        assert eventually(lambda: host.stats().buses["can0"].outages == 1)
        assert eventually(lambda: host._buses["can0"].link.failure is None)
        take(fields, 10)
    said = [record.getMessage() for record in caplog.records]
    assert "cannot receive (Network is down); trying to reopen the interface" in said[0]
    assert "can0: the bus is available again" in said


def test_two_buses_one_sync(make_hand: Callable[..., HandConfig]) -> None:
    table = make_hand().model_dump(mode="json")
    table["buses"] = [
        {"name": f"can{i}", "interface": "timed", "channel": f"{table['buses'][0]['channel']}-{i}"}
        for i in range(2)
    ]
    made = {"layout": SMALL, "tolerances": "exact"}
    table["patches"] = [{"name": f"p{i}", "node_id": 5, "bus": f"can{i}", **made} for i in range(2)]
    hand = parse_hand(table)
    with Fleet(hand), Host.from_config(hand) as host:
        fields = take(host.fields(timeout_s=10), 10)
        assert set(host.stats().buses) == {"can0", "can1"}
    assert {stamp(field).patch for field in fields} == {"p0", "p1"}
    by_scan: dict[int, set[int]] = defaultdict(set)
    for field in fields:
        by_scan[stamp(field).scan].add(stamp(field).t_sync_ns)
    assert all(len(times) == 1 for times in by_scan.values())


@pytest.mark.long
@pytest.mark.parametrize("code_bits", [16, 24])
def test_fields_over_can_fd_are_those_of_a_classic_bus(code_bits: int) -> None:
    """The same pressed patch on two buses of one hand: the same codes, so the same fields to the last bit."""
    buses = [
        {"name": name, "interface": "timed", "channel": uuid.uuid4().hex, "fd": name == "fd"}
        for name in ("classic", "fd")
    ]
    size = {"upper_wires": 4, "upper_electrodes": 8, "lower_wires": 32, "lower_electrodes": 4}
    patches = [
        {
            "name": f"on {bus['name']}",
            "node_id": 5,
            "bus": bus["name"],
            "layout": size,
            "tolerances": "exact",
            "code_bits": code_bits,
        }
        for bus in buses
    ]
    hand = parse_hand({"buses": buses, "patches": patches, "sync": {"period_ms": 50}})
    layout = hand.patches[0].layout.build()
    rest_ohm = resistance_ohm(layout, layout.upper_m)
    pressed_m = layout.upper_m.copy()
    pressed_m[1:3, 3:5, 2] -= 100e-6
    source = Fixed(resistance_ohm(layout, pressed_m))
    with ExitStack() as stack:
        for patch in hand.patches:
            bus = hand.bus(patch.bus)
            port = stack.enter_context(CanPort(bus))
            profile = PatchProfile.from_config(patch, bus)
            node = PatchNode(
                5, layout, source, send=port.send, profile=profile, serial=5, baseline_ohm=rest_ohm
            )
            stack.enter_context(NodeRunner(port, [node]))
        host = stack.enter_context(Host.from_config(hand))
        fields = take(host.fields(timeout_s=10), 12)
        stats = host.stats()
    assert {stream.assembler.scans_torn for stream in stats.patches.values()} == {0}
    for name, chunks in (("on classic", -(-128 // (3 if code_bits == 16 else 2))), ("on fd", 8)):
        stream = stats.patches[name].assembler
        assert 0 <= stream.chunks_accepted - chunks * stream.scans_complete <= chunks  # a scan may be open
    assert stats.buses["fd"].load > 0
    by_bus = {name: [f for f in fields if stamp(f).patch == f"on {name}"] for name in ("classic", "fd")}
    for classic, fd in zip(*(by_bus[name] for name in ("classic", "fd")), strict=False):
        assert classic.trusted
        assert abs(fd.displacement_m[1, 3, 2] + 100e-6) < 20e-6
        np.testing.assert_array_equal(fd.displacement_m, classic.displacement_m)
        np.testing.assert_array_equal(fd.displacement_std_m, classic.displacement_std_m)


class Fixed:
    """A source whose patch does not move."""

    def __init__(self, ohm: Float) -> None:
        self.ohm = ohm

    def read(self, t_ns: int) -> Float:
        return self.ohm


def test_simulated_hand_over_can_fd(make_hand: Callable[..., HandConfig]) -> None:
    bus = {"name": "can0", "interface": "timed", "channel": uuid.uuid4().hex, "fd": True}
    hand = make_hand(buses=[bus])
    with Fleet(hand), Host.from_config(hand) as host:
        fields = take(host.fields(timeout_s=10), 30)
        stats = host.stats()
    assert {stamp(field).patch for field in fields} == {"p0", "p1"}
    for stream in stats.patches.values():
        assert (stream.assembler.scans_torn, stream.assembler.bad_length) == (0, 0)
    assert stats.buses["can0"].ignored == 0


@pytest.mark.long
def test_patch_of_fewer_wires_than_unknowns_is_solved_with_its_prior(
    make_hand: Callable[..., HandConfig],
) -> None:
    table = make_hand(patches=1).model_dump(mode="json")
    table["patches"][0]["layout"]["lower_wires"] = 11
    hand = parse_hand(table)
    with Fleet(hand), Host.from_config(hand) as host:
        fields = take(host.fields(timeout_s=10), 3)
    assert {field.method for field in fields} == {"posterior"}
    assert all(field.trusted for field in fields)


def test_patch_that_cannot_be_solved(make_hand: Callable[..., HandConfig]) -> None:
    table = make_hand(patches=1).model_dump(mode="json")
    table["patches"][0]["layout"]["lower_wires"] = 11
    table["solver"]["method"] = "exact"
    hand = parse_hand(table)
    with Fleet(hand), pytest.raises(ConfigError) as caught, Host.from_config(hand):
        pass
    assert str(caught.value).startswith(
        "patch 'p0': got 'staggered', allowed: layout: got 11 lower wires for 12 "
    )


def test_exception_in_the_block_shuts_everything_down(
    hand: HandConfig, fleet: Fleet, listener: CanPort
) -> None:
    with pytest.raises(ZeroDivisionError), Host.from_config(hand):
        raise ZeroDivisionError
    assert eventually(lambda: {report.nmt_state for report in fleet.report()} == {NmtState.PRE_OPERATIONAL})
    heard(listener)
    clock.sleep(0.1)
    assert [frame for frame in heard(listener) if frame.can_id < 0x700] == []
