"""Shapes and colours that the drawings of the guides share."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from PIL import Image

FOLDER: Final = Path(__file__).parents[1] / "img"
INK, GREY, PAPER = "#20262e", "#7a838f", "#ffffff"
SKIN, BUS, HOST, PROGRAM, SIMULATOR = "#00796b", "#37474f", "#3949ab", "#5e35b1", "#8d6e63"
"""Colours of patches, buses, the host, programs of users, and the simulator, as in docs/img/road.svg."""
UPPER, LOWER, FAULT = "#b3372b", "#1f6f8b", "#c62828"
COLOURS: Final = 128
MOST_BYTES: Final = 150_000


def save(figure: Figure, name: str, dpi: int = 110) -> None:
    """Write ``docs/img/NAME.png`` with few colours, and print its size."""
    path = FOLDER / f"{name}.png"
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=dpi, facecolor=PAPER)
    shrink(path)


def shrink(path: Path) -> None:
    """Reduce the colours of a picture, and check that it is small."""
    few = Image.open(path).convert("RGB").quantize(COLOURS, method=Image.Quantize.FASTOCTREE, dither=0)
    few.save(path, optimize=True)
    size = path.stat().st_size
    print(f"{path.name}: {few.width} × {few.height}, {size // 1000} kB")
    if size > MOST_BYTES:
        raise SystemExit(f"{path}: got {size} bytes, allowed: at most {MOST_BYTES}")


def sheet(width: float, height: float) -> tuple[Figure, Any]:
    """Return a figure of ``width`` × ``height`` units, 100 units per inch, y downwards."""
    figure = Figure(figsize=(width / 100, height / 100))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.axis("off")
    return figure, axes


def box(
    axes: Any, x: float, y: float, width: float, height: float, text: str, sub: str = "", colour: str = HOST
) -> None:
    """Draw a filled box with a title and a second, smaller text."""
    shape = "round,pad=0,rounding_size=8"
    axes.add_patch(FancyBboxPatch((x, y), width, height, boxstyle=shape, facecolor=colour, edgecolor="none"))
    lines = sub.count("\n") + 1 if sub else 0
    middle = x + width / 2
    axes.text(
        middle, y + height / 2 - 7.5 * lines, text, color="white", ha="center", va="center", fontsize=9.5
    )
    if sub:
        axes.text(
            middle, y + height / 2 + 8, sub, color="white", ha="center", va="center", fontsize=7.5, alpha=0.95
        )


def frame(axes: Any, x: float, y: float, width: float, height: float, text: str) -> None:
    """Draw a dashed frame around boxes that belong together."""
    shape = "round,pad=0,rounding_size=8"
    axes.add_patch(
        FancyBboxPatch((x, y), width, height, boxstyle=shape, fill=False, edgecolor=GREY, ls="--", lw=1.0)
    )
    axes.text(x + 8, y + 12, text, color=GREY, ha="left", va="center", fontsize=8)


def arrow(
    axes: Any,
    points: list[tuple[float, float]],
    label: str = "",
    at: tuple[float, float] | None = None,
    *,
    both: bool = False,
    colour: str = GREY,
    **text: Any,
) -> None:
    """Draw an arrow along ``points``, with a label beside the middle of its first part, or ``at`` a place."""
    if len(points) > 2:
        axes.plot(*zip(*points[:-1], strict=True), color=colour, lw=1.5, solid_capstyle="round")
    style = "<|-|>" if both else "-|>"
    how = {"arrowstyle": style, "color": colour, "lw": 1.5, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 11}
    axes.annotate("", xy=points[-1], xytext=points[-2], arrowprops=how)
    if label:
        (x0, y0), (x1, y1) = points[:2]
        x, y = at if at is not None else ((x0 + x1) / 2, (y0 + y1) / 2 - 8)
        put = {"ha": "center", "va": "center", "fontsize": 8, "color": INK, **text}
        axes.text(x, y, label, **put)


def note(axes: Any, x: float, y: float, text: str, **how: Any) -> None:
    """Write a small grey text."""
    axes.text(x, y, text, **{"fontsize": 8, "color": INK, "ha": "left", "va": "center", **how})
