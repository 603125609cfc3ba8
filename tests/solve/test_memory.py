"""What a further patch of the same layout costs in memory, and that patches that share arrays stay apart."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable, Iterator

import numpy as np
import pytest

import skinnode as sk
from tests.lanes import some_long

from .press import frame_ohm, hertz_press

FURTHER = 5
FURTHER_MB = 1.5
"""Limit per further patch of the reference layout, MB; 1.0 when it was set. Of the arrays of a solve, the
covariance of the loads alone has 1.4 MB."""


@pytest.fixture
def traced() -> Iterator[Callable[[], float]]:
    """Memory that Python and NumPy hold at present, MB."""

    def held_mb() -> float:
        gc.collect()
        return tracemalloc.get_traced_memory()[0] / 1e6

    tracemalloc.start()
    yield held_mb
    tracemalloc.stop()


@pytest.mark.long
@pytest.mark.parametrize("method", some_long(["exact", "posterior"], "posterior"))
def test_a_further_patch_of_a_layout_takes_little_memory(traced, method):
    layout = sk.PatchLayout.preset("staggered")
    first = sk.Tracker(layout, method=method, deadline_us=50_000.0)
    before = traced()
    further = [sk.Tracker(layout, method=method, deadline_us=50_000.0) for _ in range(FURTHER)]
    assert traced() - before < FURTHER * FURTHER_MB
    assert len({id(tracker) for tracker in (first, *further)}) == FURTHER + 1  # all are still alive


@pytest.mark.long
def test_memory_follows_the_touch(traced):
    """A solve needs its arrays; a reset frees them, and so does the end of a search for wrong readings."""
    layout = sk.PatchLayout.preset("staggered")
    tracker = sk.Tracker(layout, method="posterior", relative_noise=1e-4)
    wrong = frame_ohm(layout, hertz_press(layout, 0.1))
    wrong[3, 11] *= 1.3
    tracker.update(wrong)  # computes the tables of the layout
    tracker.reset()
    before = traced()
    field = tracker.update(wrong)
    assert field.faults  # the search has run
    assert 1.0 < traced() - before < 7.0
    tracker.reset()
    del field
    assert traced() - before < 0.2


def test_patches_that_share_arrays_do_not_share_results():
    """Streams that take turns, one pressed here, one there, one at rest, are as if each were alone."""
    layout = sk.PatchLayout.preset("staggered", upper_wires=4, upper_electrodes=4, lower_electrodes=4)
    presses = [
        [hertz_press(layout, depth, centre_m=centre) for depth in depths]
        for centre, depths in (((4e-3, 4e-3), (0.1, 0.2, 0.0)), ((8e-3, 8e-3), (0.3, 0.0, 0.1)))
    ]
    streams = [[frame_ohm(layout, moved) for moved in each] for each in presses]
    streams.append([frame_ohm(layout, np.zeros_like(layout.upper_m))] * 3)

    def tracker() -> sk.Tracker:
        return sk.Tracker(layout, method="posterior", relative_noise=1e-3)

    alone = []
    for stream in streams:
        own = tracker()
        alone.append([own.update(frame) for frame in stream])
    trackers = [tracker() for _ in streams]
    for step in range(3):
        for own, stream, expected in zip(trackers, streams, alone, strict=True):
            field = own.update(stream[step])
            np.testing.assert_array_equal(field.displacement_m, expected[step].displacement_m)
            np.testing.assert_array_equal(field.displacement_std_m, expected[step].displacement_std_m)
            np.testing.assert_array_equal(field.force_n, expected[step].force_n)
