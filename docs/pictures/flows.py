"""Diagrams of programs and the data between them."""

from __future__ import annotations

from typing import Any

from style import BUS, FAULT, GREY, HOST, PROGRAM, SIMULATOR, SKIN, arrow, box, frame, note, save, sheet


def recordings() -> None:
    figure, axes = sheet(900, 310)
    box(axes, 15, 60, 130, 60, "running hand", "skinnode record", SKIN)
    box(axes, 15, 200, 130, 60, "other master", "candump -L, PLC", BUS)
    box(axes, 235, 35, 150, 110, "run.mcap", "frames, journal,\nfields, contacts,\nhealth, events", HOST)
    box(axes, 235, 200, 150, 60, "run.log, .blf, .asc", "frames, journal (.jsonl)", HOST)
    arrow(axes, [(145, 90), (235, 90)], "record")
    arrow(axes, [(145, 110), (190, 110), (190, 215), (235, 215)])
    arrow(axes, [(145, 240), (235, 240)], "no journal", (190, 252))
    arrow(axes, [(310, 145), (310, 200)], "convert", (342, 173), both=True)
    programs = (
        ("replay", "the same fields, bit for bit"),
        ("convert", "replays and writes tables"),
        ("resolve", "other options, calibrations"),
        ("ROS 2 tools", "rosbags, ros2 bag"),
    )
    axes.plot((440, 440), (48, 230), color=GREY, lw=1.5)
    for y in (90, 230):
        axes.plot((385, 440), (y, y), color=GREY, lw=1.5)
    for number, (name, sub) in enumerate(programs):
        y = 20 + 75 * number
        box(axes, 500, y, 165, 56, name, sub, PROGRAM)
        if number < 3:
            arrow(axes, [(440, y + 28), (500, y + 28)])
    arrow(axes, [(370, 145), (370, 182), (465, 182), (465, 273), (500, 273)])
    box(axes, 745, 20, 140, 56, "monitor, view", "fields as in the live run", HOST)
    box(axes, 745, 95, 140, 56, "Parquet, NPZ, RRD", "tables, 3-D view", HOST)
    box(axes, 745, 170, 140, 56, "Parquet, MCAP", "one per combination", HOST)
    for y in (48, 123, 198):
        arrow(axes, [(665, y), (745, y)])
    save(figure, "recordings")


def resolve() -> None:
    figure, axes = sheet(900, 290)
    for number, name in enumerate(("press.log", "slide.mcap")):
        box(axes, 15, 50 + 90 * number, 130, 60, name, "frames, journal", HOST)
        arrow(axes, [(145, 80 + 90 * number), (215, 80 + 90 * number)])
    box(
        axes,
        215,
        35,
        150,
        190,
        "units",
        "one recording, one patch,\none combination\nof options;\nfinished units are kept",
        BUS,
    )
    for number, (name, sub) in enumerate(
        (("process 1", "core 1"), ("process 2", "core 2"), ("Dask worker", "other computer"))
    ):
        y = 35 + 67 * number
        box(axes, 470, y, 150, 56, name, sub, PROGRAM)
        arrow(axes, [(365, y + 28), (470, y + 28)])
        arrow(axes, [(620, y + 28), (700, y + 28)])
    files = "press-method=exact.parquet\npress-method=posterior.parquet\n…\ntable of the sweep"
    box(axes, 700, 35, 190, 190, "results", files, HOST)
    note(
        axes,
        215,
        255,
        "If a worker ends early, its unit is solved again, with the same bits as in one process.",
    )
    save(figure, "resolve")


def remote() -> None:
    figure, axes = sheet(900, 330)
    box(axes, 15, 120, 100, 60, "patches", "CAN bus", SKIN)
    frame(axes, 145, 25, 425, 285, "one machine")
    box(axes, 165, 110, 150, 80, "daemon", "skinnode host\n--publish", HOST)
    box(axes, 405, 55, 145, 56, "monitor, control", "sk.connect", PROGRAM)
    box(axes, 405, 130, 145, 56, "logger", "any Zenoh program", PROGRAM)
    box(axes, 405, 225, 145, 60, "router", "zenohd, rmw_zenohd", BUS)
    arrow(axes, [(115, 150), (165, 150)], both=True)
    arrow(axes, [(315, 125), (350, 125), (350, 75), (405, 75)])
    arrow(axes, [(315, 158), (405, 158)])
    note(axes, 405, 43, "fields, health, events", ha="left")
    arrow(axes, [(240, 190), (240, 255), (405, 255)], "--router", (320, 244))
    arrow(axes, [(405, 98), (375, 98), (375, 142), (315, 142)], colour=FAULT)
    note(axes, 250, 205, "commands (tare, reset): only with --commands", color=FAULT, fontsize=7.5)
    frame(axes, 660, 25, 225, 285, "other machines")
    box(axes, 690, 60, 165, 60, "program", 'sk.connect(…, router="tls/…")', PROGRAM)
    box(axes, 690, 215, 165, 60, "ROS 2 Jazzy", "rmw_zenoh, RViz", PROGRAM)
    arrow(axes, [(550, 262), (690, 250)])
    arrow(axes, [(550, 245), (620, 245), (620, 90), (690, 90)])
    save(figure, "remote")


