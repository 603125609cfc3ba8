"""Converts a whole recording to a Rerun file, as fast as possible."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from skinnode.config import HandConfig
from skinnode.view.conversion import Conversion
from skinnode.view.outputs import Target


def convert_to_file(
    path: Path,
    save: Path,
    *,
    exaggeration: float,
    hand: HandConfig | None = None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Conversion:
    """Draw a recording to a new file; return the finished conversion.

    Args:
        path: The recording.
        save: The file.
        exaggeration: Ratio of drawn to measured displacement.
        hand: Hand for a log without a journal; see :func:`skinnode.record.replay.replay`.
        cancelled: Function called before each frame; the conversion ends when it returns True.

    Raises:
        ConfigError: The recording cannot be read.
    """
    from skinnode.view.drawing import HandDrawing
    from skinnode.view.stream import open_stream

    conversion = Conversion(path, cancelled, hand=hand)
    try:
        with open_stream(Target(None, save, path.name)) as stream:
            drawing = HandDrawing(
                stream,
                conversion.replay.hand,
                exaggeration=exaggeration,
                wall_minus_mono_ns=conversion.replay.wall_minus_mono_ns,
                live=False,
            )
            conversion.run(drawing.draw)
    finally:
        conversion.replay.log.close()
    return conversion
