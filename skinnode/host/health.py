"""Health of patches and buses: conditions, and the rules that derive them from facts.

:class:`~skinnode.host.node_monitor.NodeMonitor` collects the facts on the mainline.
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
"""Number of heartbeat periods without a heartbeat after which a node is considered lost. CiA 301 leaves this
number to the integrator; a burst of frames may delay one heartbeat and a bus error may destroy another."""

SCANS_MISSED: Final = 3
"""Number of SYNC periods without a scan after which a patch is considered stale."""

SYNCS_MISSED: Final = 5
"""Number of SYNC periods without SYNC after which another master's bus is reported as lacking SYNC; its
patches are stale by then."""


class Condition(enum.StrEnum):
    """The state of a patch in one word."""

    NEVER_SEEN = "never seen"
    BOOTING = "booting"
    """The node is sending frames, but is not operational yet."""
    OPERATIONAL = "operational"
    STALE = "stale"
    """Operational according to the node's heartbeat, but no scans arrive, or all scans are withheld."""
    RESTARTING = "restarting"
    """The node restarts by itself in a loop: see :data:`~skinnode.host.node_monitor.LOOP_RESTARTS`. A node
    that restarted once, or that is operational again and has not restarted for 0.5 s, is given the condition
    that fits its current state."""
    FROZEN = "frozen"
    """Scans arrive, but their converter has stopped: see :mod:`skinnode.host.converter_liveness`."""
    FAULTY = "faulty"
    """The node's error register is not zero, or serving the patch raised an exception
    (:attr:`PatchHealth.defect`)."""
    REFUSED = "refused"
    """The node answers, but does not match the hand file or does not keep its configuration."""
    LOST = "lost"
    """The node's heartbeat has stopped."""


@dataclass(frozen=True, slots=True)
class PatchHealth:
    """Health of a patch at one instant. An age is None if the event has never occurred."""

    patch: str
    node_id: int
    condition: Condition
    nmt_state: int | None
    """NMT state as in the heartbeat: 5 operational, 127 pre-operational, 4 stopped, 0 just booted."""
    heartbeat_age_s: float | None
    scan_age_s: float | None
    boot_ups: int
    emergencies: int
    """Number of EMCY messages reporting an error since the host started."""
    last_emergency: int | None
    """Error code of the newest EMCY message that reported an error; None before the first."""
    emergency_text: str
    """Description of the newest EMCY message that reported an error; empty before the first."""
    error_register: int
    rejoins: int = 0
    """Number of times the node has come back and been brought up again since the host started."""
    refusal: str | None = None
    """Why a node that answers is not used: wrong identity or layout, or configuration not kept."""
    restarts_in_a_loop: bool = False
    """Whether the node restarted by itself three times within ten seconds, the last time within the past 5
    s."""
    duplicate_id: bool = False
    """Whether heartbeats arrive more often than a single node would send them."""
    conflicts: int = 0
    """Number of frames that contradict other frames of the same scan: the node's counter is wrong, or two
    nodes share a node-ID."""
    wires: tuple[WireFault, ...] = ()
    """Wires that are open, shorted, noisy or drifting."""
    alive: Alive = Alive.CANNOT_TELL
    """Whether the converter is running. No means that the condition is frozen."""
    life: str = ""
    """Why the converter is not known to be running, in words; empty if it is."""
    faults: tuple[DataFault, ...] = ()
    """Faults in the data of the newest field: which parts, since when, how sure."""
    defect: str | None = None
    """The host's failed operation and its exception, until the patch has been brought up again."""
    slow_overruns: int = 0
    """Number of EMCY messages 0x8110 reporting that the computer or bus is too slow for the node's scans."""
    baselines: int = 0
    """Number of times a changed baseline was read, for example after a tare."""
    complaint: str | None = None
    """Why the last bring-up failed; None once a bring-up has succeeded."""
    withheld: bool = False
    """Whether arriving scans cannot be decoded yet because the node is being brought up or its baseline is
    being read."""

    @property
    def reason(self) -> str:
        """Why the patch is not operational, or not known to be alive, in one line; empty if it is both."""
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
                return f"node {self.node_id} restarts by itself in a loop; {self.boot_ups} boot-ups so far"
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
    """Return the faults in the data of a field; none if there is no field."""
    return () if field is None else field.faults


@dataclass(frozen=True, slots=True)
class BusHealth:
    """Health of a bus at one instant; events are counted from the start of the host."""

    bus: str
    away: str | None
    """Why the interface is unavailable; None while it works."""
    load: float
    """Fraction of the last second during which frames occupied the bus."""
    error_frames: int
    bus_offs: int
    outages: int
    kernel_dropped: int
    dropped: int
    """Frames dropped because the host's own queue was full."""
    malformed: int
    foreign: int
    """Frames with COB-IDs not used anywhere in the hand file; ``foreign_ids`` lists the COB-IDs."""
    foreign_ids: tuple[int, ...]
    other_syncs: int
    """SYNC messages from another producer on a bus where the host is the master."""
    other_masters: int
    """NMT commands, SDO requests to the hand's nodes, and heartbeats with the host's node-ID, from other
    senders."""
    controller: BusState | None = None
    """Newest reported state of the controller; None if none was reported."""
    no_sync: bool = False
    """Whether another master runs the bus and its SYNC has been absent for :data:`SYNCS_MISSED` periods."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Facts about a patch that determine its condition. Ages are in periods; None if never received."""

    nmt_state: int | None
    late_heartbeats: float | None
    late_scans: float | None
    restarting: bool
    error_register: int
    refused: bool = False
    frozen: bool = False
    defective: bool = False


def condition_of(facts: Evidence) -> Condition:
    """Return the most serious condition that the facts indicate."""
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