def ros2() -> None:
    figure, axes = sheet(900, 330)
    axes.plot((25, 545), (255, 255), color=BUS, lw=4, solid_capstyle="round")
    note(axes, 235, 243, "CAN bus", ha="left")
    for x, text, sub in ((30, "patch palm", "node 41"), (155, "patch heel", "node 42")):
        box(axes, x, 275, 105, 45, text, sub, SKIN)
        arrow(axes, [(x + 52, 275), (x + 52, 257)], both=True)
    box(axes, 300, 275, 105, 45, "drives", "nodes 1, 2", "#78909c")
    arrow(axes, [(352, 275), (352, 257)], both=True)
    box(
        axes,
        30,
        110,
        190,
        90,
        "ros2_canopen",
        "master: NMT, SYNC,\nconfiguration from bus.yml;\none proxy per patch",
        PROGRAM,
    )
    arrow(axes, [(125, 200), (125, 253)], both=True)
    note(axes, 132, 228, "NMT, SYNC, SDO;\nsummaries", va="center")
    box(
        axes,
        330,
        110,
        190,
        90,
        "skinnode host",
        'role = "guest":\nreceives all chunks,\nsolves the scans',
        HOST,
    )
    arrow(axes, [(425, 253), (425, 200)], both=True)
    note(axes, 432, 228, "all chunks", va="center")
    box(axes, 600, 110, 120, 90, "router", "rmw_zenohd", BUS)
    arrow(axes, [(520, 155), (600, 155)], "--publish", (560, 143))
    box(axes, 780, 85, 105, 55, "RViz", "PointCloud2, tf", PROGRAM)
    box(axes, 780, 170, 105, 55, "your node", "wrenches", PROGRAM)
    arrow(axes, [(720, 140), (780, 115)])
    arrow(axes, [(720, 170), (780, 195)])
    box(axes, 330, 20, 190, 50, "hand.toml", "skinnode hand ros2", "#455a64")
    arrow(axes, [(330, 45), (125, 45), (125, 110)], "bus.yml, EDS, launch file", (222, 34))
    arrow(axes, [(425, 70), (425, 110)])
    box(axes, 600, 250, 120, 55, "run.mcap", "skinnode record", HOST)
    arrow(axes, [(505, 200), (505, 232), (570, 232), (570, 278), (600, 278)])
    box(axes, 780, 250, 105, 55, "ros2 bag", "play, info", PROGRAM)
    arrow(axes, [(720, 278), (780, 278)])
    save(figure, "ros2")


def hil() -> None:
    figure, axes = sheet(900, 300)

    def row(y: float, first: tuple[str, str, str]) -> None:
        name, sub, colour = first
        box(axes, 15, y, 150, 56, name, sub, colour)

    row(40, ("robot: skin", "resistances, converter", SKIN))
    row(180, ("simulated skin", "scene, imperfections, noise", SIMULATOR))
    box(axes, 250, 110, 140, 56, "node", "skinnode.node", SKIN)
    arrow(axes, [(165, 68), (215, 68), (215, 128), (250, 128)])
    arrow(axes, [(165, 208), (215, 208), (215, 148), (250, 148)])
    box(axes, 470, 95, 130, 86, "bus", "socketcan can0, vcan0,\nudp_multicast, virtual,\ntimed", BUS)
    arrow(axes, [(390, 138), (470, 138)], both=True)
    box(axes, 660, 110, 90, 56, "host", "solver", HOST)
    arrow(axes, [(600, 138), (660, 138)], both=True)
    box(axes, 790, 110, 85, 56, "your", "program", PROGRAM)
    arrow(axes, [(750, 138), (790, 138)])
    for x, text in (
        (90, "of the skin: open wires,\nnoise, drift, stuck readings"),
        (320, "of a node: silent, reset,\nlost chunks, wrong counter"),
        (535, "of a bus: bus-off, error\nframes, second master"),
    ):
        arrow(axes, [(x, 266), (x, 240 if x == 90 else 170 if x == 320 else 185)], colour=FAULT)
        note(axes, x, 281, text, ha="center", color=FAULT, fontsize=7.5)
    frame(axes, 235, 25, 655, 165, "the same code on the robot and in the test")
    arrow(axes, [(165, 222), (832, 222), (832, 168)], colour=SIMULATOR)
    note(axes, 640, 212, "ground truth of every scan", ha="center", color=SIMULATOR)
    save(figure, "hil")


PICTURES: dict[str, Any] = {
    "recordings": recordings,
    "resolve": resolve,
    "remote": remote,
    "ros2": ros2,
    "hil": hil,
}
