"""Converts health to ``diagnostic_msgs/DiagnosticArray``, and events to ``rcl_interfaces/Log``."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any, Final

from skinnode.host.events import HealthEvent
from skinnode.host.health import BusHealth, Condition, PatchHealth
from skinnode.host.open_and_shorted_wires import WireFault
from skinnode.messages.typestore import header, message_type, time_of
from skinnode.transport.bus_state import BusState

DIAGNOSTIC_ARRAY: Final = "diagnostic_msgs/msg/DiagnosticArray"
LOG: Final = "rcl_interfaces/msg/Log"

OK, WARN, ERROR, STALE = range(4)
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""

_LEVEL: Final = {
    Condition.OPERATIONAL: OK,
    Condition.BOOTING: WARN,
    Condition.STALE: STALE,
    Condition.NEVER_SEEN: STALE,
    Condition.LOST: STALE,
}
"""Diagnostic level by condition; any condition not listed is an error."""
_LOG_LEVEL: Final = {"good": 20, "note": 30, "bad": 40}
"""Level in ``rcl_interfaces/Log`` by event severity: INFO, WARN or ERROR."""


def diagnostics(
    hand: str, patches: Mapping[str, PatchHealth], buses: Mapping[str, BusHealth], t_ns: int
) -> Any:
    """Return a hand's health as ``diagnostic_msgs/DiagnosticArray``, with one status per patch and per bus.

    Args:
        hand: Name of the hand.
        patches: Health of each patch, by name.
        buses: Health of each bus, by name.
        t_ns: Unix time, in ns.
    """
    make = message_type("diagnostic_msgs/msg/DiagnosticStatus")
    statuses = [
        make(
            level=level_of(health),
            name=f"{hand}: {name}",
            message=_joined(str(health.condition), health.reason),
            hardware_id=f"node {health.node_id}",
            values=_values(health),
        )
        for name, health in patches.items()
    ]
    for name, bus in buses.items():
        level, text = _judged(bus)
        statuses.append(make(level, f"{hand}: {name}", text, name, _values(bus)))
    return message_type(DIAGNOSTIC_ARRAY)(header(t_ns, ""), statuses)


def level_of(health: PatchHealth) -> int:
    """Return a patch's diagnostic level; WARN for an operational patch with faulty wires or readings.

    Two nodes with the same node-ID are an error, as in ``skinnode monitor``.
    """
    level = ERROR if health.duplicate_id else _LEVEL.get(health.condition, ERROR)
    return WARN if level == OK and (health.wires or health.faults or health.life) else level


def _judged(bus: BusHealth) -> tuple[int, str]:
    """Return the diagnostic level of a bus and its reason."""
    if bus.away is not None:
        return ERROR, bus.away
    if bus.no_sync:
        return ERROR, "no SYNC"
    if bus.controller not in (None, BusState.ACTIVE):
        return ERROR if bus.controller is BusState.OFF else WARN, f"the controller is {bus.controller}"
    return OK, "available"


def log_message(event: HealthEvent, t_ns: int) -> Any:
    """Return an event as ``rcl_interfaces/Log``, with its subject as ``name`` and its type as ``function``.

    Args:
        event: The event.
        t_ns: Unix time of the event, in ns.
    """
    level = _LOG_LEVEL[event.severity]
    return message_type(LOG)(time_of(t_ns), level, event.subject, event.text, "skinnode", event.what, 0)


def event_of(message: Any) -> tuple[HealthEvent, int]:
    """Return the event from an ``rcl_interfaces/Log``, with ``t_ns`` 0, and its Unix time, in ns."""
    t_ns = message.stamp.sec * 1_000_000_000 + message.stamp.nanosec
    return HealthEvent(0, message.name, message.function, message.msg), t_ns


def _joined(condition: str, reason: str) -> str:
    return f"{condition}: {reason}" if reason else condition


def _values(health: PatchHealth | BusHealth) -> list[Any]:
    """Return all known values as text."""
    make = message_type("diagnostic_msgs/msg/KeyValue")
    values = ((entry.name, getattr(health, entry.name)) for entry in dataclasses.fields(health))
    return [make(name, _text(value)) for name, value in values if value is not None]


def _text(value: object) -> str:
    if isinstance(value, WireFault):
        return f"{value.side} wire {value.number} {value.state}"
    if isinstance(value, enum.Enum):
        return str(value) if isinstance(value, str) else value.name.lower()
    if isinstance(value, tuple):
        return "; ".join(map(_text, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)
