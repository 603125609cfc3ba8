"""The host is not disturbed by the drawing, whatever that does; every field is accounted for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from skinnode.config import HandConfig
from skinnode.config.patches import ElectrodesConfig, LayoutConfig
from skinnode.errors import SkinError
from skinnode.host import Host, Subscription
from skinnode.model.layout import PatchLayout
from skinnode.monitor.live_source import HostSource
from skinnode.process import clock
from skinnode.record import Recorder
from skinnode.view.conversion import Conversion
from skinnode.view.drawing_thread import STATE_S, DrawingThread
from skinnode.view.tick import Tick
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet
from vcan_sim.virtual_time import VirtualClock

from .conftest import SMALL, a_hand


@pytest.fixture(autouse=True)
def virtual_time() -> Iterator[None]:
    with VirtualClock():
        yield


@contextmanager
def drawn(
    draw: Callable[[Tick], None], *, hand: HandConfig | None = None, rate_hz: float = 30.0
) -> Iterator[tuple[Host, Fleet, DrawingThread, Subscription]]:
    """A running hand, its drawing, and another subscriber from the same moment on, with room for all."""
    hand = a_hand() if hand is None else hand
    with Fleet(hand) as fleet, Host.from_config(hand) as host, HostSource(host) as source:
        every = host.fields(capacity=100_000)
        with DrawingThread(source, draw, rate_hz=rate_hz) as thread:
            yield host, fleet, thread, every


def silence(fleet: Fleet) -> None:
    """No more fields come, and all that have come are solved."""
    fleet.inject(Faults(unplugged=True))
    clock.sleep(1.0)


def read(every: Subscription) -> list[tuple[str, int]]:
    found = []
    while (field := every.get(0.0)) is not None:
        assert field.stamp is not None
        found.append((field.stamp.patch, field.stamp.scan))
    return found


def scans(ticks: list[Tick]) -> list[tuple[str, int]]:
    return [(name, field.stamp.scan) for tick in ticks for name, field in tick.fields.items() if field.stamp]


@pytest.mark.long
def test_a_fast_drawing_shows_every_field_once() -> None:
    ticks: list[Tick] = []
    with drawn(ticks.append, rate_hz=200.0) as (_, fleet, thread, every):
        clock.sleep(3.0)
        silence(fleet)
        published = read(every)
    assert len(published) > 200
    assert sorted(scans(ticks)) == sorted(published)
    assert (thread.counts.drawn, thread.counts.left_out, thread.counts.dropped) == (len(published), 0, 0)


@pytest.mark.long
def test_no_more_than_thirty_pictures_a_second_and_the_rest_are_counted() -> None:
    ticks: list[Tick] = []
    with drawn(ticks.append) as (_, fleet, thread, every):  # 40 SYNCs per second
        begun_s = clock.monotonic()
        clock.sleep(4.0)
        seconds = clock.monotonic() - begun_s
        of_p0 = sum(name == "p0" for name, _ in scans(ticks))
        silence(fleet)
        published = read(every)
    counts = thread.counts
    assert 0.9 * 30.0 * seconds < of_p0 <= 30.0 * seconds + 1
    assert counts.drawn == len(scans(ticks))
    assert counts.left_out > 0
    assert counts.drawn + counts.left_out + counts.dropped == len(published)
    assert scans(ticks)[-2:] == published[-2:]  # the newest is never left out


@pytest.mark.long
def test_a_drawing_that_blocks_loses_fields_and_the_host_none() -> None:
    ticks: list[Tick] = []

    def draw(tick: Tick) -> None:
        ticks.append(tick)
        clock.sleep(1.0)

    with drawn(draw) as (host, fleet, thread, every):
        clock.sleep(5.0)
        silence(fleet)
        stats = host.stats()
        published = read(every)
    counts = thread.counts
    assert counts.dropped > 100
    assert counts.drawn + counts.left_out + counts.dropped == len(published)
    assert every.dropped == 0
    for stream in stats.patches.values():
        assert stream.skipped == stream.assembler.chunks_lost == stream.assembler.scans_torn == 0
    assert sum(stream.solved for stream in stats.patches.values()) >= len(published)
    newest = [tick.counts.dropped for tick in ticks]
    assert newest == sorted(newest)  # what is told on the screen is how it stands


@pytest.mark.long
def test_the_patches_of_a_picture_show_the_same_scan() -> None:
    """Although the second bus sends its SYNC 8 ms after the first."""
    plan = a_hand(sync={"period_ms": 25, "stagger_ms": 8})
    second = plan.buses[0].model_copy(update={"name": "can1", "channel": plan.buses[0].channel + "b"})
    patches = (plan.patches[0], plan.patches[1].model_copy(update={"bus": "can1"}))
    ticks: list[Tick] = []
    with drawn(
        ticks.append, hand=plan.model_copy(update={"buses": (*plan.buses, second), "patches": patches})
    ) as (_, fleet, _thread, _):
        clock.sleep(2.0)
        settled = len(ticks)
        clock.sleep(3.0)
        pictures = [tick.fields for tick in ticks[settled:] if tick.fields]
        assert len(pictures) > 60
        assert {len({field.stamp.scan for field in each.values() if field.stamp}) for each in pictures} == {1}
        assert all(len(each) == 2 for each in pictures)
        fleet.inject(Faults(unplugged=True), "p1")  # the other is not held up
        clock.sleep(1.0)
        settled = len(ticks)
        clock.sleep(3.0)
        assert sum("p0" in tick.fields for tick in ticks[settled:]) > 60


def test_the_state_is_drawn_several_times_a_second_even_without_fields() -> None:
    ticks: list[Tick] = []
    with drawn(ticks.append) as (_, fleet, _thread, _):
        silence(fleet)
        ticks.clear()
        clock.sleep(2.0)
        views = [tick.view for tick in ticks if tick.view is not None]
    assert 0.8 * 2.0 / STATE_S <= len(views) <= 2.0 / STATE_S + 1
    assert {patch.condition for patch in views[-1].patches} == {"lost"}


@pytest.mark.long
def test_events_are_drawn_once() -> None:
    ticks: list[Tick] = []
    with drawn(ticks.append) as (host, fleet, _thread, _):
        clock.sleep(0.5)
        told = host.events()
        ticks.clear()
        fleet.inject(Faults(unplugged=True), "p1")
        clock.sleep(1.5)
        expected = []
        while (event := told.get(0.0)) is not None:
            expected.append(event)
        shown = [event for tick in ticks for event in tick.events]
    assert expected
    assert shown == expected


@pytest.mark.long
def test_a_drawing_that_fails_ends_alone() -> None:
    def draw(tick: Tick) -> None:
        raise OSError("no space left on device")

    with drawn(draw) as (host, _, thread, every):
        clock.sleep(1.0)
        read(every)
        clock.sleep(1.0)
        assert len(read(every)) > 50
        assert all(host.health(name).condition == "operational" for name in ("p0", "p1"))
    assert isinstance(thread.failure, SkinError)
    assert "no space left on device" in str(thread.failure)


@pytest.mark.long
def test_a_patch_that_supplies_its_electrodes_is_drawn_with_them(tmp_path: Path) -> None:
    """Twice as wide as planned; live, by the drawing of a recording, and by its replay."""
    plan = a_hand(patches=1, solver={"method": "exact"})
    planned = plan.patches[0].layout.build()
    wide = PatchLayout(
        planned.upper_m * [2.0, 1.0, 1.0], planned.lower_m * [2.0, 1.0, 1.0], planned.resistivity_ohm_per_m
    )
    supplied = with_layout(plan, LayoutConfig(**SMALL, coordinates="node"))
    ticks: list[Tick] = []
    path = tmp_path / "run.log"
    with (
        Fleet(with_layout(plan, LayoutConfig(electrodes=ElectrodesConfig.of(wide)))),
        Recorder(supplied, path) as recorder,
        Host.from_config(supplied, tap=recorder) as host,
        HostSource(host) as source,
        DrawingThread(source, ticks.append),
    ):
        clock.sleep(1.0)
    converted: list[Tick] = []
    Conversion(path).run(converted.append)
    for drawn_ticks in (ticks, converted):
        given = [rest_m for tick in drawn_ticks for rest_m in tick.supplied_m.values()]
        np.testing.assert_allclose(given[-1], wide.upper_m, rtol=0, atol=1e-8)
        assert len(given) <= 2  # as planned until the node has supplied its own
        first = next(tick for tick in drawn_ticks if tick.fields)
        before = drawn_ticks[: drawn_ticks.index(first) + 1]
        assert any("p0" in tick.supplied_m and tick.supplied_m["p0"] is given[-1] for tick in before)


def with_layout(hand: HandConfig, layout: LayoutConfig) -> HandConfig:
    patches = tuple(patch.model_copy(update={"layout": layout}) for patch in hand.patches)
    return hand.model_copy(update={"patches": patches})
