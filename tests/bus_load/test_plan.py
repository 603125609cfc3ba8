"""What a hand needs of its buses, against sums that can be done by hand."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from skinnode.bus_load.plan import BusPlan, check_plan, inhibit_time_100us, plan_of
from skinnode.bus_load.timing import fd_bits, fd_worst_case_bits
from skinnode.config import load_hand, parse_hand
from skinnode.errors import BusLoadError, ConfigError
from skinnode.host import Host
from skinnode.protocol.profile import PatchProfile

EXAMPLES = Path(__file__).parents[2] / "examples"
MINIMAL: dict[str, Any] = {
    "buses": [{"name": "can0"}],
    "patches": [{"name": "thumb", "node_id": 1}, {"name": "index", "node_id": 2}],
}


def minimal(**bus: object) -> dict[str, Any]:
    table = copy.deepcopy(MINIMAL)
    table["buses"][0] |= bus
    return table


def only_plan(table: dict[str, Any]) -> BusPlan:
    (plan,) = plan_of(parse_hand(table))
    return plan


RESERVE = 2 * 135e-6 / 0.250 + 2 * 65e-6 / 0.250 + 0.01
"""An EMCY and a heartbeat of each of two nodes every 250 ms, and 1 % for SDO."""


def test_load_is_every_frame_at_its_longest() -> None:
    # 8 data bytes with all stuff bits and inter-frame space are 135 bits, the SYNC with its counter 65
    # (Davis et al. 2007, table of worst cases); 300 codes are 100 chunks and a summary.
    plan = only_plan(minimal())
    assert plan.load == pytest.approx((2 * 101 * 135 + 65) / 80e3 + RESERVE, rel=1e-12)
    assert plan.frames_per_s == pytest.approx((2 * 101 + 1) / 0.08 + 4 / 0.250 + 0.01 / 135e-6, rel=1e-12)


def test_typical_load_lies_between_no_stuff_bits_and_all() -> None:
    plan = only_plan(minimal())
    chunks = next(frame for frame in plan.frames if frame.name == "chunks of thumb")
    # 34 + 64 bits that look random are stuffed every 32 of them or so: 98 / 31 = 3.2, and more in the head.
    assert 111 + 2 < chunks.typical_s * 1e6 < 111 + 6
    assert plan.typical_load < plan.load


def test_load_of_can_fd_is_the_worst_case_too() -> None:
    # 64 bytes: 29 bits and 3 stuff bits at 1 Mbit/s; 38 + 640 at 5 Mbit/s: 5 + 512 before the CRC field with
    # 128 stuff bits, 4 + 21 + 7 in it, the delimiter. Ten wires a patch; summaries and SYNC stay classic.
    table = minimal(fd=True)
    wire_s = 32e-6 + 678 / 5e6
    expected_s = 2 * (10 * wire_s + 135e-6) + 65e-6
    assert only_plan(table).load == pytest.approx(expected_s / 0.08 + RESERVE, rel=1e-12)
    table["sync"] = {"period_ms": 6}
    assert only_plan(table).load == pytest.approx(expected_s / 0.006 + RESERVE, rel=1e-12)
    table["buses"][0]["data_bitrate_bps"] = 2_000_000
    with pytest.raises(BusLoadError, match=r"2000000 bit/s in the data phase.*sync\.period_ms = \d+"):
        check_plan(parse_hand(table))


@pytest.mark.parametrize(("columns", "worst_s"), [(2, 135e-6), (3, 32e-6 + (129 + 23) / 5e6)])
def test_chunks_of_up_to_8_bytes_are_classic_frames_on_can_fd_too(columns: int, worst_s: float) -> None:
    table = minimal(fd=True)
    table["patches"][0]["layout"] = {"lower_wires": columns}
    chunks = next(frame for frame in only_plan(table).frames if frame.name == "chunks of thumb")
    assert chunks.worst_s == pytest.approx(worst_s, rel=1e-12)


def test_inhibit_time_of_few_frames_in_a_long_period_fits_its_object() -> None:
    assert inhibit_time_100us(60_000, 8) == 60_000
    assert inhibit_time_100us(60_000, 6) == 0xFFFF  # of 80,000
    table = minimal(fd=True) | {"sync": {"period_ms": 60_000}}
    table["patches"][0]["layout"] = {"upper_wires": 5}
    assert only_plan(table).scans[0].paced_s == pytest.approx(4 * 6.5535)


def test_longest_can_fd_frames_of_a_byte() -> None:
    # All data of 1 byte, in front of any CRC: the data phase and the stuffing of the head behind BRS.
    fast = fd_bits([0x181] * 256, [[value] for value in range(256)])[1]
    assert fd_worst_case_bits(1)[1] == fast.max()
    nominal = fd_bits(list(range(2048)), [[0]] * 2048)[0]
    assert fd_worst_case_bits(1)[0] == nominal.max()


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("bits", [16, 24])
@pytest.mark.parametrize(("rows", "columns"), [(10, 30), (1, 1), (3, 61), (7, 33)])
def test_frames_planned_are_the_frames_of_the_profile(fd: bool, bits: int, rows: int, columns: int) -> None:
    table = minimal(fd=fd)
    table["patches"][0] |= {"code_bits": bits, "layout": {"upper_wires": rows, "lower_wires": columns}}
    hand = parse_hand(table)
    profile = PatchProfile.from_config(hand.patches[0], hand.buses[0])
    (plan,) = plan_of(hand)
    chunks = next(frame for frame in plan.frames if frame.name == "chunks of thumb")
    assert (chunks.count, chunks.length) == (profile.n_chunks, profile.chunk_bytes)
    assert plan.scans[0].chunks == profile.n_chunks


def test_plan_that_does_not_fit_its_bus() -> None:
    table = minimal(bitrate_bps=250_000)
    hand = parse_hand(table, where="hand.toml")
    with pytest.raises(BusLoadError) as caught:
        check_plan(hand)
    # 27335 bits of 20000 in 80 ms are 136.68 %, EMCY and heartbeats 4 × 0.16 %, SDO 1 %
    assert str(caught.value) == (
        "hand.toml: buses[0] (can0): got a plan that needs 138.3% of 250000 bit/s, "
        "allowed: at most 70.0% (max_load); sync.period_ms = 160 or fewer patches would suffice"
    )
    assert (caught.value.needed, caught.value.available) == (pytest.approx(1.38315), 0.70)
    with pytest.raises(BusLoadError), Host.from_config(hand):
        pass
    table["sync"] = {"period_ms": 160}
    check_plan(parse_hand(table))
    table["sync"] = {"period_ms": 159}
    with pytest.raises(BusLoadError):
        check_plan(parse_hand(table))
    table["buses"][0]["max_load"] = 0.75
    check_plan(parse_hand(table))


def test_a_bus_that_others_fill() -> None:
    others = [{"can_id": 0x300 + i, "length": 8, "period_ms": 1.0} for i in range(6)]  # 6 × 13.5 %
    with pytest.raises(BusLoadError, match=r"needs 116\.\d%.*; fewer patches would suffice"):
        check_plan(parse_hand(minimal(others=others)))


def test_what_would_do_is_what_may_be_changed() -> None:
    one = minimal(bitrate_bps=250_000) | {"sync": {"period_ms": 20}}
    one["patches"] = one["patches"][:1]
    with pytest.raises(BusLoadError, match=r"\(max_load\); sync.period_ms = \d+ would suffice$"):
        check_plan(parse_hand(one))
    one["buses"][0] |= {"role": "guest", "guest_sends": "sdo"}
    with pytest.raises(BusLoadError, match=r"\(max_load\); a master's SYNC every \d+ ms would suffice$"):
        check_plan(parse_hand(one))


def test_how_long_others_wait() -> None:
    first = {"can_id": 0x070, "length": 6, "period_ms": 8.0}
    beside = only_plan(minimal(others=[first, {"can_id": 0x7FF, "length": 1, "period_ms": 80.0}]))
    before, after = (frame.response_s for frame in beside.others)
    # 0x070 waits for one frame of 8 bytes that has begun, 135 bits, and takes 47 + 48 and 20 stuff bits
    assert before == pytest.approx(250e-6, abs=1e-8)
    # 0x7FF waits at least for one frame of each other kind, two of each patch with 135 bits
    assert after is not None
    assert after > 8 * 135e-6
    assert only_plan(minimal()).others == ()


def test_others_delay_our_scans() -> None:
    alone = only_plan(minimal())
    shared = only_plan(minimal(others=[{"can_id": 0x101, "length": 8, "period_ms": 1.0}]))
    below = only_plan(minimal(others=[{"can_id": 0x7FF, "length": 8, "period_ms": 1.0}]))
    assert alone.scans[0].worst_s is not None
    assert shared.scans[0].worst_s is not None
    assert shared.scans[0].worst_s > alone.scans[0].worst_s
    assert below.scans[0].worst_s == alone.scans[0].worst_s  # a frame of ours blocks as long as one of theirs


def test_another_frame_with_an_identifier_of_ours(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_text(
        '[[buses]]\nname = "can0"\nothers = [\n  { can_id = 0x181, period_ms = 5 },\n]\n'
        '[[patches]]\nname = "thumb"\nnode_id = 1\n'
    )
    with pytest.raises(ConfigError) as caught:
        plan_of(load_hand(path))
    assert str(caught.value) == (
        f"{path}:4:5: buses[0].others[0].can_id: got 0x181, "
        "allowed: an identifier that is unique on the bus; this one is used for chunks of thumb"
    )


@pytest.mark.parametrize(
    ("can_id", "whose"),
    [
        (0x080, "SYNC"),
        (0x087, "EMCY of b"),
        (0x207, "commands to b"),
        (0x287, "summary of b"),
        (0x587, "SDO answers of b"),
        (0x607, "SDO requests to b"),
        (0x707, "heartbeat of b"),
        (0x77F, "heartbeat of the host"),
    ],
)
def test_every_identifier_of_ours_is_ours(can_id: int, whose: str) -> None:
    """Those of the pre-defined connection set (CiA 301 v4.2, 7.3.3) that our nodes send or take."""
    table = minimal(heartbeat_node_id=127, others=[{"can_id": can_id, "period_ms": 50.0}])
    table["patches"] = [{"name": "a", "node_id": 3}, {"name": "b", "node_id": 7}]
    with pytest.raises(ConfigError, match=f"got 0x{can_id:03X}, allowed: .* this one is used for {whose}$"):
        plan_of(parse_hand(table))


def test_services_of_all_may_be_others() -> None:
    """NMT, TIME and LSS of the robot's master."""
    others = [{"can_id": can_id, "period_ms": 1000.0} for can_id in (0x000, 0x100, 0x7E4, 0x7E5)]
    plan_of(parse_hand(minimal(others=others)))


