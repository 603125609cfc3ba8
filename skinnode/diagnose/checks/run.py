"""Runs all doctor checks on the facts about a bus."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

from skinnode.canopen.emergency import register_text
from skinnode.diagnose.bus_connection import no_answer
from skinnode.diagnose.checks import bus, configuration, nodes, skin, timing
from skinnode.diagnose.facts import BusFacts, Finding, Sure
from skinnode.diagnose.noise import LEAST_SCANS
from skinnode.text.words import counted

_SURENESS: Final = {sure: rank for rank, sure in enumerate(Sure)}


def run_checks(facts: BusFacts) -> list[Finding]:
    """Return all findings about a bus, sorted by check and then by certainty."""
    checks: tuple[Callable[[BusFacts], Iterator[Finding]], ...] = (
        bus.check_bus,
        bus.check_masters,
        nodes.check_nodes,
        configuration.check_configuration,
        skin.check_wires,
        skin.check_noise,
        skin.check_baseline,
        timing.check_timing,
        timing.check_losses,
    )
    return [
        finding
        for check in checks
        for finding in sorted(check(facts), key=lambda found: _SURENESS[found.sure])
    ]


def others(facts: BusFacts) -> list[str]:
    """Return one line for each device that is neither a patch nor in the hand file.

    Such a device is not a fault.
    """
    lines = []
    for node in facts.strangers:
        if node.is_patch:
            continue
        why = f" ({node.state_known_by})" if node.state == "unknown" else ""
        known = [*node.identity, f"NMT state {node.state}{why}"]
        if not node.answers:
            known.append(no_answer(node.wrong_answer))
        if node.error_register:
            register = register_text(node.error_register)
            known.append(f"error register 0x{node.error_register:02X} ({register})")
        name = f" ({node.name})" if node.name else ""
        whose = "not a skinnode patch" if facts.period_s is None else "not in the hand file"
        lines.append(f"{facts.name}: node {node.node_id}{name}, {whose}: {', '.join(known)}")
    return lines


def not_judged(facts: BusFacts) -> list[str]:
    """Return one line for each check that could not be performed, with the reason."""
    if facts.failure:
        return [f"{facts.name}: all checks except the interface check"]
    lines = []
    for patch in facts.patches:
        scans = 0 if patch.scans is None else patch.scans.scans
        if patch.found is not None and scans < LEAST_SCANS:
            came = counted(scans, "scan") if scans else "no scans"
            lines.append(
                f"{patch.name}: noise, steps and drift: {came} received, {LEAST_SCANS} needed"
                + ("" if facts.running or facts.active else "; the node is not running: --active starts it")
            )
        elif patch.scans is not None and skin.is_touched(patch.scans):
            lines.append(
                f"{patch.name}: noise of individual crossings and drift from the baseline, because something "
                "touched the skin; do not touch the skin during the next run"
            )
        elif patch.scans is not None and skin.may_be_frozen(patch.scans):
            lines.append(
                f"{patch.name}: frozen or merely quiet: no code changed in {scans} scans, but the stated "
                f"noise ({patch.scans.stated_noise:.0e}) is less than one code ({patch.scans.step:.0e}); "
                "touch the patch during the next run: if this line appears again, the converter has stopped"
            )
    return lines
