"""Doctor checks for the nodes' configuration: EDS, layout, PDOs, inhibit time and heartbeat."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from skinnode.canopen import indices as od
from skinnode.diagnose.facts import BusFacts, Finding, PatchFacts, Sure
from skinnode.diagnose.pdo_parameters import Pdo
from skinnode.protocol.profile import PatchProfile


def check_configuration(bus: BusFacts) -> Iterator[Finding]:
    """Check the EDS, layout, PDOs, inhibit time and heartbeat of each patch."""
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
            "the EDS in the hand file describes another patch",
            Sure.CERTAIN,
            patch.eds_problem,
            "create the correct EDS with skinnode eds",
        )
    if wanted is None:
        return
    if patch.layout_hash is not None and own.layout_hash != patch.layout_hash:
        yield Finding(
            "configuration",
            patch.name,
            "the layout differs from the hand file",
            Sure.CERTAIN,
            f"layout hash 0x{own.layout_hash:08X} ({own.layout}, {own.upper_wires} × {own.lower_wires} "
            f"wires), expected 0x{patch.layout_hash:08X}",
            "correct [patches.layout] or install the right patch; until then, the displacements are wrong",
        )
    if own.code_bits != wanted.code_bits:
        yield Finding(
            "configuration",
            patch.name,
            "the code width differs from the hand file",
            Sure.CERTAIN,
            f"{own.code_bits} bits; the hand file specifies {wanted.code_bits}",
            "correct code_bits in the hand file",
        )


def _check_pdos(bus: BusFacts, patch: PatchFacts) -> Iterator[Finding]:
    """Compare the PDOs and the heartbeat with the host's settings, except values that the host overwrites."""
    info = patch.info
    assert info is not None
    if info.patch is None or patch.found is None:
        return

    def found(what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("configuration", patch.name, what, sure, evidence, advice)

    again = "skinnode host sets this value at bring-up; find the program that overwrites it"
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
                f"the {what} is not at its COB-ID", Sure.CERTAIN, f"{has}, expected 0x{cob_id:03X}", again
            )
    if chunk is not None and bus.period_s is not None and chunk.inhibit_100us is not None:
        yield from _check_inhibit(bus.period_s, patch, chunk, running, found)
    if chunk is not None and chunk.kind < 254:
        yield found("chunks are not event-driven", Sure.CERTAIN, f"transmission type {chunk.kind}", again)
    if running and info.patch.period_ms:
        yield found(
            "the patch scans on its own timer, not on SYNC",
            Sure.LIKELY,
            f"period {info.patch.period_ms} ms (0x2021:1)",
            f"run skinnode od {patch.node_id} 2021:1 --write 0 to make all patches scan simultaneously",
        )
    if running and info.heartbeat_ms == 0:
        yield found(
            "no heartbeat: a failure of the node would go unnoticed", Sure.CERTAIN, "0x1017 is 0", again
        )
    elif running and bus.heartbeat_ms is not None and info.heartbeat_ms not in (None, bus.heartbeat_ms):
        evidence = f"a heartbeat every {info.heartbeat_ms} ms; the hand file specifies {bus.heartbeat_ms} ms"
        yield found("the heartbeat period differs from the hand file", Sure.POSSIBLE, evidence, again)


def _check_inhibit(
    period_s: float, patch: PatchFacts, chunk: Pdo, running: bool, found: Callable[..., Finding]
) -> Iterator[Finding]:
    own = patch.info.patch if patch.info is not None else None
    assert own is not None
    sizes = own.upper_wires, own.lower_wires, own.upper_electrodes, own.lower_electrodes, own.code_bits
    profile = PatchProfile(*sizes, bus="classic" if own.pdo_bytes == 8 else "fd")
    at_default = chunk.inhibit_100us == profile.default_inhibit_100us
    if at_default and not running and patch.inhibit_100us is not None:
        return  # the host replaces this default at bring-up
    chunks, inhibit_s = profile.n_chunks, (chunk.inhibit_100us or 0) * 1e-4
    if chunks * inhibit_s > period_s:
        yield found(
            "a scan takes longer than a SYNC period",
            Sure.CERTAIN,
            f"{chunks} chunks {inhibit_s * 1e3:g} ms apart take {chunks * inhibit_s * 1e3:.0f} ms; "
            f"the period is {period_s * 1e3:g} ms",
            "set a shorter inhibit time (0x1800:3) or a longer sync.period_ms",
        )
    elif running and patch.inhibit_100us is not None and chunk.inhibit_100us != patch.inhibit_100us:
        yield found(
            "the inhibit time differs from the host's setting",
            Sure.POSSIBLE,
            f"{chunk.inhibit_100us} × 100 µs; the host sets {patch.inhibit_100us} × 100 µs",
            "this is normal if another master configures the patches",
        )
