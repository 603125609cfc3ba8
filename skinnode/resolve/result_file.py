"""Writes the fields of a recording to one file, as ``skinnode convert`` would write it."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.files.whole_file import discard
from skinnode.record.convert import PARQUET, CopiedFrames, write_computed_field
from skinnode.record.field_rows import row_of
from skinnode.record.mcap_file import MCAP, McapFile
from skinnode.record.parquet_file import ParquetFile
from skinnode.record.replay import Replay
from skinnode.resolve.part_files import PartFiles, put_in_place
from skinnode.resolve.patch_solver import SolvedScan, SolveSummary
from skinnode.resolve.recording import Recording

FORMATS: Final = (PARQUET, MCAP)


@contextmanager
def new_result(
    recording: Recording, hand: HandConfig, solved: tuple[str, ...], target: Path, parts: PartFiles
) -> Iterator[None]:
    """Write the fields of all patches to a new file, in the order of a replay.

    The file is complete when the block begins, and appears under its final name when the block ends without
    an error.

    Args:
        recording: The recording.
        hand: The hand with the options of the variant.
        solved: Keys of the parts that contain the patches' fields.
        target: The file; its suffix is one of :data:`FORMATS`.
        parts: Part files.

    Raises:
        ConfigError: The file cannot be written, or a package for its format is missing.
        SkinError: A part cannot be read.
    """
    temporary = parts.temporary(target.name)
    try:
        write = _write_mcap if target.suffix == MCAP else _write_parquet
        write(recording, hand, solved, temporary, parts)
        yield
        put_in_place(temporary, target)
    except OSError as error:
        discard(temporary)
        allowed = f"a writable folder ({error.strerror})"
        raise ConfigError("--output", str(target.parent), allowed) from error
    except BaseException:
        discard(temporary)
        raise


def _in_order(solved: tuple[str, ...], parts: PartFiles) -> Iterator[tuple[SolvedScan, int, int]]:
    """Yield the solved scans of all patches in the order of a replay.

    Each scan comes with the number of its patch's part and the index of its electrode positions.
    """

    def numbered(number: int, key: str) -> Iterator[tuple[SolvedScan, int, int]]:
        for scan, index in parts.items(key):
            yield scan, number, index

    streams = [numbered(number, key) for number, key in enumerate(solved)]
    return heapq.merge(*streams, key=lambda item: item[0].place)


def _write_parquet(
    recording: Recording, hand: HandConfig, solved: tuple[str, ...], path: Path, parts: PartFiles
) -> None:
    opened = recording.opened(hand)
    opened.frames.close()
    table = ParquetFile(path, opened.lines[0] if opened.lines else "")
    for scan, _, _ in _in_order(solved, parts):
        table.write(row_of(scan.field, scan.resistance, opened.header.wall_minus_mono_ns))
    table.close()


def _write_mcap(
    recording: Recording, hand: HandConfig, solved: tuple[str, ...], path: Path, parts: PartFiles
) -> None:
    opened = recording.opened(hand)
    file = McapFile(path, opened.header.hand)
    summaries: list[SolveSummary] = [parts.summary(key) for key in solved]
    tee = CopiedFrames(opened, file)
    run = Replay(replace(opened, frames=tee))
    scans = _in_order(solved, parts)
    upcoming = next(scans, None)

    def write_until(place: tuple[int, int]) -> None:
        nonlocal upcoming
        while upcoming is not None and upcoming[0].place[:2] <= place:
            scan, part, index = upcoming
            write_computed_field(file, scan.field, summaries[part].rest_m[index], run.wall_minus_mono_ns)
            upcoming = next(scans, None)

    try:
        for _ in run.frames():
            write_until(run.place)
        write_until((run.place[0], len(hand.buses)))
        tee.mark_damage()
    finally:
        file.close()
