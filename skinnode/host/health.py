"""Define health snapshots of patches and buses, and derive the condition of a patch.

The evidence for the condition comes from :class:`~skinnode.host.node_monitor.NodeMonitor`.
"""

from __future__ import annotations

import enum
import logging
from dataclasses import dataclass
from typing import Final

from skinnode.canopen.emergency import register_text
from skinnode.canopen.nmt import STATE_NAMES, NmtState
from skinnode.host.converter_liveness import Alive
from skinnode.host.open_and_shorted_wires import WireFault
from skinnode.model.data_fault import DataFault
from skinnode.model.frames import FieldFrame
from skinnode.transport.bus_state import BusState

_log = logging.getLogger(__name__)

HEARTBEATS_MISSED: Final = 3
"""Number of heartbeat periods without a heartbeat after which a node counts as lost. CiA 301 does not specify
this number. Three periods tolerate one heartbeat delayed by a burst of frames and one destroyed by a bus
error.
"""

SCANS_MISSED: Final = 3
"""Number of SYNC periods without a scan after which a patch counts as stale."""

SYNCS_MISSED: Final = 5
"""Number of SYNC periods after which a missing SYNC is reported on a bus that another master runs. By then,
the patches are stale (:data:`SCANS_MISSED`).
"""


class Condition(enum.StrEnum):
    """Condition of a patch: the most serious of the states that apply."""

    NEVER_SEEN = "never seen"
    BOOTING = "booting"
    """The node sends frames but is not operational yet."""
    OPERATIONAL = "operational"
    STALE = "stale"
    """The heartbeat reports operational, but no scans arrive or all scans are withheld."""
    RESTARTING = "restarting"
    """The node keeps restarting without a command; see :data:`~skinnode.host.node_monitor.LOOP_RESTARTS`. The
    condition ends when the node is operational and has not restarted for 0.5 s.
    """
    FROZEN = "frozen"
    """Scans arrive, but the converter has stopped; see :mod:`skinnode.host.converter_liveness`."""
    FAULTY = "faulty"
    """The node's error register is not zero, or serving the patch has raised an exception
    (:attr:`PatchHealth.defect`).
    """
    REFUSED = "refused"
    """The node responds, but it does not match the hand file or does not keep its configuration."""
    LOST = "lost"
    """The node's heartbeat has stopped."""


@dataclass(frozen=True, slots=True)
class PatchHealth:
    """Snapshot of a patch's health.

    ``heartbeat_age_s`` and ``scan_age_s`` are the ages of the newest heartbeat and scan; None before the
    first one.
    """

    patch: str
    node_id: int
    condition: Condition
    nmt_state: int | None
    """NMT state in the newest heartbeat: 0 booted, 4 stopped, 5 operational, 127 pre-operational."""
    heartbeat_age_s: float | None
    scan_age_s: float | None
    boot_ups: int
    emergencies: int
    """Number of EMCY messages reporting an error since the host started."""
    last_emergency: int | None
    """Error code of the newest EMCY message reporting an error; None before the first one."""
    emergency_text: str
    """Description of the newest EMCY message reporting an error; empty before the first one."""
    error_register: int
    rejoins: int = 0
    """Number of times the node has been brought up again since the host started."""
    refusal: str | None = None
    """Reason why a responding node is not used: wrong identity or layout, or a configuration that it does not
    keep.
    """
    restarts_in_a_loop: bool = False
    """Whether the node has restarted three times in ten seconds without a command, most recently less than
    5 s ago.
    """
    duplicate_id: bool = False
    """Whether two nodes seem to share the node-ID: heartbeats arrive more often than one node would send
    them."""
    conflicts: int = 0
    """Number of frames that contradict another frame of the same scan. The cause may be a wrong counter in
    the node, or two nodes with the same node-ID.
    """
    wires: tuple[WireFault, ...] = ()
    """Open, shorted, noisy and drifting wires."""
    alive: Alive = Alive.CANNOT_TELL
    """Whether the converter is running. If it is not, the condition is ``frozen`` or a more serious one."""
    life: str = ""
    """Human-readable reason to doubt that the converter is running; empty if there is none."""
    faults: tuple[DataFault, ...] = ()
    """Faults found in the data of the newest field, each with its part, first scan and certainty."""
    defect: str | None = None
    """Last host operation that raised an exception while serving the patch, and the exception; reset to None
    by the next bring-up.
    """
    slow_overruns: int = 0
    """Number of EMCY messages (code 0x8110) about scans that the node skipped because its computer or the bus
    was too slow.
    """
    baselines: int = 0
    """Number of new baselines that the host has read, for example after a tare."""
    complaint: str | None = None
    """Reason why the last bring-up failed; None if it succeeded."""
    withheld: bool = False
    """Whether the host withholds scans while it brings up the node or reads its baseline."""

    @property
    def reason(self) -> str:
        """Reason for the condition or for doubts about the converter, as text; empty if there is none."""
        match self.condition:
            case Condition.OPERATIONAL:
                return self.life
            case Condition.REFUSED:
                return self.refusal or "refused"
            case Condition.NEVER_SEEN:
                return self.complaint or f"node {self.node_id} has sent nothing"
            case Condition.LOST:
                silence_s = self.heartbeat_age_s or 0.0
                return self._with_complaint(f"no heartbeat from node {self.node_id} for {silence_s:.1f} s")
            case Condition.RESTARTING:
                return (
                    f"node {self.node_id} keeps restarting without a command; {self.boot_ups} boot-ups so far"
                )
            case Condition.BOOTING:
                state = STATE_NAMES.get(self.nmt_state or 0, f"in NMT state {self.nmt_state}")
                return self._with_complaint(f"node {self.node_id} is {state}, not operational yet")
            case Condition.FAULTY:
                return self.defect or self._error()
            case Condition.STALE:
                return self._staleness()
            case Condition.FROZEN:
                return f"node {self.node_id} is frozen: {self.life or 'its codes do not change'}"

    def _with_complaint(self, text: str) -> str:
        return f"{text}; {self.complaint}" if self.complaint else text

    def _staleness(self) -> str:
        if self.withheld:
            held = "its scans are withheld until its configuration and baseline have been read"
            return self._with_complaint(held)
        if self.scan_age_s is None:
            return f"no scan from node {self.node_id} received yet"
        return f"no scan from node {self.node_id} for {self.scan_age_s:.2f} s"

    def _error(self) -> str:
        register = f"error register 0x{self.error_register:02X} ({register_text(self.error_register)})"
        if self.last_emergency is None:
            return register
        return f"{register}; newest emergency 0x{self.last_emergency:04X} {self.emergency_text}"


