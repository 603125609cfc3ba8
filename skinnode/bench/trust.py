"""Implements ``skinnode bench trust``: tests whether trusted values are correct and faults are detected.

The data of each stream pass through the modules in this order::

    trust_loads, trust_faults -> trust_signal -> trust_solver -> trust_score -> trust_report

The random numbers of a stream depend only on the seed and the stream's name, so any part of a run can be
repeated on its own.
"""

from __future__ import annotations

import json
import math
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.bench import trust_road, trust_speed, trust_table
from skinnode.bench.stability import processes
from skinnode.bench.timing import machine
from skinnode.bench.trust_faults import Fault, singles
from skinnode.bench.trust_loads import LOADS, draw
from skinnode.bench.trust_report import part_verdicts, verdicts
from skinnode.bench.trust_score import Naming, Score, judge
from skinnode.bench.trust_signal import RATE_HZ, Setting, Timeline, all_settings, make
from skinnode.bench.trust_solver import fields_of, host_patch
from skinnode.process.child_processes import starting_children
from skinnode.text.json_values import plain

PAIRS: Final = 500
"""Default number of streams with two randomly chosen faults."""
PARTS: Final = ("table", "speed", "road")
"""Names of the additional parts: earlier failures, speed versus error, and fault injection on a bus."""
SHORT: Final[dict[str, Any]] = {
    "pairs": 20,
    "hours": 0.0,
    "settings": (Setting("staggered", 0.5, 1e-5), Setting("staggered", 0.5, 1e-4)),
}
"""Options for a short run of :func:`run`."""
WATCHED: Final = 4000
"""Number of scans in a stream used to count false alarms; the stream contains ten touches."""
QUIET: Final = Timeline(rest=200, press=10, hold=30, slide=40, release=10, after=110)
"""Timeline of a touch in a stream used to count false alarms."""
PAIRED: Final = Timeline(rest=9, press=6, hold=7, slide=6, release=4, after=6)
"""Timeline of a stream with two faults. The phases are short, because there are many such streams."""


@dataclass(frozen=True)
class Item:
    """Description of a stream to solve."""

    section: str
    row: str
    """Name of the report row to which the stream's score is added."""
    setting: Setting
    load: str
    faults: tuple[str, ...] = ()
    number: int = 0

    @property
    def name(self) -> str:
        """Unique name of the stream, used to seed its random generator."""
        return f"{self.section} {self.row} {self.setting.name} {self.load} {self.number}"


def items(seed: int, *, pairs: int = PAIRS, hours: float = 0.1, settings: Sequence[Setting]) -> list[Item]:
    """List all streams of a run.

    Args:
        seed: Seed for choosing the fault pairs.
        pairs: Number of streams with two faults.
        hours: Total length of the streams in which false alarms are counted, in patch-hours.
        settings: Layouts and noise levels.
    """
    found = [Item("healthy", load, setting, load) for load in LOADS for setting in settings]
    for i, fault in enumerate(singles()):
        for j, setting in enumerate(settings):
            load = LOADS[(i + j + seed) % len(LOADS)]
            found.append(Item("single", fault.name, setting, load, (fault.name,)))
    rng = np.random.default_rng([seed, zlib.crc32(b"pairs")])
    found += [_pair(rng, settings, number) for number in range(pairs)]
    streams = math.ceil(hours * 3600.0 * RATE_HZ / WATCHED)
    for number in range(streams):
        setting = settings[number % len(settings)]
        found.append(Item("hours", f"{setting.noise:.0e}", setting, "all", number=number))
    return found


def _pair(rng: np.random.Generator, settings: Sequence[Setting], number: int) -> Item:
    faults = singles()
    while True:
        first, second = (faults[i] for i in rng.choice(len(faults), 2, replace=False))
        if not first.group or first.group != second.group:
            break
    setting, load = settings[int(rng.integers(len(settings)))], LOADS[int(rng.integers(len(LOADS)))]
    return Item("pair", setting.name, setting, load, (first.name, second.name), number)


def solve_item(item: Item, seed: int) -> Score:
    """Generate a stream, solve it, and return its score."""
    rng = np.random.default_rng([seed, zlib.crc32(item.name.encode())])
    if item.section == "hours":
        return _watch(item, rng)
    by_name = {fault.name: fault for fault in singles()}
    faults: list[Fault] = [by_name[name] for name in item.faults]
    timeline = PAIRED if item.section == "pair" else Timeline()
    taken = make(item.setting, draw(item.load, item.setting.layout(), rng), faults, rng, timeline)
    return judge(taken, fields_of(taken))


