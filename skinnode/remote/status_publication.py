"""Publishes the health and the events of a host in a separate thread.

A health report for 16 patches takes 2 ms. In a shared thread, it would delay the fields.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from skinnode.host import Host
from skinnode.host.containment import Defects, keep_on
from skinnode.host.events import HealthEvent
from skinnode.host.skeleton import Skeleton
from skinnode.messages.health import DIAGNOSTIC_ARRAY, LOG, diagnostics, log_message
from skinnode.messages.health_report import HealthReport, encode_report
from skinnode.messages.poses import TRANSFORMS, transforms
from skinnode.messages.typestore import encode
from skinnode.process import clock
from skinnode.remote.output import Outputs

HEALTH_S: Final = 0.25
"""Interval between health reports, in s; also the maximum delay before a new subscription to fields takes
effect."""
_POLL_S: Final = 0.05
"""Maximum time until :meth:`StatusPublication.close` takes effect, in s."""


class Counters(Protocol):
    """Counters included in a health report."""

    @property
    def published(self) -> dict[str, int]:
        """Number of fields sent, by patch name."""

    @property
    def dropped(self) -> int:
        """Number of fields not sent."""


class StatusPublication:
    """Thread that publishes from construction until :meth:`close` or until the host closes.

    Args:
        host: Running host.
        outputs: Publishers; this thread uses only those that do not belong to a patch.
        started_ns: Unix time that identifies the run of the publication, in ns.
        counters: Function that returns the counters of the publication.
        defects: Record of exceptions.
    """

    def __init__(
        self,
        host: Host,
        outputs: Outputs,
        started_ns: int,
        counters: Callable[[], Counters],
        defects: Defects,
    ) -> None:
        self._host, self._outputs = host, outputs
        self._started_ns, self._counters, self._defects = started_ns, counters, defects
        self._skeleton = Skeleton.of(host.hand)
        self._events = host.events()
        self._due_s = 0.0
        self._over = clock.event()
        self.wall_minus_mono_ns = clock.time_ns() - clock.monotonic_ns()
        """Unix time minus the monotonic clock, in ns, as of the newest report."""
        self._thread = clock.thread(target=self._run, name="publish status")
        self._thread.start()

    def close(self) -> None:
        """Send the pending events and wait for the thread to end. Further calls have no effect."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "publishing the health")

    def _turn(self) -> bool:
        ending = self._over.is_set()
        event = self._events.get(0.0 if ending else _POLL_S)
        if event is not None:
            self._send_event(event)
        if ending or self._events.ended:
            return event is not None
        if clock.monotonic() >= self._due_s:
            self._due_s = clock.monotonic() + HEALTH_S
            self._report()
        return True

    def _report(self) -> None:
        """Find the topics that have subscribers; send the health and the poses."""
        now_ns = clock.time_ns()
        self.wall_minus_mono_ns = now_ns - clock.monotonic_ns()
        outputs, host = self._outputs, self._host
        outputs.look()
        patches = {patch.name: host.health(patch.name) for patch in host.hand.patches}
        buses = {bus.name: host.bus_health(bus.name) for bus in host.hand.served_buses}
        counters = self._counters()
        report = HealthReport(self._started_ns, patches, buses, counters.published, counters.dropped)
        outputs.health.send(encode_report(report, now_ns), now_ns)
        if outputs.diagnostics.wanted:
            health = diagnostics(host.hand.name, patches, buses, now_ns)
            outputs.diagnostics.send(encode(health, DIAGNOSTIC_ARRAY), now_ns)
        if outputs.transforms.wanted:
            outputs.transforms.send(encode(transforms(self._skeleton, now_ns), TRANSFORMS), now_ns)

    def _send_event(self, event: HealthEvent) -> None:
        message = log_message(event, event.t_ns + self.wall_minus_mono_ns)
        self._outputs.events.send(encode(message, LOG), clock.time_ns())
