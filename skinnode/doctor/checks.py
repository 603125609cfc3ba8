"""All that the facts say of a hand, room by room. Pure functions over :class:`BusFacts`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

from skinnode.doctor import bus, configuration, nodes, skin, timing
from skinnode.doctor.facts import BusFacts, Finding, Sure
from skinnode.doctor.quiet import LEAST_SCANS
from skinnode.words import counted

_SURENESS: Final = {sure: rank for rank, sure in enumerate(Sure)}


def diagnose(facts: BusFacts) -> list[Finding]:
    """All findings of a bus, the surest first within each area."""
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


def not_judged(facts: BusFacts) -> list[str]:
    """What could not be looked at, and why, a line each."""
    if facts.failure:
        return [f"{facts.name}: nothing but the interface"]
    lines = []
    for patch in facts.patches:
        scans = 0 if patch.scans is None else patch.scans.scans
        if patch.found is not None and scans < LEAST_SCANS:
            came = counted(scans, "scan") if scans else "no scans"
            lines.append(
                f"{patch.name}: noise, steps and drift: {came} came, {LEAST_SCANS} needed"
                + ("" if facts.running or facts.active else "; it does not run: --active starts it")
            )
        elif patch.scans is not None and skin.is_touched(patch.scans):
            lines.append(
                f"{patch.name}: noise of single crossings, and what is not at its baseline: something moves "
                "on the skin; leave it alone while the doctor listens"
            )
        elif patch.scans is not None and skin.may_be_frozen(patch.scans):
            lines.append(
                f"{patch.name}: frozen or only quiet: no code changed in {scans} scans, and the noise told, "
                f"{patch.scans.told_noise:.0e}, is below a code, {patch.scans.step:.0e}: touch it while the "
                "doctor listens; if this comes again, the converter has stopped"
            )
    return lines
