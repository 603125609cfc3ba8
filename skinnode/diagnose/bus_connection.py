"""An open bus in a technician's hands: SDO to any node, LSS, NMT, and everything that is heard meanwhile."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Final, NamedTuple, Self

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import state_name
from skinnode.config import BusConfig
from skinnode.diagnose.bus_listener import Beat, BusListener
from skinnode.errors import BusError, NodeError, SkinError
from skinnode.host.link import BusLink
from skinnode.host.lss_master import LssMaster
from skinnode.host.mainline import Mainline
from skinnode.host.sdo_client import RemoteOd

LONGEST_HEARTBEAT_S: Final = 2.5
"""How long a heartbeat is waited for; nodes that beat more seldom are not known to be there by it."""

GUARD_ANSWERS_S: Final = (0.15, 0.5)
"""How long the answer to a remote frame may take; a node, or a machine, that was busy is asked once more."""

_POLL_S: Final = 0.002


class State(NamedTuple):
    """NMT state of a node and how it is known."""

    state: int | None
    """None where nobody knows."""
    how: str
    """``heartbeat``, ``guarding``, or why it is not known."""

    def __str__(self) -> str:
        return "unknown" if self.state is None else state_name(self.state)


def no_answer(wrong: str) -> str:
    """Return what is wrong with a node without a valid SDO answer, whose newest answer is ``wrong``."""
    if not wrong:
        return "does not answer SDO requests"
    return f"answers SDO requests with data that is no answer of CiA 301 (newest: {wrong})"


class BusConnection:
    """An open bus. Raises BusError where it does not open. Closed by :meth:`close` or a ``with`` block."""

    def __init__(self, bus: BusConfig) -> None:
        self.bus = bus
        self.listener = BusListener()
        self.defect: SkinError | None = None
        """A failure of this program on the mainline."""
        self._remotes: dict[int, RemoteOd] = {}
        self._abandoned = threading.Event()
        self.link = BusLink(bus, {}, self._on_defect)
        self.link.listen(self.listener.on_frames)
        self.lss = LssMaster(self.link.send)
        self.link.handle(od.LSS_RESPONSE_COB_ID, self.lss.on_response)
        self._mainline = Mainline([self.link])

    def od(self, node_id: int) -> RemoteOd:
        """The object dictionary of a node."""
        if node_id not in self._remotes:
            remote = self._remotes[node_id] = self.link.remote_od(node_id)
            remote.abandoned = self._abandoned.is_set
        return self._remotes[node_id]

    def abandon(self) -> None:
        """Abort the transfers of all threads, which raise Abandoned."""
        self._abandoned.set()

    def wait_until(self, condition: Callable[[], object], within_s: float) -> bool:
        """Whether ``condition`` comes true in that time. Raises BusError if the bus fails meanwhile."""
        end_s = time.monotonic() + within_s
        while not condition():
            if self.defect is not None:
                raise self.defect
            if self.link.failure is not None:
                raise BusError(str(self.link.failure)) from self.link.failure
            if time.monotonic() > end_s:
                return False
            time.sleep(_POLL_S)
        return True

    def ask_all(self, node_id: int, request: bytes, within_s: float) -> list[bytes]:
        """Every SDO answer to one request: two where two nodes bear the node-ID."""
        since_ns = time.monotonic_ns()
        self.link.send(od.sdo_request_cob_id(node_id), request.ljust(8, b"\0"))
        self.wait_until(lambda: False, within_s)
        answers = list(self.listener.node(node_id).sdo_answers)
        return [data for t_ns, data in answers if t_ns >= since_ns]

    def require_answer(self, node_id: int, more: Callable[[], str] = str) -> None:
        """Ask the node for its device type, twice if need be. Raises NodeError, whose message ends with
        ``more``, if there is no valid answer.
        """
        remote, since_ns = self.od(node_id), time.monotonic_ns()
        if not remote.answers() and not remote.answers():
            raise NodeError(node_id, no_answer(self.wrong_answer(node_id, since_ns)) + more())

    def wrong_answer(self, node_id: int, since_ns: int) -> str:
        """Return the newest frame received after ``since_ns`` in place of an SDO answer, as hexadecimal text;
        empty if there was none. For a node without a valid answer.
        """
        newest = self.listener.node(node_id).newest_sdo
        if newest is None or newest[0] < since_ns:
            return ""
        return newest[1].hex(" ") or "no data"

    def heartbeat_s(self, node_id: int) -> float | None:
        """How often the node beats by its 0x1017; 0 for never, None where it does not say."""
        try:
            return float(self.od(node_id).read(od.HEARTBEAT_PRODUCER, 0, "u16")) * 1e-3
        except NodeError:
            return None

    def guarded(self, node_id: int) -> bool:
        """Whether the node expects a master to guard it: a remote frame of ours would then start its clock,
        and our going away be taken for the master's.
        """
        remote = self.od(node_id)
        try:
            return bool(remote.read(od.GUARD_TIME, 0, "u16") and remote.read(od.LIFE_TIME_FACTOR, 0, "u8"))
        except NodeError:
            return False

    def state(self, node_id: int, heartbeat_s: float | None, *, guarding: bool, since_ns: int = 0) -> State:
        """NMT state by the next heartbeat after ``since_ns``, or by guarding where there is none and
        ``guarding`` allows it. ``heartbeat_s`` as of :meth:`heartbeat_s`.
        """
        if heartbeat_s != 0:
            wait_s = LONGEST_HEARTBEAT_S if heartbeat_s is None else 1.5 * heartbeat_s + 0.1
            beat = self._beat(node_id, since_ns, min(wait_s, LONGEST_HEARTBEAT_S))
            if beat is not None:
                return State(beat.state, "heartbeat")
            if heartbeat_s:
                return State(None, f"no heartbeat, though one every {heartbeat_s:g} s is set")
        if not guarding:
            return State(None, "no heartbeat, and a master guards the node")
        for answer_s in GUARD_ANSWERS_S:
            asked_ns = time.monotonic_ns()
            self.link.ask_remote(od.heartbeat_cob_id(node_id))
            beat = self._beat(node_id, asked_ns, answer_s)
            if beat is not None:
                return State(beat.state, "guarding")
        return State(None, "no heartbeat, no guarding")

    def close(self) -> None:
        self._mainline.stop()
        self.link.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _beat(self, node_id: int, since_ns: int, within_s: float) -> Beat | None:
        self.wait_until(lambda: self.listener.newest_beat(node_id, since_ns), within_s)
        return self.listener.newest_beat(node_id, since_ns)

    def _on_defect(self, error: SkinError) -> None:
        self.defect = error
