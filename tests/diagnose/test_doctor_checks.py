"""Each check on facts made up: a healthy hand has no finding, each fault has its own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from skinnode.canopen.lss import LssAddress
from skinnode.config import BusConfig, PatchConfig, SimulationConfig
from skinnode.diagnose.bus_listener import Emergency
from skinnode.diagnose.checks.run import not_judged, others, run_checks
from skinnode.diagnose.collect_facts import collect_facts
from skinnode.diagnose.facts import BusFacts, Finding, PatchFacts, Sure
from skinnode.model.layout import PatchLayout
from skinnode.text.printable import printable
from tests.lanes import some_long
from vcan_sim.default_scene import Scene
from vcan_sim.sensor import SimulatedPatch

from .healthy import NOISE, STEP, bus_of, node, quiet_ratio, scans_of, stats

WELL = PatchFacts(
    "thumb", 5, PatchConfig(name="thumb", node_id=5), found=node(), scans=scans_of(quiet_ratio())
)


def one(bus: BusFacts) -> Finding:
    """The only finding."""
    (finding,) = run_checks(bus)
    return finding


@pytest.mark.parametrize("seed", range(20))
def test_a_healthy_hand_has_no_finding(seed: int) -> None:
    assert run_checks(bus_of(replace(WELL, scans=scans_of(quiet_ratio(seed))))) == []


@pytest.mark.parametrize(
    ("changes", "what", "sure"),
    [
        ({"failure": "can0: does not open"}, "the interface does not work", Sure.CERTAIN),
        ({"link_state": "BUS-OFF"}, "the controller is BUS-OFF", Sure.CERTAIN),
        ({"link_bitrate_bps": 500_000}, "the bit rate of the interface differs", Sure.CERTAIN),
        ({"error_frames": 3}, "error frames", Sure.CERTAIN),
        ({"load": 0.85}, "exceeds the planning limit", Sure.CERTAIN),
        ({"load": 0.5, "max_load": 0.45}, "exceeds the planning limit", Sure.CERTAIN),
        ({"outages": 1}, "the interface failed", Sure.CERTAIN),
        ({"foreign": {0x3F0: 100}}, "of unknown origin", Sure.POSSIBLE),
        ({"unconfigured": (LssAddress(0, 1, 2, 7),)}, "without a node-ID", Sure.CERTAIN),
        ({"strangers": (node(9),)}, "node 9 is not in the hand", Sure.CERTAIN),
        (
            {"strangers": (node(9, product_code=1, duplicate="one request got 2 responses"),)},
            "two nodes have node-ID 9",
            Sure.CERTAIN,
        ),
        ({"dropped": 12}, "this machine dropped frames", Sure.CERTAIN),
        ({"sync_s": np.empty(0)}, "no node sends SYNC", Sure.CERTAIN),
        ({"sync_counters": (1, 200, 2, 201, 3, 202) * 4}, "two SYNC producers", Sure.CERTAIN),
        (
            {"master_node_id": 1, "master_beats_s": 0.125 * np.arange(9)},
            "two masters send the same heartbeat",
            Sure.LIKELY,
        ),
        ({"nmt_commands": 2}, "another device sends NMT commands", Sure.POSSIBLE),
        ({"sync_s": 0.1 * np.arange(50)}, "period differs", Sure.CERTAIN),
        ({"sync_s": np.delete(0.08 * np.arange(60), [20, 21])}, "SYNCs are missing", Sure.CERTAIN),
        (
            {"sync_s": 0.08 * np.arange(60) + 0.012 * (-1.0) ** np.arange(60) * (np.arange(60) % 3 == 0)},
            "SYNC is irregular",
            Sure.LIKELY,
        ),
    ],
)
def test_bus(changes: dict[str, Any], what: str, sure: Sure) -> None:
    finding = one(bus_of(WELL, **changes))
    assert what in finding.what
    assert finding.sure is sure


def test_the_planning_limit_is_that_of_the_hand_file() -> None:
    bus = BusConfig(name="can0", interface="socketcan", channel="nocan0", max_load=0.9)
    facts = collect_facts(bus, None)  # there is no such interface
    assert facts.failure
    assert run_checks(bus_of(WELL, load=0.85, max_load=facts.max_load)) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"sync_counters": tuple(k % 240 + 1 for k in range(200, 300))},
        {"sync_counters": tuple(k for k in range(1, 60) if k % 9)},  # some were lost: timing tells that
        {"sync_counters": (0,) * 60},
        {"master_node_id": 1, "master_beats_s": 0.25 * np.arange(12)},
        {"master_node_id": 1, "master_beats_s": np.empty(0)},
        {"role": "guest", "nmt_commands": 4},
    ],
)
def test_one_master_is_as_it_should_be(changes: dict[str, Any]) -> None:
    assert run_checks(bus_of(WELL, **changes)) == []


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"found": node(state="stopped", answers=False)}, "is stopped and does not answer"),
        ({"found": node(duplicate="one request got 2 responses")}, "two nodes have the patch's node-ID"),
        ({"found": node(product_code=1)}, "another device has the patch's node-ID"),
        ({"found": node(boot_ups=3)}, "restarts by itself"),
        ({"boot_ups": 2}, "restarts by itself"),
        (
            {"wanted": PatchConfig(name="thumb", node_id=5, serial=8)},
            "the serial number differs from the hand file",
        ),
        ({"emergencies": (Emergency(0, 0x5000, 0x81, b"\0\1\1\0\0"),)}, "emergency messages"),
    ],
)
def test_nodes(changes: dict[str, Any], what: str) -> None:
    other = PatchFacts("index", 6, found=node(6))
    finding = one(bus_of(replace(WELL, **changes), other))
    assert what in finding.what
    assert finding.where == "thumb"


def test_a_guest_whose_master_sends_no_sync() -> None:
    """Also where that master has started no node."""
    idle = replace(WELL, found=node(state="pre-operational"), scans=None)
    finding = one(bus_of(idle, role="guest", sync_s=np.empty(0)))
    assert (finding.what, finding.sure) == ("no node sends SYNC", Sure.CERTAIN)
    assert finding.evidence == "no SYNC in 6.0 s, and the host is a guest on this bus"
    assert run_checks(bus_of(idle, sync_s=np.empty(0))) == []  # its host does not run


def test_a_node_that_is_missing_is_told_from_a_bus_that_is_silent() -> None:
    other = PatchFacts("index", 6, found=node(6))
    gone = PatchFacts("thumb", 5)
    assert one(bus_of(gone, other)).what == "the node is missing"
    assert one(bus_of(gone, PatchFacts("index", 6))).what == "none of the hand's nodes answers"


def skin(ratio: np.ndarray, **changes: Any) -> Finding:
    return one(bus_of(replace(WELL, scans=scans_of(ratio, **changes))))


def test_noise_of_a_crossing_of_a_wire_and_of_the_patch() -> None:
    rough = np.random.default_rng(2).standard_normal((50, 4, 12)) * 20 * NOISE
    ratio = quiet_ratio()
    ratio[:, 2, 7] += rough[:, 2, 7]
    finding = skin(ratio)
    assert finding.what == "noise at 1 crossing"
    assert finding.evidence.startswith("2/7;")
    assert finding.sure is Sure.POSSIBLE
    ratio[:, 2] += rough[:, 2]
    assert skin(ratio).what == "noise on upper wire 2"
    assert skin(ratio).sure is Sure.LIKELY
    assert "the whole patch is noisier" in skin(ratio + rough).what


def test_a_press_is_no_noise_no_step_and_no_drift() -> None:
    ratio = quiet_ratio()
    press = 0.5 * (1 - np.cos(np.linspace(0, 2 * np.pi, 50)))
    ratio[:, 1:3, 3:9] -= 0.05 * press[:, None, None]
    assert run_checks(bus_of(replace(WELL, scans=scans_of(ratio)))) == []


LAYOUTS = {
    "small": PatchLayout.preset(
        "staggered", upper_wires=4, upper_electrodes=4, lower_wires=12, lower_electrodes=4
    ),
    "as it comes": PatchLayout.preset("staggered"),
}


def stroked(layout: PatchLayout, seed: int, period_s: float = 0.08, **simulation: Any) -> np.ndarray:
    """50 scans of a patch that a sphere presses and strokes, from somewhere in the scene on."""
    scene = Scene(layout, SimulationConfig(seed=seed, **simulation), seed)
    skin = SimulatedPatch(scene)
    skin.start(0)
    times_ns = (1e9 * (1.0 + 0.37 * seed % 4.0 + period_s * np.arange(50))).astype(np.int64)
    ratio = np.stack([skin.read(int(t_ns)) for t_ns in times_ns]) / SimulatedPatch(scene).skin.rest_ohm
    return np.asarray(np.rint(ratio / STEP) * STEP)


def told_of(ratio: np.ndarray) -> set[str]:
    """Findings, where the hand file tells the converter's own noise."""
    return {f.what for f in run_checks(bus_of(replace(WELL, scans=scans_of(ratio, stated_noise=3e-6))))}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("cycle_s", some_long([0.5, 1.0, 4.0], 1.0))
