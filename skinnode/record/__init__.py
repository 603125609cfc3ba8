"""Records the traffic of a running host and replays recordings to compute the same fields.

``recorder`` queues data from the host's threads and writes it in a separate thread: to ``log_files`` (a
candump log or a BLF file, and a journal next to it) or to ``mcap_file`` (one MCAP file, to which ``follow``
adds the fields, contacts, health and events). ``recording_path`` names a new recording. The ``journal``
contains everything, apart from the frames themselves, that affected how the host decoded them.
``open_recording`` opens recordings and, with a hand file, logs from other masters; ``mcap_chunks`` and
``mcap_reader`` read MCAP files that may be damaged.
``replay`` decodes the frames with the host's own code. ``convert`` converts recordings to other formats: it
repairs MCAP files with ``copy_mcap`` and writes field tables with ``field_rows``, ``parquet_file`` and
``npz_file``; ``new_file`` deletes a file that could not be completed.
"""

from skinnode.record.follow import followed
from skinnode.record.recorder import Recorder, RecorderStats
from skinnode.record.replay import Replay, replay

__all__ = ["Recorder", "RecorderStats", "Replay", "followed", "replay"]
