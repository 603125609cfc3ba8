"""``bench remote``: the counts at both ends of a short run agree, and each time is that of a whole way."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from skinnode.bench import remote as bench


@pytest.mark.long
def test_every_field_is_accounted_for(tmp_path: Path) -> None:
    path = tmp_path / "figures.json"
    program = "from skinnode.cli.main import main; main()"  # the command limits the threads of BLAS
    command = [sys.executable, "-c", program, "bench", "remote", "--seconds", "2", "--json", str(path)]
    subprocess.run(command, capture_output=True, timeout=110.0, check=False)
    total = json.loads(path.read_text())["total"]
    assert total["unaccounted"] == 0
    assert 0 < total["received"] <= total["sent"] <= total["solved"]
    for key in ("solved_to_program_ms", "sent_to_program_ms", "ping_ms"):
        assert 0 < total[key]["p50"] <= total[key]["p99"] <= total[key]["max"]


def test_a_field_that_is_neither_received_nor_lost_is_found() -> None:
    published = {"p0": 110, "p1": 100}
    counted = bench._unaccounted(published, {"counts": {"p0": (11, 95, 3), "p1": (1, 100, 0)}})
    assert counted == {"received": 195, "lost": 3, "unaccounted": 2}
    total = {
        "lost": 0,
        "unaccounted": 1,
        "daemon_dropped": 0,
        "solved_to_program_ms": {"p99": 3.1},
        "ping_ms": {"p99": 1.0},
    }
    assert [row["reached"] for row in bench._must(total)] == [False, False]
    better = total | {"unaccounted": 0, "solved_to_program_ms": {"p99": 2.9}}
    assert [row["reached"] for row in bench._must(better)] == [True, True]
