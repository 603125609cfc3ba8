"""Copies the undamaged messages of an MCAP file to a new file with an index."""

from __future__ import annotations

from pathlib import Path

from skinnode.messages.definitions import CAN_FRAME, FD_FRAME
from skinnode.messages.fields import POINT_CLOUD
from skinnode.messages.typestore import require_mcap
from skinnode.record.mcap_file import CHUNK_BYTES, PROFILE
from skinnode.transport.frame_log import create_binary


def copy_mcap(source: Path, target: Path) -> tuple[int, int, list[str]]:
    """Copy every readable message, with its times, topic and schema.

    Returns:
        Numbers of CAN frames and fields copied, and a one-line message for each damaged part.

    Raises:
        ConfigError: The source is not an MCAP file, or the target cannot be created.
    """
    require_mcap(str(source))
    from mcap.writer import CompressionType, Writer

    from skinnode.record.mcap_chunks import McapChunks

    chunks = McapChunks(source, lambda schema: None)
    counts: dict[str, int] = {}
    with create_binary(target) as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile=PROFILE, library="skinnode")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for item in chunks.messages(None):
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
        writer.finish()
    faults = [f"{source.name} {damage}" for damage in chunks.damages]
    if chunks.damaged > len(faults):
        faults.append(f"{chunks.damaged - len(faults)} more damaged places")
    frames = counts.get(CAN_FRAME, 0) + counts.get(FD_FRAME, 0)
    return frames, counts.get(POINT_CLOUD, 0), faults
