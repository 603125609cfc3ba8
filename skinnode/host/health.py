"""Define the health of patches and buses, and derive a patch's condition from evidence.

Evidence about a node is collected on the mainline by :class:`~skinnode.host.node_monitor.NodeMonitor`.
"""

from __future__ import annotations

import enum
import logging
from dataclasses import dataclass
from typing import Final

from skinnode.canopen.emergency import register_text
from skinnode.canopen.nmt import STATE_NAMES, NmtState
from skinnode.host.converter_liveness import Alive
from skinnode.host.wire_faults import WireFault
from skinnode.model.data_fault import DataFault
from skinnode.model.frames import FieldFrame
from skinnode.transport.bus_state import BusState

_log = logging.getLogger(__name__)

HEARTBEATS_MISSED: Final = 3
"""Number of heartbeat periods without a heartbeat after which a node is declared lost. CiA 301 does not
specify this number. The value tolerates two missing heartbeats: one delayed by a burst of frames and one
destroyed by a bus error.
"""

SCANS_MISSED: Final = 3
"""Number of SYNC periods without a scan after which a patch is declared stale."""

SYNCS_MISSED: Final = 5
"""Number of SYNC periods without a SYNC message after which missing SYNC is reported on a bus that another
master runs. By then, the patches on the bus are already stale (:data:`SCANS_MISSED`).
"""


class Condition(enum.StrEnum):
    """Condition of a patch: the most serious of the states that apply."""

    NEVER_SEEN = "never seen"
    BOOTING = "booting"
    """The node is sending frames but is not operational yet."""
    OPERATIONAL = "operational"
    STALE = "stale"
    """The node is operational according to its heartbeat, but no scans arrive, or all scans are withheld."""
    RESTARTING = "restarting"
    """The node restarts repeatedly without a command: see :data:`~skinnode.host.node_monitor.LOOP_RESTARTS`.
    The condition ends when the node is operational again and has not restarted for 0.5 s.
    """
    FROZEN = "frozen"
    """Scans arrive, but the patch's converter has stopped: see :mod:`skinnode.host.converter_liveness`."""
    FAULTY = "faulty"
    """The node's error register is not zero, or serving the patch raised an exception
    (:attr:`PatchHealth.defect`)."""
    REFUSED = "refused"
    """The node responds, but does not match the hand file or does not keep its configuration."""
    LOST = "lost"
    """The node's heartbeat has stopped."""


@dataclass(frozen=True, slots=True)
class PatchHealth:
    """Snapshot of a patch's health.

    The age of the newest heartbeat or scan is None until a heartbeat or scan has been received.
    """

    patch: str
    node_id: int
    condition: Condition
    nmt_state: int | None
    """NMT state from the newest heartbeat: 5 operational, 127 pre-operational, 4 stopped, 0 just booted."""
    heartbeat_age_s: float | None
    scan_age_s: float | None
    boot_ups: int
    emergencies: int
    """Number of EMCY messages that have reported an error since the host started."""
    last_emergency: int | None
    """Error code of the newest EMCY message that reported an error; None before the first such message."""
    emergency_text: str
    """Description of the newest EMCY message that reported an error; empty before the first such message."""
    error_register: int
    rejoins: int = 0
    """Number of times the node has reappeared and been brought up again since the host started."""
    refusal: str | None = None
    """Reason why the host does not use a node that responds: wrong identity or layout, or configuration not
    kept.
    """
    restarts_in_a_loop: bool = False
    """Whether the node has restarted three times within ten seconds without a command, and the last restart
    was less than 5 s ago.
    """
    duplicate_id: bool = False
    """Whether two nodes appear to share the node-ID, because heartbeats arrive more often than a single node
    would send them.
    """
    conflicts: int = 0
    """Number of frames that contradict other frames of the same scan. Possible causes are a wrong counter in
    the node and two nodes with the same node-ID.
    """
    wires: tuple[WireFault, ...] = ()
    """Wire faults: open, shorted, noisy and drifting wires."""
    alive: Alive = Alive.CANNOT_TELL
    """Whether the patch's converter is running. If the value is ``no``, the condition is ``frozen``."""
    life: str = ""
    """Human-readable reason why the converter may not be running; empty if the converter is running."""
    faults: tuple[DataFault, ...] = ()
    """Faults found in the newest field's data; each fault states the affected part, the first scan and the
    certainty.
    """
    defect: str | None = None
    """Host operation that failed most recently for this patch, with its exception; reset to None by the next
    bring-up.
    """
    slow_overruns: int = 0
    """Number of EMCY messages with code 0x8110 that report skipped scans because the node's computer or the
    bus was too slow.
    """
    baselines: int = 0
    """Number of times the host has read a changed baseline, for example after a tare."""
    complaint: str | None = None
    """Reason why the last bring-up failed; None if that bring-up succeeded."""
    withheld: bool = False
    """Whether scans are withheld because the node is being brought up or its baseline is being read."""

    @property
    def reason(self) -> str:
        """Reason why the patch is not operational or may not be converting; empty if there is none."""
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
    """Return the faults in a field's data; an empty tuple if there is no field."""
    return () if field is None else field.faults


@dataclass(frozen=True, slots=True)
class BusHealth:
    """Snapshot of a bus's health. All counters start at 0 when the host starts."""

    bus: str
    away: str | None
    """Reason why the interface is unavailable; None while the interface works."""
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
    """Number of frames with a COB-ID that the host does not expect; ``foreign_ids`` lists these COB-IDs."""
    foreign_ids: tuple[int, ...]
    other_syncs: int
    """Number of SYNC messages from another producer on a bus whose master is the host."""
    other_masters: int
    """Number of received frames that only the host should send: NMT commands, SDO requests to the hand's
    nodes, and heartbeats with the host's node-ID.
    """
    controller: BusState | None = None
    """Most recently reported state of the CAN controller; None if no state has been reported."""
    no_sync: bool = False
    """Whether another master runs the bus and no SYNC message has arrived for :data:`SYNCS_MISSED` SYNC
    periods.
    """


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence that determines a patch's condition.

    The fields ``late_heartbeats`` and ``late_scans`` state the age of the newest heartbeat and scan in
    heartbeat periods and scan periods; None if no heartbeat or scan has been received.
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
    return next((condition for holds, condition in rules if holds), Condition.OPERATIONAL)
