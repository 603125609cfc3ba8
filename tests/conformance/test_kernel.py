"""The suite over the kernel's CAN, where remote frames and their order are the kernel's, as a command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from .conftest import NODE_ID, patch_on

COMMAND = [sys.executable, "-W", "error", "-c", "from skinnode.cli.main import main; main()", "conformance"]
TIMED = {"HB-02", "HBVG-04", "HBVG-05", "HBVG-06", "HBVG-07", "PDO-04", "PDO-05", "SYNC-02"}
"""Cases that hold single milliseconds, which this lane cannot."""


@pytest.mark.vcan
@pytest.mark.timeout(300)
def test_a_patch_passes_on_socketcan(tmp_path: Path) -> None:
    with patch_on("vcan0", interface="socketcan"):
        options = ["--node-id", str(NODE_ID), "--interface", "socketcan", "--channel", "vcan0"]
        file = tmp_path / "report.json"
        done = subprocess.run(
            [*COMMAND, *options, "--json", str(file)],
            capture_output=True,
            text=True,
            timeout=280,
            check=False,
        )
    assert done.stderr == ""
    report = json.loads(file.read_text())
    failed = {case["id"]: case["why"] for case in report["cases"] if case["verdict"] == "failed"}
    assert failed.keys() <= TIMED, failed
    assert report["passed"] >= 105
