"""Opens an SDK recording stream, which sends a drawing to a viewer, a file or both."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

import rerun as rr

from skinnode.view.outputs import Target

_APPLICATION: Final = "skinnode"
_FLUSH_S: Final = 5.0
_BATCH_MS: Final = 20
"""Maximum time for which the SDK buffers data, in ms; shorter than the interval between two pictures."""


@contextmanager
def open_stream(target: Target) -> Iterator[rr.RecordingStream]:
    """Open a stream; on exit, write the pending data and close it.

    Args:
        target: Destination of the drawing.
    """
    batches = rr.ChunkBatcherConfig.LOW_LATENCY()
    batches.flush_tick = _BATCH_MS * 1e-3
    stream = rr.RecordingStream(_APPLICATION, batcher_config=batches)
    stream.set_log_time_enabled(False)  # all data carry their own timestamps
    stream.set_log_tick_enabled(False)
    sinks: list[rr.GrpcSink | rr.FileSink] = []
    if target.url is not None:
        sinks.append(rr.GrpcSink(target.url))
    if target.save is not None:
        sinks.append(rr.FileSink(str(target.save)))
    stream.set_sinks(*sinks)
    stream.send_recording_name(target.name)
    try:
        yield stream
    finally:
        with suppress(RuntimeError):  # the viewer has exited or stopped reading; a file is complete so far
            stream.flush(timeout_sec=_FLUSH_S)
        stream.disconnect()
