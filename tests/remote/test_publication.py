"""The end of a publication, in the order in which a program may write it."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

import skinnode as sk
from skinnode.config import HandConfig, parse_hand
from skinnode.remote import Publication, SessionOptions
from skinnode.remote.claim import Claim
from tests.remote.conftest import eventually
from tests.remote.daemon import SMALL, hand_of
from tests.remote.test_topics import DDS, key_of
from vcan_sim.fleet import Fleet

pytestmark = pytest.mark.system_time


def test_a_publication_ends_with_its_host_and_is_closed_more_than_once(port: int) -> None:
    hand = hand_of("hand", patches=1, period_ms=50, pitch_mm=4.0)
    threads = set(threading.enumerate())

    def publishing() -> set[str]:
        return {each.name for each in set(threading.enumerate()) - threads if each.name.startswith("publish")}

    with Fleet(hand), Claim(hand, SessionOptions(port=port)) as claim:
        with sk.Host.from_config(hand) as host:
            publication = Publication(host, claim, commands=True)
            eventually(lambda: publication.stats().published["p0"] > 2)
            assert publishing() == {"publish", "publish status"}
        eventually(lambda: not publishing())
        publication.close()
        publication.close()
        claim.close()


@pytest.mark.long
def test_programs_get_the_electrodes_of_a_node_that_appears_later(port: int, session: Any) -> None:
    """The layout of each field is known before the field arrives, and the published points stand on it."""

    def a_hand(**layout: Any) -> HandConfig:
        return parse_hand(
            {
                "name": "late",
                "buses": [{"name": "can0", "interface": "virtual", "channel": "late"}],
                "patches": [{"name": "p0", "node_id": 5, "layout": SMALL | layout, "tolerances": "exact"}],
                "sync": {"period_ms": 50},
                "bring_up": {"missing": "wait"},
            }
        )

    high, planned = a_hand(height_m=3e-3), a_hand(coordinates="node")
    wanted_m = high.patches[0].layout.build().upper_m
    clouds: list[Any] = []
    with (
        sk.Host.from_config(planned, boot_deadline_s=0.2) as host,
        sk.publish(host, SessionOptions(port=port)),
        sk.connect("late", port=port) as hand,
    ):
        subscriber = session.declare_subscriber(key_of("late/p0/field", DDS["field"]), clouds.append)
        assert not np.allclose(hand.layout("p0").upper_m, wanted_m, atol=1e-4)
        fields = hand.fields()
        with Fleet(high):
            assert fields.get(60.0) is not None
            np.testing.assert_allclose(hand.layout("p0").upper_m, wanted_m, rtol=0, atol=1e-8)
            eventually(lambda: clouds)
        subscriber.undeclare()
        assert [each.lost for each in hand.stats().patches.values()] == [0]
        with sk.connect("late", port=port) as second:
            np.testing.assert_allclose(second.layout("p0").upper_m, wanted_m, rtol=0, atol=1e-8)
    cloud: Any = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(clouds[0].payload.to_bytes(), DDS["field"])
    points_m = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(4, 4, -1)
    np.testing.assert_allclose(points_m[..., :3] - points_m[..., 3:6], wanted_m, rtol=0, atol=1e-7)
