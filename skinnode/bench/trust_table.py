"""Scenes whose fields were once trusted and wrong, measured again."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import tomllib
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skinnode.bench.trust_faults import Fault, singles, some_bits
from skinnode.bench.trust_loads import Bonded, draw
from skinnode.bench.trust_score import BEYOND, LIMIT, Score, deviations, judge, trusted_wires
from skinnode.bench.trust_signal import PITCH_M, CodeStream, Setting, Timeline, make
from skinnode.bench.trust_solver import fields_of, host_patch
from skinnode.bench.truth import Converter, Load, Skin, random_press, stream
from skinnode.config import PatchConfig, parse_hand
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout
from skinnode.model.status import Status
from skinnode.model.tolerances import ORDINARY
from skinnode.solve.paths.path import solve_path
from skinnode.solve.paths.step_control import Uniform

FINE: Final = Setting("staggered", 0.5, 1e-5)
COARSE: Final = Setting("staggered", 0.5, 1e-4)
NAMED: Final = 0.95
"""Minimum share of trusted fields with one faulty wire or crossing, once it is named."""
BRIEF: Final = Timeline(rest=4, press=5, hold=6, slide=0, release=0, after=0)
"""Phases of a stream whose contacts are counted."""
BLUNT_M: Final = 100e-6
"""Error above which a field with half of its readings should not be called trusted and precise: 5 % of the
layer."""
STEADY: Final = 0.95
"""Minimum share of fields with the right number of contacts."""

Solved = tuple[CodeStream, list[FieldFrame]]


@dataclass(frozen=True)
class Line:
    """A line of the table. ``measure`` returns the new figure in words and whether it is as it should be."""

    tried: str
    before: str
    measure: Callable[[int], tuple[str, bool]]


def rows(seed: int, only: Sequence[str] = ()) -> Iterator[dict[str, Any]]:
    """Measure the lines whose description contains a text of ``only``; default: all."""
    for line in LINES:
        if only and not any(part in line.tried for part in only):
            continue
        now, reached = line.measure(seed)
        yield {"tried": line.tried, "before": line.before, "now": now, "reached": bool(reached)}


def _streams(  # noqa: PLR0913 - parts of a stream
    seed: int,
    name: str,
    count: int,
    setting: Setting,
    faults: Sequence[Fault] = (),
    *,
    load: Callable[[np.random.Generator, PatchLayout], Load] | None = None,
    timeline: Timeline | None = None,
    config: PatchConfig | None = None,
) -> Iterator[Solved]:
    """Solve ``count`` streams drawn from the seed and a name: presses by a sphere or by ``load``."""
    for number in range(count):
        rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
        layout = setting.layout()
        body = draw("sphere", layout, rng, 0.3) if load is None else load(rng, layout)
        taken = make(setting, body, faults, rng, Timeline() if timeline is None else timeline)
        yield taken, fields_of(taken, host_patch(taken, config))


def _fault(name: str) -> Fault:
    return next(fault for fault in singles() if fault.name == name)


def _with_fault(name: str, setting: Setting, count: int = 4) -> Callable[[int], tuple[str, bool]]:
    """Return a measurement of the fields from the first changed reading on."""

    def measure(seed: int) -> tuple[str, bool]:
        fault = some_bits() if name == "some bits" else _fault(name)
        total, fields, trusted, wrong, worst = Score(), 0, 0, 0, 0.0
        for taken, found in _streams(seed, name, count, setting, (fault,)):
            total.add(judge(taken, found))
            changed = np.logical_or.accumulate(taken.bad.any(axis=(1, 2)))
            for field, truth in zip(_of(found, changed), taken.truth_m[changed], strict=True):
                fields += 1
                off = float(deviations(field, truth)[trusted_wires(field)].max(initial=0.0))
                trusted += field.trusted
                wrong += off > LIMIT
                worst = max(worst, off)
        named = f"named in {total.named} of {total.nameable} streams"
        if total.scans_to_name:
            named += f", after {total.median_scans:g} scans"
        text = f"{trusted} of {fields} trusted, {wrong} of them beyond 5 deviations, up to {worst:.3g}"
        goes_on = total.share_after if total.after else trusted / max(fields, 1)
        is_good = total.share_beyond <= BEYOND and (goes_on >= NAMED or not fault.local)
        return f"{text}; {named}", is_good

    return measure


def _of(fields: Sequence[FieldFrame], chosen: np.ndarray) -> list[FieldFrame]:
    return [field for field, wanted in zip(fields, chosen, strict=True) if wanted]


def _both(*measures: tuple[str, Callable[[int], tuple[str, bool]]]) -> Callable[[int], tuple[str, bool]]:
    def measure(seed: int) -> tuple[str, bool]:
        found = [(name, *each(seed)) for name, each in measures]
        return "; ".join(f"{name}: {text}" for name, text, _ in found), all(ok for _, _, ok in found)

    return measure


def _half_lost(seed: int) -> tuple[str, bool]:
    trusted = fields = 0
    worst = (0.0, 0.0, 0.0)
    for taken, found in _streams(seed, "half lost", 3, FINE, (_fault("50 % of chunks lost"),)):
        for field, truth in zip(found, taken.truth_m, strict=True):
            fields += 1
            trusted += field.trusted
            if field.trusted and field.precise:
                error = np.abs(field.displacement_m - truth)[trusted_wires(field)]
                std = field.displacement_std_m[trusted_wires(field)]
                if error.size:
                    at = int(error.argmax())
                    one = float(error.flat[at]), float(std.flat[at]), float((error / std).max())
                    worst = max(worst, one)
    error_m, std_m, off = worst
    text = (
        f"{trusted} of {fields} fields trusted; the worst that is also precise {1e6 * error_m:.0f} ± "
        f"{1e6 * std_m:.0f} µm"
    )
    return text, error_m <= BLUNT_M and off <= LIMIT


def _edge(seed: int) -> tuple[str, bool]:
    def load(rng: np.random.Generator, layout: PatchLayout) -> Load:
        return draw("edge", layout, rng, 0.3)

    counts = [
        len(fields[-1].contacts) for _, fields in _streams(seed, "edge", 15, FINE, load=load, timeline=BRIEF)
    ]
    return f"one contact in {counts.count(1)} of 15 presses", counts.count(1) >= 14


def _whole(seed: int) -> tuple[str, bool]:
    def load(rng: np.random.Generator, layout: PatchLayout) -> Load:
        return draw("whole patch", layout, rng)

    found: Counter[int] = Counter()
    for setting in (FINE, COARSE):
        for taken, fields in _streams(seed, "whole patch", 4, setting, load=load):
            found.update(len(field.contacts) for field in _of(fields, taken.touched))
    seen = ", ".join(f"{count} in {found[count]}" for count in sorted(found))
    return f"number of contacts: {seen} of {found.total()} fields", found[1] >= STEADY * found.total()


def _paths(seed: int) -> tuple[str, bool]:
    """Follow 72 sheared presses of 10 wires on noise-free samples."""
    skin = Skin(PatchLayout.preset("aligned", pitch_m=PITCH_M, height_m=0.5 * PITCH_M))
    right, wrong, errors = 0, 0, []
    for number in range(72):
        rng = np.random.default_rng([seed, zlib.crc32(b"sheared"), number])
        angle, press = rng.uniform(0, 2 * np.pi), random_press(rng, skin.layout, 0.7)
        shear = float(0.8 * np.cos(angle)), float(0.8 * np.sin(angle))
        press = dataclasses.replace(press, traction_ratio=shear)
        taken = stream(skin, (press,), np.linspace(0.0, 1.0, 21)[1:], Converter(), rng)
        path = solve_path(
            skin.layout,
            taken.frames_ohm,
            operator="levenberg_marquardt",
            schedule=Uniform(),
            baseline_ohm=skin.rest_ohm,
        )
        truth = taken.truth_m[-1]
        error = np.linalg.norm(path.displacement_m - truth, axis=(1, 2))
        share = error / np.linalg.norm(truth, axis=(1, 2))
        converged = np.array([status is Status.CONVERGED for status in path.status])
        is_wrong = converged & (np.abs(path.displacement_m - truth).max(axis=(1, 2)) > path.error_estimate_m)
        is_wrong &= share > 1e-4
        right += int((converged & ~is_wrong).sum())
        wrong += int(is_wrong.sum())
        errors += share[is_wrong].tolist()
    by = f" by {100 * min(errors):.2g} to {100 * max(errors):.3g} %" if errors else ""
    return f"{wrong} of 720 wires CONVERGED and wrong{by}; {right} CONVERGED and right", wrong == 0


def _placed(off: float, *, stated: float | None = None) -> Callable[[int], tuple[str, bool]]:
    """Return a measurement of wires placed ``off``, if the hand file states that or ordinary tolerances."""
    fault = _fault(f"wires placed {off:g} pitch off")
    config = None
    if stated is not None:
        keys = {
            "relative_noise": FINE.noise,
            "tolerances": {**dataclasses.asdict(ORDINARY), "placement": stated},
        }
        config = PatchConfig.model_validate({"name": "patch", "node_id": 5, **keys})

    def measure(seed: int) -> tuple[str, bool]:
        errors, worst, trusted, total = [], 0.0, 0, Score()
        for taken, fields in _streams(seed, "placed", 8, FINE, (fault,), timeline=BRIEF, config=config):
            field, truth = fields[-1], taken.truth_m[-1]
            total.add(judge(taken, fields))
            errors.append(np.linalg.norm(field.displacement_m - truth) / np.linalg.norm(truth))
            trusted += field.trusted
            worst = max(worst, float(deviations(field, truth).max()))
        text = f"error {100 * np.median(errors):.0f} %, up to {worst:.3g} deviations off"
        return f"{text}, {trusted} of 8 trusted", total.share_beyond <= BEYOND

    return measure


def _placed_beyond_ordinary(off: float) -> Callable[[int], tuple[str, bool]]:
    """Return a measurement that succeeds if fields are right once the hand file states the placement."""

    def measure(seed: int) -> tuple[str, bool]:
        ordinary, _ = _placed(off)(seed)
        text, is_good = _placed(off, stated=off)(seed)
        return f"placement {off:g} stated: {text}; {ORDINARY.placement:g} stated: {ordinary}", is_good

    return measure


def _new_hand(seed: int) -> tuple[str, bool]:
    """Press the first patch of the hand file that ``skinnode hand new`` prints."""
    command = [sys.executable, "-c", "from skinnode.cli.main import main; main()", "hand", "new"]
    text = subprocess.run(command, check=True, capture_output=True, timeout=120).stdout.decode()
    hand = parse_hand(tomllib.loads(text))
    patch = hand.patches[0]
    setting = Setting("staggered", 0.5, patch.relative_noise)
    touched = right = within = forces = 0
    methods: Counter[str] = Counter()
    for taken, fields in _streams(seed, "new hand", 6, setting, config=patch):
        for field, force in zip(_of(fields, taken.touched), taken.force_n[taken.touched], strict=True):
            touched += 1
            right += len(field.contacts) == 1
            methods[field.method] += 1
            if len(field.contacts) == 1:
                contact = field.contacts[0]
                forces += 1
                within += abs(contact.normal_force_n + force[2]) <= LIMIT * contact.normal_force_std_n
    by = " and ".join(sorted(methods))
    text = (
        f"method {by}: one contact in {right} of {touched} touched fields, {within} of {forces} forces right"
    )
    return text, right >= STEADY * touched and within >= STEADY * forces


def _bonded(seed: int) -> tuple[str, bool]:
    def load(rng: np.random.Generator, layout: PatchLayout) -> Load:
        sphere = draw("sphere", layout, rng, 0.2)
        radius = float(rng.uniform(1.0, 2.0)) * layout.pitch_m
        return Bonded(sphere.center_m, radius, layout.height_m, sphere.depth_m)

    ratios, off, missing = [], 0.0, 0
    for taken, fields in _streams(seed, "bonded", 6, COARSE, load=load, timeline=BRIEF):
        contacts, truth = fields[-1].contacts, -float(taken.force_n[-1, 2])
        if not contacts:
            missing += 1
            continue
        force = sum(contact.normal_force_n for contact in contacts)
        std = float(np.hypot.reduce([contact.normal_force_std_n for contact in contacts]))
        ratios.append(force / truth)
        off = max(off, abs(force - truth) / std)
    if not ratios:
        return "no contact in 6 presses", False
    text = f"force {np.median(ratios):.2f} of the true one, up to {off:.3g} deviations off"
    return text + (f"; no contact in {missing} of 6 presses" if missing else ""), off <= LIMIT and not missing


LINES: Final = (
    Line(
        "50 % of chunks lost",
        "97 of 97 fields trusted, the worst 495 ± 383 µm and 3.55 ± 0.64 N",
        _half_lost,
    ),
    Line(
        "patch frozen in mid-press",
        "operational and trusted for ever; at noise 1e-4 known to be frozen and still trusted",
        _both(
            ("1e-5", _with_fault("patch frozen in mid-press", FINE)),
            ("1e-4", _with_fault("patch frozen in mid-press", COARSE)),
        ),
    ),
    Line(
        "one wire frozen under the press, noise 1e-4",
        "36 of 36 trusted, all beyond 6 deviations, up to 54",
        _both(
            ("upper", _with_fault("upper wire frozen", COARSE)),
            ("lower", _with_fault("lower wire frozen", COARSE)),
        ),
    ),
    Line(
        "one crossing stuck",
        "21 of 36 trusted, all beyond 6 deviations",
        _both(
            ("at its value", _with_fault("crossing stuck at its value", FINE)),
            ("at a constant", _with_fault("crossing stuck at a constant", FINE)),
        ),
    ),
    Line(
        "one bit of one code flipped",
        "429 of 843 exact fields trusted and beyond 5 deviations",
        _with_fault("some bits", FINE, 8),
    ),
    Line(
        "lower wire open or two shorted, unmarked",
        "all wires MAX_STEPS: the patch is gone",
        _both(
            ("open", _with_fault("lower wire open, unmarked", FINE)),
            ("shorted", _with_fault("two lower wires shorted", FINE)),
        ),
    ),
    Line(
        "centre of a touch on the outermost row",
        "contacts in 2 of 15 presses, even at noise 1e-5",
        _edge,
    ),
    Line("the whole patch pressed", "0, 1, 2 or 4 contacts from frame to frame", _whole),
    Line(
        "aligned, shear 0.8 of pressure, 70 % presses, 20 samples, LM",
        "27 of 720 wires CONVERGED and wrong by 6 to 105 %",
        _paths,
    ),
    Line("wires placed 0.01 pitch off", "error 14 %, 78 deviations off, 8 of 8 trusted", _placed(0.01)),
    Line("wires placed 0.02 pitch off", "error 26 %, 150 deviations off, 6 of 8 trusted", _placed(0.02)),
    Line(
        "wires placed 0.05 pitch off",
        "error 52 %, 327 deviations off, 4 of 8 trusted",
        _placed_beyond_ordinary(0.05),
    ),
    Line("a hand file of `hand new`", "method exact: no contacts and no forces", _new_hand),
    Line(
        "a press on 2 mm of rubber bonded to metal",
        "force 0.02 of the true one, with a small deviation",
        _bonded,
    ),
)


def text(row: dict[str, Any]) -> Iterator[str]:
    """Return a line of the table as text."""
    yield f"{row['tried']}: {'as it should be' if row['reached'] else 'NOT as it should be'}"
    yield f"    before  {row['before']}"
    yield f"    now     {row['now']}"
