"""Plot the example of trust in docs/concepts.md: presses with a faulty crossing and with lost readings.

    python docs/trust_picture.py          writes docs/img/trust.png

The displacements are closed-form solutions for a sphere on rubber. The readings contain noise. The solver
decides whether a field is trusted.
"""

from __future__ import annotations

import itertools
import textwrap
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import skinnode as sk
from skinnode.bench.truth import Press, Skin
from skinnode.host.trust_report import deepest_data_share

PICTURE: Final = Path(__file__).parent / "img" / "trust.png"
NOISE: Final = 1e-5
FRAMES: Final = 150
STUCK: Final = (range(20, 62), (5, 15))
"""Frames in which a crossing repeats the value of the first of these frames, and the crossing."""
FEW_LOST: Final = (range(80, 95), 0.12)
"""Frames in which readings are lost, and the fraction of lost readings."""
HALF_LOST: Final = (range(115, 130), 0.5)
COLOURS: Final = {"trusted": "#cfe8d5", "not precise": "#fbe3b0", "not trusted": "#f4c2bd"}
INK, DATA, FAULT = "#20262e", "#1f6f8b", "#b3372b"


def stream(skin: Skin) -> tuple[list[float], list[sk.FieldFrame]]:
    """Solve a stream; return the true depths, m, and the fields."""
    rng = np.random.default_rng(7)
    tracker = sk.Tracker(skin.layout, relative_noise=NOISE, baseline_ohm=skin.rest_ohm, method="posterior")
    press = Press((0.019, 0.020), 0.03, 3.5e-4, (0.3, 0.1))
    depths_m, fields, stuck_ohm = [], [], 0.0
    for frame in range(FRAMES):
        share = 0.5 - 0.5 * np.cos(2 * np.pi * frame / 50)
        moved_m = skin.displacement_m((press,), share)
        ohm = skin.resistance_ohm(moved_m)
        ohm *= 1 + NOISE * rng.standard_normal(ohm.shape)
        when, crossing = STUCK
        if frame == when.start:
            stuck_ohm = ohm[crossing]
        if frame in when:
            ohm[crossing] = stuck_ohm
        valid = np.ones(ohm.shape, bool)
        for when, lost in (FEW_LOST, HALF_LOST):
            if frame in when:
                valid &= rng.random(ohm.shape) >= lost
        depths_m.append(float(-moved_m[..., 2].min()))
        fields.append(tracker.update(ohm, valid))
    return depths_m, fields


def deepest_um(field: sk.FieldFrame) -> tuple[float, float]:
    """Return the depth of the deepest electrode and its standard deviation, µm."""
    z, std = field.displacement_m[..., 2], field.displacement_std_m[..., 2]
    return -1e6 * float(z.min()), 1e6 * float(std.flat[z.argmin()])


def verdict(field: sk.FieldFrame) -> str:
    if not field.trusted:
        return "not trusted"
    return "trusted" if field.precise else "not precise"


def spans(values: list[Any]) -> list[tuple[int, int, Any]]:
    """Return the runs of equal values as (first, last, value)."""
    edges = [0, *(i for i in range(1, len(values)) if values[i] != values[i - 1]), len(values)]
    return [(a, b - 1, values[a]) for a, b in itertools.pairwise(edges)]


def draw(figure: Figure, depths_m: list[float], fields: list[sk.FieldFrame]) -> None:
    depth_axes, share_axes = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    frames = np.arange(len(fields))
    found_um, std_um = np.array([deepest_um(field) for field in fields]).T
    for first, last, word in spans([verdict(field) for field in fields]):
        for axes in (depth_axes, share_axes):
            axes.axvspan(first - 0.5, last + 0.5, color=COLOURS[word], lw=0)
    known = np.isfinite(std_um)
    depth_axes.plot(frames, 1e6 * np.array(depths_m), color=INK, lw=1.0, ls="--", label="true depth")
    depth_axes.plot(frames, found_um, ".", ms=4, color=DATA, label="deepest electrode")
    low, high = found_um - 2 * std_um, found_um + 2 * std_um
    depth_axes.fill_between(
        frames, low, high, where=known, color=DATA, alpha=0.25, lw=0, label="± 2 standard deviations"
    )
    top = 1e6 * max(depths_m)
    for first, last, trusted in spans([field.trusted for field in fields]):
        if not trusted and last - first >= 2:
            words = textwrap.fill(fields[(first + last) // 2].distrust or "", max(12, last - first))
            depth_axes.text(0.5 * (first + last), 1.3 * top, words, ha="center", va="top", fontsize=8)
    for first, last, places in spans([", ".join(fault.place for fault in field.faults) for field in fields]):
        if places:
            depth_axes.plot([first, last], [-0.08 * top] * 2, color=FAULT, lw=4, solid_capstyle="butt")
            if last - first > 4:
                depth_axes.text(first, -0.2 * top, f"left out: {places}", fontsize=8, color=FAULT)
    depth_axes.set_ylabel("depth (µm)")
    depth_axes.set_ylim(-0.28 * top, 1.38 * top)
    for word, colour in COLOURS.items():
        depth_axes.fill_between([], [], color=colour, label=word)
    depth_axes.legend(loc="upper left", bbox_to_anchor=(-0.02, 1.16), ncols=6, fontsize=8, frameon=False)
    share_axes.plot(frames, [100 * deepest_data_share(field) for field in fields], color=DATA, lw=1.2)
    share_axes.set_ylabel("data share (%)")
    share_axes.set_ylim(0, 105)
    share_axes.set_xlabel("frame")
    share_axes.set_xlim(-0.5, len(fields) - 0.5)


def main() -> None:
    skin = Skin(sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3))
    figure = Figure(figsize=(9.5, 4.6), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure, *stream(skin))
    figure.savefig(PICTURE, dpi=110)
    print(f"{PICTURE}: {PICTURE.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
