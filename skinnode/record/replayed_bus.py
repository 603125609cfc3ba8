"""Receives one bus's recorded frames with the host's own dispatcher, assembler and streams."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtCommand, NmtState
from skinnode.config import BusConfig
from skinnode.host.containment import Defects
from skinnode.host.dispatcher import BusStats, Dispatcher, PortCounters
from skinnode.host.patch_stream import StreamOutput
from skinnode.host.reception import PatchReception, receive_bus, receive_patch
from skinnode.host.scan_solver import ScanSolver
from skinnode.host.sync import SyncFollower, Ticks
from skinnode.host.workers import Inline
from skinnode.record.journal import facts_of

if TYPE_CHECKING:
    from skinnode.record.replay import Replay

_ROUNDING_NS: Final = 2_000
"""Maximum rounding error of a log's timestamps, in ns."""
_LAYOUTLESS: Final = (
    "the recording lacks the layout file of {patch}; solve it with skinnode resolve RECORDING --set "
    "'patches.{patch}.layout={{file=\"FILE\"}}'"
)


class _PollerlessDispatcher(Dispatcher):
    """Dispatcher that does not poll the streams after each batch; the journal determines when to poll."""

    def poll_with(self, poller: Callable[[int], None], defects: Defects | None = None) -> None:
        pass


