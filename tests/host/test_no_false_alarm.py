"""Nothing is the matter with a stream that is well, whatever the converter and whoever touches it."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from skinnode.config import HandConfig
from skinnode.host import Host
from tests.lanes import some_long
from vcan_sim.fleet import Fleet

from .conftest import eventually

SCANS = 200
OF_A_TOUCH = ("touched", "released")
OF_THE_MACHINE = {"emergencies", "faulty", "stale", "operational"}
"""A simulator that is held up by other work is stale, and says that it skipped a scan (EMCY 0x8110)."""


@pytest.mark.long
@pytest.mark.parametrize("noise", some_long([0.0, 1e-6, 1e-4], 1e-6))
@pytest.mark.parametrize("depth", some_long([0.01, 0.5], 0.5))
def test_no_alarm_of_a_healthy_stream(
    make_hand: Callable[..., HandConfig], noise: float, depth: float
) -> None:
    """At 80 scans a second, pressed hard or hardly; the host believes in a noise of 3e-6."""
    hand = make_hand(
        sync={"period_ms": 12}, simulation={"converter_noise": noise, "depth": depth, "cycle_s": 1.0}
    )
    with Fleet(hand), Host.from_config(hand) as host:
        events = host.events()
        assert eventually(
            lambda: min(stream.solved for stream in host.stats().patches.values()) > SCANS, 20.0
        )
        told = []
        while (event := events.get(0.0)) is not None:
            told.append(event)
        health = [host.health(patch.name) for patch in hand.patches]
    alarms = [event for event in told if event.what not in (*OF_THE_MACHINE, *OF_A_TOUCH)]
    assert [str(event) for event in alarms] == []
    for patch in hand.patches:  # a press of 1 % or 50 % each second: onset and release, in turn
        touches = [event for event in told if event.subject == patch.name and event.what in OF_A_TOUCH]
        assert len(touches) >= 2
        assert [event.what for event in touches] == [OF_A_TOUCH[i % 2] for i in range(len(touches))]
        times = [event.t_ns for event in touches]
        assert times == sorted(times)
    for patch in health:
        assert patch.wires == ()
        assert patch.conflicts == patch.rejoins == 0
        assert not patch.duplicate_id
        assert patch.last_emergency in (None, 0x8110)
