"""A daemon that returns: with an earlier clock, with another hand file, or with other messages."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

import skinnode as sk
from skinnode.config import parse_hand
from skinnode.errors import SkinError
from skinnode.host import Condition
from skinnode.model.layout import PatchLayout
from skinnode.remote.description import Description
from tests.remote.conftest import Process, eventually
from tests.remote.daemon import SMALL

pytestmark = pytest.mark.system_time


def runs(*fields: sk.FieldFrame | None) -> set[int]:
    """Which of the daemons' runs these fields are of; none may be missing."""
    assert None not in fields
    return {each.stamp.run for each in fields if each is not None and each.stamp is not None}


@pytest.mark.long
def test_fields_and_hand_frames_go_on_after_a_restart_with_an_earlier_clock(
    start: Callable[..., Process], port: int
) -> None:
    first = start().wait_until_up()
    with sk.connect("hand", port=port) as hand:
        fields, hands = hand.fields(), hand.hands()
        eventually(lambda: hand.stats().patches["p0"].received > 300)  # more than the new run will have sent
        before = [frame.scan for _ in range(100) if (frame := hands.get(0.0)) is not None]
        first.kill()
        start(behind_s=3600).wait_until_up()
        while 1 not in runs(fields.get(30.0)):
            pass
        while (frame := hands.get(30.0)) is not None and runs(*frame.fields.values()) != {1}:
            assert runs(*frame.fields.values()) == {0}  # of one daemon
        assert frame is not None
        assert max(before) > frame.scan
        eventually(lambda: hand.health("p0").condition is Condition.OPERATIONAL)
        assert [each.lost for each in hand.stats().patches.values()] == [0, 0]
        assert hands.late < 10  # a starved machine delays some fields; an earlier clock would delay all


@pytest.mark.long
@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"pitch_mm": 8.0}, "its daemon has restarted with another hand file; connect again"),
        ({"version": 99}, "install the same version on both sides"),
    ],
)
def test_a_daemon_that_returns_changed_is_refused_everywhere(
    start: Callable[..., Process],
    port: int,
    changed: dict[str, Any],
    reason: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    first = start(commands=True).wait_until_up()
    hand = sk.connect("hand", port=port)
    called: list[sk.FieldFrame] = []
    callback = hand.on_field(called.append)
    fields, events = hand.fields(), hand.events()
    eventually(lambda: called)
    first.kill()
    eventually(lambda: hand.away is not None)
    last, depth_m = hand.latest("p0"), hand.layout("p0").upper_m
    start(commands=True, **changed).wait_until_up()
    eventually(lambda: reason in str(hand.away))
    with pytest.raises(SkinError, match=reason):
        list(fields)
    eventually(lambda: callback.ended)
    assert reason in caplog.text
    health = hand.health("p0")
    assert health.condition is Condition.LOST
    assert reason in health.reason
    assert reason in str(hand.bus_health("can0").away)
    heard = [(event.what, event.text) for event in iter(lambda: events.get(0.0), None)]
    assert heard[-1][0] == "away"
    assert reason in heard[-1][1]
    with pytest.raises(SkinError, match=reason):
        hand.tare("p0")
    assert hand.latest("p0") is last
    assert hand.layout("p0").upper_m is depth_m
    closing = threading.Thread(target=hand.close, daemon=True)
    closing.start()
    closing.join(30.0)
    assert not closing.is_alive()
    hand.close()
    assert hand.stats().malformed == 0


def test_electrodes_that_the_hand_file_does_not_contain_are_compared_too() -> None:
    table = {"name": "p0", "node_id": 4, "layout": SMALL}
    hand = parse_hand({"buses": [{"name": "can0"}], "patches": [table]})
    layout = hand.patches[0].layout.build()
    one = Description(hand, {"p0": layout}, "", False, 1)
    assert one.agrees_with(Description.decode(replace(one, started_ns=2).encode(), "hand"))
    moved = PatchLayout(layout.upper_m + 1e-4, layout.lower_m, layout.resistivity_ohm_per_m, layout.name)
    assert not one.agrees_with(replace(one, layouts={"p0": moved}))


def test_electrodes_that_the_node_supplies_may_be_unknown_before_it_appears() -> None:
    table = {"name": "p0", "node_id": 4, "layout": {**SMALL, "coordinates": "node"}}
    hand = parse_hand({"buses": [{"name": "can0"}], "patches": [table]})
    layout = hand.patches[0].layout.build()
    moved = PatchLayout(layout.upper_m + 1e-4, layout.lower_m, layout.resistivity_ohm_per_m, layout.name)
    one = Description(hand, {"p0": layout}, "", False, 1)
    assert one.agrees_with(replace(one, layouts={"p0": moved}))