def faults_of(field: FieldFrame | None) -> tuple[DataFault, ...]:
    """Return the faults in a field's data; an empty tuple if ``field`` is None."""
    return () if field is None else field.faults


@dataclass(frozen=True, slots=True)
class BusHealth:
    """Snapshot of a bus's health. The counters start at 0 when the host starts."""

    bus: str
    away: str | None
    """Reason why the bus is unavailable; None while it is available."""
    load: float
    """Bus load over the last second, as a fraction of the capacity."""
    error_frames: int
    bus_offs: int
    outages: int
    kernel_dropped: int
    dropped: int
    """Number of frames dropped because the host's receive queue was full."""
    malformed: int
    foreign: int
    """Number of frames with an unexpected COB-ID; ``foreign_ids`` lists these COB-IDs."""
    foreign_ids: tuple[int, ...]
    other_syncs: int
    """Number of SYNC messages from another producer on a bus where the host is the master."""
    other_masters: int
    """Number of NMT commands, SDO requests to the hand's nodes, and heartbeats with the host's node-ID that
    came from other senders.
    """
    controller: BusState | None = None
    """Last reported state of the CAN controller; None before the first report."""
    no_sync: bool = False
    """Whether another master runs the bus but no SYNC has arrived for :data:`SYNCS_MISSED` SYNC periods."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence for the condition of a patch.

    ``late_heartbeats`` and ``late_scans`` are the ages of the newest heartbeat and scan, in heartbeat periods
    and scan periods respectively; None before the first one.
    """

    nmt_state: int | None
    late_heartbeats: float | None
    late_scans: float | None
    restarting: bool
    error_register: int
    refused: bool = False
    frozen: bool = False
    defective: bool = False


def condition_of(facts: Evidence) -> Condition:
    """Return the most serious condition that applies to the patch."""
    late = facts.late_heartbeats
    stale = facts.late_scans is None or facts.late_scans > SCANS_MISSED
    rules = (
        (facts.refused, Condition.REFUSED),
        (facts.defective, Condition.FAULTY),
        (late is None, Condition.NEVER_SEEN),
        (late is not None and late > HEARTBEATS_MISSED, Condition.LOST),
        (facts.restarting, Condition.RESTARTING),
        (facts.nmt_state != NmtState.OPERATIONAL, Condition.BOOTING),
        (facts.error_register != 0, Condition.FAULTY),
        (stale, Condition.STALE),
        (facts.frozen, Condition.FROZEN),
    )
    for holds, condition in rules:
        if holds:
            return condition
    return Condition.OPERATIONAL
