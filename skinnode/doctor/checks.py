"""What the facts say of buses, nodes, configuration, timing and losses. Pure functions; the skin itself is
looked at in :mod:`skinnode.doctor.skin`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from skinnode.doctor import skin
from skinnode.doctor.facts import BusFacts, Finding, PatchFacts, Sure
from skinnode.model.config import MAX_BUS_LOAD
from skinnode.technician.pdo import Pdo
from skinnode.wire import indices as od
from skinnode.wire.emergency import error_text, register_text
from skinnode.wire.profile import PatchProfile

_JITTER: Final = 0.1
"""Share of the period that a SYNC may come early or late before somebody should know."""

_PERIOD_ERROR: Final = 0.02
_LATE: Final = 0.95
"""Share of the period after which a scan that is not over runs into the next."""

_SURENESS: Final = {sure: rank for rank, sure in enumerate(Sure)}


def diagnose(facts: BusFacts) -> list[Finding]:
    """All findings of a bus, the surest first within each area."""
    checks: tuple[Callable[[BusFacts], Iterator[Finding]], ...] = (
        check_bus,
        check_nodes,
        check_configuration,
        skin.check_wires,
        skin.check_noise,
        skin.check_baseline,
        check_timing,
        check_losses,
    )
    return [
        finding
        for check in checks
        for finding in sorted(check(facts), key=lambda found: _SURENESS[found.sure])
    ]


def check_bus(bus: BusFacts) -> Iterator[Finding]:
    """Interface, controller, load, strangers."""

    def found(what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("bus", bus.name, what, sure, evidence, advice)

    if bus.failure:
        yield found(
            "the interface does not work",
            Sure.CERTAIN,
            bus.failure,
            "bring it up: ip link set NAME up type can bitrate BPS; see that the adapter is plugged in",
        )
        return
    if bus.link_state is not None and bus.link_state not in ("ERROR-ACTIVE", "ERROR-WARNING"):
        yield found(
            f"the controller is {bus.link_state}",
            Sure.CERTAIN,
            "the kernel says so (ip -details link show)",
            "check bit rate, cable and the two terminations of 120 ohm; then take the interface down and up",
        )
    if bus.link_bitrate_bps not in (None, bus.bitrate_bps):
        yield found(
            "the interface has another bit rate than the hand file",
            Sure.CERTAIN,
            f"{bus.link_bitrate_bps} bit/s, the hand file says {bus.bitrate_bps}",
            "set one to the other: at two bit rates nobody understands anybody",
        )
    if bus.error_frames:
        yield found(
            "error frames on the bus",
            Sure.CERTAIN,
            f"{bus.error_frames} in {bus.seconds:.1f} s",
            "termination, bit rate of each node, length of stubs, a node that is not powered",
        )
    if bus.load > MAX_BUS_LOAD:
        yield found(
            "the bus is loaded above what plans allow",
            Sure.CERTAIN,
            f"{bus.load:.0%} over the last second, {MAX_BUS_LOAD:.0%} allowed",
            "a longer sync.period_ms, send mode changed, or fewer patches on this bus",
        )
    if bus.outages:
        yield found(
            "the interface failed while it was watched",
            Sure.CERTAIN,
            f"{bus.outages} times",
            "cable and power of the adapter; kernel log (dmesg)",
        )
    if bus.foreign:
        shown = ", ".join(f"0x{cob_id:03X}: {count}" for cob_id, count in Counter(bus.foreign).most_common(6))
        yield found(
            "frames that nothing in the hand explains",
            Sure.POSSIBLE,
            f"{shown} in {bus.seconds:.1f} s",
            "fine if the bus is shared with drives or another master; else find who sends them",
        )
    for address in bus.unconfigured:
        yield found(
            "a node without a node-ID",
            Sure.CERTAIN,
            f"serial {address.serial_number} answers LSS",
            f"skinnode lss set --serial {address.serial_number} --node-id N",
        )


def check_nodes(bus: BusFacts) -> Iterator[Finding]:
    """Present, the right ones, alive, without errors."""
    if bus.failure:
        return
    if bus.patches and all(patch.found is None for patch in bus.patches):
        yield Finding(
            "nodes",
            bus.name,
            "no node of the hand answers",
            Sure.CERTAIN,
            f"{len(bus.patches)} asked, {bus.frames} frames heard in {bus.seconds:.1f} s",
            "supply of the patches, cable, termination, bit rate, channel",
        )
        return
    for patch in bus.patches:
        yield from _check_node(bus, patch)
    for node in bus.strangers:
        if node.is_patch:
            yield Finding(
                "nodes",
                bus.name,
                f"patch at node {node.node_id} is not in the hand file",
                Sure.CERTAIN,
                f"serial {node.serial}, {node.state}",
                "add it, or give it the node-ID that it should have (skinnode lss set)",
            )


def _check_node(bus: BusFacts, patch: PatchFacts) -> Iterator[Finding]:
    def found(what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("nodes", patch.name, what, sure, evidence, advice)

    node, wanted, info = patch.found, patch.wanted, patch.info
    if node is None:
        yield found(
            "the node is not there",
            Sure.CERTAIN,
            f"node {patch.node_id} neither answers nor beats; others on {bus.name} do",
            "its supply and connector; skinnode scan shows whether it has another node-ID",
        )
        return
    if node.duplicate:
        yield found(
            "two nodes have its node-ID",
            Sure.CERTAIN if "answers" in node.duplicate else Sure.LIKELY,
            node.duplicate,
            "unplug one and give it another node-ID: skinnode lss set --serial …",
        )
    if not node.answers:
        yield found(
            f"the node is {node.state} and does not answer",
            Sure.CERTAIN,
            "its heartbeat is heard",
            f"skinnode nmt {patch.node_id} reset-communication",
        )
        return
    if wanted is not None and not node.is_patch:
        yield found(
            "another device has its node-ID",
            Sure.CERTAIN,
            f"{node.name!r}, vendor {node.vendor_id}, product {node.product_code}",
            "give one of them another node-ID",
        )
        return
    if wanted is not None and wanted.serial not in (None, node.serial):
        yield found(
            "another patch than the hand file says",
            Sure.CERTAIN,
            f"serial {node.serial}, the hand file says {wanted.serial}",
            "two patches exchanged? Put them back, or correct the hand file and its calibration",
        )
    if patch.failure:
        yield found(
            "it did not tell all about itself", Sure.CERTAIN, patch.failure, "skinnode info shows more"
        )
    if patch.boot_ups or node.boot_ups:
        yield found(
            "the node restarts by itself",
            Sure.CERTAIN,
            f"{max(patch.boot_ups, node.boot_ups)} boot-up messages in {bus.seconds:.1f} s",
            "supply voltage under load, connector, watchdog of the board",
        )
    if bus.running and node.state != "operational":
        yield found(
            f"the node is {node.state} while others run",
            Sure.LIKELY,
            f"NMT state by {node.state_known_by}",
            "see its errors below; a host that runs takes it up again when they are gone",
        )
    if info is not None and info.error_register:
        yield found(
            "the node reports an error",
            Sure.CERTAIN,
            f"error register 0x{info.error_register:02X} ({register_text(info.error_register)}); "
            f"last: {info.errors[0] if info.errors else 'none told'}",
            "what it says is wrong; skinnode info has its history",
        )
    told = [emergency for emergency in patch.emergencies if emergency.code]
    if told:
        kinds = Counter(error_text(emergency.code, emergency.detail) for emergency in told)
        shown = "; ".join(f"{count} × {text}" for text, count in kinds.most_common(3))
        yield found(
            "emergency messages while it was watched", Sure.CERTAIN, shown, "the cause is what they name"
        )


def check_configuration(bus: BusFacts) -> Iterator[Finding]:
    """Sizes, layout, EDS, PDOs, inhibit time, heartbeat."""
    for patch in bus.patches:
        if patch.info is None or patch.info.patch is None:
            continue
        yield from _check_layout(patch)
        yield from _check_pdos(bus, patch)


def _check_layout(patch: PatchFacts) -> Iterator[Finding]:
    info, wanted = patch.info, patch.wanted
    assert info is not None
    own = info.patch
    assert own is not None
    if patch.eds_problem:
        yield Finding(
            "configuration",
            patch.name,
            "the EDS of the hand file is of another patch",
            Sure.CERTAIN,
            patch.eds_problem,
            "skinnode eds writes the right one",
        )
    if wanted is None:
        return
    if patch.layout_hash is not None and own.layout_hash != patch.layout_hash:
        yield Finding(
            "configuration",
            patch.name,
            "its electrodes are elsewhere than the hand file says",
            Sure.CERTAIN,
            f"layout hash 0x{own.layout_hash:08X} ({own.layout}, {own.upper_wires} × {own.lower_wires} "
            f"wires), wanted 0x{patch.layout_hash:08X}",
            "correct [patches.layout], or the wrong patch is mounted: fields solved with it are wrong",
        )
    if own.code_bits != wanted.code_bits:
        yield Finding(
            "configuration",
            patch.name,
            "codes of another width",
            Sure.CERTAIN,
            f"{own.code_bits} bits, the hand file says {wanted.code_bits}",
            "correct code_bits in the hand file",
        )


def _check_pdos(bus: BusFacts, patch: PatchFacts) -> Iterator[Finding]:
    """As the host sets them; judged only where a host has been: a node at its defaults gets them later."""
    info = patch.info
    assert info is not None
    if info.patch is None or patch.found is None:
        return

    def found(what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("configuration", patch.name, what, sure, evidence, advice)

    again = "skinnode host sets it at bring-up: who else writes to the node?"
    pdos = {(pdo.direction, pdo.number): pdo for pdo in info.pdos}
    chunk, summary = pdos.get(("TPDO", 1)), pdos.get(("TPDO", 2))
    running = patch.found.state == "operational"
    for pdo, what, cob_id in (
        (chunk, "chunk PDO (TPDO1)", od.chunk_cob_id(patch.node_id)),
        (summary, "summary PDO (TPDO2)", od.summary_cob_id(patch.node_id)),
    ):
        if pdo is None or not pdo.enabled or pdo.cob_id != cob_id:
            has = "missing" if pdo is None else "off" if not pdo.enabled else f"at 0x{pdo.cob_id:03X}"
            yield found(
                f"the {what} is not where it belongs", Sure.CERTAIN, f"{has}, wanted 0x{cob_id:03X}", again
            )
    if chunk is not None and bus.period_s is not None and chunk.inhibit_100us is not None:
        yield from _check_inhibit(bus.period_s, patch, chunk, running, found)
    if chunk is not None and chunk.kind < 254:
        yield found("chunks are not sent on event", Sure.CERTAIN, f"transmission type {chunk.kind}", again)
    if running and info.patch.period_ms:
        yield found(
            "the patch scans by its own timer, not at SYNC",
            Sure.LIKELY,
            f"period {info.patch.period_ms} ms (0x2021:1)",
            f"write 0: skinnode od {patch.node_id} 2021:1 --write 0; patches then scan at the same instant",
        )
    if running and info.heartbeat_ms == 0:
        yield found("no heartbeat: nobody sees it go", Sure.CERTAIN, "0x1017 is 0", again)
    elif running and bus.heartbeat_ms is not None and info.heartbeat_ms not in (None, bus.heartbeat_ms):
        evidence = f"every {info.heartbeat_ms} ms, the hand file says {bus.heartbeat_ms}"
        yield found("another heartbeat than wanted", Sure.POSSIBLE, evidence, again)


def _check_inhibit(
    period_s: float, patch: PatchFacts, chunk: Pdo, running: bool, found: Callable[..., Finding]
) -> Iterator[Finding]:
    own = patch.info.patch if patch.info is not None else None
    assert own is not None
    sizes = own.upper_wires, own.lower_wires, own.upper_electrodes, own.lower_electrodes, own.code_bits
    chunks = PatchProfile(*sizes, bus="classic" if own.pdo_bytes == 8 else "fd").n_chunks
    inhibit_s = (chunk.inhibit_100us or 0) * 1e-4
    if chunks * inhibit_s > period_s:
        yield found(
            "a scan takes longer than a SYNC period",
            Sure.CERTAIN,
            f"{chunks} chunks {inhibit_s * 1e3:g} ms apart are {chunks * inhibit_s * 1e3:.0f} ms, "
            f"the period is {period_s * 1e3:g} ms",
            "a shorter inhibit time (0x1800:3) or a longer sync.period_ms",
        )
    elif running and patch.inhibit_100us is not None and chunk.inhibit_100us != patch.inhibit_100us:
        yield found(
            "another inhibit time than the host sets",
            Sure.POSSIBLE,
            f"{chunk.inhibit_100us} × 100 µs, the host sets {patch.inhibit_100us}",
            "fine if another master configures the patches",
        )


def check_timing(bus: BusFacts) -> Iterator[Finding]:
    """SYNC, and how soon after it a scan is there."""

    def found(where: str, what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("timing", where, what, sure, evidence, advice)

    if bus.running and not bus.sync_ours and len(bus.sync_s) == 0 and bus.seconds > 0:
        timers = any(p.info and p.info.patch and p.info.patch.period_ms for p in bus.patches)
        if not timers:
            yield found(
                bus.name,
                "nobody sends SYNC",
                Sure.CERTAIN,
                f"none in {bus.seconds:.1f} s, and nodes are operational",
                "is the host, or the robot's master, running? Patches scan at SYNC alone",
            )
    intervals = np.diff(bus.sync_s)
    if len(intervals) >= 5:
        period_s = float(np.median(intervals))
        if bus.period_s is not None and abs(period_s / bus.period_s - 1) > _PERIOD_ERROR:
            yield found(
                bus.name,
                "SYNC has another period than the hand file",
                Sure.CERTAIN,
                f"{period_s * 1e3:.2f} ms, the hand file says {bus.period_s * 1e3:g} ms",
                "two masters, or another hand file in use",
            )
        missing = int(np.sum(np.rint(intervals / period_s) - 1))
        if missing > 0:
            yield found(
                bus.name,
                "SYNCs are missing",
                Sure.CERTAIN,
                f"{missing} of {len(intervals) + missing}",
                "the machine that sends SYNC is overloaded, or the bus loses frames",
            )
        regular = intervals[intervals < 1.5 * period_s]
        jitter_s = float(np.percentile(np.abs(regular - period_s), 99)) if len(regular) else 0.0
        if jitter_s > _JITTER * period_s:
            yield found(
                bus.name,
                "SYNC is irregular",
                Sure.LIKELY,
                f"99 % within {jitter_s * 1e3:.1f} ms of a period of {period_s * 1e3:.1f} ms",
                "load of the machine that sends it; a real-time priority for the host",
            )
    for patch in bus.patches:
        if patch.scans is None or bus.period_s is None:
            continue
        latency_s = patch.scans.latency_s[np.isfinite(patch.scans.latency_s)]
        if len(latency_s) and float(np.median(latency_s)) > _LATE * bus.period_s:
            yield found(
                patch.name,
                "scans end when the next has begun",
                Sure.CERTAIN,
                f"median {np.median(latency_s) * 1e3:.1f} ms after SYNC, period {bus.period_s * 1e3:g} ms",
                "a shorter inhibit time, a longer period, less load on the bus",
            )


def check_losses(bus: BusFacts) -> Iterator[Finding]:
    """Where frames went missing: before this program, on the bus, at the node."""

    def found(where: str, what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("losses", where, what, sure, evidence, advice)

    if bus.dropped:
        yield found(
            bus.name,
            "this machine dropped frames",
            Sure.CERTAIN,
            f"{bus.dropped} of {bus.frames + bus.dropped}, by the kernel or the receive queue",
            "raise net.core.rmem_max, less load; what is said of scans below may come from this",
        )
    for patch in bus.patches:
        if patch.scans is None:
            continue
        stats, scans = patch.scans.stats, patch.scans.scans
        if stats.chunks_lost or stats.scans_torn or stats.summaries_lost:
            yield found(
                patch.name,
                "scans with holes",
                Sure.LIKELY if bus.dropped else Sure.CERTAIN,
                f"{stats.scans_torn} of {scans} torn, {stats.chunks_lost} chunks and {stats.summaries_lost} "
                "summaries lost",
                "bus errors, load, or a node that is interrupted; compare with the other patches",
            )
        if stats.scans_missed:
            yield found(
                patch.name,
                "whole scans are missing",
                Sure.CERTAIN,
                f"{stats.scans_missed} of {scans + stats.scans_missed}",
                "the node skips scans (EMCY 0x8110) when they take longer than the period",
            )
        if stats.conflicts:
            yield found(
                patch.name,
                "two different chunks with one number",
                Sure.LIKELY,
                f"{stats.conflicts} times",
                "two nodes with one node-ID: skinnode scan",
            )
        wrong = stats.bad_length + stats.bad_index + stats.bad_counter
        if wrong:
            yield found(
                patch.name,
                "frames that are no chunks of this patch",
                Sure.CERTAIN,
                f"{stats.bad_length} of wrong length, {stats.bad_index} of wrong index, "
                f"{stats.bad_counter} of wrong counter",
                "another node uses its COB-IDs, or its mapping was changed",
            )
