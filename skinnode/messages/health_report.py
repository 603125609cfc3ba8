"""Converts a hand's health to ``skinnode_msgs/HealthReport`` and back, without loss."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from skinnode.host.converter_liveness import Alive
from skinnode.host.health import BusHealth, Condition, PatchHealth
from skinnode.host.open_and_shorted_wires import WireFault, WireState
from skinnode.messages.definitions import HEALTH_REPORT
from skinnode.messages.typestore import decode, encode, header, message_type
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.transport.bus_state import BusState


@dataclass(frozen=True, slots=True)
class HealthReport:
    """Health of a hand at one instant, and its publisher's counters."""

    started_ns: int
    """Unix time (ns) at which the publisher started; identifies the publisher's run."""
    patches: Mapping[str, PatchHealth]
    buses: Mapping[str, BusHealth]
    published: Mapping[str, int]
    """Number of fields sent so far in this run, by patch name."""
    dropped: int
    """Number of fields, over all patches, that the publisher could not send in time."""


def encode_report(report: HealthReport, t_ns: int) -> bytes:
    """Encode a report as ``skinnode_msgs/HealthReport``.

    Args:
        report: The report.
        t_ns: Unix time, in ns.
    """
    table = dataclasses.asdict(report)
    del table["started_ns"]
    message = message_type(HEALTH_REPORT)(header(t_ns, ""), report.started_ns, json.dumps(table))
    return encode(message, HEALTH_REPORT)


def decode_report(data: bytes) -> HealthReport:
    """Decode a report.

    Raises:
        ValueError: The data are not a valid ``skinnode_msgs/HealthReport``.
    """
    message = decode(data, HEALTH_REPORT)
    try:
        table = json.loads(message.json)
        return HealthReport(
            message.started_ns,
            {name: _patch(each) for name, each in table["patches"].items()},
            {name: _bus(each) for name, each in table["buses"].items()},
            table["published"],
            table["dropped"],
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{HEALTH_REPORT}: {error!r}") from None


def _patch(table: dict[str, Any]) -> PatchHealth:
    table["condition"] = Condition(table["condition"])
    table["alive"] = Alive(table["alive"])
    table["wires"] = tuple(
        WireFault(each["side"], each["number"], WireState(each["state"])) for each in table["wires"]
    )
    table["faults"] = tuple(
        DataFault(**{**each, "part": FaultyPart(each["part"]), "kind": FaultKind(each["kind"])})
        for each in table["faults"]
    )
    return PatchHealth(**table)


def _bus(table: dict[str, Any]) -> BusHealth:
    table["foreign_ids"] = tuple(table["foreign_ids"])
    if table["controller"] is not None:
        table["controller"] = BusState(table["controller"])
    return BusHealth(**table)
