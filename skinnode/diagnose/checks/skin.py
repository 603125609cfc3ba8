"""Doctor checks for the skin: faulty wires, noise, jumps, frozen values and baseline.

The checks evaluate captured scans. They report nothing that a touch could explain.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from skinnode.diagnose.facts import BusFacts, Finding, PatchFacts, ScanFacts, Sure
from skinnode.diagnose.noise import LEAST_SCANS, Mask, NoiseAnalysis, analyse_noise
from skinnode.model.layout import Float
from skinnode.protocol.device_time import TIME_WRAP_US
from skinnode.text.words import counted

NOISY: Final = 5.0
"""Ratio of measured to stated noise above which a crossing is reported as noisy.

The noise measured over 20 scans practically never exceeds this ratio by chance.
"""

_DRIFT: Final = 0.003
"""Deviation |R/R0 − 1| at rest above which a tare is advised.

The noise of a good converter is a hundredth of this value, and a press changes R/R0 by a hundred times this
value.
"""

_MANY: Final = 0.8
_FEW: Final = 0.1
_SHARE: Final = 0.7
"""Fraction of a wire's crossings that must be noisy for the wire to be reported as noisy."""


def _judged(bus: BusFacts) -> Iterator[tuple[PatchFacts, ScanFacts, NoiseAnalysis]]:
    for patch in bus.patches:
        if patch.scans is not None and patch.scans.scans >= LEAST_SCANS:
            yield patch, patch.scans, analyse_noise(patch.scans)


def check_wires(bus: BusFacts) -> Iterator[Finding]:
    """Check for wires and crossings that are open, shorted or out of range."""
    for patch in bus.patches:
        own = patch.info.patch if patch.info is not None else None
        upper: set[int] = set()
        lower: set[int] = set()
        if own is not None:
            upper, lower = {*own.open_upper, *own.shorted_upper}, {*own.open_lower, *own.shorted_lower}
            for what, wires, advice in (
                ("upper wires open", own.open_upper, "check the connector and solder joints of these wires"),
                ("lower wires open", own.open_lower, "check the connector and solder joints of these wires"),
                ("upper wires shorted", own.shorted_upper, "look for a short to a lower wire, or moisture"),
                ("lower wires shorted", own.shorted_lower, "look for a short to an upper wire, or moisture"),
            ):
                if wires:
                    by = "reported by the node (0x2030, 0x2031)"
                    yield Finding("wires", patch.name, f"{what}: {_listed(wires)}", Sure.CERTAIN, by, advice)
        if patch.scans is not None and patch.scans.scans:
            yield from _check_crossings(patch, patch.scans, upper, lower)


def _check_crossings(
    patch: PatchFacts, scans: ScanFacts, upper: set[int], lower: set[int]
) -> Iterator[Finding]:
    """Check all crossings except those on wires that the node reports as faulty."""
    whole = max(1, int(scans.complete.sum()))  # in a torn scan, some crossings have no code
    rest = np.ones(scans.n_open.shape, dtype=np.bool_)
    rest[sorted(upper), :] = False
    rest[:, sorted(lower)] = False
    for what, counts, advice in (
        (
            "open",
            scans.n_open,
            "look for a broken electrode or wire; the values of these crossings are not used",
        ),
        ("shorted", scans.n_short, "look for squeezed-out rubber, and for moisture"),
        (
            "out of range",
            scans.n_over,
            "if the baseline is missing or old, tare the untouched skin; a press may also exceed the range",
        ),
    ):
        always, sometimes = rest & (counts >= whole), rest & (counts > 0) & (counts < whole)
        for side, wires in (("upper", always.all(axis=1)), ("lower", always.all(axis=0))):
            if wires.any():  # the node's fault masks may be out of date
                yield Finding(
                    "wires",
                    patch.name,
                    f"{side} wires {what}: {_listed(tuple(int(i) for i in np.flatnonzero(wires)))}",
                    Sure.CERTAIN,
                    f"every crossing, {_in_all(scans)}",
                    "check the connector and solder joints of these wires" if what == "open" else advice,
                )
        always &= ~(always.all(axis=1, keepdims=True) | always.all(axis=0, keepdims=True))
        if always.any():
            yield Finding(
                "wires",
                patch.name,
                f"{_crossings(always)} {what}",
                Sure.CERTAIN,
                f"{_in_all(scans)}: {_places(always)}",
                advice,
            )
        if sometimes.any():
            yield Finding(
                "wires",
                patch.name,
                f"{_crossings(sometimes)} intermittently {what}",
                Sure.LIKELY if what == "open" else Sure.POSSIBLE,
                f"in up to {int(counts[sometimes].max())} of {scans.scans} scans: {_places(sometimes)}",
                "look for a loose contact: move the cable and repeat the test" if what == "open" else advice,
            )


