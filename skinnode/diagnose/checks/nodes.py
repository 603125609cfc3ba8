"""Doctor checks for the nodes: presence, identity, NMT state and errors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from skinnode.canopen.emergency import error_text, register_text
from skinnode.diagnose.bus_connection import no_answer
from skinnode.diagnose.discovery import FoundNode
from skinnode.diagnose.facts import BusFacts, Finding, PatchFacts, Sure
from skinnode.text.words import counted, known


def check_nodes(bus: BusFacts) -> Iterator[Finding]:
    """Check that every node answers, is the expected device, is running and reports no error."""
    if bus.failure:
        return
    if bus.patches and all(patch.found is None for patch in bus.patches):
        yield Finding(
            "nodes",
            bus.name,
            "none of the hand's nodes answers",
            Sure.CERTAIN,
            f"{counted(len(bus.patches), 'node')} queried, {counted(bus.frames, 'frame')} received "
            f"in {bus.seconds:.1f} s",
            "check the patches' supply, the cable, the termination, the bit rate and the channel",
        )
        return
    for patch in bus.patches:
        yield from _check_node(bus, patch)
    for node in bus.strangers:
        if node.duplicate:
            yield Finding(
                "nodes",
                bus.name,
                f"two nodes have node-ID {node.node_id}",
                Sure.CERTAIN if "responses" in node.duplicate else Sure.LIKELY,
                node.duplicate,
                "unplug one node and change the node-ID of the other",
            )
        if node.is_patch:
            yield Finding(
                "nodes",
                bus.name,
                f"patch at node {node.node_id} is not in the hand file",
                Sure.CERTAIN,
                f"serial {known(node.serial)}, {node.state}",
                "add the patch to the hand file, or assign the intended node-ID (skinnode lss set)",
            )


def _check_node(bus: BusFacts, patch: PatchFacts) -> Iterator[Finding]:
    def found(what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("nodes", patch.name, what, sure, evidence, advice)

    node, wanted = patch.found, patch.wanted
    if node is None:
        yield found(
            "the node is missing",
            Sure.CERTAIN,
            f"node {patch.node_id} sends neither SDO responses nor heartbeats; other nodes on {bus.name} do",
            "check the node's supply and connector; skinnode scan shows whether its node-ID has changed",
        )
        return
    if node.duplicate:
        yield found(
            "two nodes have the patch's node-ID",
            Sure.CERTAIN if "responses" in node.duplicate else Sure.LIKELY,
            node.duplicate,
            "unplug one node and change the node-ID of the other: skinnode lss set --serial …",
        )
    if not node.answers:
        standard = " as CiA 301 requires" if node.wrong_answer else ""
        yield found(
            f"the node is {node.state} and does not answer{standard}",
            Sure.CERTAIN,
            "the node sends heartbeats"
            + (f" but {no_answer(node.wrong_answer)}" if node.wrong_answer else ""),
            f"skinnode nmt {patch.node_id} reset-communication",
        )
        return
    if wanted is not None and not node.is_patch:
        yield found(
            "another device has the patch's node-ID",
            Sure.CERTAIN,
            ", ".join([f"'{node.name}'" if node.name else "unnamed", *node.identity]),
            "change the node-ID of one of the two devices",
        )
        return
    if wanted is not None and wanted.serial not in (None, node.serial):
        yield found(
            "the serial number differs from the hand file",
            Sure.CERTAIN,
            f"serial {known(node.serial)}; the hand file specifies {wanted.serial}",
            "if two patches were swapped, swap them back or correct the hand file and its calibration",
        )
    yield from _check_state(bus, patch, node)


def _check_state(bus: BusFacts, patch: PatchFacts, node: FoundNode) -> Iterator[Finding]:
    def found(what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("nodes", patch.name, what, sure, evidence, advice)

    info = patch.info
    if patch.failure:
        yield found(
            "some objects of the node could not be read", Sure.CERTAIN, patch.failure, "see skinnode info"
        )
    if patch.boot_ups or node.boot_ups:
        yield found(
            "the node restarts by itself",
            Sure.CERTAIN,
            f"{counted(max(patch.boot_ups, node.boot_ups), 'boot-up message')} in {bus.seconds:.1f} s",
            "check the supply voltage under load, the connector and the board's watchdog",
        )
    if bus.running and node.state != "operational":
        yield found(
            f"the node is {node.state} while other nodes are operational",
            Sure.LIKELY,
            f"NMT state by {node.state_known_by}",
            "see the node's errors below; a running host restarts the node when they are cleared",
        )
    if info is not None and info.error_register:
        yield found(
            "the node reports an error",
            Sure.CERTAIN,
            f"error register 0x{info.error_register:02X} ({register_text(info.error_register)}); "
            f"last: {info.errors[0] if info.errors else 'none reported'}",
            "fix the reported fault; skinnode info shows the error history",
        )
    reported = [emergency for emergency in patch.emergencies if emergency.code]
    if reported:
        kinds = Counter(
            error_text(emergency.code, emergency.detail, ours=node.is_patch) for emergency in reported
        )
        shown = "; ".join(f"{count} × {text}" for text, count in kinds.most_common(3))
        yield found(
            "emergency messages received during the check", Sure.CERTAIN, shown, "fix the reported faults"
        )
