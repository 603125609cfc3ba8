"""Recordings of a hand: raw frames in a candump log or BLF file, and beside it, in a small journal, what else
the host decoded them with. :func:`replay` makes the same fields of them again.
"""

from skinnode.record.recorder import Recorder, RecorderStats
from skinnode.record.replay import Replay, replay

__all__ = ["Recorder", "RecorderStats", "Replay", "replay"]