def check_noise(bus: BusFacts) -> Iterator[Finding]:
    """Check for frozen values, excessive noise and jumps."""
    for patch, scans, analysis in _judged(bus):
        yield from _check_frozen(patch, scans)
        yield from _check_noise(patch, scans, analysis)
        if analysis.steps.any() and analysis.steps.mean() <= max(_FEW, 1.0 / min(analysis.steps.shape)):
            row, column = (int(i) for i in np.argwhere(analysis.steps)[0])
            yield Finding(
                "wires",
                patch.name,
                f"{_crossings(analysis.steps)} jumped and kept the new value",
                Sure.POSSIBLE,
                f"{_places(analysis.steps)}; crossing {row}/{column} by "
                f"{analysis.step_by[row, column]:.2%} of R0 in scan {int(analysis.step_at[row, column]) + 1}",
                "look for a loose contact, unless something touched the skin there",
            )


def _check_noise(patch: PatchFacts, scans: ScanFacts, analysis: NoiseAnalysis) -> Iterator[Finding]:
    def found(what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("wires", patch.name, what, sure, evidence, advice)

    factor = analysis.noise / analysis.stated
    judged = np.isfinite(factor) & ~analysis.steps
    noisy = judged & (factor > NOISY)
    over = f"over {counted(scans.scans, 'scan')}"
    figures = ""
    if noisy.any():
        median, worst = float(np.median(analysis.noise[noisy])), float(np.max(factor[noisy]))
        figures = f"median noise {median:.1e} of R0, maximum {worst:.0f} × stated noise, {over}"
    all_alike = noisy.sum() > 0.5 * judged.sum()
    if analysis.is_touched:
        levels = (analysis.floor, np.median(analysis.upper), np.median(analysis.lower))
        all_alike &= bool(min(levels) > NOISY)
    if all_alike or analysis.supply > NOISY:
        yield found(
            "the whole patch is noisier than the hand file states",
            Sure.LIKELY,
            f"{int(noisy.sum())} of {_crossings(judged)}; {figures}"
            if all_alike
            else f"all crossings together: {analysis.supply:.0f} times the stated noise, {over}",
            "check the patch's supply and shield, and relative_noise in the hand file",
        )
        return
    names = [
        f"{side} wire {wire}"
        for side, axis, levels in (("upper", 1, analysis.upper), ("lower", 0, analysis.lower))
        for wire in np.flatnonzero(noisy.sum(axis=axis) > _SHARE * np.maximum(1, judged.sum(axis=axis)))
        if not analysis.is_touched or _stands_out(levels, int(wire))
    ]
    if names:
        shown = ", ".join(names[:6]) + (" …" if len(names) > 6 else "")
        yield found(f"noise on {shown}", Sure.LIKELY, figures, "check the contacts of the noisy wires")
    elif noisy.any() and not analysis.is_touched:
        yield found(
            f"noise at {_crossings(noisy)}",
            Sure.POSSIBLE,
            f"{_places(noisy)}; {figures}",
            "check the contact at the electrodes, unless the skin is being touched lightly",
        )


def _stands_out(levels: Float, wire: int) -> bool:
    """Return whether a wire is much noisier than its neighbours; a touch would affect the neighbours too."""
    neighbours = [levels[i] for i in (wire - 1, wire + 1) if 0 <= i < len(levels)]
    return bool(neighbours) and bool(levels[wire] > NOISY * max(1.0, *neighbours))


def _check_frozen(patch: PatchFacts, scans: ScanFacts) -> Iterator[Finding]:
    device = scans.device_us[scans.device_us >= 0] % TIME_WRAP_US  # the host added the higher bits
    if len(device) >= LEAST_SCANS and len(np.unique(device)) == 1:
        yield Finding(
            "wires",
            patch.name,
            "the node repeats the same scan",
            Sure.CERTAIN,
            f"the node's clock did not change over {len(device)} scans",
            "sampling has stopped: reset the node",
        )
    known, still = _still(scans)
    if scans.repeated >= LEAST_SCANS and not scans.conversions:
        yield Finding(
            "wires",
            patch.name,
            "the values are frozen",
            Sure.CERTAIN,
            f"the converter completed no conversion in {scans.repeated} successive scans",
            "the converter has stopped: switch the patch off and on",
        )
    elif _shows(scans) and known.any() and still.sum() > _MANY * known.sum():
        yield Finding(
            "wires",
            patch.name,
            "the values are frozen",
            Sure.LIKELY,
            f"{int(still.sum())} of {_crossings(known)} did not change in {scans.scans} scans, "
            f"although the stated noise ({scans.stated_noise:.0e}) exceeds one code ({scans.step:.0e})",
            "the converter has stopped: switch the patch off and on",
        )


def may_be_frozen(scans: ScanFacts) -> bool:
    """Return whether all codes are constant but the stated noise is too small for this to prove a fault.

    Returns False if the patch counts its conversions, because the count shows whether the converter is
    running.
    """
    if scans.conversions is not None:
        return False
    known, still = _still(scans)
    return scans.scans >= LEAST_SCANS and not _shows(scans) and bool(known.any() and (still == known).all())


def _shows(scans: ScanFacts) -> bool:
    """Return whether the stated noise exceeds one code; every code should then change within a few scans."""
    return scans.stated_noise > scans.step


def _still(scans: ScanFacts) -> tuple[Mask, Mask]:
    """Return two masks: crossings with a value in every scan, and crossings whose value never changed."""
    known = np.asarray(np.isfinite(scans.ratio).all(axis=0))
    return known, known & (np.ptp(np.where(known, scans.ratio, 0.0), axis=0) == 0.0)


def check_baseline(bus: BusFacts) -> Iterator[Finding]:
    """Check that there is a baseline and that it matches the skin at rest."""
    for patch in bus.patches:
        own = patch.info.patch if patch.info is not None else None
        if own is not None and own.baseline_missing:
            yield Finding(
                "baseline",
                patch.name,
                f"{counted(own.baseline_missing, 'crossing has', 'crossings have')} no baseline",
                Sure.CERTAIN,
                "R0 is 0 (0x2301)",
                f"make sure that nothing touches the skin, then run skinnode tare {patch.node_id}",
            )
    for patch, scans, analysis in _judged(bus):
        at_rest = np.isfinite(analysis.level) & ~analysis.touched & ~analysis.steps
        if at_rest.sum() < 0.5 * at_rest.size:
            continue  # the skin is touched
        off = analysis.level[at_rest] - 1.0
        share = float(np.mean(np.abs(off) > _DRIFT))
        one_way = max(float(np.mean(off > 0)), float(np.mean(off < 0)))
        figures = f"median R/R0 − 1 is {np.median(off):+.2%} over {scans.scans} scans; {share:.0%} of "
        figures += f"{off.size} crossings deviate by more than {_DRIFT:.1%}"
        if share > _MANY and one_way > 0.9:
            yield Finding(
                "baseline",
                patch.name,
                "the baseline no longer matches the skin at rest",
                Sure.LIKELY,
                figures,
                "temperature or ageing changed the resistances: run skinnode tare with the skin untouched",
            )
        elif share > 0.02 and not analysis.is_touched:
            yield Finding(
                "baseline",
                patch.name,
                "part of the skin differs from its baseline",
                Sure.POSSIBLE,
                figures,
                "if nothing presses on the skin, run skinnode tare",
            )


def is_touched(scans: ScanFacts) -> bool:
    """Return whether something touched the skin during the scans; if so, some checks are skipped."""
    return scans.scans >= LEAST_SCANS and analyse_noise(scans).is_touched


def _in_all(scans: ScanFacts) -> str:
    return "in the only scan" if scans.scans == 1 else f"in all {scans.scans} scans"


def _crossings(mask: Mask) -> str:
    return counted(int(mask.sum()), "crossing")


def _listed(wires: tuple[int, ...]) -> str:
    return ", ".join(map(str, wires[:12])) + (" …" if len(wires) > 12 else "")


def _places(mask: Mask) -> str:
    """Return the first six crossings of a mask as text, such as ``3/12`` (upper/lower wire)."""
    places = [f"{row}/{column}" for row, column in np.argwhere(mask)[:6]]
    return ", ".join(places) + (" …" if mask.sum() > 6 else "")
