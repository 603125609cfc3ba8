"""Records the traffic of a running host, and replays recordings to compute the same fields.

``recorder`` writes raw frames to a candump log or a BLF file. A ``journal`` file next to the log contains
everything else that affected how the host decoded the frames. ``replay`` reads both files and decodes the
frames with the host's own code.
"""

from skinnode.record.recorder import Recorder, RecorderStats
from skinnode.record.replay import Replay, replay

__all__ = ["Recorder", "RecorderStats", "Replay", "replay"]
