"""Opens a bus for SDO, LSS and NMT, and records the messages received on it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import state_name
from skinnode.config import BusConfig
from skinnode.diagnose.bus_listener import Beat, BusListener
from skinnode.errors import BusError, NodeError, SkinError
from skinnode.host.link import BusLink
from skinnode.host.lss_master import LssMaster
from skinnode.host.mainline import Mainline
from skinnode.host.sdo_client import Abandoned, RemoteOd
from skinnode.process import clock
from skinnode.process.closing import Closing

LONGEST_HEARTBEAT_S: Final = 2.5
"""Maximum wait for a heartbeat whose period is unknown, in s. Heartbeats with a longer period are missed."""

LONGEST_KNOWN_HEARTBEAT_S: Final = 15.1
"""Maximum wait for a heartbeat whose period is known, in s. This covers the longest period that a hand file
can set, 10 s."""

GUARD_ANSWERS_S: Final = (0.15, 0.5)
"""Maximum waits for the responses to the first and the second remote frame, in s.

The second remote frame is sent in case the node was too busy to answer the first.
"""

_POLL_S: Final = 0.002


class State(NamedTuple):
    """NMT state of a node, and how it was determined."""

    state: int | None
    """NMT state; None if unknown."""
    how: str
    """``heartbeat`` or ``guarding``; if the state is unknown, the reason."""

    def __str__(self) -> str:
        return "unknown" if self.state is None else state_name(self.state)


def no_answer(wrong: str) -> str:
    """Describe a node that sent no valid SDO response.

    ``wrong`` is the node's most recent invalid response, in hexadecimal; empty if the node did not respond at
    all.
    """
    if not wrong:
        return "does not answer SDO requests"
    return f"sends SDO frames that are not responses to the request (newest: {wrong})"


class BusConnection(Closing):
    """Connection to an open bus; use it in a ``with`` block, or call :meth:`close`.

    Args:
        bus: The bus.

    Raises:
        BusError: The bus cannot be opened.
    """

    def __init__(self, bus: BusConfig) -> None:
        self.bus = bus
        self.listener = BusListener()
        self.defect: SkinError | None = None
        """Internal error of the receiving thread; None if there is none."""
        self._remotes: dict[int, RemoteOd] = {}
        self._abandoned = clock.event()
        self.link = BusLink(bus, {}, self._on_defect)
        self.link.listen(self.listener.on_frames)
        self.lss = LssMaster(self.link.send)
        self.link.handle(od.LSS_RESPONSE_COB_ID, self.lss.on_response)
        self._mainline = Mainline([self.link])

    def od(self, node_id: int) -> RemoteOd:
        """Return an SDO client for the object dictionary of a node."""
        if node_id not in self._remotes:
            remote = self._remotes[node_id] = self.link.remote_od(node_id)
            remote.abandoned = self._abandoned.is_set
        return self._remotes[node_id]

    def abandon(self) -> None:
        """End all SDO transfers and waits, in all threads; each of them raises Abandoned."""
        self._abandoned.set()

    def wait_until(self, condition: Callable[[], object], within_s: float) -> bool:
        """Wait until a condition is true.

        Args:
            condition: Polled until it returns a true value.
            within_s: Maximum wait, in s.

        Returns:
            True if the condition became true, False if ``within_s`` elapsed first.

        Raises:
            BusError: The bus failed during the wait.
            Abandoned: :meth:`abandon` has been called.
        """
        end_s = clock.monotonic() + within_s
        while not condition():
            if self.defect is not None:
                raise self.defect
            if self.link.failure is not None:
                raise BusError(str(self.link.failure)) from self.link.failure
            if self._abandoned.is_set():
                raise Abandoned
            if clock.monotonic() > end_s:
                return False
            clock.sleep(_POLL_S)
        return True

    def ask_all(self, node_id: int, request: bytes, within_s: float) -> list[bytes]:
        """Send an SDO request and return all responses; there are several if nodes share the node-ID."""
        since_ns = clock.monotonic_ns()
        self.link.send(od.sdo_request_cob_id(node_id), request.ljust(8, b"\0"))
        self.wait_until(lambda: False, within_s)
        answers = list(self.listener.node(node_id).sdo_answers)
        return [data for t_ns, data in answers if t_ns >= since_ns]

    def require_answer(self, node_id: int, more: Callable[[], str] = str) -> None:
        """Check that a node answers SDO requests, retrying once.

        Args:
            node_id: The node.
            more: Callback that returns a suffix for the error message.

        Raises:
            NodeError: The node sends no valid response.
        """
        remote, since_ns = self.od(node_id), clock.monotonic_ns()
        if not remote.answers() and not remote.answers():
            raise NodeError(node_id, no_answer(self.wrong_answer(node_id, since_ns)) + more())

    def wrong_answer(self, node_id: int, since_ns: int) -> str:
        """Return the newest frame that a node sent with the COB-ID of its SDO responses.

        Args:
            node_id: A node that sent no valid response.
            since_ns: Frames received before this time (monotonic clock, ns) are ignored.

        Returns:
            The data in hexadecimal; empty if there was no frame.
        """
        newest = self.listener.node(node_id).newest_sdo
        if newest is None or newest[0] < since_ns:
            return ""
        return newest[1].hex(" ") or "no data"

    def heartbeat_s(self, node_id: int) -> float | None:
        """Read a node's heartbeat period (0x1017) in seconds; 0 if disabled, None if it cannot be read."""
        try:
            return float(self.od(node_id).read(od.HEARTBEAT_PRODUCER, 0, "u16")) * 1e-3
        except NodeError:
            return None

    def guarded(self, node_id: int) -> bool:
        """Return whether life guarding is configured on the node; the first remote frame would start it.

        Such a node would report a life guarding error as soon as this program stopped sending remote frames.
        """
        remote = self.od(node_id)
        try:
            return bool(remote.read(od.GUARD_TIME, 0, "u16") and remote.read(od.LIFE_TIME_FACTOR, 0, "u8"))
        except NodeError:
            return False

    def state(self, node_id: int, heartbeat_s: float | None, *, guarding: bool, since_ns: int = 0) -> State:
        """Determine the NMT state of a node from its heartbeat or, if it sends none, by node guarding.

        Args:
            node_id: The node.
            heartbeat_s: Result of :meth:`heartbeat_s`.
            guarding: Whether remote frames may be sent.
            since_ns: Heartbeats received before this time (monotonic clock, ns) are ignored.
        """
        if heartbeat_s != 0:
            wait_s = LONGEST_HEARTBEAT_S
            if heartbeat_s is not None:
                wait_s = min(1.5 * heartbeat_s + 0.1, LONGEST_KNOWN_HEARTBEAT_S)
            beat = self._beat(node_id, since_ns, wait_s)
            if beat is not None:
                return State(beat.state, "heartbeat")
            if heartbeat_s:
                return State(None, f"no heartbeat, although the heartbeat period is set to {heartbeat_s:g} s")
        if not guarding:
            return State(None, "no heartbeat; no remote frame was sent, because it might start life guarding")
        for answer_s in GUARD_ANSWERS_S:
            asked_ns = clock.monotonic_ns()
            self.link.ask_remote(od.heartbeat_cob_id(node_id))
            beat = self._beat(node_id, asked_ns, answer_s)
            if beat is not None:
                return State(beat.state, "guarding")
        return State(None, "no heartbeat, no guarding")

    def close(self) -> None:
        """Close the bus and wait for its receiving thread to exit."""
        self._mainline.stop()
        self.link.close()

    def _beat(self, node_id: int, since_ns: int, within_s: float) -> Beat | None:
        self.wait_until(lambda: self.listener.newest_beat(node_id, since_ns), within_s)
        return self.listener.newest_beat(node_id, since_ns)

    def _on_defect(self, error: SkinError) -> None:
        self.defect = error
