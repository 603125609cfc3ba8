"""A hand in one process, used by another: what a program sees, and what it may do."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

import skinnode as sk
from skinnode.errors import ConfigError, NodeTimeout, SkinError
from skinnode.host import Condition
from skinnode.messages.definitions import FIELD, HEALTH_REPORT
from skinnode.messages.health import LOG
from skinnode.remote import keys
from tests.remote.conftest import Process, eventually

pytestmark = pytest.mark.system_time


def own_threads() -> set[threading.Thread]:
    """The threads of Python; its entries for threads of Zenoh remain when those have ended."""
    return {each for each in threading.enumerate() if not isinstance(each, threading._DummyThread)}


def test_a_program_has_what_the_host_has(start: Callable[..., Process], port: int) -> None:
    daemon = start(name="left hand / 1*").wait_until_up()
    threads = own_threads()
    with sk.connect("left hand / 1*", port=port) as hand:
        assert [patch.name for patch in hand.hand.patches] == ["p0", "p1"]
        assert np.array_equal(hand.layout("p1").upper_m, hand.hand.patch("p1").layout.build().upper_m)
        fields = hand.fields(timeout_s=30.0)
        seen = [next(iter(fields)) for _ in range(20)]
        for name in ("p0", "p1"):
            scans = [field.stamp.scan for field in seen if field.stamp and field.stamp.patch == name]
            assert scans == sorted(
                scans
            )  # a host that is held up skips scans, and assembles one in two parts
            eventually(lambda name=name: hand.health(name).condition is Condition.OPERATIONAL)
        newest = hand.latest("p0")
        assert newest is not None
        assert newest.trusted
        assert newest.displacement_m.shape == (4, 4, 3)
        assert newest.stamp is not None
        assert 0 < time.monotonic_ns() - newest.stamp.t_sync_ns < 5_000_000_000  # one clock: one machine
        whole = hand.hands(timeout_s=30.0)
        assert any(next(iter(whole)).complete for _ in range(5))
        called: list[sk.FieldFrame] = []
        callback = hand.on_field(called.append, patch="p1")
        eventually(lambda: len(called) > 2)
        callback.close()
        assert hand.bus_health("can0").away is None

        async def follow() -> int:
            async for field in hand.fields(patch="p1", timeout_s=30.0):
                assert field.stamp is not None
                return field.stamp.scan
            raise AssertionError

        assert asyncio.run(follow()) > 0
        with pytest.raises(ValueError, match=r"p0, p1"):
            hand.latest("p2")
        with pytest.raises(SkinError, match=r"--commands"):
            hand.tare("p0")
        ending = hand.fields()
    assert all(isinstance(field, sk.FieldFrame) for field in ending)  # ends, because the hand is closed
    eventually(
        lambda: own_threads() == threads
    )  # Zenoh's thread that drops a callback may last a little longer
    assert daemon.end()[0] == 0


def test_fields_are_counted_at_both_ends(start: Callable[..., Process], port: int) -> None:
    daemon = start(patches=3, period_ms=25).wait_until_up()
    with sk.connect("hand", port=port) as hand:
        eventually(lambda: all(each.received > 40 for each in hand.stats().patches.values()))
        before = json.loads(daemon.tell("stats"))
        eventually(
            lambda: all(
                each.sequence >= before["published"][name] for name, each in hand.stats().patches.items()
            )
        )
        stats, after = hand.stats(), json.loads(daemon.tell("stats"))
    for name, each in stats.patches.items():
        assert each.lost == 0
        assert each.runs == 1
        assert before["published"][name] <= each.sequence <= after["published"][name]
        assert after["published"][name] <= after["solved"][name]
        assert each.age_s is not None
        assert 0 < each.age_s < 5
        assert 0 < each.delay_s < 5
    assert (stats.malformed, stats.dropped, stats.daemon_dropped, before["dropped"]) == (0, 0, 0, 0)


def test_commands(start: Callable[..., Process], port: int) -> None:
    daemon = start(commands=True).wait_until_up()
    with sk.connect("hand", port=port) as hand:
        events = hand.events()
        hand.tare("p1")
        baselines = json.loads(daemon.tell("baselines"))
        assert baselines["p0"] == 0
        assert baselines["p1"] >= 1  # one read again on a busy machine counts again
        boot_ups = json.loads(daemon.tell("boot_ups"))
        hand.reset_node("p0")
        eventually(lambda: json.loads(daemon.tell("boot_ups"))["p0"] > boot_ups["p0"])
        eventually(lambda: hand.health("p0").rejoins == 1)
        eventually(lambda: hand.health("p0").condition is Condition.OPERATIONAL)
        found: list[tuple[str, str]] = []

        def new() -> list[tuple[str, str]]:
            while (event := events.get(0.0)) is not None:
                found.append((event.subject, event.what))
            return found

        eventually(lambda: {("p1", "baselines"), ("p0", "rejoins")} <= set(new()))
        with pytest.raises(KeyError):
            hand.tare("p7")
        with pytest.raises(NodeTimeout, match=r"node 5.*no new baseline"):
            hand.tare("p1", deadline_s=0.0)
        assert hand.stats().events_lost == 0
    for command in (hand.tare, hand.reset_node):
        with pytest.raises(SkinError, match=r"^hand 'hand': this program has closed the connection$"):
            command("p0")
    assert hand.health("p0").condition is Condition.LOST


@pytest.mark.parametrize("name", ["", " ", "left\nhand", "\udcff"])
def test_what_no_hand_can_be_called_is_one_line(name: str, port: int) -> None:
    with pytest.raises(ConfigError, match="allowed: the name of a hand") as refused:
        sk.connect(name, port=port, timeout_s=0.0)
    assert "\n" not in str(refused.value)


def test_a_wrong_name_lists_the_hands(start: Callable[..., Process], port: int) -> None:
    with pytest.raises(ConfigError, match=r"hand: got 'left'.*none is published on this machine.*--publish"):
        sk.connect("left", port=port, timeout_s=0.0)
    daemons = [start(name=name) for name in ("right", "left hand")]
    for daemon in daemons:
        daemon.wait_until_up()
    with pytest.raises(ConfigError) as refused:
        sk.connect("left", port=port, timeout_s=1.0)
    assert str(refused.value) == "hand: got 'left', allowed: one of the published hands: 'left hand', 'right'"
    for name in ("right", "left hand"):  # two daemons on one machine, each on its own port
        with sk.connect(name, port=port) as hand:
            assert hand.fields().get(30.0) is not None


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("my hand", "name: got 'my hand', allowed: a hand that no other daemon publishes"),
        pytest.param("my-hand", "'my hand'", marks=pytest.mark.long),
    ],
)
def test_a_hand_has_one_daemon(start: Callable[..., Process], name: str, said: str) -> None:
    start(name="my hand").wait_until_up()
    status, text = start(name=name).end()
    assert status == 2
    assert said in text
    assert text.count("\n") == 1


def test_an_interrupted_connect_leaves_nothing_open(
    start: Callable[..., Process], port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(hand: sk.RemoteHand) -> bool:
        raise KeyboardInterrupt

    start().wait_until_up()
    threads = own_threads()
    monkeypatch.setattr(sk.RemoteHand, "ready", property(interrupted))  # Ctrl-C before the first report
    with pytest.raises(KeyboardInterrupt):
        sk.connect("hand", port=port)
    eventually(lambda: own_threads() == threads)


def test_messages_that_are_none_harm_nobody(start: Callable[..., Process], port: int) -> None:
    start().wait_until_up()
    sent = {"/hand/p0/full_field": FIELD, "/hand/health": HEALTH_REPORT, "/hand/events": LOG}
    with sk.connect("hand", port=port) as hand:
        before = hand.stats()
        for topic, message in sent.items():  # the program's own session stands in for a foreign publisher
            for data in (b"", b"\0", b"\0\1\0\0", b"\xff" * 5000):
                hand._session.put(keys.topic_key(topic, message), data)
        eventually(lambda: hand.stats().malformed >= before.malformed + 12)
        received = before.patches["p0"].received
        eventually(lambda: hand.stats().patches["p0"].received > received + 10)
        assert hand.stats().patches["p0"].lost == 0
        eventually(lambda: hand.health("p0").condition is Condition.OPERATIONAL)
