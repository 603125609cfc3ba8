"""The demo is what a user runs first: it must work, and not say that all is well when it is not."""

from __future__ import annotations

import dataclasses
import io
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from skinnode.config import HandConfig
from skinnode.demo import run as _demo
from skinnode.demo.hand import demo_hand
from skinnode.demo.view import BusView, PatchView, render
from skinnode.model.layout import Float
from skinnode.transport import CanPort
from vcan_sim.fleet import Fleet

SKINNODE = Path(sys.executable).with_name("skinnode")


@pytest.mark.long
@pytest.mark.real_time
def test_the_demo_runs_and_writes_what_it_promises(tmp_path: Path) -> None:
    figures, plot = tmp_path / "demo.json", tmp_path / "demo.png"
    command = [str(SKINNODE), "demo", "--seconds", "3", "--patches", "2", "--seed", "7"]
    done = subprocess.run(
        [*command, "--json", str(figures), "--plot", str(plot)],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.stderr == ""
    assert done.returncode == 0, done.stdout
    assert "\nerror in the deepest scan: " in done.stdout
    assert (
        "\nno scan torn, no frame lost, errors consistent with the reported standard deviations"
        in done.stdout
    )
    report = json.loads(figures.read_text())
    assert [patch["patch"] for patch in report["patches"]] == ["palm", "thumb"]
    assert report["faults"] == []
    assert report["frames_lost"] == 0
    assert 0.4 < report["bus_load"] < 0.7  # two patches at 25 scans/s: 5,050 frames/s of 111 to 135 bits
    for patch in report["patches"]:
        assert patch["scans_sent"] == patch["scans_solved"] + patch["scans_skipped"]
        assert patch["scans_sent"] == pytest.approx(75, abs=5)
        assert patch["scans_torn"] == 0
        score = patch["score"]
        assert score["deepest_m"] > 1e-4
        # the converter's own 3e-6 beside the codes' 4.4e-6: √(1 + (3/4.4)²) = 1.21 times the bound
        assert score["error_rms_m"] < 1.3 * score["bound_rms_m"]
        assert 0.92 < score["coverage95"] <= 1.0
    assert plot.read_bytes().startswith(b"\x89PNG")


def quiet() -> Console:
    return Console(file=io.StringIO(), width=80)


def unhurried_hand() -> HandConfig:
    """One patch at a pace at which a stall of the machine is no torn scan."""
    hand = demo_hand(1, 1)
    return hand.model_copy(update={"sync": hand.sync.model_copy(update={"period_ms": 100})})


@pytest.mark.real_time
def test_a_lost_frame_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    send, sent = CanPort.send, [0]

    def lossy(port: CanPort, can_id: int, data: bytes, *, remote: bool = False) -> None:
        sent[0] += can_id == 0x181
        if can_id != 0x181 or sent[0] != 300:
            send(port, can_id, data, remote=remote)

    monkeypatch.setattr(CanPort, "send", lossy)
    report = _demo.play(unhurried_hand(), 1.0, quiet()).report
    assert report.frames_lost == report.patches[0].frames_lost == 1
    assert report.patches[0].scans_torn == 1
    assert any("1 frame" in fault for fault in report.faults)
    assert any("torn" in fault for fault in report.faults)


@pytest.mark.long
@pytest.mark.real_time
def test_an_error_above_its_uncertainty_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gain error that appears after the baseline was taken: the solver cannot know it."""
    init = Fleet.__init__

    def with_drift(fleet: Fleet, *args: object, **options: object) -> None:
        init(fleet, *args, **options)  # type: ignore[arg-type]  # hands on whatever it was given

        def drift(resistance_ohm: Float, t_ns: int) -> Float:
            return resistance_ohm * np.where(source.started, 1.001, 1.0)

        source = fleet.patches["palm"]
        source.fault = drift

    monkeypatch.setattr(Fleet, "__init__", with_drift)
    report = _demo.play(unhurried_hand(), 2.0, quiet()).report
    # Where no scan came before it, the solver finds that no deformation explains any of them.
    assert report.faults[0].startswith(("palm: error", "palm: no scan solved")), report


def test_a_line_before_the_first_field_contains_no_nan() -> None:
    hand, written = demo_hand(1, seed=1), io.StringIO()
    host = SimpleNamespace(stats=lambda: SimpleNamespace(patches={}, buses={}))
    progress = _demo._Progress(Console(file=written), hand, [], 8.0)
    progress.update(host, 1.0, 0)  # type: ignore[arg-type]
    assert "latency p99 - ms, depth - µm" in written.getvalue()


def test_the_view_shows_names_health_and_losses_in_80_columns() -> None:
    displacement = np.zeros((10, 10, 3))
    displacement[4, 5] = 1e-5, 0.0, -1.2e-4
    patches = [
        PatchView(name, "operational", displacement, 1e-6, 2.5e-6, 12.5, 0)
        for name in ("palm", "thumb", "index", "middle")
    ]
    patches[1] = PatchView("thumb", "lost", None, float("nan"), float("nan"), 0.0, 3)
    patches[2] = dataclasses.replace(patches[2], distrust="half of its readings are lost")
    console = Console(file=io.StringIO(), width=80, height=24)
    console.print(render(patches, BusView(3.2, 8.0, 0.63, 13000, 17, 1.2, 2.4), 2e-4))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]  # it is the StringIO above
    assert max(map(len, lines)) <= 80
    assert len(lines) < 24
    text = "\n".join(lines)
    assert "index not trusted: half of its readings are lost" in text
    for expected in ("palm", "lost 17", "lost ─", "120.0 µm", "→ 10 µm", "63 %", "p99 2.4", "not trusted ─"):
        assert expected in text
