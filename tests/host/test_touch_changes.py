"""Onsets and releases become events of the host, with the time of their scan, once each."""

from __future__ import annotations

import numpy as np

from skinnode.host.events import Events
from skinnode.host.health_watch import HealthWatch
from skinnode.host.publish import Publisher
from skinnode.model.frames import FieldFrame, ScanStamp, SolveStats
from skinnode.model.status import Status

MS = 1_000_000


def field(patch: str, scan: int, touched: bool | None, t_sync_ns: int | None = None) -> FieldFrame:
    t_ns = scan * 80 * MS
    return FieldFrame(
        displacement_m=np.zeros((1, 1, 3)),
        displacement_std_m=np.ones((1, 1, 3)),
        status=(Status.CONVERGED,),
        residual=np.zeros(1),
        stats=SolveStats(0, 0, 0, 0.0),
        stamp=ScanStamp(patch, scan, scan % 256, 0, t_ns if t_sync_ns is None else t_sync_ns, t_ns + 5 * MS),
        touched=touched,
    )


def test_each_touch_is_one_onset_and_one_release() -> None:
    publisher, events = Publisher(("thumb", "palm")), Events()
    subscription = events.subscribe(16)
    with HealthWatch(dict, dict, events, touches=publisher.touches.take):
        for scan, touched in enumerate((False, True, True, None, True, False, False), start=1):
            publisher.publish(field("thumb", scan, touched), "thumb")
        publisher.publish(field("palm", 9, True, t_sync_ns=0), "palm")
    found = [subscription.get(1.0) for _ in range(3)]
    assert [(event.subject, event.what, event.t_ns) for event in found if event is not None] == [
        ("thumb", "touched", 2 * 80 * MS),
        ("thumb", "released", 6 * 80 * MS),
        ("palm", "touched", 9 * 80 * MS + 5 * MS),  # the time of its SYNC is unknown
    ]
    assert str(found[1]) == "thumb: released in scan 6, after 0.32 s"
    assert subscription.get(0.0) is None


def test_without_detection_there_are_no_events() -> None:
    publisher = Publisher(("thumb",))
    for scan in range(5):
        publisher.publish(field("thumb", scan, None), "thumb")
    assert publisher.touches.take() == []