@pytest.mark.parametrize("depth", some_long([0.02, 0.1, 0.5], 0.1, 0.5))
def test_who_touches_the_skin_is_no_defect(layout: PatchLayout, cycle_s: float, depth: float) -> None:
    for seed, period_s in ((1, 0.08), (2, 0.08), (3, 0.08), (4, 0.025)):
        ratio = stroked(layout, seed, period_s, cycle_s=cycle_s, depth=depth)
        assert told_of(ratio) == set()
    facts = bus_of(replace(WELL, scans=scans_of(ratio, stated_noise=3e-6)))
    assert [line for line in not_judged(facts) if "do not touch the skin" in line]


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("depth", some_long([0.0, 0.1, 0.5], 0.1))
@pytest.mark.parametrize("seed", some_long([1, 2, 3], 1))
def test_faults_are_found_while_somebody_touches_the_skin(
    layout: PatchLayout, depth: float, seed: int
) -> None:
    """Wires as noisy as the simulator makes them, a converter far noisier than told, a loose contact."""
    random, at_work = np.random.default_rng(seed), stroked(layout, seed, depth=depth)
    upper, lower, loose = at_work.copy(), at_work.copy(), at_work.copy()
    upper[:, seed] *= 1.0 + 3e-3 * random.standard_normal(upper[:, seed].shape)
    assert told_of(upper) == {f"noise on upper wire {seed}"}
    lower[..., seed] *= 1.0 + 3e-3 * random.standard_normal(lower[..., seed].shape)
    assert told_of(lower) == {f"noise on lower wire {seed}"}
    whole = stroked(layout, seed, depth=depth, converter_noise=1e-4)
    assert told_of(whole) == {"the whole patch is noisier than the hand file states"}
    loose[10:20:3, seed, 5] = np.nan
    n_open = np.zeros(layout.shape, dtype=np.int64)
    n_open[seed, 5] = 4
    facts = scans_of(loose, stated_noise=3e-6, n_open=n_open)
    assert {f.what for f in run_checks(bus_of(replace(WELL, scans=facts)))} == {
        "1 crossing intermittently open"
    }


