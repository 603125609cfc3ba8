"""Pictures of scans: on the bus, in the mirror of a foreign master, and under a scene."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from style import FAULT, FOLDER, HOST, INK, PAPER, SKIN, save, shrink

import skinnode as sk
from skinnode.bus_load.plan import inhibit_time_100us
from skinnode.config import load_hand
from skinnode.protocol.codec import check_of_codes, pack_checked_summary, pack_scan
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile
from vcan_sim.timed_bus import BitRates, CanFrame, Delivered, StationOptions, TimedBus

ROOT = FOLDER.parents[1]


def timing() -> None:
    """One SYNC period of the hand in examples/hand.toml, with boards that keep the planned times exactly."""
    hand = load_hand(ROOT / "examples" / "hand.toml")
    profile = PatchProfile(10, 30, 10, 10)
    step_ns = 100_000 * inhibit_time_100us(hand.sync.period_ms, profile.n_chunks + 1)
    codes = np.random.default_rng(1).integers(40_000, 49_000, (10, 30))
    chunks = pack_scan(codes, 1, profile)
    summary = pack_checked_summary(1, 0, len(chunks), 0, check_of_codes(codes, profile))
    queued = [
        (0, 0, CanFrame(0x080, b"\x01")),
        (hand.sync.period_ms * 1_000_000, 0, CanFrame(0x080, b"\x02")),
    ]
    for station, patch in enumerate(hand.patches, start=1):
        for number, data in enumerate([*chunks, summary]):
            base = 0x180 if number < len(chunks) else 0x280
            queued.append((300_000 + number * step_ns, station, CanFrame(base + patch.node_id, data)))
    bus = TimedBus([StationOptions()] * (len(hand.patches) + 1), BitRates(1_000_000))
    for time_ns, station, frame in sorted(queued, key=lambda each: each[:2]):
        bus.send(time_ns, station, frame)
    sent = [event for event in bus.advance(10**9) if isinstance(event, Delivered)]
    figure = Figure(figsize=(9.5, 4.3))
    whole, part = figure.add_axes((0.11, 0.56, 0.87, 0.38)), figure.add_axes((0.11, 0.12, 0.87, 0.32))
    rows = [("SYNC", (0x080,), HOST)] + [
        (f"{patch.name}, node {patch.node_id}", (0x180 + patch.node_id, 0x280 + patch.node_id), SKIN)
        for patch in hand.patches
    ]
    last = 1e-6 * max(event.time_ns for event in sent if event.frame.can_id >= 0x280)
    for axes, first_ms, last_ms in ((whole, -0.6, 81.5), (part, -0.05, 3.0)):
        for row, (name, ids, colour) in enumerate(rows):
            for event in sent:
                if event.frame.can_id in ids:
                    start, end = 1e-6 * event.started_ns, 1e-6 * event.time_ns
                    is_summary, is_chunk = event.frame.can_id >= 0x280, 0x180 < event.frame.can_id < 0x280
                    width = max(end - start, 0.3 if axes is whole and not is_chunk else 0.0)
                    axes.barh(row, width, 0.7, start, color=FAULT if is_summary else colour, lw=0)
            axes.text(-0.008, row, name, ha="right", va="center", fontsize=8.5, transform=_by_row(axes))
        axes.set_xlim(first_ms, last_ms)
        axes.set_ylim(len(rows) - 0.4, -0.7)
        axes.set_yticks([])
        axes.tick_params(labelsize=8)
        for side in ("left", "right", "top"):
            axes.spines[side].set_visible(False)
    whole.set_title(
        f"one scan of four patches: SYNC, 100 chunks each, summaries (red) after {last:.0f} ms",
        fontsize=9,
        loc="left",
    )
    part.set_title(
        "the first 3 ms: the frame with the lowest identifier is sent first", fontsize=9, loc="left"
    )
    part.set_xlabel("ms after SYNC", fontsize=8.5)
    save(figure, "timing")


def _by_row(axes: Any) -> Any:
    """Coordinates with x as a fraction of the axes and y in rows."""
    return axes.get_yaxis_transform()


def mirror() -> None:
    """A scan in the mirror of a master, and in the assembler, with one chunk lost."""
    layout = sk.PatchLayout.preset("staggered")
    points = layout.upper_m[..., :2] - np.array([14e-3, 20e-3])
    pressed = layout.upper_m.copy()
    pressed[..., 2] -= 4e-4 * np.exp(-(points**2).sum(axis=-1) / (2 * (7e-3) ** 2))
    ratio = sk.resistance_ohm(layout, pressed) / sk.resistance_ohm(layout, layout.upper_m)
    scale = CodeScale(16)
    codes = np.round((ratio - scale.lo) / (scale.hi - scale.lo) * (2**16 - 4)).astype(int)
    known = codes.astype(float)
    known[6, 12:15] = np.nan  # chunk 64: lost
    last = np.full(codes.shape, np.nan)
    last.flat[-3:] = codes.flat[-3:]
    figure = Figure(figsize=(9.5, 3.1))
    for number, (values, title) in enumerate(
        (
            (last, "mirror of a PLC or proxy: the last chunk"),
            (known, "assembler: the scan; one chunk was lost"),
        )
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
        command = [
            sys.executable,
            "-c",
            "from vcan_sim.cli import main; main()",
            str(ROOT / "examples" / "hand.toml"),
        ]
        subprocess.run(
            [*command, "--scene", f"{folder}/scene.toml", "--plot", str(FOLDER / "scene.png")], check=True
        )
    shrink(FOLDER / "scene.png")


PICTURES: dict[str, Any] = {"timing": timing, "mirror": mirror, "scene": scene}
