"""Divides the work of ``skinnode resolve`` into units."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.resolve.part_files import PartFiles
from skinnode.resolve.recording import Recording
from skinnode.resolve.settings import Variant, apply, capture_hand, name_of
from skinnode.resolve.units import CaptureScans, SolvePatch, Unit, WriteResult

_MOST_NAME: Final = 120


@dataclass(frozen=True, slots=True)
class Job:
    """Recording to be solved with the options of one variant."""

    recording: Recording
    variant: Variant
    captures: tuple[CaptureScans, ...]
    solves: tuple[SolvePatch, ...]
    write: WriteResult

    def units(self, parts: PartFiles) -> list[Unit]:
        """Return the unfinished units; none if the file is complete."""
        if self.write.finished(parts):
            return []
        units: list[Unit] = [*self.captures, *self.solves]
        return [*(unit for unit in units if not unit.finished(parts)), self.write]


def make_plan(
    recordings: Sequence[tuple[Recording, HandConfig]],
    variants: Sequence[Variant],
    folder: Path,
    suffix: str,
    workers: int,
) -> list[Job]:
    """Return the jobs for all recordings and variants.

    Args:
        recordings: Recordings and their hands.
        variants: Variants of the options.
        folder: Folder for the results.
        suffix: Suffix of the result files.
        workers: Number of units that can run at the same time. If there are fewer recordings, the buses of a
            recording are divided among several units, each of which must read the whole recording.

    Raises:
        ConfigError: Two results would have the same name, two variants result in the same hand, or a setting
            is not allowed for a hand.
    """
    jobs: list[Job] = []
    groups = -(-workers // len(recordings))
    for recording, hand in recordings:
        applied = [apply(hand, variant) for variant in variants]
        _require_different(variants, applied)
        for variant, changed in zip(variants, applied, strict=True):
            name = file_name(recording.path.stem, variant if len(variants) > 1 else ())
            jobs.append(_job(recording, changed, variant, folder / f"{name}{suffix}", groups))
    targets = [job.write.target for job in jobs]
    for job, target in zip(jobs, targets, strict=True):
        if targets.count(target) > 1:
            allowed = "recordings whose names differ, because the results are named after them"
            raise ConfigError("recording", str(job.recording.path), allowed)
    return jobs


def file_name(stem: str, variant: Variant) -> str:
    """Return the name of a result without its suffix: the recording's name and the settings."""
    if not variant:
        return stem
    text = "-".join([stem, *name_of(variant).split()])
    name = re.sub(r"[^\w.=+-]+", "_", text)
    if len(name) <= _MOST_NAME:
        return name
    return f"{name[: _MOST_NAME - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _require_different(variants: Sequence[Variant], hands: Sequence[HandConfig]) -> None:
    """Raise ConfigError if two variants result in the same hand, because they would have the same results."""
    seen: dict[str, Variant] = {}
    for variant, hand in zip(variants, hands, strict=True):
        before = seen.setdefault(hand.model_dump_json(), variant)
        if before is not variant:
            allowed = f"values that differ; these have the same effect as {name_of(before)}"
            raise ConfigError("--set", name_of(variant), allowed)


def _job(recording: Recording, hand: HandConfig, variant: Variant, target: Path, groups: int) -> Job:
    plain = capture_hand(hand)
    buses = [bus.name for bus in hand.buses]
    count = min(groups, len(buses))
    captures = tuple(CaptureScans(recording, plain, tuple(buses[i::count])) for i in range(count))
    of_bus = {bus: capture for capture in captures for bus in capture.buses}
    solves = tuple(SolvePatch(recording, hand, patch.name, of_bus[patch.bus]) for patch in hand.patches)
    captured, solved = tuple(unit.key for unit in captures), tuple(unit.key for unit in solves)
    write = WriteResult(recording, hand, target, captured, solved)
    return Job(recording, variant, captures, solves, write)