def test_noise_of_the_supply_is_alike_in_all_crossings() -> None:
    hum = 1.0 + 20 * NOISE * np.random.default_rng(3).standard_normal((50, 1, 1))
    finding = skin(quiet_ratio() * hum)
    assert finding.what == "the whole patch is noisier than the hand file states"
    assert finding.evidence.startswith("all crossings together: ")


def test_a_jump_that_stays() -> None:
    ratio = quiet_ratio()
    ratio[25:, 1, 4] += 0.03
    finding = skin(ratio)
    assert finding.what == "1 crossing jumped and kept the new value"
    assert "1/4 by 3.0" in finding.evidence
    assert finding.sure is Sure.POSSIBLE


def test_frozen_values_and_a_frozen_node() -> None:
    frozen = np.broadcast_to(quiet_ratio()[:1], (50, 4, 12))
    assert skin(frozen).what == "the values are frozen"
    # Of a converter quieter than a code, values that stand still say nothing, and that is said.
    quiet = bus_of(replace(WELL, scans=scans_of(frozen, stated_noise=3e-6)))
    assert run_checks(quiet) == []
    (line,) = not_judged(quiet)
    assert line.startswith("thumb: frozen or merely quiet: no code changed in 50 scans")
    assert "touch the patch" in line
    assert not_judged(bus_of(replace(WELL, scans=scans_of(frozen)))) == []  # that is a finding
    flickers = frozen.copy()
    flickers[30, 2, 5] += STEP
    assert not_judged(bus_of(replace(WELL, scans=scans_of(flickers, stated_noise=3e-6)))) == []
    finding = skin(quiet_ratio(), device_us=np.full(50, 4711))
    assert "repeats the same scan" in finding.what
    assert finding.sure is Sure.CERTAIN


