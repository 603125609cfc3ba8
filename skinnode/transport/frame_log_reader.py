"""Reads CAN frames from a candump log, a BLF file or an ASC file, even if the file is damaged.

The reader skips the damaged parts of a truncated or partly overwritten file, and records where they are
(:class:`Damage`). Invalid content never causes an exception. A candump log has no checksums, so a corrupt
frame is not detected if it is well-formed.
"""

from __future__ import annotations

import io
import mmap
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import can

from skinnode.canopen.data_length import FD_LENGTHS
from skinnode.errors import ConfigError
from skinnode.text.words import counted
from skinnode.transport.frame import Frame
from skinnode.transport.frame_log import WRITABLE, LoggedFrame

READABLE: Final = WRITABLE
"""Suffixes of logs that can be read."""
DAMAGES_KEPT: Final = 100
"""Maximum number of damaged parts that are described. Any further damaged parts are counted but not
described."""


@dataclass(frozen=True, slots=True)
class Damage:
    """Damaged part of a log file."""

    line: int | None
    """Line number, counted from 1; None for a BLF file."""
    offset: int
    """Offset from the beginning of the file, in bytes."""
    what: str

    def __str__(self) -> str:
        where = f"offset {self.offset}" if self.line is None else f"line {self.line} (offset {self.offset})"
        return f"{where}: {self.what}"


class _Container(NamedTuple):
    """Container of a BLF file."""

    end: int
    """File offset from which to search for the next container, in bytes."""
    objects: bytes | None
    """Readable part of the content; None if nothing is readable."""
    intact: bool = False


