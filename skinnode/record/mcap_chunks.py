"""Reads the messages of an MCAP file chunk by chunk, even if the file is damaged or truncated.

The library's own readers stop at the first damaged record. This reader skips damaged parts and records their
positions. The library parses the records and verifies each chunk's checksum.
"""

from __future__ import annotations

import io
import mmap
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk

from skinnode.errors import ConfigError
from skinnode.transport.frame_log_reader import DAMAGES_KEPT, Damage

MAGIC: Final = b"\x89MCAP0\r\n"

_HEAD: Final = struct.Struct("<BQ")  # opcode and length of each record
_CHUNK_HEAD: Final = struct.Struct("<QQQII")  # two times, size, checksum, length of the compression name
_FOOT: Final = struct.Struct("<BQQQI")  # opcode, length, two offsets, checksum of the index before it
_COMPRESSIONS: Final = (b"zstd", b"lz4", b"")
_MOST_CHUNK: Final = 1 << 26
"""Maximum uncompressed chunk size in bytes; the usual size is 1 MiB. A larger size indicates damage."""
TRUNCATED: Final = "truncated"
"""Description of the damage if a file ends in the middle of a record."""
_AT_THE_END: Final = (Opcode.DATA_END, Opcode.FOOTER)


@dataclass(frozen=True, slots=True)
class McapMessage:
    """MCAP message with its channel and schema; the schema is None if the message has none."""

    message: Message
    channel: Channel
    schema: Schema | None
    offset: int
    """Offset of the message's chunk in the file, in bytes."""


