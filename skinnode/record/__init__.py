"""Recordings of a hand: written while a host runs, and replayed as the same fields.

``recorder`` writes raw frames to a candump log or BLF file and, beside it, a ``journal`` of what else decided
how the host decoded them. ``replay`` reads both and decodes the frames with the host's own code.
"""

from skinnode.record.recorder import Recorder, RecorderStats
from skinnode.record.replay import Replay, replay

__all__ = ["Recorder", "RecorderStats", "Replay", "replay"]
