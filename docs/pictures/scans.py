"""Pictures of scans: on the bus, in the mirror of a foreign master, and under a scene."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from style import FAULT, FOLDER, GREY, HOST, INK, PAPER, SKIN, save, shrink

import skinnode as sk
from skinnode.config import load_hand
from skinnode.host.sync import SyncProducer, Ticks
from skinnode.protocol.codec import check_of_codes, pack_checked_summary, pack_scan
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile
from skinnode.transport import CanPort
from vcan_sim.fleet import Fleet
from vcan_sim.timed_bus import BitRates
from vcan_sim.timed_interface import segment
from vcan_sim.trace import Trace
from vcan_sim.virtual_time import VirtualClock

ROOT = FOLDER.parents[1]


def timing() -> None:
    """One SYNC period of the hand in examples/hand.toml, on a simulated bus with exact frame times."""
    hand = load_hand(ROOT / "examples" / "hand.toml")
    buses = tuple(bus.model_copy(update={"interface": "timed", "channel": "can0"}) for bus in hand.buses)
    hand = hand.model_copy(update={"buses": buses})
    with VirtualClock() as clock:
        trace = Trace(segment("can0", clock, BitRates(1_000_000)))
        with Fleet(hand), CanPort(hand.buses[0]) as port:
            for patch in hand.patches:
                port.send(0x600 + patch.node_id, bytes.fromhex("2f 19 10 00 f0 00 00 00"))
                port.send(0x600 + patch.node_id, bytes.fromhex("2b 00 18 03 06 00 00 00"))
            clock.sleep(0.2)
            port.send(0x000, b"\x01\x00")
            with SyncProducer([(port.send, Ticks(240))], hand.sync.period_s):
                clock.sleep(1.0)
        lines = re.findall(r"\((\d+\.\d+)\) \S+ ([0-9A-F]+)#", trace.text())
    times, ids = np.array([float(t) for t, _ in lines]), np.array([int(i, 16) for _, i in lines])
    start = times[ids == 0x080][4]
    shown = (times > start - 1e-3) & (times < start + 81.5e-3)
    times, ids = 1e3 * (times[shown] - start), ids[shown]
    figure = Figure(figsize=(9.5, 3.6))
    axes = figure.add_axes((0.105, 0.13, 0.875, 0.78))
    rows = [("SYNC", [0x080], HOST)]
    for patch in hand.patches:
        rows.append((f"{patch.name}, node {patch.node_id}", [0x180 + patch.node_id, 0x280 + patch.node_id], SKIN))
    for row, (name, (first, *summary), colour) in enumerate(rows):
        axes.vlines(times[ids == first], row - 0.33, row + 0.33, color=colour, lw=0.9)
        for cob_id in summary:
            axes.vlines(times[ids == cob_id], row - 0.42, row + 0.42, color=FAULT, lw=2.2)
        axes.text(-1.6, row, name, ha="right", va="center", fontsize=8.5, color=INK)
    last = max(times[ids == 0x280 + patch.node_id].max() for patch in hand.patches)
    axes.annotate(
        "SYNC starts the scan", (0, -0.2), (6, -0.45), fontsize=8.5, color=INK, va="center",
        arrowprops={"arrowstyle": "-|>", "color": GREY},
    )  # fmt: skip
    axes.annotate(
        "summary (red) ends the scan", (last, 4.45), (last - 24, 4.75), fontsize=8.5, color=INK, va="center",
        arrowprops={"arrowstyle": "-|>", "color": GREY},
    )  # fmt: skip
    gap = np.median(np.diff(times[ids == 0x180 + hand.patches[0].node_id][:100]))
    axes.text(22, -0.45, f"100 chunks per patch, one every {gap:.2f} ms (inhibit time 0.6 ms)", fontsize=8.5, va="center")
    axes.set_ylim(5.0, -0.9)
    axes.set_xlim(-1.2, 81.5)
    axes.set_yticks([])
    axes.set_xlabel("ms after SYNC", fontsize=8.5)
    axes.tick_params(labelsize=8)
    for side in ("left", "right", "top"):
        axes.spines[side].set_visible(False)
    save(figure, "timing")


def mirror() -> None:
    """A scan in the mirror of a master, and in the assembler, with one chunk lost."""
    layout = sk.PatchLayout.preset("staggered")
    points = layout.upper_m[..., :2] - np.array([14e-3, 20e-3])
    pressed = layout.upper_m.copy()
    pressed[..., 2] -= 4e-4 * np.exp(-(points**2).sum(axis=-1) / (2 * (7e-3) ** 2))
    ratio = sk.resistance_ohm(layout, pressed) / sk.resistance_ohm(layout, layout.upper_m)
    scale, profile = CodeScale(16), PatchProfile(10, 30, 10, 10)
    codes = np.round((ratio - scale.lo) / (scale.hi - scale.lo) * (2**16 - 4)).astype(int)
    chunks = pack_scan(codes, 1, profile)
    pack_checked_summary(1, 0, len(chunks), 0, check_of_codes(codes, profile))
    known = codes.astype(float)
    known[6, 12:15] = np.nan  # chunk 64: lost
    last = np.full(codes.shape, np.nan)
    last.flat[-3:] = codes.flat[-3:]
    figure = Figure(figsize=(9.5, 3.1))
    for number, (values, title) in enumerate(
        ((last, "mirror of a PLC or proxy: the last chunk"), (known, "assembler: the scan; one chunk was lost"))
    ):
        axes = figure.add_axes((0.045 + 0.445 * number, 0.13, 0.415, 0.72))
        axes.set_facecolor("#dfe3e7")
        image = axes.imshow(values, cmap="viridis", vmin=codes.min(), vmax=codes.max(), aspect="auto")
        axes.set_title(title, fontsize=9.5, color=INK)
        axes.set_xlabel("lower wire", fontsize=8.5)
        axes.set_ylabel("upper wire" if number == 0 else "", fontsize=8.5)
        axes.tick_params(labelsize=7.5)
        for k in range(1, 10):
            axes.axvline(3 * k - 0.5, color=PAPER, lw=0.5)
            axes.axhline(k - 0.5, color=PAPER, lw=0.5)
    bar = figure.colorbar(image, cax=figure.add_axes((0.935, 0.13, 0.013, 0.72)))
    bar.ax.tick_params(labelsize=7)
    bar.ax.set_title("code", fontsize=8)
    save(figure, "mirror")


def scene() -> None:
    """The scene of docs/scenes.md, as ``vcan-sim --plot`` draws it."""
    import subprocess
    import sys
    import tempfile
    from pathlib import Path

    page = (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8")
    (text,) = re.findall(r'```toml title="scene\.toml"\n(.*?)```', page, flags=re.DOTALL)
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "scene.toml").write_text(text, encoding="utf-8")
        command = [sys.executable, "-c", "from vcan_sim.cli import main; main()", str(ROOT / "examples" / "hand.toml")]
        subprocess.run(
            [*command, "--scene", f"{folder}/scene.toml", "--plot", str(FOLDER / "scene.png")], check=True
        )
    shrink(FOLDER / "scene.png")


PICTURES: dict[str, Any] = {"timing": timing, "mirror": mirror, "scene": scene}