class McapChunks:
    """Messages of an MCAP file, in file order. The file is open only while it is being read.

    Args:
        path: The file.
        check: Function called with each schema read; its exceptions propagate to the caller.

    Raises:
        ConfigError: The file cannot be read or is not an MCAP file.
    """

    def __init__(self, path: Path, check: Callable[[Schema], None]) -> None:
        self.path, self._check = path, check
        _open(path).close()
        self.damages: list[Damage] = []
        """First :data:`DAMAGES_KEPT` damaged parts of the file."""
        self.damaged = 0
        """Number of damaged parts found so far."""

    def messages(self, names: Collection[str] | None, *, by_index: bool = False) -> Iterator[McapMessage]:
        """Yield the messages that have one of the given schemas.

        Args:
            names: Schema names; None for all messages.
            by_index: Whether to skip chunks that contain no such message according to the index at the end of
                the file. The first message on each topic must then be in the chunk that defines the topic.
        """

        def wanted(channel: int) -> bool:
            if names is None or channel not in channels:
                return True
            schema = schemas.get(channels[channel].schema_id)
            return schema is not None and schema.name in names

        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        self.damages, self.damaged = [], 0
        with _open(self.path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            for offset, item in self._records(data, wanted if by_index else None):
                if isinstance(item, Schema):
                    self._check(item)
                    schemas[item.id] = item
                elif isinstance(item, Channel):
                    channels[item.id] = item
                elif isinstance(item, Message) and item.channel_id in channels and wanted(item.channel_id):
                    channel = channels[item.channel_id]
                    yield McapMessage(item, channel, schemas.get(channel.schema_id), offset)

    def complain(self, offset: int, what: str) -> None:
        """Record a damaged part of the file."""
        self.damaged += 1
        if len(self.damages) < DAMAGES_KEPT:
            self.damages.append(Damage(None, offset, what))

    def _records(
        self, data: mmap.mmap, wanted: Callable[[int], bool] | None
    ) -> Iterator[tuple[int, McapRecord]]:
        """Yield all records, each with the offset of its chunk.

        A corrupt length field may point beyond intact chunks. If a chunk's checksum is correct, so is its
        length. The length of any other record is accepted if the next record is plausible or no intact chunk
        follows.
        """
        at, size = len(MAGIC), len(data)
        indexes = {} if wanted is None else _chunk_indexes(data)
        while at < size:
            opcode, end = data[at], _end_of(data, at)
            if opcode == Opcode.CHUNK and end is not None:
                if wanted is not None and _can_skip(indexes.get(at), end - at, wanted):
                    at = end
                    continue
                content = self._read(data, at, end)
                if content is not None:
                    yield from ((at, item) for item in content)
                    at = end
                    continue
            elif end is not None and (
                (opcode not in _AT_THE_END and _is_plausible(data, end)) or _find_chunk(data, at + 1) == size
            ):
                if opcode in _AT_THE_END:
                    return
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                    yield from ((at, item) for item in self._read(data, at, end) or ())
                at = end
                continue
            following = _find_chunk(data, at + 1)
            if end is None or opcode != Opcode.CHUNK:  # otherwise, the damage has already been recorded
                self.complain(at, TRUNCATED if following == size else "no record")
            at = following

    def _read(self, data: mmap.mmap, at: int, end: int) -> list[McapRecord] | None:
        """Return the records in a chunk, or a single record outside a chunk; None if it cannot be read."""
        try:
            record = _parsed(data[at], data[at + _HEAD.size : end])
            if not isinstance(record, Chunk):
                return [record]
            if end - at != _HEAD.size + _CHUNK_HEAD.size + len(record.compression) + 8 + len(record.data):
                raise ValueError("wrong length")
            content: list[McapRecord] = breakup_chunk(_decompressed(record), validate_crc=True)
        except Exception as error:  # the decompressors and the library raise various exceptions
            self.complain(at, f"a record that cannot be read ({type(error).__name__}: {error})")
            return None
        return content


def _open(path: Path) -> BinaryIO:
    allowed = "an MCAP file"
    try:
        file = path.open("rb")
        try:
            if file.read(len(MAGIC)) == MAGIC:
                return file
        except OSError as error:
            allowed = f"an MCAP file that can be read ({error.strerror})"
        file.close()
    except OSError as error:
        allowed = f"a file that can be read ({error.strerror})"
    raise ConfigError("recording", str(path), allowed) from None


def _parsed(opcode: int, data: bytes) -> McapRecord:
    stream = ReadDataStream(io.BytesIO(data))
    record: McapRecord
    match opcode:
        case Opcode.CHUNK:
            record = Chunk.read(stream)
        case Opcode.SCHEMA:
            record = Schema.read(stream)
        case Opcode.CHANNEL:
            record = Channel.read(stream)
        case _:
            record = Message.read(stream, len(data))
    return record


def _end_of(data: mmap.mmap, at: int) -> int | None:
    """Return the end offset of the record at ``at``; None if there is no complete record."""
    if at + _HEAD.size > len(data):
        return None
    opcode, length = _HEAD.unpack_from(data, at)
    known = 0 < opcode <= Opcode.DATA_END or opcode >= 0x80  # 0x80 and above are private records
    end = int(at + _HEAD.size + length)
    return end if known and end <= len(data) else None


def _is_plausible(data: mmap.mmap, at: int) -> bool:
    """Return whether the file ends or a complete record begins at ``at``."""
    return at == len(data) or _end_of(data, at) is not None


def _can_skip(index: ChunkIndex | None, length: int, wanted: Callable[[int], bool]) -> bool:
    """Return whether a chunk's index entry shows that the chunk contains no wanted message."""
    if index is None or index.chunk_length != length or not index.message_index_offsets:
        return False
    return not any(map(wanted, index.message_index_offsets))


def _chunk_indexes(data: mmap.mmap) -> dict[int, ChunkIndex]:
    """Return the entries of the index at the end of the file, by the offsets of their chunks.

    Only this index has a checksum. If it is missing or damaged, the result is empty.
    """
    foot = len(data) - _FOOT.size - len(MAGIC)
    if foot < len(MAGIC) or data[foot + _FOOT.size :] != MAGIC:
        return {}
    opcode, _, at, _, checksum = _FOOT.unpack_from(data, foot)
    summed = data[at : foot + _FOOT.size - 4]
    if opcode != Opcode.FOOTER or not 0 < at < foot or zlib.crc32(summed) != checksum:
        return {}
    found = {}
    try:
        while at < foot and (end := _end_of(data, at)) is not None:
            if data[at] == Opcode.CHUNK_INDEX:
                index = ChunkIndex.read(ReadDataStream(io.BytesIO(data[at + _HEAD.size : end])))
                found[index.chunk_start_offset] = index
            at = end
    except Exception:  # a wrong index with a correct checksum; the library raises various exceptions
        return {}
    return found


def _find_chunk(data: mmap.mmap, at: int) -> int:
    """Return the offset of the next complete chunk, or the file length if there is none."""
    while (at := data.find(bytes([Opcode.CHUNK]), at)) >= 0:
        end = _end_of(data, at)
        if end is not None and end >= at + _HEAD.size + _CHUNK_HEAD.size:
            _, _, size, _, length = _CHUNK_HEAD.unpack_from(data, at + _HEAD.size)
            word = at + _HEAD.size + _CHUNK_HEAD.size
            if size <= _MOST_CHUNK and length <= 4 and data[word : word + length] in _COMPRESSIONS:
                return at
        at += 1
    return len(data)


def _decompressed(chunk: Chunk) -> Chunk:
    """Decompress a chunk. Raises ValueError if the result would be larger than the chunk's stated size."""
    size, data = chunk.uncompressed_size, chunk.data
    if size > _MOST_CHUNK:
        raise ValueError(f"{size} bytes, must be at most {_MOST_CHUNK}")
    if chunk.compression == "zstd":
        import zstandard

        if zstandard.frame_content_size(data) > size:
            raise ValueError("larger than its stated size")
        data = zstandard.decompress(data, max_output_size=size)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    elif chunk.compression:
        raise ValueError(f"unknown compression {chunk.compression[:20]!r}")
    return replace(chunk, compression="", data=data)
