"""Regression tests for ``skinnode bench trust``: scenes on which earlier versions failed."""

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
"""Minimum fraction of trusted fields after a faulty wire or crossing has been identified."""
BRIEF: Final = Timeline(rest=4, press=5, hold=6, slide=0, release=0, after=0)
"""Timeline of a short stream, which ends while the load is held."""
BLUNT_M: Final = 100e-6
"""Maximum error of a trusted, precise field computed from half of the readings, in metres: 5 % of the layer
height."""
STEADY: Final = 0.95
"""Minimum fraction of fields with the right number of contacts, and of contacts with the right force."""

Solved = tuple[CodeStream, list[FieldFrame]]


@dataclass(frozen=True)
class Line:
    """A scene of the table; ``measure`` returns the result as text, and whether the target was reached."""

    tried: str
    before: str
    measure: Callable[[int], tuple[str, bool]]


def rows(seed: int, only: Sequence[str] = ()) -> Iterator[dict[str, Any]]:
    """Measure the scenes whose descriptions contain one of the strings in ``only``; default: all scenes."""
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
    """Yield ``count`` solved streams, seeded with ``seed`` and ``name``; the default load is a sphere."""
    for number in range(count):
        rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
        layout = setting.layout()
        body = draw("sphere", layout, rng, 0.3) if load is None else load(rng, layout)
        taken = make(setting, body, faults, rng, Timeline() if timeline is None else timeline)
        yield taken, fields_of(taken, host_patch(taken, config))


def _fault(name: str) -> Fault:
    return next(fault for fault in singles() if fault.name == name)


def _with_fault(name: str, setting: Setting, count: int = 4) -> Callable[[int], tuple[str, bool]]:
    """Return a function that evaluates all fields from the first changed reading onwards."""

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
        named = f"fault identified in {total.named} of {total.nameable} streams"
        if total.scans_to_name:
            named += f", after {total.median_scans:g} scans"
        text = (
            f"{trusted} of {fields} fields trusted, {wrong} of them wrong by more than 5 deviations, "
            f"at most {worst:.3g}"
        )
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
        f"{trusted} of {fields} fields trusted; largest error of a trusted and precise field "
        f"{1e6 * error_m:.0f} ± {1e6 * std_m:.0f} µm"
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
    """Solve 72 noise-free sheared presses on a patch with 10 upper wires, each as a path of 20 samples."""
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
    """Return a function that evaluates fields of patches with wires misplaced by ``off`` pitches.

    ``stated`` is the placement tolerance stated in the hand file, in pitches; default: ordinary tolerances.
    """
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
        text = f"error {100 * np.median(errors):.0f} %, at most {worst:.3g} deviations"
        return f"{text}, {trusted} of 8 trusted", total.share_beyond <= BEYOND

    return measure


def _placed_beyond_ordinary(off: float) -> Callable[[int], tuple[str, bool]]:
    """Return a function that checks fields of patches whose hand file states the true placement error."""

    def measure(seed: int) -> tuple[str, bool]:
        ordinary, _ = _placed(off)(seed)
        text, is_good = _placed(off, stated=off)(seed)
        return f"with a stated placement of {off:g}: {text}; of {ORDINARY.placement:g}: {ordinary}", is_good

    return measure


def _new_hand(seed: int) -> tuple[str, bool]:
    """Press the first patch of a hand file generated by ``skinnode hand new``."""
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
        f"method {by}: one contact in {right} of {touched} touched fields, "
        f"{within} of {forces} forces correct"
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
    text = f"force {np.median(ratios):.2f} of the true force, at most {off:.3g} deviations off"
    return text + (f"; no contact in {missing} of 6 presses" if missing else ""), off <= LIMIT and not missing


LINES: Final = (
    Line(
        "50 % of chunks lost",
        "97 of 97 fields trusted, largest errors 495 ± 383 µm and 3.55 ± 0.64 N",
        _half_lost,
    ),
    Line(
        "patch frozen in mid-press",
        "always operational and trusted; at noise 1e-4 detected as frozen but still trusted",
        _both(
            ("1e-5", _with_fault("patch frozen in mid-press", FINE)),
            ("1e-4", _with_fault("patch frozen in mid-press", COARSE)),
        ),
    ),
    Line(
        "one wire frozen under the press, noise 1e-4",
        "36 of 36 fields trusted, all wrong by 6 to 54 deviations",
        _both(
            ("upper", _with_fault("upper wire frozen", COARSE)),
            ("lower", _with_fault("lower wire frozen", COARSE)),
        ),
    ),
    Line(
        "one crossing stuck",
        "21 of 36 fields trusted, all wrong by more than 6 deviations",
        _both(
            ("at the last reading", _with_fault("crossing frozen at last reading", FINE)),
            ("at a constant", _with_fault("crossing stuck at a constant", FINE)),
        ),
    ),
    Line(
        "one bit of one code flipped",
        "429 of 843 exact fields trusted but wrong by more than 5 deviations",
        _with_fault("some bits", FINE, 8),
    ),
    Line(
        "lower wire open or two shorted, unmarked",
        "all wires MAX_STEPS: the whole patch is lost",
        _both(
            ("open", _with_fault("lower wire open, unmarked", FINE)),
            ("shorted", _with_fault("two lower wires shorted", FINE)),
        ),
    ),
    Line(
        "centre of a touch on the outermost row",
        "contact found in only 2 of 15 presses, even at noise 1e-5",
        _edge,
    ),
    Line("the whole patch pressed", "number of contacts changes between 0, 1, 2 and 4", _whole),
    Line(
        "aligned, shear 0.8 of pressure, 70 % presses, 20 samples, LM",
        "27 of 720 wires CONVERGED and wrong by 6 to 105 %",
        _paths,
    ),
    Line("wires placed 0.01 pitch off", "error 14 %, at most 78 deviations, 8 of 8 trusted", _placed(0.01)),
    Line("wires placed 0.02 pitch off", "error 26 %, at most 150 deviations, 6 of 8 trusted", _placed(0.02)),
    Line(
        "wires placed 0.05 pitch off",
        "error 52 %, at most 327 deviations, 4 of 8 trusted",
        _placed_beyond_ordinary(0.05),
    ),
    Line("a hand file of `hand new`", "method exact, which reports neither contacts nor forces", _new_hand),
    Line(
        "a press on 2 mm of rubber bonded to metal",
        "force 0.02 of the true force, with a small standard deviation",
        _bonded,
    ),
)


def text(row: dict[str, Any]) -> Iterator[str]:
    """Yield the report lines of a scene."""
    yield f"{row['tried']}: {'target met' if row['reached'] else 'target NOT MET'}"
    yield f"    before  {row['before']}"
    yield f"    now     {row['now']}"