class ReplayedBus:
    """Receiver for one bus of a recording; contains the streams of all patches on the bus."""

    def __init__(self, config: BusConfig, replay: Replay, events: list[dict[str, Any]]) -> None:
        self._config, self._replay = config, replay
        hand = replay.hand
        self._ticks = Ticks(hand.sync.counter_overflow)
        self._dispatcher = _PollerlessDispatcher(config, {}, 0)
        output = StreamOutput(Inline(), replay.publisher)
        receive_bus(hand, self._dispatcher, self._ticks)
        self._own_syncs = SyncFollower(self._ticks)
        self.patches: dict[str, PatchReception] = {
            patch.name: receive_patch(patch, hand, self._dispatcher, self._ticks, output)
            for patch in hand.patches_on(config.name)
        }
        for name, heard in self.patches.items():
            mine = [e for e in events if e["event"] == "overtaken" and e["patch"] == name]
            heard.stream.leave_out([e["received_ns"] for e in mine], _ROUNDING_NS)
        self._events = deque(event for event in events if event["event"] != "sync")
        numbered = [event for event in events if event["event"] == "sync"]
        self._numbered = deque(numbered if hand.sync.counter_overflow else ())
        self._solvers: dict[str, ScanSolver | None] = {}
        self._without_baseline: set[str] = set()
        self._received = self._sent = 0
        self._of_heartbeat = {
            od.heartbeat_cob_id(patch.node_id): self.patches[patch.name].monitor
            for patch in hand.patches_on(config.name)
        }
        self._stood_by: set[int] = set()  # heartbeat COB-IDs of nodes that the host set to pre-operational

    def take(self, frame: Any, *, sent: bool, whole: bool) -> None:
        """Process the next frame of the log; ``whole`` is True if the log has been undamaged so far."""
        if sent:
            self._sent += 1
            self._dispatcher.count_sent(frame.can_id, frame.data)
            if frame.can_id == od.SYNC_COB_ID and not frame.extended:
                self._on_own_sync(frame.data, frame.t_ns)
            if frame.can_id == od.NMT_COB_ID and not frame.extended:
                self._on_command(frame.data)
            return
        while self._events and self._is_due(self._events[0], frame.t_ns, whole=whole):
            self._happen(self._events.popleft())
        self._received += 1
        self._dispatcher.dispatch((frame,))
        if self._replay.foreign:
            self._go_on(frame.can_id)
        if frame.can_id in self._stood_by:
            monitor = self._of_heartbeat[frame.can_id]
            if monitor.nmt_state == NmtState.PRE_OPERATIONAL:  # not a fault: the host commanded it
                monitor.nmt_state = NmtState.OPERATIONAL
        if not whole:
            for heard in self.patches.values():
                heard.stream.poll(frame.t_ns)
        self._dispatcher.measure(frame.t_ns)

    def _on_own_sync(self, data: bytes, t_ns: int) -> None:
        """Process a SYNC from the host; the journal has its number if the counter does not determine it."""
        self._own_syncs.on_sync(data, t_ns)
        if self._numbered and self._numbered[0]["t_ns"] <= t_ns + _ROUNDING_NS:
            number = self._numbered.popleft()["number"]
            if bytes([self._ticks.counter_of(number)]) == data:  # otherwise, the time is damaged
                self._ticks.note(number, t_ns)

    def _go_on(self, can_id: int) -> None:
        """Resume with the same solver after a node restart; a log alone does not show when the host resumed.

        After a baseline change, scans remain withheld, because the new baseline is unknown.
        """
        for name, heard in self.patches.items():
            solver = self._solvers.get(name)
            if not heard.stream.withholding or solver is None or name in self._without_baseline:
                continue
            if self._of_heartbeat.get(can_id) is heard.monitor:
                heard.stream.resume(solver, heard.stream.withholdings, anew=True)
            else:
                self._without_baseline.add(name)
                self._replay.complaints.append(
                    f"{name}: its baseline changed; its later scans cannot be solved, "
                    "because the log does not contain the new baseline"
                )

    def _on_command(self, data: bytes) -> None:
        """Process an NMT command from the host. On exit, the host sets its nodes to pre-operational."""
        if len(data) != 2:
            return
        cob_id = od.heartbeat_cob_id(data[1])
        monitor = self._of_heartbeat.get(cob_id)
        if monitor is None or data[0] == NmtCommand.START:
            self._stood_by.discard(cob_id)
        elif data[0] == NmtCommand.ENTER_PRE_OPERATIONAL and monitor.nmt_state == NmtState.OPERATIONAL:
            self._stood_by.add(cob_id)

    def finish(self) -> None:
        """Apply the journal events that follow the last frame."""
        while self._events:
            self._happen(self._events.popleft())

    def solver(self, patch: str) -> ScanSolver | None:
        """Return a patch's newest solver; None if there is none yet."""
        return self._solvers.get(patch)

    def stats(self) -> BusStats:
        """Return the bus counters."""
        return self._dispatcher.count(PortCounters(sent=self._sent))

    def _is_due(self, event: dict[str, Any], t_ns: int, *, whole: bool) -> bool:
        if whole:
            return bool(event["at"] <= self._received)
        return bool(event["t_ns"] <= t_ns)

    def _happen(self, event: dict[str, Any]) -> None:
        heard = self.patches[event["patch"]]
        stream = heard.stream
        match event["event"]:
            case "withheld":
                stream.withhold()
            case "polled":
                stream.poll(event["t_ns"] + _ROUNDING_NS)
            case "resumed":
                solver, anew = self._solver(event), bool(event.get("anew"))
                if anew:  # the host has set the heartbeat period
                    heard.monitor.forget_beats()
                if solver is None:
                    stream.withhold()
                else:
                    stream.resume(solver, stream.withholdings, anew=anew)

    def _solver(self, event: dict[str, Any]) -> ScanSolver | None:
        """Return the solver for a journal event; None if the node facts are unknown or unusable."""
        name, replay = event["patch"], self._replay
        if "facts" in event:
            self._solvers[name] = None
            try:
                if name in replay.layoutless and event["facts"]["layout"] is None:
                    replay.complain(event, _LAYOUTLESS.format(patch=name))
                    return None
                facts = facts_of(event["facts"], replay.hand.patch(name), self._config)
                self._solvers[name] = replay.solver_of(facts)
            except (KeyError, TypeError, OverflowError, ValueError) as error:
                replay.complain(event, f"unusable facts about {name} ({type(error).__name__}: {error})")
        return self._solvers.get(name)
