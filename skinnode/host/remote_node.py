"""A patch as its host sees it: the node on its bus, what is known of it, and the stream of its scans."""

from __future__ import annotations

import queue
import time
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
from skinnode.protocol.command import pack_command
from skinnode.protocol.profile import PatchProfile

_MAINLINE_S: Final = 1.0
"""How long the mainline may take to do a small job; it turns fifty times a second unless its bus is away."""

_ANSWER_S: Final = 0.05
"""Wait for the answers to a single SDO request, s. A failed bring-up is delayed by two of them if the node
is alone."""

_MUTE_S: Final = 0.4
_MUTE_SCANS: Final = 5
"""Time and SYNC periods without a scan after which the configuration of a node is read back: the stream must
be back within a second."""


class RemoteNode:
    """One patch. Its methods without a mark may be called by one thread at a time, which is not the mainline:
    whoever brings the node up."""

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
        """Whether nothing at all may be sent to the node."""
        self.facts: NodeFacts | None = None
        self.boot_ups = 0
        """Boot-up messages when its bring-up began: more of them, and it has to be done again."""
        self.t_answer_ns = 0
        """When it last answered an SDO request."""
        self._answers = 0
        """SDO answers with its node-ID so far."""
        self._hand, self._lss = hand, bus.lss
        self._profile = PatchProfile.from_config(patch, self.bus)
        self._remote = self.link.remote_od(patch.node_id, self._on_answer, defects)

    # --- mainline

    def _on_answer(self, t_ns: int) -> None:
        self.t_answer_ns = t_ns
        self._answers += 1

    # --- bring-up

    @property
    def heard(self) -> bool:
        """Whether anything of the node was heard since the host opened its bus."""
        return self.monitor.t_heartbeat_ns is not None or self.stream.stats().withheld > 0

    @property
    def heartbeat_s(self) -> float:
        """How often the node says that it is there."""
        return self._hand.bring_up.heartbeat_s if self.facts is None else self.facts.heartbeat_s

    def configure(
        self,
        deadline_s: float,
        abandoned: Callable[[], bool],
        on_answer: Callable[[PatchConfig], None] | None = None,
    ) -> ScanSolver:
        """Bring the node up and learn what it is; scans are withheld meanwhile. Raises as
        :meth:`Configurator.configure`."""
        self.boot_ups = self.monitor.boot_ups
        if self.monitor.running and self.monitor.nmt_state == NmtState.STOPPED and not self.has_other_master:
            nmt_master.stand_by(self.link.send, self.patch.node_id)  # a stopped node does not answer SDO

        def answered(patch: PatchConfig) -> None:
            self.boot_ups = self.monitor.boot_ups  # those of before were waited for
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
            why = f"one question got {count} answers: two nodes have node-ID {node_id} (see skinnode scan)"
            raise kind(node_id, f"{text}; {why}") from error
        try:
            return ScanSolver(self.facts, self._hand.solver)
        except ValueError as error:  # of electrodes that only the node knew
            raise NodeError(self.patch.node_id, f"patch {self.patch.name!r}: {error}") from None

    def start(self, solver: ScanSolver, withholdings: int) -> None:
        """Let scans through to ``solver`` and, as master, tell the node to send them. Raises BusError."""
        # What a guest finds running goes on, heard since its bus was opened, unless the node has booted.
        anew = not self.has_other_master or self.monitor.boot_ups > 0
        self.link.call(lambda: self.stream.resume(solver, withholdings, anew=anew), self.defects)
        if not self.has_other_master:
            nmt_master.start(self.link.send, self.patch.node_id)
        self.monitor.running = True

    def renew_baseline(self, deadline_s: float, abandoned: Callable[[], bool]) -> ScanSolver | None:
        """A solver with the baseline that the node has now; None where that is the one known and scans go
        through. Raises as :meth:`Configurator.settle_baseline`."""
        facts = self.facts
        assert facts is not None  # asked of nodes that run
        configurator = self._configurator(deadline_s, abandoned, lambda patch: None)
        with self._remote.abort_if(abandoned):
            baseline_ohm = configurator.settle_baseline(self.patch, self._profile, self._remote)
        if (baseline_ohm == facts.baseline_ohm).all() and not self.stream.withholding:
            return None
        facts = facts.with_baseline(baseline_ohm)
        solver = ScanSolver(facts, self._hand.solver)
        self.facts = facts  # only now: if there is no solver, the baseline in use is the old one
        return solver

    def renew_register(self) -> None:
        """Ask the node for its error register: the emergency that takes an error back may have been lost.
        Raises as :class:`RemoteOd`."""
        said = self.monitor.registers_said
        register = self._remote.read(od.ERROR_REGISTER, 0, "u8")
        self.link.call(lambda: self.monitor.on_register_read(register, said), self.defects)

    def is_mute(self, since_ns: int) -> bool:
        """Whether the node, operational since ``since_ns``, has sent no scan for so long that it may have
        lost its configuration. False on the bus of another master, who alone may restore it."""
        scan_ns = max(self.monitor.t_scan_ns or 0, since_ns)
        patience_ns = max(_MUTE_S, _MUTE_SCANS * self._hand.sync.period_s) * 1e9
        return not self.has_other_master and self.link.t_dispatched_ns > scan_ns + patience_ns

    def is_configured(self) -> bool:
        """As :func:`~skinnode.host.configurator.is_configured`."""
        return is_configured(self.patch, self._hand, self._remote)

    def tare(self) -> None:
        """Tell the node to take what it feels now for its baseline. Any thread. Raises as
        :meth:`Host.tare`."""
        node_id, said = self.patch.node_id, f"patch {self.patch.name!r} on {self.patch.bus}: not tared"
        if self.has_other_master:
            raise NodeError(node_id, f"{said}: the host is a guest there")
        if self.patch.baseline is not None:  # it would be written back at once
            raise NodeError(node_id, f"{said}: its baseline is kept in {self.patch.baseline}")
        if (
            not self.monitor.running or self.monitor.nmt_state != NmtState.OPERATIONAL
        ):  # PDOs are heard by no other
            raise NodeError(node_id, f"{said}: it is not operational")
        self.link.send(od.command_cob_id(node_id), pack_command(tare=True))

    def withhold(self) -> int:
        """Have the mainline withhold scans; returns the number that :meth:`start` wants. Raises NodeTimeout
        where the mainline is held up, as while the bus is away."""
        answer: queue.SimpleQueue[int] = queue.SimpleQueue()
        self.link.call(lambda: answer.put(self.stream.withhold()), self.defects)
        try:
            return answer.get(timeout=_MAINLINE_S)
        except queue.Empty:
            raise NodeTimeout(
                self.patch.node_id, f"patch {self.patch.name!r} on {self.patch.bus}: the bus is away"
            ) from None

    def probe(self) -> None:
        """Ask the node for its device type, without waiting for the answer. Raises BusError."""
        request = b"\x40" + od.DEVICE_TYPE.to_bytes(2, "little") + bytes(5)
        self.link.send(od.sdo_request_cob_id(self.patch.node_id), request)

    def _answers_to_one_question(self) -> int:
        """Return how many answers a single SDO request gets: two if two nodes have this node-ID. The smaller
        count of two requests, because an answer to an earlier request may be late. Raises BusError."""
        time.sleep(_ANSWER_S)
        counts = []
        for _ in range(2):
            before = self._answers
            self.probe()
            time.sleep(_ANSWER_S)
            counts.append(self._answers - before)
            if counts[-1] < 2:
                break
        return min(counts)

    @property
    def searchable(self) -> bool:
        """Whether the hand file has its serial number, and the host is not a guest."""
        return not self.has_other_master and self.patch.serial is not None

    def search(self) -> bool:
        """Look for the patch by its serial number, if there is one; whether it was found. It will boot at its
        node-ID."""
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
