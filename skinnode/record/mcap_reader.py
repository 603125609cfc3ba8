"""Reads the journal and CAN frames from an MCAP file: a recording or a ROS 2 bag with CAN frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from skinnode.errors import ConfigError, Shown
from skinnode.messages.can_frames import frame_of
from skinnode.messages.definitions import (
    CAN_FRAME,
    DEFINITIONS,
    FD_FRAME,
    JOURNAL_LINE,
    OURS,
    version_of,
)
from skinnode.messages.typestore import decode, require_mcap
from skinnode.record.mcap_file import BUS_KEY, SENT_KEY
from skinnode.transport.frame_log import LoggedFrame
from skinnode.transport.frame_log_reader import Damage

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

_RECEIVED_TOPICS = ("from_can_bus", "from_can_bus_fd")
_SENT_TOPICS = ("to_can_bus", "to_can_bus_fd")
"""Last components of the ros2_socketcan topic names for sent frames."""


class McapReader:
    """Iterable over the CAN frames in an MCAP file. A frame's channel is the name of its bus.

    If the file does not name the bus, the channel is the namespace of a ros2_socketcan topic, such as
    ``can0`` in ``/can0/from_can_bus``, or the full name of any other topic.

    Raises:
        ConfigError: The file cannot be read, is not an MCAP file, or contains newer versions of skinnode
            messages; or a package for the mcap extra is missing.
    """

    def __init__(self, path: Path) -> None:
        require_mcap(str(path))
        from skinnode.record.mcap_chunks import McapChunks

        self.path = path
        self._chunks = McapChunks(path, self._check)

    @property
    def damages(self) -> list[Damage]:
        """Damaged parts found so far; only the first few are kept."""
        return self._chunks.damages

    @property
    def damaged(self) -> int:
        """Number of damaged parts found so far."""
        return self._chunks.damaged

    def close(self) -> None:
        """Do nothing, because the file is open only while it is being read."""

    def journal(self) -> Iterator[bytes]:
        """Yield the journal lines."""
        for item in self._chunks.messages((JOURNAL_LINE,), by_index=True):
            try:
                line: str = decode(item.message.data, JOURNAL_LINE).json
            except ValueError as error:
                line = f"{error}"
            yield f"{line}\n".encode()

    def __iter__(self) -> Iterator[LoggedFrame]:
        for item in self._chunks.messages((CAN_FRAME, FD_FRAME)):
            assert item.schema is not None  # selected by its name
            bus, sent = _bus_of(item.channel)
            try:
                yield LoggedFrame(frame_of(item.message.data, item.schema.name), bus, sent)
            except ValueError as error:
                self._chunks.complain(item.offset, f"a message that cannot be read ({error})")

    def _check(self, schema: Schema) -> None:
        """Raise ConfigError if a skinnode message type is newer than this program supports."""
        if not schema.name.startswith(OURS):
            return
        found = version_of(schema.data.decode("utf-8", "replace"))
        known = version_of(DEFINITIONS.get(schema.name, ""))
        if found is not None and known is not None and found > known:
            allowed = f"version {known} or older; a newer skinnode can read this file"
            raise ConfigError(schema.name, Shown(f"version {found}"), allowed, where=str(self.path))


def _bus_of(channel: Channel) -> tuple[str, bool]:
    """Return the bus of a channel's frames and whether the recording program sent them."""
    bus, sent = channel.metadata.get(BUS_KEY), channel.metadata.get(SENT_KEY)
    parent, _, last = channel.topic.rpartition("/")
    if bus is None:
        bus = (parent.strip("/") or "/") if last in (*_RECEIVED_TOPICS, *_SENT_TOPICS) else channel.topic
    return bus, last in _SENT_TOPICS if sent is None else sent == "1"
