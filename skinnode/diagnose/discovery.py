"""Finds the nodes on a bus by SDO, heartbeat and LSS.

The search requests the device type (0x1000) from every node-ID and records the heartbeats received during the
search. Nodes without a node-ID are found by LSS, which changes their LSS mode. The search changes nothing
else on any node.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Final

from skinnode.bus_load.timing import worst_case_bits
from skinnode.canopen import indices as od
from skinnode.canopen.lss import LssAddress
from skinnode.canopen.sdo import upload_request
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.errors import NodeError
from skinnode.process import clock
from skinnode.text.printable import printable
from skinnode.text.words import counted

PACE_S: Final = 0.001
"""Minimum interval between requests in a sweep, in s. At 1 Mbit/s, the requests use one sixth of the bus
capacity."""

PACE_FRAMES: Final = 3
"""Interval between requests at a low bit rate, in frames: a request, its response and one other frame. With
shorter intervals, requests would queue up until their responses arrive too late or the send buffer is
full."""

ANSWER_S: Final = 0.12
"""Time to wait for responses after the last request in a sweep, in s."""

SWEEPS: Final = 2
"""Number of sweeps over all node-IDs. The second sweep reaches nodes that were busy during the first."""

LISTEN_S: Final = 1.2
"""Minimum listening time, in s. A stopped node does not answer SDO requests and is found only by its
heartbeats."""

LSS_S: Final = 1.5
"""Maximum duration of the search for nodes without a node-ID, in s. The search then ends, even if further
nodes remain unidentified."""

OTHERS_S: Final = 1.0
"""Maximum wait for the SDO transfers of other clients to end, in s."""

_QUIET_S: Final = 0.1
_THREADS: Final = 16
_ASK_DEVICE_TYPE: Final = upload_request(od.DEVICE_TYPE, 0)
_ASK_SERIAL: Final = upload_request(od.IDENTITY, od.IDENTITY_SERIAL)


@dataclass(frozen=True, slots=True)
class FoundNode:
    """Node found on a bus; None stands for a value that the node did not return."""

    node_id: int
    answers: bool
    """Whether the node answers SDO requests; a stopped node does not."""
    state: str
    state_known_by: str
    """Source of the NMT state, or the reason why the state is unknown."""
    name: str | None
    """Device name (0x1008)."""
    device_type: int | None
    """Device type (0x1000); the lower 16 bits are the number of the device profile."""
    error_register: int | None
    """Error register (0x1001)."""
    vendor_id: int | None
    product_code: int | None
    revision: int | None
    serial: int | None
    heartbeat_ms: int | None
    boot_ups: int
    """Number of boot-up messages received during the search."""
    duplicate: str
    """Evidence that two nodes have this node-ID; empty if there is none."""
    wrong_answer: str = ""
    """Newest invalid SDO response in hexadecimal; empty if there was a valid response or no response at
    all."""

    @property
    def profile(self) -> str:
        """Device profile as text; empty if the device type is unknown."""
        if self.device_type is None:
            return ""
        number = self.device_type & 0xFFFF
        return f"device profile {number}" if number else "no device profile"

    @property
    def identity(self) -> list[str]:
        """Profile, vendor and product as text; unknown values are omitted."""
        known = [self.profile] if self.profile else []
        for what, number in (("vendor", self.vendor_id), ("product", self.product_code)):
            if number is not None:
                known.append(f"{what} 0x{number:08X}")
        return known

    @property
    def is_patch(self) -> bool:
        """Whether the vendor-ID and product code are those of a patch."""
        return (self.vendor_id, self.product_code) == (od.VENDOR_ID, od.PRODUCT_CODE)


@dataclass(frozen=True, slots=True)
class Discovery:
    """Result of a search for nodes."""

    nodes: tuple[FoundNode, ...]
    """Nodes with a node-ID, in ascending order."""
    unconfigured: tuple[LssAddress, ...]
    """Nodes without a node-ID."""
    more_unconfigured: bool
    """Whether there are further nodes without a node-ID that the search did not identify."""
    seconds: float


def discover(connection: BusConnection, progress: Callable[[str], None] = lambda _: None) -> Discovery:
    """Find all nodes on a bus.

    Args:
        connection: The bus.
        progress: Called with a description of each step.

    Raises:
        BusError: The bus failed.
    """
    begun_s = clock.monotonic()
    _let_others_finish(connection)
    asked_ns = clock.monotonic_ns()
    with clock.pool(_THREADS, "discovery") as pool:
        try:
            lss = pool.submit(find_unconfigured, connection)
            progress("querying node-IDs 1 to 127")
            answered = _sweep(connection)
            progress(f"{counted(len(answered), 'node answers', 'nodes answer')}; reading identities")
            jobs = [pool.submit(_examine, connection, node_id, count) for node_id, count in answered.items()]
            _wait_for(jobs)
            nodes = [job.result() for job in jobs]
            connection.wait_until(lambda: False, max(0.0, begun_s + LISTEN_S - clock.monotonic()))
            _wait_for([lss])
            unconfigured, more = lss.result()
        except BaseException:  # the pool's threads must end on Ctrl-C, too
            connection.abandon()
            raise
    heard = connection.listener.nodes
    silent = [_only_heard(connection, node_id, asked_ns) for node_id in heard if node_id not in answered]
    found = sorted((*nodes, *filter(None, silent)), key=lambda node: node.node_id)
    return Discovery(tuple(found), unconfigured, more, clock.monotonic() - begun_s)


def _wait_for(jobs: Sequence[Future[Any]]) -> None:
    """Wait until all jobs have ended."""
    ended = clock.simple_queue()
    for job in jobs:
        job.add_done_callback(ended.put)
    for _ in jobs:
        ended.get()


def _let_others_finish(connection: BusConnection) -> None:
    """Wait until other clients' SDO transfers have ended; a request from this program would abort them.

    A host performs SDO transfers mainly during bring-up.
    """
    end_s = clock.monotonic() + OTHERS_S
    while clock.monotonic() < end_s:
        before = _sdo_frames(connection)
        connection.wait_until(lambda: False, _QUIET_S)
        if _sdo_frames(connection) == before:
            return


def _sdo_frames(connection: BusConnection) -> int:
    first, end = od.sdo_response_cob_id(1), od.sdo_request_cob_id(od.MAX_NODE_ID + 1)
    return sum(count for cob_id, count in dict(connection.listener.cob_ids).items() if first <= cob_id < end)


def find_unconfigured(connection: BusConnection) -> tuple[tuple[LssAddress, ...], bool]:
    """Find the nodes without a node-ID, and return them to LSS waiting mode.

    Returns:
        The LSS addresses found, and True if there are more such nodes.
    """
    found: list[LssAddress] = []
    end_s = clock.monotonic() + LSS_S
    if not connection.lss.any_unconfigured():
        return (), False
    try:
        while clock.monotonic() < end_s:
            address = connection.lss.find_unconfigured()
            if address is None or address in found:
                return tuple(found), not found
            found.append(address)
        return tuple(found), connection.lss.find_unconfigured() is not None
    finally:
        connection.lss.release()


def _sweep(connection: BusConnection) -> dict[int, int]:
    """Request the device type from all node-IDs; return the number of responses by node-ID."""
    answers: dict[int, int] = {}
    pace_s = max(PACE_S, PACE_FRAMES * worst_case_bits(8) / connection.bus.bitrate_bps)
    for _ in range(SWEEPS):
        asked_ns = clock.monotonic_ns()
        for node_id in range(1, od.MAX_NODE_ID + 1):
            if node_id not in answers:
                connection.link.send(od.sdo_request_cob_id(node_id), _ASK_DEVICE_TYPE)
                clock.sleep(pace_s)
        connection.wait_until(lambda: False, ANSWER_S)
        for node_id, heard in connection.listener.nodes.items():
            count = sum(
                t_ns >= asked_ns and data[1:4] == _ASK_DEVICE_TYPE[1:4]
                for t_ns, data in list(heard.sdo_answers)
            )
            if count and node_id not in answers:
                answers[node_id] = count
    return dict(sorted(answers.items()))


def _examine(connection: BusConnection, node_id: int, answers: int) -> FoundNode:
    duplicate = _two_serials(connection, node_id) if answers > 1 else ""
    identity = [_number(connection, node_id, od.IDENTITY, sub) for sub in (1, 2, 3, 4)]
    if not duplicate and identity[:2] == [od.VENDOR_ID, od.PRODUCT_CODE]:
        strangers = _number(connection, node_id, od.REJECTED_FRAMES, 7)
        if strangers:
            duplicate = (
                f"another node sent boot-up messages or heartbeats with this node-ID (0x2040:7 = {strangers})"
            )
    heartbeat_s = connection.heartbeat_s(node_id)
    state = connection.state(node_id, heartbeat_s, guarding=not connection.guarded(node_id))
    return FoundNode(
        node_id=node_id,
        answers=True,
        state=str(state),
        state_known_by=state.how,
        name=_text(connection, node_id, od.DEVICE_NAME_INDEX),
        device_type=_number(connection, node_id, od.DEVICE_TYPE, 0),
        error_register=_number(connection, node_id, od.ERROR_REGISTER, 0),
        vendor_id=identity[0],
        product_code=identity[1],
        revision=identity[2],
        serial=identity[3],
        heartbeat_ms=None if heartbeat_s is None else round(heartbeat_s * 1e3),
        boot_ups=connection.listener.node(node_id).boot_ups,
        duplicate=duplicate,
    )


def _only_heard(connection: BusConnection, node_id: int, asked_ns: int) -> FoundNode | None:
    """Describe a node that sent no valid SDO response; None if it sent no heartbeat either."""
    beat = connection.listener.newest_beat(node_id)
    if beat is None:
        return None
    state = connection.state(node_id, None, guarding=False)
    boot_ups = connection.listener.node(node_id).boot_ups
    identity = ("vendor_id", "product_code", "revision", "serial")
    nothing = dict.fromkeys(("device_type", "error_register", *identity, "heartbeat_ms"))
    return FoundNode(
        node_id,
        False,
        str(state),
        state.how,
        name=None,
        boot_ups=boot_ups,
        duplicate="",
        wrong_answer=connection.wrong_answer(node_id, asked_ns),
        **nothing,
    )


def _two_serials(connection: BusConnection, node_id: int) -> str:
    """Return evidence that two nodes have this node-ID.

    The text is empty if a new request gets only one response; in that case, the second response during the
    sweep belonged to an earlier request.
    """
    answers = connection.ask_all(node_id, _ASK_SERIAL, ANSWER_S)
    answers = [data for data in answers if data[1:4] == _ASK_SERIAL[1:4]]
    if len(answers) < 2:
        return ""
    serials = sorted({int.from_bytes(data[4:8], "little") for data in answers if data[0] & 0xE0 == 0x40})
    shown = " and ".join(map(str, serials))
    return f"{len(answers)} responses to one request" + (f": serials {shown}" if shown else "")


def _number(connection: BusConnection, node_id: int, index: int, subindex: int) -> int | None:
    try:
        return int.from_bytes(connection.od(node_id).read_bytes(index, subindex), "little")
    except NodeError:
        return None


def _text(connection: BusConnection, node_id: int, index: int) -> str | None:
    try:
        return printable(connection.od(node_id).read_bytes(index, 0))
    except NodeError:
        return None
