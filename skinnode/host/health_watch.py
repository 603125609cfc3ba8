"""Monitor the health of a running host and the touches on its patches, and publish changes as events."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Final, Self

from skinnode.host.containment import Defects, DefectStats, keep_on
from skinnode.host.events import Events, HealthEvent
from skinnode.host.health import BusHealth, PatchHealth
from skinnode.host.touch_changes import TouchChange
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.process import clock
from skinnode.text.words import counted

_CHECK_S: Final = 0.05
"""Interval (s) between health checks. A change that lasts less than this interval may appear only in the
counters."""

_QUIET_NS: Final = 1_000_000_000
"""Minimum interval (ns) between events for the same counter."""


_PATCH_COUNTERS: Final = {
    "boot_ups": ("boot-up", ""),
    "emergencies": ("emergency", "emergencies"),
    "rejoins": ("rejoin", ""),
    "baselines": ("new baseline in use", "new baselines in use"),
    "conflicts": ("conflict", ""),
}
"""Counters of :class:`PatchHealth`, mapped to the noun in event texts (singular, irregular plural)."""
_BUS_COUNTERS: Final = {
    "bus_offs": ("bus-off", ""),
    "error_frames": ("error frame", ""),
    "foreign": ("foreign frame", ""),
    "kernel_dropped": ("frame dropped by the kernel", "frames dropped by the kernel"),
    "dropped": ("frame dropped", "frames dropped"),
    "malformed": ("malformed frame", ""),
    "outages": ("outage", ""),
    "other_syncs": ("SYNC of another producer", "SYNCs of another producer"),
    "other_masters": ("command of another master", "commands of another master"),
}
"""Counters of :class:`BusHealth`, mapped to the noun in event texts (singular, irregular plural)."""


def _monotonic_ns() -> int:
    return clock.monotonic_ns()


def _is_frozen_part(fault: DataFault) -> bool:
    return fault.kind is FaultKind.FROZEN and fault.part is not FaultyPart.PATCH


class HealthWatch:
    """Publishes changes in the health of all patches and buses, and the onsets and releases of touches.

    Threads: a dedicated thread checks the health, from :meth:`__enter__` until :meth:`close`. Without that
    thread, the caller must call :meth:`check`.

    Args:
        patches: Function that returns the health of each patch.
        buses: Function that returns the health of each bus.
        events: Destination of the published changes.
        defects: Collector of the exceptions.
        all_defects: Function that returns the statistics of all contained exceptions.
        touches: Function that returns the onsets and releases since its last call.
        now_ns: Function that returns the time (ns) of a check.
    """

    def __init__(  # noqa: PLR0913 - what is watched, and by which clock
        self,
        patches: Callable[[], Mapping[str, PatchHealth]],
        buses: Callable[[], Mapping[str, BusHealth]],
        events: Events,
        defects: Defects | None = None,
        all_defects: Callable[[], Mapping[str, DefectStats]] = dict,
        touches: Callable[[], list[TouchChange]] = list,
        now_ns: Callable[[], int] = _monotonic_ns,
    ) -> None:
        self._patches, self._buses, self._events = patches, buses, events
        self._defects = Defects("host") if defects is None else defects
        self._all_defects, self._touches, self._now_ns = all_defects, touches, now_ns
        self._ended = False
        self._patch_before, self._bus_before = dict(patches()), dict(buses())
        # (subject, counter) -> time and counter value of the last event
        self._reported: dict[tuple[str, str], tuple[int, int]] = {}
        self._stop = clock.event()
        self._thread = clock.thread(target=self._run, name="health")

    def close(self) -> None:
        """Check the health once more, then end and join the thread."""
        self._stop.set()
        self._thread.join()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "watching the health")

    def _turn(self) -> bool:
        """Wait for the next check and perform it. Return False after the last check.

        A check that raises an exception is repeated, so an event may be published twice but is never missed.
        """
        if self._ended:
            return False
        self._ended = self._stop.wait(_CHECK_S)
        self.check()
        return True

    def check(self) -> None:
        """Publish the changes since the last check. Never raises."""
        for check in (self._check_touches, self._check_patches, self._check_buses, self._check_defects):
            try:
                check()
            except Exception as error:
                self._defects.report("watching the health", error)

    def _check_touches(self) -> None:
        for change in self._touches():
            self._events.publish(HealthEvent(change.t_ns, change.patch, change.what, change.text))

    def _check_patches(self) -> None:
        for name, health in self._patches().items():
            self._compare_patch(name, self._patch_before[name], health)
            self._patch_before[name] = health

    def _check_buses(self) -> None:
        for name, bus in self._buses().items():
            self._compare_bus(name, self._bus_before[name], bus)
            self._bus_before[name] = bus

    def _check_defects(self) -> None:
        words = ("defect of the host", "defects of the host")
        for name, stats in self._all_defects().items():
            self._compare_count(name, "defects", (0, stats.count), words, f", last {stats.newest}")

    def _compare_bus(self, name: str, before: BusHealth, now: BusHealth) -> None:
        if now.away != before.away:
            self._publish(name, "away" if now.away else "back", now.away or "the bus is available again")
        if now.no_sync != before.no_sync:
            text = "no SYNC received from its master" if now.no_sync else "SYNC received again"
            self._publish(name, "no SYNC" if now.no_sync else "SYNC", text)
        if now.controller is not before.controller and now.controller is not None:
            self._publish(name, now.controller.value, f"the controller is {now.controller}")
        self._compare_counters(name, before, now, _BUS_COUNTERS)

    def _compare_patch(self, name: str, before: PatchHealth, now: PatchHealth) -> None:
        if now.condition is not before.condition:
            why = f" ({now.reason})" if now.reason else ""
            self._publish(name, now.condition.value, f"{before.condition}, now {now.condition}{why}")
        if now.restarts_in_a_loop and not before.restarts_in_a_loop:
            self._publish(name, "restarts in a loop", "restarts in a loop: check its supply and watchdog")
        if now.duplicate_id and not before.duplicate_id:
            self._publish(name, "duplicate node-ID", f"two nodes have node-ID {now.node_id}")
        if now.wires != before.wires:
            self._compare_wires(name, before, now)
        if now.faults != before.faults:
            self._compare_frozen_parts(name, before, now)
        self._compare_counters(name, before, now, _PATCH_COUNTERS)

    def _compare_wires(self, name: str, before: PatchHealth, now: PatchHealth) -> None:
        for fault in sorted({*now.wires} - {*before.wires}):
            self._publish(name, fault.state.value, f"{fault.side} wire {fault.number} is {fault.state}")
        for fault in sorted({*before.wires} - {*now.wires}):
            self._publish(name, "well", f"{fault.side} wire {fault.number} is no longer {fault.state}")

    def _compare_frozen_parts(self, name: str, before: PatchHealth, now: PatchHealth) -> None:
        """Publish an event when a frozen wire or crossing is left out of the solve or used again."""
        was, are = (
            {each.place: each for each in health.faults if _is_frozen_part(each)} for health in (before, now)
        )
        for place in are.keys() - was.keys():
            sure = f"{are[place].deviations:.0f} standard deviations"
            self._publish(name, "left out", f"{place} repeats its codes; left out of the solve ({sure})")
        for place in was.keys() - are.keys():
            self._publish(name, "readmitted", f"{place} no longer repeats its codes")

    def _compare_counters(
        self, name: str, before: object, now: object, counters: Mapping[str, tuple[str, str]]
    ) -> None:
        for counter, words in counters.items():
            count = getattr(now, counter)
            if not count:  # most counters of a healthy hand are 0
                continue
            detail = ""
            if isinstance(now, BusHealth) and counter == "foreign":
                detail = ": " + ", ".join(f"0x{cob_id:03X}" for cob_id in now.foreign_ids)
            elif isinstance(now, PatchHealth) and counter == "emergencies":
                detail = f", last 0x{now.last_emergency or 0:04X} {now.emergency_text}"
            self._compare_count(name, counter, (getattr(before, counter), count), words, detail)

    def _compare_count(
        self, name: str, counter: str, counts: tuple[int, int], words: tuple[str, str], detail: str
    ) -> None:
        before, count = counts
        when_ns, reported = self._reported.get((name, counter), (0, before))
        if count > reported and (t_ns := self._now_ns()) - when_ns > _QUIET_NS:
            self._reported[name, counter] = t_ns, count
            self._publish(name, counter, f"{counted(count - reported, *words)}{detail}")

    def _publish(self, subject: str, what: str, text: str) -> None:
        self._events.publish(HealthEvent(self._now_ns(), subject, what, text))
