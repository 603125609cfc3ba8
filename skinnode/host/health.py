"""How each patch is: what its node says of itself and what it does, side by side.

The mainline writes down what it sees (:class:`NodeMonitor`), :func:`judge` draws the conclusion when asked.
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
"""Heartbeat periods without one after which a node counts as lost. CiA 301 leaves it to the integrator; one
may be late behind a burst of frames and one be hit by a bus error."""

SCANS_MISSED: Final = 3
"""SYNC periods without a scan after which a patch counts as stale."""

SYNCS_MISSED: Final = 5
"""SYNC periods without one after which a guest says so; a patch is stale by then."""


class Condition(enum.StrEnum):
    """The one word for a patch."""

    NEVER_SEEN = "never seen"
    BOOTING = "booting"
    """Heard, not operational yet."""
    OPERATIONAL = "operational"
    STALE = "stale"
    """Operational by its heartbeat, but no scans arrive, or all are withheld."""
    RESTARTING = "restarting"
    """Restarting by itself in a loop: see :data:`LOOP_RESTARTS`. A node that restarted once, or that is
    operational again and has not restarted for 0.5 s, has the condition of its present state."""
    FROZEN = "frozen"
    """Scans come, but always with the same values: see :mod:`skinnode.host.code_watch`."""
    FAULTY = "faulty"
    """The node's error register is not zero, or the host had a defect while serving the patch:
    :attr:`PatchHealth.defect`."""
    REFUSED = "refused"
    """It answers, but is not what the hand file says, or does not keep its configuration."""
    LOST = "lost"
    """Was there, and its heartbeat stopped."""


@dataclass(frozen=True, slots=True)
class PatchHealth:
    """Health of a patch at one instant. Ages are None where the thing was never seen."""

    patch: str
    node_id: int
    condition: Condition
    nmt_state: int | None
    """As in the heartbeat: 5 operational, 127 pre-operational, 4 stopped, 0 just booted."""
    heartbeat_age_s: float | None
    scan_age_s: float | None
    boot_ups: int
    emergencies: int
    """EMCY messages with an error, since the host started."""
    last_emergency: int | None
    """Code of the newest of them."""
    emergency_text: str
    """The newest of them in words; empty before the first."""
    error_register: int
    rejoins: int = 0
    """Times the node came back and was brought up again since the host started."""
    refusal: str | None = None
    """Why a node that answers is not taken up: another identity or layout, a configuration not kept."""
    restarts_in_a_loop: bool = False
    """It restarted by itself three times within ten seconds, and goes on."""
    duplicate_id: bool = False
    """Heartbeats come more often than one node sends them."""
    conflicts: int = 0
    """Frames that contradict others of their scan: a node that counts wrongly, or two with one node-ID."""
    wires: tuple[WireFault, ...] = ()
    """Wires that are open, shorted, noisy or drifting."""
    defect: str | None = None
    """Operation of the host and the exception that it raised, until the patch has been brought up again."""
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
    """Why the interface is away; None while it is there."""
    load: float
    """Share of the last second that frames took."""
    error_frames: int
    bus_offs: int
    outages: int
    kernel_dropped: int
    dropped: int
    """Frames that found the host's own queue full."""
    malformed: int
    foreign: int
    """Frames of COB-IDs that the hand file does not explain: those of ``foreign_ids``."""
    foreign_ids: tuple[int, ...]
    other_syncs: int
    """SYNC of another producer, where the host is the master."""
    other_masters: int
    """NMT commands, SDO requests to our nodes, or our own heartbeat, from somebody else."""
    controller: BusState | None = None
    """What the interface said last of its controller; None where it said nothing, and where it does not."""
    no_sync: bool = False
    """Where the host is a guest: none of its master's SYNCs has come for :data:`SYNCS_MISSED` periods."""


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