class FrameLogReader:
    """Iterable over the frames of a log file. It can be iterated over once, by one thread.

    Raises:
        ConfigError: if the file cannot be opened, or its suffix is not ``.log``, ``.blf`` or ``.asc``.
    """

    def __init__(self, path: Path) -> None:
        if path.suffix not in READABLE:
            raise ConfigError("recording", str(path), "a file ending in .log, .blf or .asc")
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise ConfigError("recording", str(path), f"a file that can be read ({error.strerror})") from None
        self.path = path
        self.damages: list[Damage] = []
        """First :data:`DAMAGES_KEPT` damaged parts of the file."""
        self.damaged = 0
        """Number of damaged parts found so far."""

    def __iter__(self) -> Iterator[LoggedFrame]:
        with self._file:
            yield from {".blf": self._blf, ".asc": self._asc}.get(self.path.suffix, self._candump)()

    def close(self) -> None:
        """Stop reading and close the file."""
        self._file.close()

    def _complain(self, line: int | None, offset: int, what: str) -> None:
        self.damaged += 1
        if len(self.damages) < DAMAGES_KEPT:
            self.damages.append(Damage(line, offset, what))

    # --- candump

    def _candump(self) -> Iterator[LoggedFrame]:
        number = offset = 0
        while line := self._file.readline(_LONGEST_LINE):
            number += 1
            logged = _candump_frame(line)
            if logged is not None:
                yield logged
            elif line.strip():
                cut = not line.endswith(b"\n") and len(line) < _LONGEST_LINE
                self._complain(number, offset, f"{'truncated' if cut else 'no frame'}: {_shown(line)}")
            offset += len(line)

    # --- ASC

    def _asc(self) -> Iterator[LoggedFrame]:
        """Yield the frames of an ASC file. python-can parses the file and skips lines that are not frames."""
        head = self._file.read(_ASC_HEAD_BYTES)
        if not head:  # a log without frames, as in the other formats
            return
        if re.search(rb"^date\s", head, re.MULTILINE | re.IGNORECASE) is None:
            self._complain(1, 0, f"not an ASC file: {_shown(head[:16])}")
            return
        self._file.seek(0)
        text = io.TextIOWrapper(self._file, encoding="ascii", errors="replace")
        try:
            for message in can.ASCReader(text, relative_timestamp=False):
                yield _numbered_frame(message)
        except Exception as error:  # python-can raises various exceptions for invalid data
            self._complain(None, 0, f"unreadable from an unknown line on ({type(error).__name__}: {error})")

    # --- BLF

    def _blf(self) -> Iterator[LoggedFrame]:
        size = self._file.seek(0, io.SEEK_END)
        if size == 0:
            return
        with mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            header = data[:_FILE_HEADER_BYTES]
            if header[:4] != b"LOGG" or len(header) < _FILE_HEADER_BYTES:
                self._complain(None, 0, f"no BLF file header: {_shown(header[:16])}")
                header = _BLANK_HEADER
            tail, at = b"", _find_container(data, 0)
            if header is not _BLANK_HEADER and at not in (_FILE_HEADER_BYTES, size):
                self._complain(
                    None, _FILE_HEADER_BYTES, f"no container for {counted(at - _FILE_HEADER_BYTES, 'byte')}"
                )
            while at < size:
                end, objects, intact = self._container(data, at)
                if objects is not None:
                    whole, tail = self._whole_objects(tail + objects, at)
                    yield from self._frames(header, whole, at)
                if not intact:  # the length of a partial frame may be wrong, so do not complete it
                    tail = b""
                following = _find_container(data, end)
                if following > end + _PADDING_BYTES and intact:
                    self._complain(None, end, f"no container for {counted(following - end, 'byte')}")
                    tail = b""
                at = following
            if tail:
                self._complain(
                    None, size, f"truncated: the last frame ends after {counted(len(tail), 'byte')}"
                )

    def _container(self, data: mmap.mmap, at: int) -> _Container:
        """Return the BLF container at file offset ``at``.

        The length of a damaged container may be wrong, so the search for the next container starts directly
        after its header.
        """
        _, _, _, size, _ = _OBJECT.unpack_from(data, at)
        begin, end = at + _CONTAINER_HEAD_BYTES, at + size
        body = data[begin:end]
        method = struct.unpack_from("<H", data, at + _OBJECT.size)[0] if len(body) else _DEFLATE
        damaged = _Container(at + _OBJECT.size, None)
        if method == _STORED:
            if end > len(data):
                self._complain(None, at, "truncated in the middle of a container")
                return damaged._replace(objects=body)
            return _Container(end, body, intact=True)
        if method != _DEFLATE:
            self._complain(None, at, f"a container compressed by the unknown method {method}")
            return damaged
        inflater = zlib.decompressobj()
        try:
            objects = inflater.decompress(body, _MOST_INFLATED)
        except zlib.error as error:
            self._complain(None, at, f"a container that cannot be decompressed ({error})")
            return damaged
        if not inflater.eof:
            self._complain(None, at, "truncated in the middle of a container")
            return damaged._replace(objects=objects)
        if len(inflater.unused_data) > _PADDING_BYTES:
            self._complain(None, at, "a container with a wrong length")
            return _Container(end - len(inflater.unused_data), objects, intact=True)
        return _Container(min(end, len(data)), objects, intact=True)

    def _whole_objects(self, data: bytes, container: int) -> tuple[bytes, bytes]:
        """Split ``data`` into its complete objects and an incomplete object at its end."""
        pieces: list[bytes] = []
        begin = at = 0  # offsets of the first object after the last gap, and of the next object
        while True:
            start = data.find(b"LOBJ", at, at + _PADDING_BYTES + 4)
            if start < 0 and len(data) - at <= _PADDING_BYTES:
                return b"".join([*pieces, data[begin:at]]), b""
            if start < 0:
                self._complain(None, container, f"no frame at byte {at} of the container")
                start = data.find(b"LOBJ", at)
                pieces.append(data[begin:at])
                if start < 0:
                    return b"".join(pieces), b""
                begin = start
            cut = start + _OBJECT.size > len(data)
            length = len(data) if cut else _OBJECT.unpack_from(data, start)[3]
            if start + length > len(data) and (cut or length <= _MOST_OBJECT):
                return b"".join([*pieces, data[begin:at]]), data[start:]
            if not _OBJECT.size <= length <= _MOST_OBJECT:
                self._complain(None, container, f"no frame at byte {start} of the container")
                pieces.append(data[begin:start])
                begin = at = start + 4
            else:
                at = start + length

    def _frames(self, header: bytes, objects: bytes, container: int) -> Iterator[LoggedFrame]:
        """Yield the CAN frames in ``objects``. python-can parses them as a BLF file in memory."""
        head = _OBJECT.pack(b"LOBJ", _OBJECT.size, 1, _CONTAINER_HEAD_BYTES + len(objects), _LOG_CONTAINER)
        file = io.BytesIO(header + head + struct.pack("<H6xL4x", _STORED, len(objects)) + objects)
        try:
            for message in can.BLFReader(file):
                yield _numbered_frame(message)
        except Exception as error:  # python-can raises various exceptions for invalid data
            self._complain(None, container, f"objects that cannot be read ({type(error).__name__}: {error})")


