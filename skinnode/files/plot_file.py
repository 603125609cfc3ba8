"""Writes matplotlib figures, and checks in advance that matplotlib, an optional dependency, is installed."""

from __future__ import annotations

import io
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from skinnode.errors import ConfigError
from skinnode.files.output_file import write_bytes


def require_matplotlib(file: Path) -> None:
    """Check that matplotlib is installed and can write the format given by the suffix of ``file``.

    Raises:
        ConfigError: matplotlib is missing, or cannot write this format.
    """
    if find_spec("matplotlib") is None:
        raise ConfigError("--plot", str(file), "plots require matplotlib (install: sh install.sh plot)")
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    kinds = sorted(FigureCanvasAgg.get_supported_filetypes())
    if file.suffix.removeprefix(".").lower() not in kinds:
        raise ConfigError("--plot", str(file), f"a file name that ends in one of {', '.join(kinds)}")


def save_figure(option: str, file: Path, figure: Any, dpi: int) -> None:
    """Write a figure to a file atomically; the suffix of the file determines the format.

    Args:
        option: Option that specifies the file, for error messages.
        file: The file.
        figure: A ``matplotlib.figure.Figure``.
        dpi: Resolution in dots per inch.

    Raises:
        ConfigError: The file cannot be written.
    """
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=dpi, format=file.suffix[1:].lower() or None)
    write_bytes(option, file, drawn.getvalue())
