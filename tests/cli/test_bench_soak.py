"""``skinnode bench soak``: twenty seconds of it here, ten minutes before a release; and that it finds what
it looks for."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from skinnode.cli.bench import app
from skinnode.host.pipeline import Lane
from skinnode.host.publish import Publisher
from skinnode.model.frames import FieldFrame


def soak(tmp_path: Path, minutes: str) -> tuple[int, str, dict[str, Any]]:
    file = tmp_path / "figures.json"
    result = CliRunner().invoke(app, ["soak", "--minutes", minutes, "--json", str(file)])
    assert file.exists(), result.output
    return result.exit_code, result.output, json.loads(file.read_text(encoding="utf-8"))


def missed(figures: dict[str, Any]) -> list[str]:
    return [row["what"] for row in figures["must"] if not row["reached"]]


def test_a_hand_under_faults_does_not_grow_and_its_sums_agree(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    command = ["-c", "from skinnode.cli.main import main; main()", "bench", "soak", "--minutes", "0.33"]
    done = subprocess.run(  # apart from pytest, which keeps every line that is logged
        [sys.executable, *command, "--json", str(file)], capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(file.read_text(encoding="utf-8"))
    assert missed(figures) == []
    assert figures["rounds"] > 2
    assert figures["fields"] > 100
    assert sum(figures["injected"].values()) > 100


def test_what_grows_or_is_miscounted_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Any] = []
    publish, on_summary = Publisher.publish, Lane.on_summary

    def leaking(publisher: Publisher, field: FieldFrame, patch: str) -> None:
        kept.append([[number] for number in range(1000)])
        publish(publisher, field, patch)

    def losing(lane: Lane, data: bytes, t_ns: int) -> None:
        if data[0] % 50:
            on_summary(lane, data, t_ns)

    monkeypatch.setattr(Publisher, "publish", leaking)
    monkeypatch.setattr(Lane, "on_summary", losing)
    code, output, figures = soak(tmp_path, "0.1")
    assert code == 1
    assert {"growth: blocks of Python", "sums that do not agree"} <= set(missed(figures)), output
    assert any("chunks and summaries, must be the" in text for text in figures["discrepancies"])