# --- candump

_LONGEST_LINE: Final = 4096
_LINE: Final = re.compile(
    rb"\((\d{1,11})\.(\d{6})\) (\S{1,64}) ([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})#"
    rb"(?:(R)[0-9A-Fa-f]?|(?:#([0-9A-Fa-f]))?((?:[0-9A-Fa-f]{2}){0,64}))( [RT])?(\r?\n)?"
)
_EXTENDED_BITS: Final = 0x1FFF_FFFF
_ERROR_BIT: Final = 0x2000_0000


def _candump_frame(line: bytes) -> LoggedFrame | None:
    """Parse a line written by ``candump -L`` or python-can. Return None for any other line."""
    match = _LINE.fullmatch(line)
    if match is None:
        return None
    seconds, micros, channel, word, remote, fd, digits, direction, end = match.groups()
    if end is None and direction is None:
        return None
    can_id = int(word, 16)
    data = b"" if digits is None else bytes.fromhex(digits.decode())
    if (fd is None and len(data) > 8) or len(data) not in FD_LENGTHS or (len(word) == 3 and can_id > 0x7FF):
        return None
    error = len(word) == 8 and bool(can_id & _ERROR_BIT)
    frame = Frame(
        can_id & _EXTENDED_BITS,
        data,
        int(seconds) * 1_000_000_000 + int(micros) * 1000,
        remote is not None,
        error,
        len(word) == 8 and not error,
        fd is not None,
    )
    return LoggedFrame(frame, channel.decode("ascii", "replace"), direction == b" T")


def _shown(data: bytes) -> str:
    text = data[:40].decode("ascii", "backslashreplace").rstrip()
    shown = "".join(c if c.isprintable() else "?" for c in text)
    return repr(shown + ("…" if len(data) > 40 else ""))


_ASC_HEAD_BYTES: Final = 1024

# --- BLF: sizes are from python-can's can/io/blf.py

_OBJECT: Final = struct.Struct("<4sHHLL")  # "LOBJ", header size, version, object size, object type
_CONTAINER_HEAD_BYTES: Final = _OBJECT.size + 16
_FILE_HEADER_BYTES: Final = 144
_BLANK_HEADER: Final = b"LOGG" + struct.pack("<L", _FILE_HEADER_BYTES) + bytes(_FILE_HEADER_BYTES - 8)
_LOG_CONTAINER: Final = 10
_STORED, _DEFLATE = 0, 2
_PADDING_BYTES: Final = 4
_MOST_CONTAINER: Final = 1 << 24
_MOST_INFLATED: Final = 1 << 26
_MOST_OBJECT: Final = 1 << 16


def _find_container(data: mmap.mmap, at: int) -> int:
    """Return the file offset of the next container, or the length of the file if there is none."""
    while (at := data.find(b"LOBJ", at)) >= 0:
        if at + _OBJECT.size <= len(data):
            _, _, _, size, kind = _OBJECT.unpack_from(data, at)
            if kind == _LOG_CONTAINER and _CONTAINER_HEAD_BYTES <= size <= _MOST_CONTAINER:
                return at
        at += 4
    return len(data)


def _numbered_frame(message: can.Message) -> LoggedFrame:
    frame = Frame(
        message.arbitration_id,
        b"" if message.is_remote_frame else bytes(message.data),
        round(message.timestamp * 1e6) * 1000,
        message.is_remote_frame,
        message.is_error_frame,
        message.is_extended_id and not message.is_error_frame,
        message.is_fd,
    )
    return LoggedFrame(frame, str(message.channel), not message.is_rx)
