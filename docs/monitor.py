"""Create the screenshots of `skinnode monitor` for the documentation: four patches, one of them unplugged.

    python docs/monitor.py          writes docs/img/monitor.svg and docs/img/monitor-remote.svg

The screenshots show the real program, which runs without a terminal, on a host and on a remote hand.
"""

from __future__ import annotations

import asyncio
import re
import time
from contextlib import ExitStack
from pathlib import Path

import skinnode as sk
from skinnode.config import HandConfig
from skinnode.demo.hand import demo_hand
from skinnode.monitor.app import MonitorApp
from skinnode.monitor.live_source import HostSource, RemoteSource
from skinnode.monitor.source import Source
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet

PICTURES = Path(__file__).with_name("img")
SIZE = (100, 26)
PRESSED_M = 4e-4
LONGEST_S = 30.0


async def screenshot(source: Source, fleet: Fleet) -> str:
    """Return the screen as SVG, taken when one patch is lost and the other patches are pressed."""
    app = MonitorApp(source, folder=Path(), colours="rgb")
    async with app.run_test(size=SIZE):
        await asyncio.sleep(4.0)
        fleet.inject(Faults(unplugged=True), "index")
        end_s = time.monotonic() + LONGEST_S
        while time.monotonic() < end_s:
            await asyncio.sleep(0.1)
            touches = [
                touch for name in ("palm", "thumb", "middle") for touch in app.view.patch(name).touches
            ]
            forces = [touch.shear_n for touch in touches if touch.depth_m > PRESSED_M]
            sheared = sum(force is not None and abs(force[0]) + abs(force[1]) > 0.5 for force in forces)
            if app.view.patch("index").condition == "lost" and sheared == 3:
                break
        await asyncio.sleep(0.3)
        return app.export_screenshot(title="skinnode monitor")


def without_addresses(svg: str) -> str:
    """Replace downloadable fonts in an SVG with fonts installed on the reader's machine."""
    svg = re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r"font-family: (Fira Code|arial)", "font-family: DejaVu Sans Mono, Menlo, Consolas", svg)
    return re.sub(r"<!--.*?-->", "", svg)


def picture_of(hand: HandConfig, *, remote: bool) -> str:
    """Return the screen for a simulated hand as SVG."""
    with ExitStack() as stack:
        fleet = stack.enter_context(Fleet(hand))
        host = stack.enter_context(sk.Host.from_config(hand))
        if not remote:
            return asyncio.run(screenshot(stack.enter_context(HostSource(host)), fleet))
        stack.enter_context(sk.publish(host, commands=True))
        published = stack.enter_context(sk.connect(hand.name, timeout_s=LONGEST_S))
        return asyncio.run(screenshot(stack.enter_context(RemoteSource(published)), fleet))


def main() -> None:
    hand = demo_hand(4, seed=1)
    solver = hand.solver.model_copy(update={"method": "posterior"})
    hand = hand.model_copy(update={"name": "hand", "solver": solver})
    for name, remote in (("monitor.svg", False), ("monitor-remote.svg", True)):
        svg = without_addresses(picture_of(hand, remote=remote))
        (PICTURES / name).write_text(svg, encoding="utf-8")


if __name__ == "__main__":
    main()
