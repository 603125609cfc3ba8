"""What the doctor finds is in order: the most certain first, and what follows from a finding below it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinnode.canopen import indices as od
from skinnode.config import PatchConfig, load_hand
from skinnode.diagnose.bus_listener import Emergency
from skinnode.diagnose.facts import BusFacts, PatchFacts, Sure
from skinnode.diagnose.root_causes import grouped, merged
from skinnode.host import Host
from skinnode.process import clock
from skinnode.transport import CanPort
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet

from .conftest import run
from .healthy import bus_of, node, quiet_ratio, scans_of, stats

OVERRUN = Emergency(0, 0x8110, 0x11, bytes.fromhex("0300000000"))


def patch(name: str, node_id: int, **changes: Any) -> PatchFacts:
    """A patch of an overloaded bus: torn scans, late scans, and emergencies of overruns."""
    late = scans_of(
        quiet_ratio(node_id), latency_s=np.full(50, 0.079), stats=stats(scans_torn=2, chunks_lost=9)
    )
    facts = PatchFacts(
        name,
        node_id,
        PatchConfig(name=name, node_id=node_id),
        found=node(node_id),
        scans=late,
        emergencies=(OVERRUN,),
    )
    return replace(facts, **changes)


def scene() -> BusFacts:
    """An overload and five faults: a node that is gone, one that restarts, an open wire, noise, and a node
    that nobody knows."""
    noisy = quiet_ratio(4) * (1 + 3e-3 * np.random.default_rng(1).standard_normal((50, 1, 12)))
    open_wire = np.zeros((4, 12), dtype=np.int64)
    open_wire[2] = 50
    ratio = quiet_ratio(3)
    ratio[:, 2] = np.nan
    wire = Emergency(0, 0x5000, 0x81, bytes.fromhex("0002010000"))
    return bus_of(
        patch("palm", 1, found=None, scans=None, emergencies=()),
        patch("thumb", 2, boot_ups=4),
        patch("index", 3, scans=scans_of(ratio, n_open=open_wire), emergencies=(wire, OVERRUN)),
        patch("middle", 4, scans=scans_of(noisy)),
        patch("ring", 5),
        load=0.93,
        strangers=(node(9),),
        foreign={0x3F0: 20},
    )


def test_an_overload_and_five_faults_are_in_order() -> None:
    groups = grouped([scene()])
    named = {f"{group.cause.where}: {group.cause.what}": group for group in groups}
    assert next(iter(named)) == "can0: the bus load exceeds the planning limit"
    assert {name for name, group in named.items() if group.rank == 0} == {
        "can0: the bus load exceeds the planning limit",
        "palm: the node is missing",
        "thumb: the node restarts by itself",
        "index: upper wires open: 2",
        "can0: patch at node 9 is not in the hand file",
    }
    assert [group.rank for group in groups] == sorted(group.rank for group in groups)
    assert groups[-1].cause.sure is Sure.POSSIBLE
    overload = named["can0: the bus load exceeds the planning limit"]
    below = {(finding.where, finding.what) for finding in overload.consequences}
    assert ("ring", "incomplete scans") in below
    assert ("ring", "scans end after the next scan has begun") in below
    assert ("ring", "emergency messages received during the check") in below
    assert not any(where == "thumb" for where, _ in below)  # that it restarts is nearer
    restarts = named["thumb: the node restarts by itself"]
    assert {finding.what for finding in restarts.consequences} >= {"incomplete scans"}
    wire = named["index: upper wires open: 2"]
    assert {finding.what for finding in wire.consequences} == {"emergency messages received during the check"}
    places = {finding.what: where for finding, where in merged(overload.consequences)}
    assert places["emergency messages received during the check"] == ("middle", "ring")


def test_nothing_is_lost_by_grouping() -> None:
    from skinnode.diagnose.checks.run import run_checks

    facts = scene()
    told = [finding for group in grouped([facts]) for finding in (group.cause, *group.consequences)]
    key = lambda finding: (finding.where, finding.what)  # noqa: E731
    assert sorted(told, key=key) == sorted(run_checks(facts), key=key)
    assert len(grouped([facts])) < len(told) / 2


def test_an_emergency_that_names_something_else_stands_alone() -> None:
    other = Emergency(0, 0x4200, 0x09, bytes(5))
    facts = bus_of(patch("ring", 5, emergencies=(OVERRUN, other)), load=0.93)
    causes = {group.cause.what for group in grouped([facts])}
    assert "emergency messages received during the check" in causes


@pytest.mark.long
def test_the_command_prints_causes_first(hand_file: Callable[..., Path], on: Callable[[Any], Any]) -> None:
    file = hand_file()
    hand = load_hand(file)
    fleet = on(Fleet(hand))
    on(Host.from_config(hand))
    fleet.inject(Faults(open_upper=2), "thumb")
    done = run(["doctor", file, "--json"])
    rows = [row for row in done.json["findings"] if row["where"] == "thumb"]
    wire = next(row for row in rows if row["what"].startswith("upper wires open"))
    error = next(row for row in rows if row["what"] == "the node reports an error")
    assert (wire["cause"], error["cause"]) == (None, "thumb: upper wires open: 2")
    text = run(["doctor", file]).stdout
    assert text.index("upper wires open: 2") < text.index("probable consequences:")
    assert text.index("probable consequences:") < text.index("thumb: the node reports an error")


@pytest.mark.long
def test_a_host_of_the_hand_is_neither_somebody_nor_unknown(
    hand_file: Callable[..., Path], on: Callable[[Any], Any]
) -> None:
    """It asks for the patch that is missing, and starts the one that restarts."""
    file = hand_file()
    hand = load_hand(file)
    fleet = on(Fleet(hand))
    waiting = hand.model_copy(update={"bring_up": hand.bring_up.model_copy(update={"missing": "wait"})})
    on(Host.from_config(waiting))
    fleet.inject(Faults(unplugged=True), "index")
    port = on(CanPort(hand.buses[0]))
    port.send(od.NMT_COB_ID, bytes((128, 5)))  # the host starts it again
    clock.sleep(0.8)
    done = run(["doctor", file, "--json"])
    told = {row["what"] for row in done.json["findings"]}
    assert "the node is missing" in told
    assert "frames of unknown origin" not in told
    assert "another device sends NMT commands" not in told
