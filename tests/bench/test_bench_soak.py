"""``skinnode bench soak``: twenty seconds of it here, thirty minutes before a release; and that it finds what
it looks for."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from skinnode.bench import soak_cache as _soak_cache
from skinnode.bench.soak_starvation import starved_processor
from skinnode.cli.bench import app
from skinnode.compiled import jit
from skinnode.host.patch_stream import PatchStream
from skinnode.host.publish import Publisher
from skinnode.model.frames import FieldFrame
from vcan_sim.faulty_bus import FaultyPort


def soak(tmp_path: Path, minutes: str) -> tuple[int, str, dict[str, Any]]:
    file = tmp_path / "figures.json"
    result = CliRunner().invoke(app, ["soak", "--own-cache", "--minutes", minutes, "--json", str(file)])
    assert file.exists(), result.output
    return result.exit_code, result.output, json.loads(file.read_text(encoding="utf-8"))


def missed(figures: dict[str, Any]) -> list[str]:
    return [row["what"] for row in figures["must"] if not row["reached"]]


@pytest.mark.long
@pytest.mark.real_time
def test_a_hand_under_faults_does_not_grow_and_its_sums_agree(tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    command = ["-c", "from skinnode.cli.main import main; main()", "bench", "soak", "--minutes", "0.33"]
    done = subprocess.run(  # apart from pytest, which keeps every line that is logged
        [sys.executable, *command, "--json", str(file)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(file.read_text(encoding="utf-8"))
    assert missed(figures) == []
    assert figures["rounds"] > 2
    assert figures["fields"] > 100
    assert sum(figures["injected"].values()) > 100
    assert "cut in half" in done.stdout  # the cache it started with
    assert "filled with random bytes" in done.stdout
    arrived = {row["kind"]: row["arrived"] for row in (*figures["from_nodes"], *figures["from_host"])}
    assert {"chunk", "SDO response", "SDO request", "NMT", "heartbeat", "EMCY"} <= arrived.keys()


def test_the_users_own_cache_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    users = tmp_path / "user" / "skinnode" / "numba-1"
    users.mkdir(parents=True)
    for i in range(6):
        (users / f"kernel{i}.nbc").write_bytes(bytes([i]) * 100)
    monkeypatch.setattr(jit, "cache_dir", lambda: users)
    monkeypatch.setattr(jit, "is_cold", lambda: False)
    copy = tmp_path / "copy"
    _soak_cache.fill(copy)
    lines = _soak_cache.damage(copy, seed=1)
    assert len(lines) == 4
    assert all((users / f"kernel{i}.nbc").read_bytes() == bytes([i]) * 100 for i in range(6))
    changed = [
        f
        for f in (copy / "skinnode" / "numba-1").iterdir()
        if f.read_bytes() != (users / f.name).read_bytes()
    ]
    assert len(changed) == 4
    again = tmp_path / "again"
    _soak_cache.fill(again)
    assert _soak_cache.damage(again, seed=1) == lines


def test_the_processor_is_given_back() -> None:
    before = _children()  # such as a resource tracker of earlier tests
    with starved_processor() as count:
        children = _children() - before
        assert len(children) >= count > 0
    assert not _children() & children


def _children() -> set[int]:
    """Process IDs of the children of this process."""
    return {
        int(pid)
        for task in Path("/proc/self/task").iterdir()
        for pid in (task / "children").read_text().split()
    }


@pytest.mark.long
@pytest.mark.real_time
def test_what_grows_or_is_miscounted_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Any] = []
    publish, on_summary = Publisher.publish, PatchStream.on_summary

    def leaking(publisher: Publisher, field: FieldFrame, patch: str) -> None:
        kept.append([[number] for number in range(1000)])
        publish(publisher, field, patch)

    def losing(stream: PatchStream, data: bytes, t_ns: int) -> None:
        if data[0] % 50:
            on_summary(stream, data, t_ns)

    monkeypatch.setattr(Publisher, "publish", leaking)
    monkeypatch.setattr(PatchStream, "on_summary", losing)
    code, output, figures = soak(tmp_path, "0.1")
    assert code == 1
    assert {"growth: blocks of Python", "frame counts that do not agree"} <= set(missed(figures)), output
    assert any("chunks and summaries" in text for text in figures["discrepancies"])
    assert "The soak failed: " in output.splitlines()[-1]


@pytest.mark.long
@pytest.mark.real_time
def test_a_frame_that_is_lost_uncounted_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a kind that no other counter sees."""
    send, heartbeats = FaultyPort.send, itertools.count()

    def losing(port: FaultyPort, can_id: int, data: bytes, *, remote: bool = False) -> None:
        if not (can_id & 0x780 == 0x700 and next(heartbeats) % 20 == 7):
            send(port, can_id, data, remote=remote)

    monkeypatch.setattr(FaultyPort, "send", losing)
    code, output, figures = soak(tmp_path, "0.1")
    assert code == 1
    assert missed(figures) == ["frame counts that do not agree"], output
    assert all("heartbeat frames" in text or "boot-up frames" in text for text in figures["discrepancies"])
