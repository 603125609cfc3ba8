"""Collects the facts about one bus by listening and by reading objects.

A running hand is not disturbed: nodes are started and SYNC is sent only if ``active`` is set.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Final, TypeVar

import numpy as np

from skinnode.bus_load.plan import SCAN_SHARE, inhibit_time_100us
from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtCommand, encode
from skinnode.config import BusConfig, HandConfig, PatchConfig
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.diagnose.bus_listener import BusListener
from skinnode.diagnose.data_sheet import read_profile
from skinnode.diagnose.discovery import discover
from skinnode.diagnose.facts import BusFacts, PatchFacts
from skinnode.diagnose.node_info import read_info
from skinnode.diagnose.scan_capture import ScanCapture
from skinnode.errors import BusError, NodeError, ProfileError
from skinnode.host.hand_files import check_eds
from skinnode.process import clock
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import DEFAULT_PERIOD_MS, PatchProfile
from skinnode.transport.socketcan import read_link

SCANS: Final = 50
"""Number of scans to capture; with 50 scans, the error in the estimated noise is about 10 %."""

LONGEST_S: Final = 15.0
"""Maximum duration of the capture, in s, unless :data:`LEAST_PERIODS` SYNC periods take longer."""

LEAST_PERIODS: Final = 1.5
"""Minimum duration of the capture in SYNC periods. The first scan may have begun before the capture and is
not used; with this duration, the capture contains the second scan."""

DEFAULT_NOISE: Final = 3e-6
"""Relative converter noise assumed if there is no hand file."""

_PAUSES_S: Final = (0.0, 0.1, 0.3, 0.6)
"""Pauses before successive attempts to read a node, in s. A node's SDO server is busy for 0.1 to 0.3 s while
a host reads the baseline."""

_FIRST_SYNC_S: Final = 0.5
_KNOWN_TO_ALL: Final = frozenset(
    {od.NMT_COB_ID, od.SYNC_COB_ID, od.TIME_COB_ID, od.LSS_REQUEST_COB_ID, od.LSS_RESPONSE_COB_ID}
)

Progress = Callable[[str], None]
Answer = TypeVar("Answer")


def collect_facts(
    bus: BusConfig, hand: HandConfig | None, *, active: bool = False, progress: Progress = lambda _: None
) -> BusFacts:
    """Collect the facts about one bus. A bus failure is recorded in the facts instead of being raised.

    Args:
        bus: The bus.
        hand: The hand; None if there is no hand file.
        active: Whether to start nodes that are not running, and to send SYNC if no other device does. Nodes
            started here return to PRE-OPERATIONAL at the end.
        progress: Called with a description of each step.
    """
    facts = BusFacts(
        bus.name,
        bus.interface,
        bus.channel,
        bus.bitrate_bps,
        max_load=bus.max_load,
        period_s=None if hand is None else hand.sync.period_s,
        heartbeat_ms=None if hand is None else hand.bring_up.heartbeat_ms,
        role=bus.role,
        master_node_id=bus.heartbeat_node_id,
        patches=() if hand is None else tuple(_wanted(p, hand, bus) for p in hand.patches_on(bus.name)),
    )
    state, bitrate = link_facts(bus)
    facts = replace(facts, link_state=state, link_bitrate_bps=bitrate)
    try:
        with BusConnection(bus) as connection:
            return _examine(connection, facts, hand, active, progress)
    except BusError as error:
        return replace(facts, failure=str(error))


def _wanted(patch: PatchConfig, hand: HandConfig, bus: BusConfig) -> PatchFacts:
    profile = PatchProfile.from_config(patch, bus)
    problem = ""
    if patch.eds is not None:
        try:
            check_eds(patch.eds, profile)
        except ProfileError as error:
            problem = str(error)
    known = patch.layout.coordinates == "preset"
    configures = bus.role == "master" or bus.guest_sends == "sdo"
    inhibit_100us = inhibit_time_100us(hand.sync.period_ms, profile.n_chunks + 1)
    return PatchFacts(
        patch.name,
        patch.node_id,
        patch,
        layout_hash=patch.layout.build().layout_hash if known else None,
        inhibit_100us=inhibit_100us if configures else None,
        eds_problem=problem,
    )


def _examine(
    connection: BusConnection, facts: BusFacts, hand: HandConfig | None, active: bool, progress: Progress
) -> BusFacts:
    begun_s = clock.monotonic()
    capture = ScanCapture()
    connection.link.listen(capture.on_frames)
    found = discover(connection, lambda text: progress(f"{facts.name}: {text}"))
    nodes = {node.node_id: node for node in found.nodes}
    patches = facts.patches
    if hand is None:
        patches = tuple(PatchFacts(f"node {n.node_id}", n.node_id) for n in found.nodes if n.is_patch)
    profiles: dict[int, PatchProfile] = {}
    asked: list[PatchFacts] = []
    for patch in patches:
        node = nodes.get(patch.node_id)
        if node is not None and node.answers and node.is_patch:
            progress(f"{facts.name}: reading {patch.name}")
            info, failure = _asked(functools.partial(read_info, connection, patch.node_id))
            patch = replace(patch, info=info, failure=failure)
            profile, _ = _asked(functools.partial(read_profile, connection.od(patch.node_id)))
            if profile is not None and info is not None:
                profiles[patch.node_id] = profile
        asked.append(replace(patch, found=node))
    period_s = facts.period_s or DEFAULT_PERIOD_MS * 1e-3
    if active:
        period_s = max([period_s, *(_scan_s(patch, profiles) for patch in asked)])
    ours, load = _listen(
        connection,
        capture,
        asked,
        profiles,
        period_s,
        active=active,
        progress=lambda text: progress(f"{facts.name}: {text}"),
    )
    stats = connection.link.stats()
    heard = connection.listener
    return replace(
        facts,
        seconds=clock.monotonic() - begun_s,
        frames=stats.received,
        load=max(load, stats.load),
        error_frames=heard.errors,
        dropped=stats.dropped,
        outages=stats.outages,
        foreign=_foreign(heard, {*nodes, *(patch.node_id for patch in patches)}, connection.bus),
        unconfigured=found.unconfigured,
        strangers=tuple(n for n in found.nodes if n.node_id not in {p.node_id for p in asked}),
        sync_s=np.empty(0) if ours else np.array([t_ns for t_ns, _ in list(capture.syncs)]) * 1e-9,
        sync_counters=() if ours else tuple(counter for _, counter in list(capture.syncs)),
        sync_ours=ours,
        own_period_s=period_s if ours else 0.0,
        active=active,
        nmt_commands=_commands_of_others(heard, {patch.node_id for patch in patches}),
        master_beats_s=None
        if facts.master_node_id is None
        else np.array([beat.t_ns for beat in list(heard.node(facts.master_node_id).beats)]) * 1e-9,
        patches=tuple(_with_scans(patch, heard, capture, profiles) for patch in asked),
    )


def _asked(question: Callable[[], Answer]) -> tuple[Answer | None, str]:
    """Call ``question`` up to four times; return its result and "", or None and the text of the last error.

    A call fails if a running host accesses the node at the same time, because an SDO server handles only one
    transfer at a time.
    """
    failure = ""
    for pause_s in _PAUSES_S:
        clock.sleep(pause_s)
        try:
            return question(), ""
        except NodeError as error:
            failure = str(error)
    return None, failure


def _listen(  # noqa: PLR0913 - one call, the state of one examination
    connection: BusConnection,
    capture: ScanCapture,
    patches: Sequence[PatchFacts],
    profiles: dict[int, PatchProfile],
    period_s: float,
    *,
    active: bool,
    progress: Callable[[str], None],
) -> tuple[bool, float]:
    """Capture scans of the running patches; if ``active`` is set, start the other patches first.

    Returns:
        True if this program sent SYNC, and the bus load (fraction) in the busiest second.
    """
    overflows: dict[int, int] = {}
    for node_id, profile in profiles.items():
        overflows[node_id] = _overflow(connection, node_id)
        capture.add(node_id, profile, overflows[node_id], period_s)
    states = {p.node_id: p.found.state for p in patches if p.found is not None and p.node_id in profiles}
    start = [node_id for node_id, state in states.items() if active and state == "pre-operational"]
    running = [node_id for node_id, state in states.items() if state == "operational"] + start
    for node_id in start:
        connection.link.send(od.NMT_COB_ID, encode(NmtCommand.START, node_id))
    if not running:
        return False, 0.0
    try:
        heard = len(capture.syncs)
        connection.wait_until(lambda: len(capture.syncs) > heard, max(_FIRST_SYNC_S, 2.5 * period_s))
        ours = active and len(capture.syncs) == heard
        due_s, end_s = clock.monotonic(), clock.monotonic() + _capture_s(period_s)
        number, load = 0, 0.0
        while min(map(capture.scans, running)) < SCANS and clock.monotonic() < end_s:
            if ours:
                number += 1
                overflow = max(overflows.values())
                counter = (number - 1) % overflow + 1 if overflow else 0
                capture.note_sync(clock.monotonic_ns(), counter)
                connection.link.send(od.SYNC_COB_ID, bytes((counter,)) if counter else b"")
            due_s += period_s
            connection.wait_until(lambda: False, max(0.0, due_s - clock.monotonic()))
            load = max(load, connection.link.stats().load)
            progress(f"{min(map(capture.scans, running))} of {SCANS} scans")
        return ours, load
    finally:
        for node_id in start:
            connection.link.send(od.NMT_COB_ID, encode(NmtCommand.ENTER_PRE_OPERATIONAL, node_id))


def _capture_s(period_s: float) -> float:
    """Return the maximum duration of the capture, in s, for a SYNC period in s."""
    return min(max(LONGEST_S, LEAST_PERIODS * period_s), 2 * SCANS * period_s)


def _scan_s(patch: PatchFacts, profiles: dict[int, PatchProfile]) -> float:
    """Return the minimum SYNC period (s) of a node that has its default inhibit time; 0 for other nodes.

    With a shorter period, the node would not finish a scan before the next SYNC. A host replaces the default
    with an inhibit time that suits the hand's SYNC period.
    """
    profile = profiles.get(patch.node_id)
    if profile is None or patch.info is None or patch.found is None or patch.found.state == "operational":
        return 0.0
    default = profile.default_inhibit_100us
    if all(
        pdo.inhibit_100us != default
        for pdo in patch.info.pdos
        if pdo.cob_id == od.chunk_cob_id(patch.node_id)
    ):
        return 0.0
    return (profile.n_chunks + 1) * default * 1e-4 / SCAN_SHARE


def _overflow(connection: BusConnection, node_id: int) -> int:
    read = functools.partial(connection.od(node_id).read, od.SYNC_COUNTER_OVERFLOW, 0, "u8")
    value = int(_asked(read)[0] or 0)
    return value if 2 <= value <= 240 else 0


def _with_scans(
    patch: PatchFacts, heard: BusListener, capture: ScanCapture, profiles: dict[int, PatchProfile]
) -> PatchFacts:
    node = heard.node(patch.node_id)
    scans = None
    if patch.node_id in profiles and patch.info is not None and patch.info.patch is not None:
        own = patch.info.patch
        scale = CodeScale(own.code_bits, own.code_lo, own.code_hi)
        noise = DEFAULT_NOISE if patch.wanted is None else patch.wanted.relative_noise
        scans = capture.facts(patch.node_id, scale, noise)
    return replace(patch, boot_ups=node.boot_ups, emergencies=tuple(node.emergencies), scans=scans)


def _commands_of_others(heard: BusListener, node_ids: Collection[int]) -> int:
    """Count the NMT commands that this hand's host would not send.

    A host sends only *start* and *enter pre-operational*, each addressed to a single patch. A second host
    running the same hand is therefore detected by its SYNCs, not here.
    """
    return sum(
        count
        for data, count in dict(heard.nmt).items()
        if len(data) != 2
        or data[0] not in (NmtCommand.START, NmtCommand.ENTER_PRE_OPERATIONAL)
        or data[1] not in node_ids
    )


def _foreign(heard: BusListener, node_ids: Collection[int], bus: BusConfig) -> dict[int, int]:
    """Count the frames of unknown origin, by COB-ID.

    The origin of a frame is known if its COB-ID belongs to a CANopen service, to the pre-defined connection
    set of a node in ``node_ids``, or to an entry of ``others`` in the hand file. The patches of the hand are
    included even if they do not answer, because a host may be polling them.
    """
    explained = _KNOWN_TO_ALL.union(*map(od.predefined_cob_ids, node_ids))
    explained |= {other.can_id for other in bus.others}
    return {cob_id: count for cob_id, count in dict(heard.cob_ids).items() if cob_id not in explained}


def link_facts(bus: BusConfig) -> tuple[str | None, int | None]:
    """Return a SocketCAN interface's controller state and bit rate, reported by ``ip``; None if unknown."""
    if bus.interface != "socketcan":
        return None, None
    link = read_link(bus.channel)
    return link.state, link.bitrate_bps
