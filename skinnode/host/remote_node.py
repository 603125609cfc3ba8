"""Represent a patch's node on the host: its SDO client, its parameters and its scans."""

from __future__ import annotations

import queue
from collections.abc import Callable
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtState
from skinnode.config import HandConfig, PatchConfig
from skinnode.errors import BusError, NodeError, NodeTimeout
from skinnode.host import nmt_master
from skinnode.host.configurator import Configurator, is_configured
from skinnode.host.containment import Defects
from skinnode.host.node_facts import NodeFacts
from skinnode.host.reception import PatchReception
from skinnode.host.scan_solver import ScanSolver
from skinnode.host.served_bus import ServedBus
from skinnode.process import clock
from skinnode.protocol.command import pack_command
from skinnode.protocol.profile import PatchProfile

_MAINLINE_S: Final = 1.0
"""Time limit (s) for a short job on the mainline. The mainline runs pending jobs at least fifty times a
second, unless the bus is unavailable.
"""

_ANSWER_S: Final = 0.05
"""Time (s) for which responses to one SDO request are collected when looking for a second node with the same
node-ID. The search prolongs a failed bring-up by at least twice this time.
"""

_MUTE_S: Final = 0.4
_MUTE_SCANS: Final = 5
"""Time without a scan after which the configuration of a node is read back: ``_MUTE_S`` seconds or
``_MUTE_SCANS`` SYNC periods, whichever is longer. This is short enough for scans to resume within a second.
"""


