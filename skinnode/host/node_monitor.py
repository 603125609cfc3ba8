"""Evaluate a node's heartbeats and EMCY messages, and derive the health of its patch."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from typing import Final

from skinnode.canopen.emergency import error_text, says_too_slow
from skinnode.canopen.indices import emcy_cob_id, heartbeat_cob_id
from skinnode.canopen.nmt import STATE_MASK, NmtState
from skinnode.errors import CodecError
from skinnode.host.code_watch import CodeWatch
from skinnode.host.converter_liveness import Alive
from skinnode.host.health import (
    HEARTBEATS_MISSED,
    SCANS_MISSED,
    Condition,
    Evidence,
    PatchHealth,
    condition_of,
)

_log = logging.getLogger(__name__)

RESTART_MEMORY_NS: Final = 5_000_000_000
"""Time (ns) for which a restart loop continues to be reported after its last restart."""

SETTLED_NS: Final = 500_000_000
"""Minimum time (ns) for which the condition stays *restarting* after the last restart in a loop, even if the
node is operational.
"""

LOOP_RESTARTS: Final = 3
LOOP_NS: Final = 10_000_000_000
"""Definition of a restart loop: ``LOOP_RESTARTS`` restarts without a command within ``LOOP_NS`` (ns)."""

RESET_NS: Final = 5_000_000_000
"""Time (ns) after the host's reset command within which the node's next boot-up message is expected."""

BEATS: Final = 12
BEATS_TOO_OFTEN: Final = 0.7
"""Test for two nodes with the same node-ID: ``BEATS`` heartbeats arrive in less than ``BEATS_TOO_OFTEN``
times the time that a single node needs to send them.
"""


class NodeMonitor:
    """Collector of evidence about one node.

    Threads: any thread may call :meth:`health` and :meth:`expect_boot_up`. Only the mainline may call the
    other methods.

    Args:
        patch: Name of the patch.
        node_id: Node-ID of the patch's node.
        on_reject: Function called with each malformed heartbeat or EMCY message.
        watch: Fault detector for the patch's codes.
    """

    def __init__(
        self,
        patch: str,
        node_id: int,
        on_reject: Callable[[CodecError], None] = lambda error: None,
        watch: CodeWatch | None = None,
    ) -> None:
        self.patch, self.node_id = patch, node_id
        self._watch = watch
        self._beats: deque[int] = deque(maxlen=BEATS)
        self._restarts: deque[int] = deque(maxlen=LOOP_RESTARTS)
        self.on_reject = on_reject
        """Function called with each malformed heartbeat or EMCY message."""
        self.nmt_state: int | None = None
        self._t_heartbeat_ns: int | None = None
        self._t_scan_ns: int | None = None
        self._boot_ups = self._emergencies = self._slow_overruns = self._error_register = 0
        self._registers_said = 0
        self._last_emergency: tuple[int, bytes] | None = None  # error code, other bytes
        self.running = False
        """Whether the host has started the node. From then on, an unexpected boot-up message means that the
        node has restarted without a command.
        """
        self._expected_until_ns = 0
        self.rejoins = self.baselines = 0
        self.refusal: str | None = None
        self.defect: str | None = None
        self.complaint: str | None = None
        """Reason why the last bring-up failed. Like ``refusal`` and ``defect``, it is set by the supervisor.
        """

    @property
    def boot_ups(self) -> int:
        """Number of boot-up messages received from the node."""
        return self._boot_ups

    @property
    def t_heartbeat_ns(self) -> int | None:
        """Monotonic time (ns) of the newest heartbeat or boot-up message; None before the first."""
        return self._t_heartbeat_ns

    @property
    def t_scan_ns(self) -> int | None:
        """Monotonic time (ns) of the newest scan's last frame; None before the first scan."""
        return self._t_scan_ns

    def on_heartbeat(self, data: bytes, t_ns: int) -> None:
        """Process a heartbeat or boot-up message, which must be one byte long."""
        if len(data) != 1:
            self.on_reject(CodecError(heartbeat_cob_id(self.node_id), data, "1 byte (heartbeat)"))
            return
        state = data[0] & STATE_MASK  # bit 7 is the toggle bit of node guarding
        if state == NmtState.INITIALISING:
            self._boot_ups += 1
            self.forget_beats()
            self._on_register(0)  # a reset clears the register; the node reports persisting errors again
            if t_ns <= self._expected_until_ns:
                self._expected_until_ns = 0
            elif self.running:
                self._restarts.append(t_ns)
                _log.warning("node %d (%s) restarted without a command", self.node_id, self.patch)
        else:
            self._beats.append(t_ns)
        self.nmt_state = state
        self._t_heartbeat_ns = t_ns

    def expect_boot_up(self, now_ns: int) -> None:
        """Expect a boot-up message, because the host resets the node at monotonic time ``now_ns``."""
        self._expected_until_ns = now_ns + RESET_NS

    def forget_beats(self) -> None:
        """Forget the heartbeats received so far, because their period may have changed."""
        self._beats = deque(maxlen=BEATS)  # replaced, not modified, because other threads read the old one

    def on_emergency(self, data: bytes, t_ns: int) -> None:
        """Process an EMCY message.

        The message contains the error code (u16), the error register (u8) and five manufacturer-specific
        bytes. Error code 0 means that all errors have been cleared.
        """
        if len(data) != 8:
            self.on_reject(CodecError(emcy_cob_id(self.node_id), data, "8 bytes (EMCY)"))
            return
        code = int.from_bytes(data[:2], "little")
        self._on_register(data[2])
        if code:
            self._emergencies += 1
            self._last_emergency = code, data[3:]
            self._slow_overruns += says_too_slow(code, data[3:])

    @property
    def error_register(self) -> int:
        """Last reported error register of the node."""
        return self._error_register

    @property
    def registers_said(self) -> int:
        """Number of times the error register has been reported."""
        return self._registers_said

    def on_register_read(self, register: int, said: int) -> None:
        """Store an error register read by SDO, unless the node has reported a newer value since the request.

        Args:
            register: Value of the error register.
            said: :attr:`registers_said` at the time of the request.
        """
        if said == self._registers_said:
            self._on_register(register)

    def _on_register(self, register: int) -> None:
        self._error_register = register
        self._registers_said += 1

    def said_since(self, state: int, t_ns: int) -> bool:
        """Return whether the newest heartbeat arrived after ``t_ns`` and reported NMT state ``state``."""
        heard_ns = self._t_heartbeat_ns
        return heard_ns is not None and heard_ns > t_ns and self.nmt_state == state

    def on_scan(self, t_ns: int) -> None:
        """Record that a scan ended at monotonic time ``t_ns``."""
        self._t_scan_ns = t_ns

    def health(
        self,
        now_ns: int,
        heartbeat_s: float,
        scan_s: float,
        conflicts: int = 0,
        t_passed_ns: int | None = None,
    ) -> PatchHealth:
        """Return the health of the patch.

        Args:
            now_ns: Current monotonic time (ns).
            heartbeat_s: Heartbeat period (s).
            scan_s: Scan period (s).
            conflicts: Number of frames that contradict another frame of the same scan.
            t_passed_ns: Monotonic arrival time (ns) of the newest scan that was not withheld; 0 if there is
                none. None if scans are never withheld.
        """

        def age_s(t_ns: int | None) -> float | None:
            return None if t_ns is None else max(0, now_ns - t_ns) * 1e-9

        heartbeat_age_s, scan_age_s = age_s(self._t_heartbeat_ns), age_s(self._t_scan_ns)
        passed_age_s = scan_age_s if t_passed_ns is None else age_s(t_passed_ns or None)
        late_scans = None if passed_age_s is None else passed_age_s / scan_s
        in_a_loop = self._in_a_loop(now_ns)
        settled = (
            in_a_loop and self.nmt_state == NmtState.OPERATIONAL and now_ns - self._restarts[-1] > SETTLED_NS
        )
        watch = self._watch
        alive, words = (Alive.CANNOT_TELL, "") if watch is None else (watch.alive, watch.words)
        facts = Evidence(
            nmt_state=self.nmt_state,
            late_heartbeats=None if heartbeat_age_s is None else heartbeat_age_s / heartbeat_s,
            late_scans=late_scans,
            restarting=in_a_loop and not settled,
            error_register=self._error_register,
            refused=self.refusal is not None,
            frozen=alive is Alive.NO,
            defective=self.defect is not None,
        )
        condition = condition_of(facts)
        return PatchHealth(
            patch=self.patch,
            node_id=self.node_id,
            condition=condition,
            nmt_state=self.nmt_state,
            heartbeat_age_s=heartbeat_age_s,
            scan_age_s=scan_age_s,
            boot_ups=self._boot_ups,
            emergencies=self._emergencies,
            last_emergency=None if self._last_emergency is None else self._last_emergency[0],
            emergency_text=""
            if self._last_emergency is None
            else self._emergency_text(*self._last_emergency),
            error_register=self._error_register,
            rejoins=self.rejoins,
            slow_overruns=self._slow_overruns,
            baselines=self.baselines,
            refusal=self.refusal,
            restarts_in_a_loop=in_a_loop,
            duplicate_id=self._beats_too_often(now_ns, heartbeat_s),
            conflicts=conflicts,
            wires=() if watch is None else watch.wires,
            alive=alive,
            life=words,
            defect=self.defect,
            complaint=self.complaint,
            withheld=condition is Condition.STALE
            and scan_age_s is not None
            and scan_age_s <= SCANS_MISSED * scan_s,
        )

    def _emergency_text(self, code: int, detail: bytes) -> str:
        """Return a description of an EMCY message.

        A refused node may be another type of device, so skinnode's own error texts do not apply to it.
        """
        return error_text(code, detail, ours=self.refusal is None)

    def _in_a_loop(self, now_ns: int) -> bool:
        restarts = list(self._restarts)
        if len(restarts) < LOOP_RESTARTS or now_ns - restarts[-1] > RESTART_MEMORY_NS:
            return False
        return restarts[-1] - restarts[0] < LOOP_NS

    def _beats_too_often(self, now_ns: int, heartbeat_s: float) -> bool:
        """Return whether heartbeats arrive too often to come from a single node."""
        beats, period_ns = self._beats, heartbeat_s * 1e9
        if len(beats) < BEATS:
            return False
        first_ns, last_ns = beats[0], beats[-1]  # safe: a concurrent append never shrinks the deque
        if now_ns - last_ns > HEARTBEATS_MISSED * period_ns:
            return False
        return last_ns - first_ns < BEATS_TOO_OFTEN * (BEATS - 1) * period_ns
