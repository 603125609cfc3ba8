"""Health of patches and buses: conditions, and the rules by which facts lead to a condition.

:class:`~skinnode.host.node_monitor.NodeMonitor` collects the facts on the mainline.
"""

from __future__ import annotations

import enum
import logging
from dataclasses import dataclass
from typing import Final

from skinnode.canopen.emergency import register_text
from skinnode.canopen.nmt import STATE_NAMES, NmtState
from skinnode.host.code_watch import WireFault
from skinnode.transport.bus_state import BusState

_log = logging.getLogger(__name__)

HEARTBEATS_MISSED: Final = 3
"""Heartbeat periods without a heartbeat after which a node is lost. CiA 301 leaves it to the integrator; one
may be delayed by a burst of frames and one be destroyed by a bus error."""

SCANS_MISSED: Final = 3
"""SYNC periods without a scan after which a patch is stale."""

SYNCS_MISSED: Final = 5
"""SYNC periods without SYNC after which a bus of another master lacks SYNC; its patches are stale by then."""


class Condition(enum.StrEnum):
    """The state of a patch in one word."""

    NEVER_SEEN = "never seen"
    BOOTING = "booting"
    """The node sends, but is not operational yet."""
    OPERATIONAL = "operational"
    STALE = "stale"
    """Operational by its heartbeat, but no scans arrive, or all are withheld."""
    RESTARTING = "restarting"
    """The node restarts by itself in a loop: see :data:`~skinnode.host.node_monitor.LOOP_RESTARTS`. A node
    that restarted once, or that is operational again and has not restarted for 0.5 s, has the condition of
    its present state."""
    FROZEN = "frozen"
    """Scans arrive, but always with the same values: see :mod:`skinnode.host.code_watch`."""
    FAULTY = "faulty"
    """The node's error register is not zero, or the host had a defect while serving the patch:
    :attr:`PatchHealth.defect`."""
    REFUSED = "refused"
    """The node answers, but is not what the hand file says, or does not keep its configuration."""
    LOST = "lost"
    """The heartbeat of the node stopped."""


@dataclass(frozen=True, slots=True)
class PatchHealth:
    """Health of a patch at one instant. An age is None if the event never occurred."""

    patch: str
    node_id: int
    condition: Condition
    nmt_state: int | None
    """As in the heartbeat: 5 operational, 127 pre-operational, 4 stopped, 0 just booted."""
    heartbeat_age_s: float | None
    scan_age_s: float | None
    boot_ups: int
    emergencies: int
    """EMCY messages that reported an error, since the host started."""
    last_emergency: int | None
    """Code of the newest of them."""
    emergency_text: str
    """Description of the newest of them; empty before the first."""
    error_register: int
    rejoins: int = 0
    """Times the node came back and was brought up again since the host started."""
    refusal: str | None = None
    """Why a node that answers is not used: another identity or layout, or a configuration not kept."""
    restarts_in_a_loop: bool = False
    """Whether the node restarted by itself three times within ten seconds, and continues to."""
    duplicate_id: bool = False
    """Whether heartbeats come more often than one node sends them."""
    conflicts: int = 0
    """Frames that contradict others of their scan: the node counts wrongly, or two nodes share a node-ID."""
    wires: tuple[WireFault, ...] = ()
    """Wires that are open, shorted, noisy or drifting."""
    defect: str | None = None
    """Operation of the host that raised an exception, and the exception, until the patch is brought up again.
    """
    slow_overruns: int = 0
    """Number of emergencies 0x8110 that report a computer or bus too slow for the node's scans."""
    baselines: int = 0
    """Number of times a changed baseline was read, as after a tare."""
    complaint: str | None = None
    """Why the last bring-up failed; None once a bring-up succeeded."""
    withheld: bool = False
    """Whether scans arrive that cannot be decoded yet, because the node is being brought up or its baseline
    is being read."""

    @property
    def reason(self) -> str:
        """Why the patch is not operational, in one line; empty if it is operational."""
        match self.condition:
            case Condition.OPERATIONAL:
                return ""
            case Condition.REFUSED:
                return self.refusal or "refused"
            case Condition.NEVER_SEEN:
                return self.complaint or f"node {self.node_id} has sent nothing"
            case Condition.LOST:
                silence_s = self.heartbeat_age_s or 0.0
                return self._with_complaint(f"no heartbeat of node {self.node_id} for {silence_s:.1f} s")
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
                return f"node {self.node_id} sends the same codes again and again"

    def _with_complaint(self, text: str) -> str:
        return f"{text}; {self.complaint}" if self.complaint else text

    def _staleness(self) -> str:
        if self.withheld:
            held = "its scans are withheld until its configuration and baseline have been read"
            return self._with_complaint(held)
        if self.scan_age_s is None:
            return f"no scan of node {self.node_id} received yet"
        return f"no scan of node {self.node_id} for {self.scan_age_s:.2f} s"

    def _error(self) -> str:
        register = f"error register 0x{self.error_register:02X} ({register_text(self.error_register)})"
        if self.last_emergency is None:
            return register
        return f"{register}; newest emergency 0x{self.last_emergency:04X} {self.emergency_text}"


@dataclass(frozen=True, slots=True)
class BusHealth:
    """Health of a bus at one instant; counts are since the host started."""

    bus: str
    away: str | None
    """Why the interface is away; None while it works."""
    load: float
    """Share of the last second taken by frames."""
    error_frames: int
    bus_offs: int
    outages: int
    kernel_dropped: int
    dropped: int
    """Frames that found the host's own queue full."""
    malformed: int
    foreign: int
    """Frames with COB-IDs that the hand file does not explain: those of ``foreign_ids``."""
    foreign_ids: tuple[int, ...]
    other_syncs: int
    """SYNC messages of another producer on a bus where the host is the master."""
    other_masters: int
    """NMT commands, SDO requests to nodes of the hand, or heartbeats with the host's node-ID, from another
    sender."""
    controller: BusState | None = None
    """Newest reported state of the controller; None if none was reported."""
    no_sync: bool = False
    """Whether another master runs the bus and its SYNC has not come for :data:`SYNCS_MISSED` periods."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Facts about a patch from which its condition follows. Ages are in periods, None if never seen."""

    nmt_state: int | None
    late_heartbeats: float | None
    late_scans: float | None
    restarting: bool
    error_register: int
    refused: bool = False
    frozen: bool = False
    defective: bool = False


def condition_of(facts: Evidence) -> Condition:
    """Return the most serious condition that the facts show."""
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
