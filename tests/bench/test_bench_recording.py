"""The benchmark of recordings writes what it says, and its sizes are those of the files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from skinnode.bench import recording as bench


@pytest.mark.long
def test_a_block_is_the_traffic_of_a_full_bus(tmp_path: Path) -> None:
    block = bench.block_of(1, 1.0, tmp_path)
    assert len(block.fields) in (76, 80)  # four patches, twenty scans a second; the last may end later
    assert len(block.frames) == pytest.approx(8100, abs=50)  # 101 frames a scan, and SYNC
    times_ns = [frame.t_ns for _, frame in block.frames]
    assert times_ns == sorted(times_ns)


@pytest.mark.long
def test_sizes_and_counts_are_those_of_the_files(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = []
    kept: dict[str, int] = {}

    def report(row: dict[str, Any]) -> None:
        rows.append(row)
        for path in tmp_path.glob("*/run.*"):
            kept[path.suffix] = path.stat().st_size

    with pytest.MonkeyPatch.context() as patched:
        folder = tmp_path / "made"
        patched.setattr("tempfile.TemporaryDirectory", lambda: _Folder(folder))
        figures = bench.run(1, 2 / 60, 1.0, report)
    assert figures["rates"]["minutes"] == pytest.approx(2 / 60)
    sizes = {row["format"]: row["gb_per_hour"] for row in rows}
    assert sizes[".log"] == pytest.approx(kept[".log"] * 1800 / 1e9)
    assert sizes[".mcap with fields"] > sizes[".mcap"] > sizes[".blf"] > 0
    assert figures["seek"]["chunks"] == pytest.approx(2.0 / 0.25, abs=1)


class _Folder:
    """A folder that stays."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> str:
        self._path.mkdir()
        return str(self._path)

    def __exit__(self, *_: object) -> None:
        pass
