"""``skinnode bench pipeline``: the figures add up. Whether this machine is fast enough is no business of a
test."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from skinnode.cli.bench import app


@pytest.mark.real_time
@pytest.mark.release
def test_pipeline_accounts_for_every_frame_of_a_full_hand(tmp_path):
    file = tmp_path / "figures.json"
    options = ["--seconds", "1", "--short", "--json", str(file), "--plot", str(tmp_path / "figures.png")]
    result = CliRunner().invoke(app, ["pipeline", *options])
    assert result.exit_code in (0, 1), result.output
    data = json.loads(file.read_text(encoding="utf-8"))
    nothing_lost = all(row["reached"] for row in data["must"] if not row["time"])
    assert (result.exit_code == 0) is nothing_lost
    assert [(row["fd"], row["buses"], row["patches"], row["stagger_ms"]) for row in data["rows"]] == [
        (False, 4, 16, 0),
        (False, 4, 16, 3),
        (True, 4, 16, 0),
        (True, 4, 16, 3),
    ]
    for row, scans, frames in zip(data["rows"], (20, 20, 40, 40), (101, 101, 11, 11), strict=True):
        assert row["discrepancies"] == []
        assert row["sent"] == row["received"] + row["kernel_dropped"]
        assert row["sent"] >= 16 * scans * frames
        if row["kernel_dropped"] == 0:
            assert (row["scans"], row["chunks_lost"]) == (16 * scans, 0)
        assert row["fields"] + row["scans_skipped"] == row["scans"]
        assert row["fields_read"] == row["fields"] > 0
