"""Records the traffic of a running host, and replays recordings to compute the same fields.

``recorder`` queues what the host's threads pass on and writes it on a thread of its own: to ``log_files`` (a
candump log or a BLF file, and a journal next to it) or to ``mcap_file`` (one MCAP file, which ``follow`` also
gives the fields, contacts, health and events). The ``journal`` contains everything other than the frames that
affected how the host decoded them. ``sources`` opens recordings, and logs of other masters with a hand file;
``mcap_chunks`` and ``mcap_reader`` read MCAP files that may be damaged. ``replay`` decodes the frames with
the host's own code. ``convert`` converts recordings: with ``copy_frames`` from frames to frames, and with
``field_table``, ``parquet_file`` and ``npz_file`` to tables of fields.
"""

from skinnode.record.follow import followed
from skinnode.record.recorder import Recorder, RecorderStats
from skinnode.record.replay import Replay, replay

__all__ = ["Recorder", "RecorderStats", "Replay", "followed", "replay"]