def _watch(item: Item, rng: np.random.Generator) -> Score:
    """Score all touches of a long fault-free stream, and count the false alarms."""
    total, known, number = Score(), set[Naming](), 0
    patch = None
    for touch in range(WATCHED // QUIET.scans):
        load = draw(LOADS[(item.number + touch) % len(LOADS)], item.setting.layout(), rng)
        taken = make(item.setting, load, (), rng, QUIET)
        patch = host_patch(taken) if patch is None else patch
        fields = []
        for codes in taken.codes:
            fields.append(patch.field(codes, number, 1 + number % 3))
            number += 1
        total.add(judge(taken, fields, known))
    return total


class Kept:
    """Score file with one line per solved stream, used to resume an interrupted run.

    Args:
        path: File to which scores are appended; None to store nothing.
        seed: Seed for the run; lines with a different seed are ignored.
    """

    def __init__(self, path: Path | None, seed: int) -> None:
        self._path, self._seed = path, seed
        self.scores: dict[str, Score] = {}
        if path is None or not path.exists():
            return
        for line in path.read_text(encoding="utf-8").splitlines():
            kept = json.loads(line)
            if kept["seed"] == seed:
                self.scores[kept["stream"]] = Score(**kept["score"])

    def keep(self, item: Item, score: Score) -> None:
        """Append the score of a stream to the file."""
        if self._path is not None:
            line = json.dumps({"seed": self._seed, "stream": item.name, "score": asdict(score)})
            with self._path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")


def _solve_all(
    work: Sequence[Item], seed: int, jobs: int, progress: Callable[[str], object], kept: Kept
) -> Iterator[tuple[Item, Score]]:
    todo = [item for item in work if item.name not in kept.scores]
    for item in work:
        if item.name in kept.scores:
            yield item, kept.scores[item.name]
    with ExitStack() as stack:
        results: Iterable[Score]
        if jobs > 1:
            with starting_children():
                pool: ProcessPoolExecutor = stack.enter_context(processes(jobs))
                shares = [pool.submit(solve_item, item, seed) for item in todo]
            results = (share.result() for share in shares)
        else:
            results = (solve_item(item, seed) for item in todo)
        start = time.monotonic()
        for done, (item, score) in enumerate(zip(todo, results, strict=True), 1):
            kept.keep(item, score)
            yield item, score
            if done % 20 == 0 or done == len(todo):
                progress(f"{done} of {len(todo)} streams, {time.monotonic() - start:.0f} s")


def run(  # noqa: PLR0913 - options of a command
    seed: int = 1,
    *,
    pairs: int = PAIRS,
    hours: float = 0.1,
    only: Sequence[str] = (),
    settings: Sequence[Setting] | None = None,
    jobs: int = 1,
    progress: Callable[[str], object] = lambda line: None,
    kept: Path | None = None,
) -> dict[str, Any]:
    """Solve streams with zero, one or two faults, and long fault-free streams; check the targets.

    Args:
        seed: Seed for all streams.
        pairs: Number of streams with two faults.
        hours: Total length of the streams in which false alarms are counted, in patch-hours.
        only: Substrings of section and row names; only matching rows are run. Default: all rows.
        settings: Layouts and noise levels; default: all.
        jobs: Number of processes that solve streams in parallel; the results do not depend on this number.
        progress: Function that receives a line of text after every 20 streams.
        kept: File for the scores of solved streams; streams that it already contains are not solved again.

    Returns:
        The report's rows and targets, as built-in types.
    """
    chosen = all_settings() if settings is None else settings
    work = [
        item
        for item in items(seed, pairs=pairs, hours=hours, settings=chosen)
        if not only or any(part in f"{item.section}: {item.row}" for part in only)
    ]
    cells: dict[tuple[str, str], dict[str, Score]] = {(item.section, item.row): {} for item in work}
    before = Kept(kept, seed)
    for item, score in _solve_all(work, seed, jobs, progress, before):
        cells[item.section, item.row].setdefault(item.setting.name, Score()).add(score)
    rows = [_row(section, row, found) for (section, row), found in cells.items()]
    return {
        "benchmark": "trust",
        "machine": machine(),
        "seed": seed,
        "rows": plain(rows),
        "must": verdicts(rows, chosen) if rows else [],
    }


def with_parts(
    figures: dict[str, Any], seed: int, parts: Sequence[str], progress: Callable[[str], object]
) -> dict[str, Any]:
    """Run additional parts of the benchmark; return a copy of ``figures`` with their results added.

    Args:
        figures: Result of :func:`run`.
        seed: Seed for all streams.
        parts: Names from :data:`PARTS`.
        progress: Function that receives a line of text for each step.
    """
    found = dict(figures)
    if "table" in parts:
        found["table"] = []
        for row in trust_table.rows(seed):
            found["table"].append(plain(row))
            progress(f"table: {row['tried']}")
    if "speed" in parts:
        progress("speed versus error")
        found["speed"] = plain(trust_speed.rows(seed))
    if "road" in parts:
        progress("faults over the bus")
        found["road"] = plain(trust_road.rows(seed))
    found["must"] = [*figures["must"], *part_verdicts(found)]
    return found


def _row(section: str, name: str, cells: dict[str, Score]) -> dict[str, Any]:
    total = Score()
    for score in cells.values():
        total.add(score)
    worst = max(cells, key=lambda setting: (cells[setting].share_beyond, cells[setting].worst))
    return {
        "section": section,
        "row": name,
        **_figures(total),
        "worst_setting": worst,
        "settings": {setting: _figures(score) for setting, score in cells.items()},
    }


def _figures(score: Score) -> dict[str, Any]:
    shares = ("beyond", "trusted", "after", "named", "contacts", "forces")
    named = {f"share_{name}": getattr(score, f"share_{name}") for name in shares}
    counts = asdict(score)
    del counts["scans_to_name"]
    return counts | named | {"median_scans": score.median_scans}
