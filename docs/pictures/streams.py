"""Pictures of streams: what the touch detector and a controller see over time."""

from __future__ import annotations

import re
import tempfile
import tomllib
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from style import FAULT, FOLDER, HOST, INK, SKIN, save

import skinnode as sk
from skinnode.bench.truth import Press, Skin
from skinnode.config import parse_hand
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet
from vcan_sim.scenes import load_scene
from vcan_sim.virtual_time import VirtualClock

NOISE: Final = 1e-4
RATE_HZ: Final = 12.5
DEPTHS_M: Final = (3e-5, 7e-5, 2e-4)
"""Depths by which the sphere moves into the skin in each press; the electrodes move less."""
PRESS_S, PAUSE_S = 2.0, 2.0


def touch() -> None:
    """Three presses of different depths in noise, and a drift of all gains."""
    skin = Skin(sk.PatchLayout.preset("staggered"))
    tracker = sk.Tracker(
        skin.layout, relative_noise=NOISE, baseline_ohm=skin.rest_ohm, scan_period_s=1 / RATE_HZ
    )
    rng = np.random.default_rng(11)
    times, depths, odds, touched = [], [], [], []
    for frame in range(int(RATE_HZ * (len(DEPTHS_M) * (PRESS_S + PAUSE_S) + PAUSE_S))):
        t = frame / RATE_HZ
        number, phase = divmod(t - PAUSE_S, PRESS_S + PAUSE_S)
        pressed = 0 <= number < len(DEPTHS_M) and phase < PRESS_S
        depth = DEPTHS_M[int(number)] * np.sin(np.pi * phase / PRESS_S) ** 2 if pressed else 0.0
        press = Press((0.018, 0.020), 0.03, max(DEPTHS_M), (0.0, 0.0))
        moved = skin.displacement_m((press,), depth / max(DEPTHS_M))
        ohm = skin.resistance_ohm(moved) * (
            1 + 2e-4 * t / 10 + NOISE * rng.standard_normal(skin.rest_ohm.shape)
        )
        field = tracker.update(ohm)
        times.append(t)
        depths.append(1e6 * float(-moved[..., 2].min()))
        odds.append(field.touch_odds)
        touched.append(bool(field.touched))
    figure = Figure(figsize=(9.5, 3.4))
    upper, lower = figure.add_axes((0.08, 0.56, 0.9, 0.36)), figure.add_axes((0.08, 0.14, 0.9, 0.36))
    for axes in (upper, lower):
        for t, on in zip(times, touched, strict=True):
            if on:
                axes.axvspan(t, t + 1 / RATE_HZ, color="#cfe8d5", lw=0)
        axes.set_xlim(0, times[-1])
        axes.tick_params(labelsize=8)
        for side in ("right", "top"):
            axes.spines[side].set_visible(False)
    upper.plot(times, depths, color=INK, lw=1.4)
    upper.set_ylabel("true depth (µm)", fontsize=8.5)
    upper.set_title("green: touched", fontsize=9, loc="right", color=SKIN)
    lower.semilogy(times, np.clip(odds, 1e-7, 1e12), ".-", color=HOST, lw=0.8, ms=3)
    lower.axhline(1.0, color=INK, lw=0.6, ls=":")
    lower.set_ylabel("touch_odds", fontsize=8.5)
    lower.set_xlabel("s", fontsize=8.5)
    save(figure, "touch")


def gripper() -> None:
    """The controller of docs/testing.md on its scene; the finger is unplugged for a second."""
    page = (FOLDER.parent / "testing.md").read_text(encoding="utf-8")

    def block(name: str) -> str:
        return re.findall(rf'```\w+ title="{re.escape(name)}"\n(.*?)```', page, flags=re.DOTALL)[0]

    table = tomllib.loads(block("gripper.toml"))
    table["buses"][0] |= {"interface": "timed", "channel": "can0"}
    program: dict[str, Any] = {}
    exec(block("gripper.py"), program)
    rows = []
    with tempfile.TemporaryDirectory() as folder, VirtualClock() as clock:
        path = Path(folder, "press.toml")
        path.write_text(block("press.toml"), encoding="utf-8")
        hand = parse_hand(table)
        with Fleet(hand, scene=load_scene(path, hand)) as fleet, sk.Host.from_config(hand) as host:
            controller = program["Gripper"](host, "finger", now_ns=clock.monotonic_ns)
            begun = 1e-9 * clock.monotonic_ns()
            while (t := 1e-9 * clock.monotonic_ns() - begun) < 7.0:
                fleet.inject(Faults(unplugged=3.0 < t < 4.0), "finger")
                field = host.latest("finger")
                depth, std = np.nan, np.nan
                if field is not None:
                    at = np.unravel_index(
                        field.displacement_m[..., 2].argmin(), field.displacement_m.shape[:2]
                    )
                    depth = -1e6 * field.displacement_m[(*at, 2)]
                    std = 1e6 * field.displacement_std_m[(*at, 2)]
                rows.append((t, depth, std, controller.step()))
                clock.sleep(0.02)
    times, depths, stds = (np.array([row[i] for row in rows], dtype=float) for i in range(3))
    figure = Figure(figsize=(9.5, 3.2))
    axes = figure.add_axes((0.08, 0.15, 0.9, 0.72))
    colours = {"close": "#dbe5f5", "hold": "#cfe8d5", "stop": "#f4c2bd"}
    for t, *_, action in rows:
        axes.axvspan(t, t + 0.021, color=colours[action], lw=0)
    axes.plot(times, depths, color=HOST, lw=1.4)
    axes.fill_between(times, depths - 2 * stds, depths + 2 * stds, color=HOST, alpha=0.25, lw=0)
    axes.axhline(100, color=INK, lw=0.8, ls=":")
    axes.text(0.05, 104, "touch_m = 100 µm", fontsize=8, va="bottom")
    axes.axvline(3.0, color=FAULT, lw=1.0)
    axes.axvline(4.0, color=FAULT, lw=1.0)
    axes.text(3.5, axes.get_ylim()[1] * 0.97, "unplugged", color=FAULT, fontsize=8.5, ha="center", va="top")
    for action, colour in colours.items():
        axes.fill_between([], [], color=colour, label=action)
    axes.legend(loc="upper left", bbox_to_anchor=(0, 1.2), ncols=3, fontsize=8.5, frameon=False)
    axes.set_ylabel("deepest electrode (µm)", fontsize=8.5)
    axes.set_xlabel("s", fontsize=8.5)
    axes.set_xlim(0, 7)
    axes.tick_params(labelsize=8)
    save(figure, "gripper")


PICTURES: dict[str, Any] = {"touch": touch, "gripper": gripper}