class RemoteNode:
    """Patch of the hand and its CANopen node, as seen by the host.

    Threads: one thread at a time, other than the mainline, may bring up the node. Only that thread may call
    the methods that are not marked as thread-safe.
    """

    def __init__(
        self,
        patch: PatchConfig,
        hand: HandConfig,
        bus: ServedBus,
        reception: PatchReception,
        defects: Defects,
    ) -> None:
        self.patch, self.link, self.defects = patch, bus.link, defects
        self.stream, self.monitor = reception.stream, reception.monitor
        self.bus = hand.bus(patch.bus)
        self.has_other_master = self.bus.role == "guest"
        self.listen_only = self.has_other_master and self.bus.guest_sends == "nothing"
        """Whether the hand file forbids sending frames to the node."""
        self.facts: NodeFacts | None = None
        self.boot_ups = 0
        """Number of boot-up messages received before bring-up. If another one arrives, bring-up must be
        repeated.
        """
        self.t_answer_ns = 0
        """Monotonic time (ns) of the newest SDO response."""
        self._answers = 0
        """Number of SDO responses received with this node-ID."""
        self._hand, self._lss = hand, bus.lss
        self._mute_ns = max(_MUTE_S, _MUTE_SCANS * hand.sync.period_s) * 1e9
        self._profile = PatchProfile.from_config(patch, self.bus)
        self._remote = self.link.remote_od(patch.node_id, self._on_answer, defects)

    # --- mainline

    def _on_answer(self, t_ns: int) -> None:
        self.t_answer_ns = t_ns
        self._answers += 1

    # --- bring-up

    @property
    def heard(self) -> bool:
        """Whether the node has sent a heartbeat or scan since the host opened the bus."""
        return self.monitor.t_heartbeat_ns is not None or self.stream.stats().withheld > 0

    @property
    def heartbeat_s(self) -> float:
        """Heartbeat period of the node, in seconds."""
        return self._hand.bring_up.heartbeat_s if self.facts is None else self.facts.heartbeat_s

    def configure(
        self,
        deadline_s: float,
        abandoned: Callable[[], bool],
        on_answer: Callable[[PatchConfig], None] | None = None,
    ) -> ScanSolver:
        """Withhold the node's scans, and configure the node.

        Args:
            deadline_s: Time limit (s) for the node's first response.
            abandoned: Function polled during configuration. If it returns True, Abandoned is raised.
            on_answer: Function called when the node has responded.

        Returns:
            Solver for the node's scans.

        Raises:
            NodeError: if the node's layout cannot be solved, or two nodes have the same node-ID.
            SkinError: for the reasons listed under :meth:`Configurator.configure`.
        """
        self.boot_ups = self.monitor.boot_ups
        if self.monitor.running and self.monitor.nmt_state == NmtState.STOPPED and not self.has_other_master:
            # a stopped node does not respond to SDO requests
            nmt_master.stand_by(self.link.send, self.patch.node_id)

        def answered(patch: PatchConfig) -> None:
            self.boot_ups = self.monitor.boot_ups  # boot-ups up to this point are expected
            if on_answer is not None:
                on_answer(patch)

        configurator = self._configurator(deadline_s, abandoned, answered)
        answers = self._answers
        try:
            with self._remote.abort_if(abandoned):
                self.facts = configurator.configure(self.patch, self._profile, self._remote)
        except NodeError as error:
            if self._answers == answers or abandoned() or (count := self._answers_to_one_question()) < 2:
                raise
            node_id, kind = self.patch.node_id, NodeTimeout if isinstance(error, NodeTimeout) else NodeError
            text = str(error).removeprefix(f"node {node_id}: ")
            why = f"one request got {count} responses: two nodes have node-ID {node_id} (see skinnode scan)"
            raise kind(node_id, f"{text}; {why}") from error
        try:
            return ScanSolver(self.facts, self._hand.solver, period_s=self._hand.sync.period_s)
        except ValueError as error:  # the node's electrode layout is invalid
            raise NodeError(self.patch.node_id, f"patch {self.patch.name!r}: {error}") from None

    def start(self, solver: ScanSolver, withholdings: int) -> None:
        """Pass subsequent scans to ``solver``. If the host is the NMT master, start the node.

        Args:
            solver: Solver for the node's scans.
            withholdings: Number returned by :meth:`withhold`.

        Raises:
            BusError: if the command cannot be sent.
        """
        # Scans of a node that another master runs have been arriving since the bus was opened, unless the
        # node has booted since.
        anew = not self.has_other_master or self.monitor.boot_ups > 0
        self.link.call(self.monitor.forget_beats, self.defects)
        self.link.call(lambda: self.stream.resume(solver, withholdings, anew=anew), self.defects)
        if not self.has_other_master:
            nmt_master.start(self.link.send, self.patch.node_id)
        self.monitor.running = True

    def renew_baseline(self, deadline_s: float, abandoned: Callable[[], bool]) -> ScanSolver | None:
        """Read the node's current baseline. Create a new solver if needed.

        Returns:
            Solver with the baseline that was read; None if the baseline is unchanged and no scans are
            withheld.

        Raises:
            SkinError: for the reasons listed under :meth:`Configurator.settle_baseline`.
        """
        facts = self.facts
        assert facts is not None  # called for running nodes only
        configurator = self._configurator(deadline_s, abandoned, lambda patch: None)
        with self._remote.abort_if(abandoned):
            baseline_ohm = configurator.settle_baseline(self.patch, self._profile, self._remote)
        if (baseline_ohm == facts.baseline_ohm).all() and not self.stream.withholding:
            return None
        facts = facts.with_baseline(baseline_ohm)
        solver = ScanSolver(facts, self._hand.solver, period_s=self._hand.sync.period_s)
        self.facts = facts  # not earlier: if creating the solver fails, the old baseline stays in use
        return solver

    def renew_register(self) -> None:
        """Read the node's error register. The EMCY message that clears an error may have been lost.

        Raises:
            NodeError: if reading fails; see :class:`RemoteOd`.
        """
        said = self.monitor.registers_said
        register = self._remote.read(od.ERROR_REGISTER, 0, "u8")
        self.link.call(lambda: self.monitor.on_register_read(register, said), self.defects)

    def is_mute(self, since_ns: int) -> bool:
        """Return whether an operational node sends no scans and may therefore have lost its configuration.

        On a bus that another master runs, the result is False, because the host must not restore the
        configuration there.

        Args:
            since_ns: Monotonic time (ns) at which the node became operational.
        """
        scan_ns = max(self.monitor.t_scan_ns or 0, since_ns)
        return not self.has_other_master and self.link.t_dispatched_ns > scan_ns + self._mute_ns

    def is_configured(self) -> bool:
        """Return the result of :func:`~skinnode.host.configurator.is_configured` for the node."""
        return is_configured(self.patch, self._hand, self._remote)

    def tare(self) -> None:
        """Command the node to tare. Thread-safe.

        Raises:
            SkinError: for the reasons listed under :meth:`Host.tare`.
        """
        node_id, said = self.patch.node_id, f"patch {self.patch.name!r} on {self.patch.bus}: not tared"
        if self.has_other_master:
            raise NodeError(node_id, f"{said}: another master runs the bus")
        if self.patch.baseline is not None:  # the host would immediately restore the baseline from the file
            raise NodeError(node_id, f"{said}: its baseline is kept in {self.patch.baseline}")
        if (
            not self.monitor.running or self.monitor.nmt_state != NmtState.OPERATIONAL
        ):  # only operational nodes receive PDOs
            raise NodeError(node_id, f"{said}: it is not operational")
        self.link.send(od.command_cob_id(node_id), pack_command(tare=True))

    def withhold(self) -> int:
        """Make the mainline withhold the node's scans.

        Returns:
            Number to pass to :meth:`start` as ``withholdings``.

        Raises:
            NodeTimeout: if the mainline does not respond in time, for example because the bus is unavailable.
        """
        answer: queue.SimpleQueue[int] = clock.simple_queue()
        self.link.call(lambda: answer.put(self.stream.withhold()), self.defects)
        try:
            return answer.get(timeout=_MAINLINE_S)
        except queue.Empty:
            raise NodeTimeout(
                self.patch.node_id, f"patch {self.patch.name!r} on {self.patch.bus}: the bus is unavailable"
            ) from None

    def probe(self) -> None:
        """Request the node's device type (0x1000) without waiting for the response.

        Raises:
            BusError: if the request cannot be sent.
        """
        request = b"\x40" + od.DEVICE_TYPE.to_bytes(2, "little") + bytes(5)
        self.link.send(od.sdo_request_cob_id(self.patch.node_id), request)

    def _answers_to_one_question(self) -> int:
        """Return the number of responses to one SDO request. Two responses reveal a shared node-ID.

        A late response to an earlier request would be counted too. The method therefore sends two requests
        and returns the smaller count.
        """
        clock.sleep(_ANSWER_S)
        counts = []
        for _ in range(2):
            before = self._answers
            self.probe()
            clock.sleep(_ANSWER_S)
            counts.append(self._answers - before)
            if counts[-1] < 2:
                break
        return min(counts)

    @property
    def searchable(self) -> bool:
        """Whether the host is the NMT master and knows the serial number; an LSS search requires both."""
        return not self.has_other_master and self.patch.serial is not None

    def search(self) -> bool:
        """Search for the node over LSS, by serial number. Return whether it was found.

        A node that is found boots with the node-ID from the hand file.
        """
        if self.has_other_master or self.patch.serial is None:
            return False
        try:
            return self._lss.give_node_id(self.patch.serial, self.patch.node_id)
        except BusError:
            return False

    def _configurator(
        self, deadline_s: float, abandoned: Callable[[], bool], answered: Callable[[PatchConfig], None]
    ) -> Configurator:
        return Configurator(
            self.link.send, self._hand, self.bus, deadline_s, abandoned, answered, lambda _: self.search()
        )