def test_patch_too_large_for_its_chunk_index() -> None:
    table = minimal()
    table["patches"][0]["layout"] = {"upper_wires": 26}
    with pytest.raises(ConfigError) as caught:
        check_plan(parse_hand(table))
    assert str(caught.value) == (
        "patches[0].layout: got 780 rows × columns, allowed: at most 768 codes of 16 bits"
    )


def test_scan_of_a_single_patch_by_hand() -> None:
    # One wire pair: a chunk and a summary. The SYNC waits for the longest frame on the bus, 135 bits, and
    # takes 65. The node may take 2 ms. The chunk is at worst 200 µs late, waits for a frame of lower priority
    # (135), a SYNC (65) and an EMCY (135), and takes 135; the summary finds the same before it and a chunk.
    table = minimal()
    table["patches"] = [{"name": "tip", "node_id": 1, "layout": {"upper_wires": 1, "lower_wires": 1}}]
    (scan,) = only_plan(table).scans
    assert scan.paced_s == 0
    chunk_us, summary_us = 200 + 135 + 65 + 135 + 135, 135 + 65 + 135 + 135 + 135
    assert scan.worst_s == pytest.approx((135 + 65 + 2000 + chunk_us + summary_us) * 1e-6)


def test_inhibit_time_leaves_a_fifth_of_the_period() -> None:
    # 100 chunks and a summary in 64 of 80 ms
    assert inhibit_time_100us(80, 101) == 6
    assert 101 * 6 * 0.1 <= 64 < 101 * 7 * 0.1


def test_buses_without_patches_have_no_plan() -> None:
    table = minimal()
    table["buses"].append({"name": "can1", "channel": "other"})
    assert [plan.bus.name for plan in plan_of(parse_hand(table))] == ["can0"]
