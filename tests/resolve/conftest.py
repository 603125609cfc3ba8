"""A short recording of three patches on two buses, made in virtual time."""

from __future__ import annotations

from pathlib import Path

import pytest

from skinnode.config import parse_hand
from skinnode.host import Host
from skinnode.process import clock
from skinnode.record import Recorder
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("resolve") / "run.log"
    patches = [
        {"name": f"p{i}", "node_id": 5 + i, "bus": f"can{i % 2}", "layout": SMALL, "tolerances": "exact"}
        for i in range(3)
    ]
    buses = [{"name": f"can{i}", "interface": "timed", "channel": f"resolve{i}"} for i in range(2)]
    hand = parse_hand({"buses": buses, "patches": patches, "sync": {"period_ms": 25}})
    with (
        VirtualClock(),
        Fleet(hand),
        Recorder(hand, path) as recorder,
        Host.from_config(hand, tap=recorder),
    ):
        clock.sleep(2.5)
    return path
