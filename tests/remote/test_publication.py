"""The end of a publication, in the order in which a program may write it."""

from __future__ import annotations

import threading

import pytest

import skinnode as sk
from skinnode.remote import Publication, SessionOptions
from skinnode.remote.claim import Claim
from tests.remote.conftest import eventually
from tests.remote.daemon import hand_of
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
