"""Records the fields, contacts, health and events of a running host in an MCAP file."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Final

from skinnode.host import Host
from skinnode.host.events import EventSubscription
from skinnode.process import clock
from skinnode.record.recorder import Recorder

HEALTH_S: Final = 1.0
"""Interval (s) at which the health of all patches and buses is recorded."""

CAPACITY_FIELDS: Final = 4096
"""Maximum number of fields queued for the recorder; about ten seconds of fields from sixteen patches."""

_POLL_S: Final = 0.2


@contextlib.contextmanager
def followed(recorder: Recorder, host: Host) -> Iterator[None]:
    """Record the fields, contacts, health and events of ``host`` during the ``with`` block.

    If the host closes after the block, the fields of scans that end during the shutdown are also recorded, so
    the recording contains the same fields as its replay.

    This has no effect if the recording is not an MCAP file. If the disk is slow, the recorder drops the
    oldest queued fields and counts them in ``RecorderStats.fields_dropped``; the host is not delayed.

    Args:
        recorder: Recorder of the host's frames.
        host: Running host.
    """
    if not recorder.records_fields:
        yield
        return
    callback = host.on_field(recorder.field, capacity=CAPACITY_FIELDS)  # ends when the host closes
    recorder.count_lost_fields(lambda: callback.dropped + callback.failed)
    events, over = host.events(), clock.event()
    watcher = clock.thread(target=lambda: _watch(recorder, host, events, over), name="record health")
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def _watch(recorder: Recorder, host: Host, events: EventSubscription, over: threading.Event) -> None:
    """Record each event immediately, and record the health every second and at the end.

    Recording ends when the block or the host ends, whichever comes first.
    """
    due_s = clock.monotonic()
    ended = False
    while not ended:
        ended = over.is_set() or events.ended
        now_s = clock.monotonic()
        if now_s >= due_s or ended:
            due_s = now_s + HEALTH_S
            recorder.health(
                {patch.name: host.health(patch.name) for patch in host.hand.patches},
                {bus.name: host.bus_health(bus.name) for bus in host.hand.served_buses},
            )
        timeout_s = 0.0 if ended else min(_POLL_S, max(0.0, due_s - clock.monotonic()))
        while (event := events.get(timeout_s)) is not None:
            recorder.event(event)
            timeout_s = 0.0
