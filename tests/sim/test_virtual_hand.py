"""A hand and its host in virtual time: one seed, one trace, to the byte."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import hashlib, sys
from dataclasses import replace
import skinnode as sk
from skinnode.config import parse_hand
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet
from vcan_sim.timed_bus import BitRates
from vcan_sim.timed_interface import segment
from vcan_sim.trace import Trace
from vcan_sim.virtual_time import VirtualClock

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}
hand = parse_hand({
    "buses": [{"name": "can0", "interface": "timed", "channel": "can0"}],
    "patches": [
        {"name": f"p{i}", "node_id": 5 + i, "layout": SMALL, "tolerances": "exact"} for i in range(3)
    ],
    "sync": {"period_ms": 25},
})
for scene in sys.argv[1:]:
    seed, twin = int(scene.removesuffix("+twin")), scene.endswith("+twin")
    end_ns = 1_002_500_000_000 if twin else 1_004_000_000_000
    with VirtualClock() as clock:
        trace = Trace(segment("can0", clock, BitRates(1_000_000)))
        faults = Faults(seed=seed, lost=0.01, restart_every_s=3.0, sdo_response_lost=0.02)
        with Fleet(hand, faults=faults) as fleet, sk.Host.from_config(hand) as host:
            fields, seen = hashlib.sha256(), 0
            stream = host.fields(timeout_s=5)
            if twin:
                fleet.inject(replace(faults, duplicate_node_id=True), "p0")
            while clock.monotonic_ns() < end_ns:
                field = next(iter(stream))
                fields.update(repr((field.stamp, field.status)).encode() + field.displacement_m.tobytes())
                seen += 1
        text = trace.text()
        print(len(trace), hashlib.sha256(text.encode()).hexdigest(), seen, fields.hexdigest())
        print(text.splitlines()[0], sum(" 605#A200" in line for line in text.splitlines()))
"""

FAST_CLOCK = """
import itertools, time
time.time = map(float, itertools.count(2_000_000_000)).__next__
"""
"""Each reading of the system clock is one second later than the last, as on a very slow machine."""


def run(hash_seed: int, *scenes: str, before: str = "") -> tuple[list[str], str]:
    """Run the hand with each scene, a seed, in one process, after the code ``before``; two lines for each
    scene, and what it says on stderr."""
    done = subprocess.run(
        [sys.executable, "-c", before + PROGRAM, *scenes],
        env=os.environ | {"PYTHONHASHSEED": str(hash_seed)},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), done.stderr


@pytest.mark.long
def test_two_runs_with_one_seed_are_identical_and_with_another_seed_are_not() -> None:
    """In two processes whose sets have other orders, and whose system clocks other speeds."""
    (first, begin, other, _), said = run(0, "1", "2")
    again, said_again = run(12345, "1", before=FAST_CLOCK)
    assert again == [first, begin]
    assert said_again
    assert said.startswith(said_again)
    assert other != first
    frames, _, fields, _ = first.split()
    assert int(frames) > 4_000
    assert int(fields) > 250
    assert begin.startswith("(1600000000.0")


@pytest.mark.long
def test_two_runs_with_two_nodes_of_one_node_id_are_identical() -> None:
    """Block transfers whose segments come from both nodes in turn are repeated until a time limit."""
    (first, begin), _ = run(0, "1+twin")
    assert run(12345, "1+twin", before=FAST_CLOCK)[0] == [first, begin]
    assert int(begin.split()[-1]) > 2  # block uploads with segments to be sent again
