"""A patch with its wires and axes, poses of patches on a hand, and the wiring of boards and buses."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from style import BUS, GREY, HOST, INK, LOWER, PAPER, SKIN, UPPER, arrow, box, note, save, sheet

import skinnode as sk
from skinnode.config import parse_hand
from skinnode.host.skeleton import Skeleton
from skinnode.model.pose import Pose

ENLARGED = 2.2
"""Factor by which the layer is drawn too thick, so that its wires can be seen."""


def patch() -> None:
    """A small patch of the preset ``staggered``, pressed by a ball."""
    layout = sk.PatchLayout.preset(
        "staggered", pitch_m=4e-3, height_m=2e-3, upper_wires=5, upper_electrodes=5
    )
    upper, lower = 1e3 * layout.upper_m, 1e3 * layout.lower_m
    height = ENLARGED * upper[0, 0, 2]
    figure = Figure(figsize=(9.0, 5.0))
    axes: Any = figure.add_axes((-0.08, -0.16, 1.16, 1.34), projection="3d", computed_zorder=False)
    axes.set_box_aspect((26, 26, 9.5))
    for k in range(lower.shape[0]):
        x, y = lower[k, :, 0], lower[k, :, 1]
        axes.plot(x, y, 0 * x, "-o", color=LOWER, lw=1.0, ms=2.4, alpha=0.85, zorder=1)
    fine_x, fine_y = np.meshgrid(np.linspace(-2, 18, 41), np.linspace(-2, 18, 41))

    def depth(x: Any, y: Any) -> Any:
        return height - 2.2 * np.exp(-((x - 9) ** 2 + (y - 8) ** 2) / 14)

    surface = axes.plot_surface(fine_x, fine_y, depth(fine_x, fine_y), color="#cfd8dc", alpha=0.45, zorder=2)
    surface.set_edgecolor("none")
    for u in range(upper.shape[0]):
        along = np.linspace(-1, 17, 60)
        axes.plot(
            along, 0 * along + upper[u, 0, 1], depth(along, upper[u, 0, 1]), color=UPPER, lw=1.6, zorder=3
        )
        x, y = upper[u, :, 0], upper[u, :, 1]
        axes.plot(x, y, depth(x, y), "o", color=UPPER, ms=4.5, zorder=4)
    u, k = 1, 9
    axes.plot(lower[k, :, 0], lower[k, :, 1], 0, "-o", color=INK, lw=2.4, ms=4, zorder=5)
    axes.plot(
        np.linspace(-1, 17, 60),
        0 * along + upper[u, 0, 1],
        depth(along, upper[u, 0, 1]),
        color=INK,
        lw=2.4,
        zorder=5,
    )
    for direction, name in (((6, 0, 0), "x"), ((0, 6, 0), "y"), ((0, 0, 6), "z")):
        axes.quiver(0, 0, 0, *direction, color="black", lw=1.8, arrow_length_ratio=0.2, zorder=9)
        axes.text(*(1.12 * np.array(direction)), name, fontsize=12, zorder=10, fontweight="bold")
    axes.text(
        17.6,
        upper[4, 0, 1],
        height + 0.4,
        "upper wires, each with\nelectrodes at z = height",
        color=UPPER,
        fontsize=10,
    )
    axes.text(18.6, -1.5, -1.2, "lower wires, each with\nelectrodes at z = 0", color=LOWER, fontsize=10)
    axes.text2D(
        0.16,
        0.68,
        "crossing of upper wire 1 and\nlower wire 9: one resistance",
        transform=figure.transFigure,
        fontsize=10,
        ha="center",
    )
    axes.plot([-2, -2], [18, 18], [0, height], color=GREY, lw=1.5)
    axes.text(-2.4, 18.6, height / 2 - 0.3, "height", color=INK, fontsize=10, ha="right")
    axes.text(9, 8, height - 2.0, "press:\nelectrodes move", fontsize=9, ha="center", zorder=11)
    axes.set_xlim(-3, 19)
    axes.set_ylim(-3, 19)
    axes.set_zlim(-1, 7)
    axes.view_init(elev=33, azim=-62)
    axes.set_axis_off()
    save(figure, "patch", dpi=105)


LINKS: dict[str, Any] = {
    "buses": [{"name": "can0", "channel": "can0"}],
    "links": [{"name": "distal", "pose": {"position_m": [0.1, 0.0, 0.02], "rpy_rad": [0.0, 0.0, 1.5708]}}],
    "patches": [
        {"name": "palm", "node_id": 1},
        {"name": "fingertip", "node_id": 2, "link": "distal", "pose": {"position_m": [0.0, 0.0, 0.008]}},
    ],
}
"""The hand file links.toml of docs/hand.md."""


def frames() -> None:
    """Frames of the hand, its link and its patches in links.toml of docs/hand.md."""
    hand = parse_hand(LINKS)
    skeleton = Skeleton.of(hand)
    figure = Figure(figsize=(9.0, 3.6))
    axes: Any = figure.add_axes((-0.5, -0.95, 2.0, 2.9), projection="3d")
    for each in hand.patches:
        mount = skeleton.mount(each.name)
        link = skeleton.link_pose(mount.link)
        layout = each.layout.build()
        corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0]]) * layout.upper_m[-1, -1]
        placed = 1e3 * link.points_m(mount.pose.points_m(corners))
        axes.plot(*placed.T, color=SKIN, lw=2)
        axes.plot_trisurf(*placed[:4].T, triangles=[[0, 1, 2], [0, 2, 3]], color=SKIN, alpha=0.25)
        origin = 1e3 * link.points_m(mount.pose.points_m(np.zeros(3)))
        triad(axes, link, mount.pose, 17, "", origin)
        axes.text(
            *placed[:4].mean(axis=0), f"patch {each.name}", color=INK, fontsize=10, ha="center", va="center"
        )
    triad(axes, Pose(), Pose(), 32, "hand", np.zeros(3))
    link = skeleton.link_pose("distal")
    origin = 1e3 * link.points_m(np.zeros(3))
    triad(axes, link, Pose(), 27, "link distal", origin)
    axes.plot(*np.array([np.zeros(3), origin]).T, "--", color=GREY, lw=1.2)
    axes.text(55, -14, 6, "links[0].pose", color=GREY, fontsize=9)
    axes.set_box_aspect((150, 75, 42))
    axes.set_xlim(-10, 140)
    axes.set_ylim(-20, 55)
    axes.set_zlim(0, 42)
    axes.view_init(elev=26, azim=-66)
    axes.set_axis_off()
    save(figure, "frames")


def triad(axes: Any, link: Pose, pose: Pose, length: float, name: str, origin: Any) -> None:
    for axis, colour in zip(np.eye(3), ("#c62828", "#2e7d32", "#1565c0"), strict=True):
        end = 1e3 * link.points_m(pose.points_m(1e-3 * length * axis))
        axes.quiver(*origin, *(end - origin), color=colour, lw=2.0, arrow_length_ratio=0.18)
        at = origin + 1.15 * (end - origin)
        axes.text(*at, "xyz"[int(axis.argmax())], color=colour, fontsize=8, ha="center", va="center")
    axes.text(*(origin + np.array([-3, -9, -4])), name, color=INK, fontsize=10)


def wiring() -> None:
    """Two buses with patches and drives, and who sends SYNC on them."""
    figure, axes = sheet(900, 330)
    box(axes, 15, 105, 120, 110, "host", "two CAN interfaces,\none SYNC number", HOST)
    for y, name, host_y in ((85, "can0", 105), (245, "can1", 215)):
        for wire_y, host_x in ((y, 70), (y + 7, 80)):
            axes.plot((host_x, host_x, 860), (host_y, wire_y, wire_y), color=BUS, lw=2.5)
        note(axes, 205, y - 13, f"{name}: CAN_H, CAN_L, and a common ground", fontsize=8)
        for x in (171, 853):
            axes.add_patch(Rectangle((x, y - 8), 14, 23, facecolor=PAPER, edgecolor=INK, lw=1.3, zorder=5))
            note(axes, x + 7, y - 20, "120 Ω", ha="center", fontsize=8)
    _device(axes, 250, 92, "patch index1", "node 1", SKIN)
    _device(axes, 385, 92, "patch index2", "node 2", SKIN)
    note(axes, 530, 135, "…", fontsize=14)
    _device(axes, 580, 92, "patch index8", "node 8", SKIN)
    _device(axes, 250, 252, "drive 1", "node 1", "#78909c")
    _device(axes, 385, 252, "drive 2", "node 2", "#78909c")
    _device(axes, 520, 252, "patch palm", "node 41", SKIN)
    _device(axes, 655, 252, "master", "NMT, SYNC", "#5e35b1")
    note(axes, 720, 135, 'role = "master": the host\nsends NMT and SYNC', fontsize=8)
    note(axes, 500, 214, 'role = "guest": another master sends NMT and SYNC', fontsize=8)
    save(figure, "wiring")


def _device(axes: Any, x: float, y: float, text: str, sub: str, colour: str) -> None:
    box(axes, x, y + 25, 110, 45, text, sub, colour)
    axes.plot((x + 50, x + 50), (y - 7, y + 25), color=BUS, lw=1.2)
    axes.plot((x + 60, x + 60), (y, y + 25), color=BUS, lw=1.2)


def board() -> None:
    """A board that measures the crossings of a patch, as in docs/node.md."""
    figure, axes = sheet(900, 330)
    rows, columns = 5, 8
    x0, y0, step_x, step_y = 150, 60, 34, 38
    for row in range(rows):
        y = y0 + row * step_y
        axes.plot((x0 - 50, x0 + columns * step_x - 12), (y, y), color=UPPER, lw=1.8)
    for column in range(columns):
        x = x0 + column * step_x
        axes.plot((x, x), (y0 - 20, y0 + rows * step_y + 8), color=LOWER, lw=1.8)
        for row in range(rows):
            axes.plot(x, y0 + row * step_y, "o", color="#b0bec5", ms=5, zorder=3)
    axes.plot(x0 + 3 * step_x, y0 + step_y, "o", color=INK, ms=9, zorder=4)
    note(axes, x0 - 50, 22, "upper wires (rows)", color=UPPER)
    note(axes, x0 + 140, 22, "lower wires (columns)", color=LOWER)
    box(axes, 12, 45, 80, 190, "row\nswitch", "", BUS)
    note(axes, 52, 250, "one row at 3.3 V", ha="center", fontsize=7.5)
    box(axes, x0 - 14, 270, columns * step_x + 2, 42, "column switch", "", BUS)
    box(axes, 470, 262, 110, 58, "A/D converter", "10 kΩ to ground", BUS)
    arrow(axes, [(x0 + columns * step_x - 12, 291), (470, 291)])
    box(
        axes,
        640,
        80,
        120,
        150,
        "board",
        "my_board:Board\nread() → ohms\n\nskinnode node\n0x1018 serial 77",
        SKIN,
    )
    arrow(axes, [(580, 291), (700, 291), (700, 230)], "SPI", (640, 279))
    arrow(axes, [(700, 80), (700, 14), (52, 14), (52, 45)], "selects row and column", (620, 28))
    box(axes, 800, 110, 88, 56, "CAN", "transceiver", BUS)
    arrow(axes, [(760, 138), (800, 138)], both=True)
    arrow(axes, [(844, 166), (844, 250)], both=True)
    axes.plot((770, 890), (256, 256), color=BUS, lw=3)
    axes.plot((770, 890), (263, 263), color=BUS, lw=3)
    note(axes, 830, 280, "CAN_H, CAN_L, ground", ha="center")
    note(axes, x0 + 3 * step_x + 8, y0 + step_y - 13, "R(1, 3)", fontsize=8.5)
    save(figure, "board")


PICTURES: dict[str, Any] = {"patch": patch, "frames": frames, "wiring": wiring, "board": board}
