"""Copies the undamaged messages of an MCAP file to a new file with an index."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

from skinnode.files.whole_file import discard
from skinnode.messages.definitions import CAN_FRAME, FD_FRAME, JOURNAL_LINE
from skinnode.messages.fields import POINT_CLOUD
from skinnode.messages.typestore import decode, encode, message_type, require_mcap
from skinnode.record.journal import repaired_line
from skinnode.record.mcap_file import CHUNK_BYTES, PROFILE
from skinnode.transport.frame_log import create_binary

if TYPE_CHECKING:
    from mcap.records import Message
    from mcap.writer import Writer

    from skinnode.record.mcap_chunks import McapChunks


_FRAMES: Final = (CAN_FRAME, FD_FRAME, JOURNAL_LINE)
"""Schemas of a recording without fields."""


def copy_mcap(source: Path, target: Path, *, frames_only: bool = False) -> tuple[int, int, list[str]]:
    """Copy every readable message, including its times, topic and schema.

    If the source is a recording that is damaged or was not closed properly, this is noted in the journal of
    the copy.

    Args:
        source: Existing file.
        target: New file.
        frames_only: Whether to copy only the CAN frames and the journal.

    Returns:
        Numbers of CAN frames and fields copied, and a one-line message for each damaged part.

    Raises:
        ConfigError: The source is not an MCAP file, or the target exists or cannot be created.
        OSError: The target cannot be written; it is deleted.
    """
    require_mcap(str(source))
    from skinnode.record.mcap_chunks import McapChunks

    chunks = McapChunks(source, lambda schema: None)
    file = create_binary(target)
    try:
        with file:
            counts = _copy(chunks, file, _FRAMES if frames_only else None)
    except BaseException:
        discard(target)
        raise
    faults = [f"{source.name} {damage}" for damage in chunks.damages]
    if chunks.damaged > len(faults):
        faults.append(f"{chunks.damaged - len(faults)} more damaged places")
    frames = counts.get(CAN_FRAME, 0) + counts.get(FD_FRAME, 0)
    return frames, counts.get(POINT_CLOUD, 0), faults


def _copy(chunks: McapChunks, file: BinaryIO, names: tuple[str, ...] | None) -> dict[str, int]:
    """Copy the readable messages of the given schemas; return the number of messages of each schema."""
    from mcap.writer import CompressionType, Writer

    from skinnode.record.mcap_chunks import TRUNCATED

    counts: dict[str, int] = {}
    writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(profile=PROFILE, library="skinnode")
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    last: tuple[int, Message] | None = None  # newest journal line and its channel in the copy
    ended = False
    for item in chunks.messages(names):
        channel, message, schema = item.channel, item.message, item.schema
        if channel.id not in channels:
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            number = 0 if schema is None else schemas[schema.id]
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, number, channel.metadata
            )
        writer.add_message(
            channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
        )
        name = "" if schema is None else schema.name
        counts[name] = counts.get(name, 0) + 1
        if name == JOURNAL_LINE:
            last = (channels[channel.id], message)
            ended = ended or _ends(message.data)
    inside = sum(damage.what != TRUNCATED for damage in chunks.damages)
    if last is not None and (inside or not ended):
        frames = counts.get(CAN_FRAME, 0) + counts.get(FD_FRAME, 0)
        _add_repaired(writer, *last, frames=frames, damaged=inside)
    writer.finish()
    return counts


def _ends(data: bytes) -> bool:
    """Return whether a journal line states that the recording was closed properly or has been repaired."""
    with suppress(ValueError, TypeError, KeyError, RecursionError):
        return json.loads(decode(data, JOURNAL_LINE).json)["event"] in ("ended", "repaired")
    return False


def _add_repaired(writer: Writer, channel: int, last: Message, *, frames: int, damaged: int) -> None:
    """Write the journal line that marks a repaired recording; ``last`` is the preceding line."""
    data = encode(message_type(JOURNAL_LINE)(repaired_line(frames, damaged)), JOURNAL_LINE)
    writer.add_message(channel, last.log_time, data, last.publish_time, (last.sequence + 1) & 0xFFFF_FFFF)
