"""A small hand for the screen, and the check that nothing stays behind."""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
import uuid
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot

from skinnode.config import HandConfig, parse_hand
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float
from skinnode.monitor.app import MonitorApp
from skinnode.monitor.source import Source
from skinnode.node import NodeRunner, PatchNode
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort

SMALL = {"upper_wires": 4, "upper_electrodes": 4, "lower_wires": 12, "lower_electrodes": 4}


@pytest.fixture(autouse=True)
def nothing_left_running() -> Iterator[None]:
    """Threads and file descriptors are the same after a test as before it."""
    resource_tracker.ensure_running()  # multiprocessing opens its pipe once, and keeps it
    threads, descriptors = set(threading.enumerate()), os.listdir("/proc/self/fd")
    yield
    assert [thread.name for thread in threading.enumerate() if thread not in threads] == []
    assert len(os.listdir("/proc/self/fd")) <= len(descriptors)  # an earlier test's garbage may have gone


def a_hand(patches: int = 2, bus: dict[str, object] | None = None, **tables: object) -> HandConfig:
    """Patches p0, p1 … of 4 × 4 electrodes with node-IDs from 5 on, on a virtual bus of their own."""
    own = {"name": "can0", "interface": "virtual", "channel": uuid.uuid4().hex[:8], **(bus or {})}
    listed = [
        {"name": f"p{i}", "node_id": 5 + i, "layout": SMALL, "tolerances": "exact"} for i in range(patches)
    ]
    return parse_hand({"buses": [own], "patches": listed, "sync": {"period_ms": 50}, **tables})


class Pressed:
    """Real nodes whose skin is as a test has it."""

    def __init__(self, hand: HandConfig) -> None:
        self._layouts = {patch.name: patch.layout.build() for patch in hand.patches}
        self._ohm = {name: resistance_ohm(layout, layout.upper_m) for name, layout in self._layouts.items()}
        self._running = ExitStack()
        for patch in hand.patches:
            port = self._running.enter_context(CanPort(hand.bus(patch.bus)))
            layout = self._layouts[patch.name]
            node = PatchNode(
                patch.node_id,
                layout=layout,
                profile=PatchProfile.from_layout(layout, patch.code_bits),
                serial=0,
                source=_Skin(self._ohm, patch.name),
                send=port.send,
            )
            self._running.enter_context(NodeRunner(port, [node]))

    def press(self, patch: str, wire: int, electrode: int, moved_m: tuple[float, float, float]) -> None:
        """Move one electrode from its rest."""
        layout = self._layouts[patch]
        upper_m = layout.upper_m.copy()
        upper_m[wire, electrode] += moved_m
        self._ohm[patch] = resistance_ohm(layout, upper_m)

    def close(self) -> None:
        self._running.close()


class _Skin:
    def __init__(self, ohm: dict[str, Float], patch: str) -> None:
        self._ohm, self._patch = ohm, patch

    def read(self, t_ns: int) -> Float:
        return self._ohm[self._patch]


async def eventually(pilot: Pilot[Any], condition: Callable[[], object], within_s: float = 8.0) -> bool:
    """Whether ``condition`` comes true; how long it takes is not what is tested."""
    end_s = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > end_s:
            return False
        await asyncio.sleep(0.02)  # pilot.pause would wait for a host that computes to be idle
    return True


async def press(pilot: Pilot[Any], *keys: str) -> None:
    """Keys, without the pilot's waiting for idleness after each."""
    for key in keys:
        before = len(pilot.app.screen_stack)
        pilot.app.simulate_key(key)
        if key in ("t", "question_mark") or before > 1:  # a dialog comes or goes
            assert await eventually(pilot, lambda before=before: len(pilot.app.screen_stack) != before)
        await asyncio.sleep(0.02)


def screen_of(pilot: Pilot[Any]) -> str:
    """What is to be read beneath any dialog."""
    app = pilot.app
    assert isinstance(app, MonitorApp)
    return app.canvas.text


def in_app(
    source: Source,
    play: Callable[[Pilot[Any]], Awaitable[None]],
    *,
    folder: Path = Path("/nowhere"),
    size: tuple[int, int] = (80, 24),
    **options: Any,
) -> MonitorApp:
    """Open the screen without a terminal, do what ``play`` does, and quit; the app that it was."""
    app = MonitorApp(source, folder=folder, **{"colours": "none", **options})

    async def run() -> None:
        async with app.run_test(size=size) as pilot:
            assert await eventually(pilot, lambda: screen_of(pilot))
            await play(pilot)
            await press(pilot, "q")

    asyncio.run(run())
    return app


PROGRAM = [sys.executable, "-W", "error", "-c", "from skinnode.cli.main import main; main()", "monitor"]
PATIENCE_S = 40.0
LAYOUT = "{ " + ", ".join(f"{key} = {value}" for key, value in SMALL.items()) + " }"


def write_hand(folder: Path, hand: HandConfig) -> Path:
    (bus,) = hand.buses
    text = f'[[buses]]\nname = "can0"\ninterface = "{bus.interface}"\nchannel = "{bus.channel}"\n'
    text += f"[sync]\nperiod_ms = {hand.sync.period_ms}\n"
    for patch in hand.patches:
        text += f'[[patches]]\nname = "{patch.name}"\nnode_id = {patch.node_id}\nlayout = {LAYOUT}\n'
        text += 'tolerances = "exact"\n'
    path = folder / "hand.toml"
    path.write_text(text)
    return path


@pytest.fixture
def crossing_hand(multicast_group: str) -> HandConfig:
    """On a bus that crosses processes; so slow that no node skips a scan on a machine that is busy."""
    return a_hand(2, {"interface": "udp_multicast", "channel": multicast_group}, sync={"period_ms": 400})
