"""Draw the picture in the README: one solved scan of the simulated hand in examples/hand.toml.

    python docs/hand_picture.py          writes docs/img/hand.png

The numbers are results of a running host. The outline of the hand and the positions of the patches are
invented.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch
from matplotlib.transforms import Affine2D

import skinnode as sk
from skinnode.config import HandConfig, load_hand
from vcan_sim.fleet import Fleet

ROOT: Final = Path(__file__).parents[1]
PICTURE: Final = ROOT / "docs" / "img" / "hand.png"

PLACES: Final = {
    "palm": (0.0, -6.0, 0.0),
    "index": (-33.0, 118.0, 5.0),
    "middle": (33.0, 122.0, -5.0),
    "thumb": (-104.0, 30.0, 48.0),
}
"""Position (x, y) of each patch's centre in the picture, mm, and rotation of the patch, degrees."""

FINGERS: Final = {"index": 125.0, "middle": 130.0, "thumb": 105.0}
"""Length of each finger, mm."""

LONGEST_S: Final = 12.0
COLOURS: Final = "magma"
SHADING: Final = 0.6
"""Exponent of the colour scale; a value below 1 makes the flanks of a press visible."""
SKIN, EDGE, INK = "#d9dde3", "#8b94a1", "#20262e"


def deepest_scan(config: Path) -> tuple[HandConfig, dict[str, sk.FieldFrame]]:
    """Run the hand; return it with the fields of the scan in which all patches are pressed most deeply."""
    hand = load_hand(config)
    buses = tuple(bus.model_copy(update={"interface": "virtual"}) for bus in hand.buses)
    hand = hand.model_copy(update={"buses": buses})
    best: dict[str, sk.FieldFrame] = {}
    deepest_m = 0.0
    with Fleet(hand), sk.Host.from_config(hand) as host:
        for frame in host.hands(timeout_s=5.0):
            fields = dict(frame.fields)
            if len(fields) == len(hand.patches):
                depth_m = min(float(-field.displacement_m[..., 2].min()) for field in fields.values())
                trusted = all(field.trusted and field.contacts for field in fields.values())
                if trusted and depth_m > deepest_m:
                    best, deepest_m = fields, depth_m
            if frame.scan * hand.sync.period_ms * 1e-3 > LONGEST_S:
                break
    return hand, best


def draw_hand(axes: Any) -> None:
    def body(x: float, y: float, width: float, height: float, radius: float, place: Affine2D) -> None:
        shape = FancyBboxPatch(
            (x, y),
            width,
            height,
            boxstyle=f"round,pad=0,rounding_size={radius}",
            facecolor=SKIN,
            edgecolor=EDGE,
            linewidth=1.2,
        )
        shape.set_transform(place + axes.transData)
        axes.add_patch(shape)

    for name, length in FINGERS.items():
        x, y, turn = PLACES[name]
        place = Affine2D().rotate_deg(turn).translate(x, y)
        body(-28, 31 - length, 56, length, 18, place)
        joint_y = -27.0
        axes.plot(*place.transform([(-28, joint_y), (28, joint_y)]).T, color=EDGE, lw=1.2)
    body(-66, -72, 132, 124, 20, Affine2D())


def draw_patch(axes: Any, name: str, layout: sk.PatchLayout, field: sk.FieldFrame, full_um: float) -> None:
    x, y, turn = PLACES[name]
    rest_mm = 1e3 * layout.upper_m[..., :2]
    centre = 0.5 * (rest_mm.min(axis=(0, 1)) + rest_mm.max(axis=(0, 1)))
    place = Affine2D().translate(*-centre).rotate_deg(turn).translate(x, y)
    low, high = rest_mm.min(axis=(0, 1)) - 2.0, rest_mm.max(axis=(0, 1)) + 2.0
    depth_um = -1e6 * field.displacement_m[..., 2]
    image = axes.imshow(
        depth_um,
        origin="lower",
        extent=(low[0], high[0], low[1], high[1]),
        cmap=COLOURS,
        norm=PowerNorm(SHADING, 0.0, full_um),
        interpolation="bicubic",
        zorder=3,
    )
    image.set_transform(place + axes.transData)
    points = place.transform(rest_mm.reshape(-1, 2))
    axes.plot(*points.T, ".", color="white", alpha=0.35, ms=1.3, zorder=4)
    shear = Affine2D().rotate_deg(turn).transform(1e6 * field.displacement_m[..., :2].reshape(-1, 2))
    seen = np.hypot(*shear.T) > 4e6 * np.hypot(*field.displacement_std_m[..., :2].reshape(-1, 2).T)
    axes.quiver(
        *points[seen].T,
        *shear[seen].T,
        color="#59d8e6",
        angles="xy",
        scale_units="xy",
        scale=full_um / 14.0,
        width=0.0022,
        zorder=5,
    )
    contact = field.contacts[0]
    middle = place.transform(1e3 * np.asarray(contact.centroid_m)[None, :2])[0]
    radius_mm = 1e3 * float(np.sqrt(contact.area_m2 / np.pi))
    axes.add_patch(Circle(middle, radius_mm, fill=False, ec="white", lw=1.4, zorder=6))
    force = f"{contact.normal_force_n:.2f} ± {contact.normal_force_std_n:.2f} N"
    deepest = np.unravel_index(depth_um.argmax(), depth_um.shape)
    std_um = 1e6 * field.displacement_std_m[(*deepest, 2)]
    label = f"{name}\n{force}\n{depth_um.max():.0f} ± {std_um:.1f} µm deep"
    side = 1.0 if x > 0 or name == "palm" else -1.0
    where = (x + side * 36, y) if name != "palm" else (x + 72, y)
    if name == "thumb":
        where = (x - 14, y - 42)
    axes.text(
        *where,
        label,
        ha="left" if side > 0 else "right",
        va="center" if name != "thumb" else "top",
        fontsize=10.5,
        color=INK,
        linespacing=1.35,
    )


def main() -> None:
    hand, fields = deepest_scan(ROOT / "examples" / "hand.toml")
    layouts = {patch.name: patch.layout.build() for patch in hand.patches}
    figure = Figure(figsize=(8.6, 5.6), facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 0.9, 1.0))
    axes.set_aspect("equal")
    axes.axis("off")
    draw_hand(axes)
    full_um = 1e6 * max(float(-field.displacement_m[..., 2].min()) for field in fields.values())
    for name in PLACES:
        draw_patch(axes, name, layouts[name], fields[name], full_um)
    axes.set_xlim(-196, 152)
    axes.set_ylim(-80, 156)
    bar = figure.add_axes((0.9, 0.2, 0.018, 0.6))
    figure.colorbar(
        ScalarMappable(PowerNorm(SHADING, 0.0, full_um), COLOURS), cax=bar, label="depth (µm); arrows: shear"
    )
    figure.savefig(PICTURE, dpi=110)
    print(f"{PICTURE}: {PICTURE.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
