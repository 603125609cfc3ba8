"""The child process that draws: what arrives in the file, and what happens if it ends."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from skinnode.errors import SkinError
from skinnode.view.drawing_process import DrawingOptions, DrawingProcess
from skinnode.view.outputs import Target
from skinnode.view.texts import DrawnCounts
from skinnode.view.tick import Tick

from .conftest import a_contact, a_field, a_hand
from .test_rrd import Rows

OPTIONS = DrawingOptions(exaggeration=10.0, wall_minus_mono_ns=0, live=True)
HAND = a_hand(patches=1)
REST_M = HAND.patch("p0").layout.build().upper_m


def a_tick(number: int) -> Tick:
    field = a_field(np.full(REST_M.shape, -1e-6 * number), contacts=(a_contact(),))
    return Tick(6_000_000_000 + number, {"p0": field}, DrawnCounts(number, 0, 0))


def until_it_fails(draw: Callable[[], None]) -> SkinError:
    end_s = time.monotonic() + 10.0
    while time.monotonic() < end_s:
        try:
            draw()
        except SkinError as error:
            return error
        time.sleep(0.02)
    raise AssertionError("the drawing goes on")


def test_what_is_drawn_is_in_the_file_when_the_process_has_ended(tmp_path: Path, sdk: None) -> None:
    path = tmp_path / "x.rrd"
    with DrawingProcess(HAND, Target(None, path, "x"), OPTIONS) as process:
        for number in range(50):
            process.draw(a_tick(number))
    rows = Rows(path).in_time("/skin/hand/p0/surface")[1:]
    assert len(rows) == 50
    heights = [row["Mesh3D:vertex_positions"].as_py()[0][2] for row in rows]
    expected = [REST_M[0, 0, 2] - 1e-5 * number for number in range(50)]
    assert sorted(heights, reverse=True) == pytest.approx(expected, rel=1e-6)


def test_a_process_that_is_killed_is_told(tmp_path: Path, sdk: None) -> None:
    with DrawingProcess(HAND, Target(None, tmp_path / "x.rrd", "x"), OPTIONS) as process:
        process.draw(a_tick(0))
        os.kill(process._process.pid or 0, signal.SIGKILL)
        error = until_it_fails(lambda: process.draw(a_tick(1)))
    assert str(error) == "drawing: its process ended"


def test_a_drawing_that_fails_is_told(tmp_path: Path, sdk: None) -> None:
    wrong = Tick(0, {"no such patch": a_field(np.zeros(REST_M.shape))}, DrawnCounts(1, 0, 0))
    with DrawingProcess(HAND, Target(None, tmp_path / "x.rrd", "x"), OPTIONS) as process:
        process.draw(wrong)
        error = until_it_fails(lambda: process.draw(wrong))
    assert str(error) == "drawing: KeyError('no such patch')"
