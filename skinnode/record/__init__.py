"""Recordings of a hand, written while a host runs and replayed to give the same fields.

``recorder`` writes raw frames to a candump log or BLF file and, next to it, a ``journal`` of the other events
that determined how the host decoded the frames. ``replay`` reads both and decodes the frames with the host's
own code.
"""

from skinnode.record.recorder import Recorder, RecorderStats
from skinnode.record.replay import Replay, replay

__all__ = ["Recorder", "RecorderStats", "Replay", "replay"]