def test_drift_of_the_baseline() -> None:
    finding = skin(1.012 * quiet_ratio())
    assert "no longer matches the skin at rest" in finding.what
    assert "+1.20 %" in finding.evidence.replace("%", " %")
    part = quiet_ratio()
    part[:, 0, :4] *= 0.97
    assert skin(part).what == "part of the skin differs from its baseline"
    assert skin(part).sure is Sure.POSSIBLE


def test_crossings_open_always_and_now_and_then() -> None:
    ratio, n_open = quiet_ratio(), np.zeros((4, 12), dtype=np.int64)
    ratio[:, 3, 5], n_open[3, 5] = np.nan, 50
    finding = skin(ratio, n_open=n_open)
    assert (finding.what, finding.sure) == ("1 crossing open", Sure.CERTAIN)
    ratio[:, 1], n_open[1] = np.nan, 50
    assert [f.what for f in run_checks(bus_of(replace(WELL, scans=scans_of(ratio, n_open=n_open))))] == [
        "upper wires open: 1",
        "1 crossing open",
    ]
    n_open[1], n_open[3, 5] = 0, 4
    finding = skin(ratio, n_open=n_open)
    assert (finding.what, finding.sure) == ("1 crossing intermittently open", Sure.LIKELY)


@pytest.mark.parametrize(
    ("counts", "what"),
    [
        ({"scans_torn": 2, "chunks_lost": 5}, "incomplete scans"),
        ({"scans_corrupt": 2}, "codes differ from the codes that the node packed"),
        ({"bad_form": 3}, "frames that are not chunks of this patch"),
        ({"scans_missed": 3}, "whole scans are missing"),
        ({"conflicts": 4}, "two different chunks with the same number"),
        ({"bad_length": 1}, "frames that are not chunks"),
    ],
)
def test_losses(counts: dict[str, int], what: str) -> None:
    assert skin(quiet_ratio(), stats=stats(**counts)).what.startswith(what)


def test_scans_that_run_into_the_next() -> None:
    assert "end after the next scan has begun" in skin(quiet_ratio(), latency_s=np.full(50, 0.079)).what


def test_few_scans_are_not_judged() -> None:
    ratio = quiet_ratio()[:10] * 1.05 + 100 * STEP
    bus = bus_of(replace(WELL, scans=scans_of(ratio)))
    assert run_checks(bus) == []
    few = "thumb: noise, steps and drift: 10 scans received, 20 needed"
    assert not_judged(bus) == [few]
    assert WELL.found is not None
    stopped = replace(bus.patches[0], found=replace(WELL.found, state="pre-operational"))
    assert not_judged(replace(bus, patches=(stopped,))) == [
        f"{few}; the node is not running: --active starts it"
    ]
    assert not_judged(replace(bus, patches=(stopped,), active=True)) == [few]


DRIVE: dict[str, Any] = {
    "name": None,
    "device_type": 0x0002_0192,
    "vendor_id": 0x42,
    "product_code": None,
    "serial": None,
    "state": "unknown",
    "state_known_by": "no heartbeat, no guarding",
}


def test_a_device_of_others_beside_a_hand_is_named_and_no_finding() -> None:
    bus = bus_of(WELL, strangers=(node(16, **DRIVE),))
    assert run_checks(bus) == []
    assert others(bus) == [
        "can0: node 16, not in the hand file: device profile 402, vendor 0x00000042, "
        "NMT state unknown (no heartbeat, no guarding)"
    ]
    assert others(replace(bus, period_s=None))[0].startswith("can0: node 16, not a skinnode patch: ")


def test_a_device_of_others_in_place_of_a_patch_is_described() -> None:
    found = one(bus_of(replace(WELL, found=node(**DRIVE))))
    assert found.evidence == "unnamed, device profile 402, vendor 0x00000042"


def test_a_name_that_was_made_printable_is_not_escaped_again() -> None:
    found = one(bus_of(replace(WELL, found=node(**{**DRIVE, "name": printable(b"\x1b[31mdrive")}))))
    assert found.evidence.startswith(r"'\x1b[31mdrive', device profile 402")
