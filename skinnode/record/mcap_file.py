"""Writes a recording to a single MCAP file: frames, journal, fields, contacts, health and events.

The file consists of chunks. Each :meth:`McapFile.flush` ends a chunk and passes it to the operating system.
If the process is killed, the file contains every chunk up to the last flush and lacks only the index at its
end.

A message's log time is the time at which the recorder received it. A frame's publish time is its arrival
time; a field's publish time is the time at which the field was solved.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skinnode.config import HandConfig
from skinnode.files.whole_file import discard
from skinnode.host.events import HealthEvent
from skinnode.host.health import BusHealth, PatchHealth
from skinnode.host.skeleton import Skeleton
from skinnode.messages.can_frames import FrameEncoder
from skinnode.messages.contacts import WRENCH, contact_wrenches, contacts_message
from skinnode.messages.definitions import CAN_FRAME, CONTACTS, FD_FRAME, FIELD_INFO, JOURNAL_LINE
from skinnode.messages.fields import POINT_CLOUD, field_info, point_cloud
from skinnode.messages.health import DIAGNOSTIC_ARRAY, LOG, diagnostics, log_message
from skinnode.messages.poses import TRANSFORMS, transforms
from skinnode.messages.topics import DIAGNOSTICS, TF_STATIC, HandTopics
from skinnode.messages.typestore import encode, message_type, require_mcap, schema_text
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from skinnode.transport.frame import Frame
from skinnode.transport.frame_log import create_binary

if TYPE_CHECKING:
    from collections.abc import Mapping

MCAP: Final = ".mcap"
PROFILE: Final = "ros2"
BUS_KEY: Final = "skinnode.bus"
"""Channel metadata key: name of the bus whose frames the channel contains."""
SENT_KEY: Final = "skinnode.sent"
"""Channel metadata key: ``1`` if the host sent the channel's frames, otherwise ``0``."""
CHUNK_BYTES: Final = 1 << 20
"""Maximum uncompressed chunk size in bytes."""

_LATCHED: Final = """\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""
"""QoS of ``/tf_static``, as written by rosbag2: reliable and transient local."""


class McapFile:
    """MCAP file of a recording. Only one thread may write to it.

    All write methods raise OSError if writing fails.

    Args:
        path: Path of the new file.
        hand: The hand.

    Raises:
        ConfigError: The file already exists or cannot be created, or a package for the mcap extra is missing.
    """

    def __init__(self, path: Path, hand: HandConfig) -> None:
        require_mcap(str(path))
        from mcap.writer import CompressionType, Writer

        self.path, self._hand = path, hand
        self._topics = HandTopics.of(hand)
        self._skeleton = Skeleton.of(hand)
        self._file = create_binary(path)
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile=PROFILE, library="skinnode")
        self._encoders = {bus.name: FrameEncoder(bus.name) for bus in hand.buses}
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[int, int] = {}
        self._frame_channels: dict[tuple[str, bool, bool], int] = {}
        self.frames = 0
        """Number of CAN frames written."""
        self.fields = 0
        """Number of fields written."""

    def write(self, bus: str, frame: Frame, *, sent: bool, log_ns: int) -> None:
        """Write a CAN frame.

        Args:
            bus: Name of the bus.
            frame: The frame; ``t_ns`` is a Unix time.
            sent: Whether the host sent the frame.
            log_ns: Unix time at which the recorder received the frame, in ns.
        """
        channel = self._frame_channels.get((bus, sent, frame.fd))
        if channel is None:
            channel = self._frame_channels[bus, sent, frame.fd] = self._frame_channel(bus, sent, frame.fd)
        self._add(channel, self._encoders[bus].encode(frame), frame.t_ns, log_ns)
        self.frames += 1

    def write_line(self, line: str, log_ns: int) -> None:
        """Write a journal line."""
        self._write(self._topics.journal, JOURNAL_LINE, message_type(JOURNAL_LINE)(line), log_ns, log_ns)

    def write_field(self, field: FieldFrame, rest_m: Float, offset_ns: int, log_ns: int) -> None:
        """Write a field and its contacts.

        Args:
            field: The field; must have a stamp.
            rest_m: (U, N, 3) electrode positions at rest, in m.
            offset_ns: Unix time minus time on the stamp's clock, in ns.
            log_ns: Unix time at which the recorder received the field, in ns.
        """
        stamp = field.stamp
        assert stamp is not None
        topics = self._topics.patches[stamp.patch]
        t_ns = (stamp.t_sync_ns or stamp.t_receive_ns) + offset_ns
        solved_ns = (stamp.t_solved_ns or stamp.t_receive_ns) + offset_ns
        self._write(topics.field, POINT_CLOUD, point_cloud(field, rest_m, t_ns), solved_ns, log_ns)
        self._write(topics.field_info, FIELD_INFO, field_info(field, t_ns), solved_ns, log_ns)
        self._write(topics.contacts, CONTACTS, contacts_message(field, t_ns), solved_ns, log_ns)
        for wrench in contact_wrenches(field, t_ns):
            self._write(topics.contact_wrenches, WRENCH, wrench, solved_ns, log_ns)
        self.fields += 1

    def write_health(
        self, patches: Mapping[str, PatchHealth], buses: Mapping[str, BusHealth], log_ns: int
    ) -> None:
        """Write the health of all patches and buses, and the poses of all patches and links."""
        health = diagnostics(self._hand.name, patches, buses, log_ns)
        self._write(DIAGNOSTICS, DIAGNOSTIC_ARRAY, health, log_ns, log_ns)
        self._write(TF_STATIC, TRANSFORMS, transforms(self._skeleton, log_ns), log_ns, log_ns)

    def write_event(self, event: HealthEvent, offset_ns: int, log_ns: int) -> None:
        """Write an event; ``offset_ns`` is the Unix time minus the time on the event's clock."""
        t_ns = event.t_ns + offset_ns
        self._write(self._topics.events, LOG, log_message(event, t_ns), t_ns, log_ns)

    def flush(self, *, to_disk: bool) -> None:
        """End the chunk and pass it to the operating system, so that it survives if the process is killed.

        Args:
            to_disk: Whether to wait until the file is on disk, where it would survive a power failure.
        """
        self._writer.flush()
        if to_disk:
            os.fsync(self._file.fileno())

    def flush_journal(self) -> None:
        """Flush the journal and everything else written so far."""
        self.flush(to_disk=False)

    def close(self) -> None:
        """Write the index to disk and close the file, even if writing fails."""
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()

    def discard(self) -> None:
        """Close and delete the file."""
        with contextlib.suppress(Exception):  # the file may already be closed
            self.close()
        discard(self.path)

    def _write(self, topic: str, name: str, message: Any, publish_ns: int, log_ns: int) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._register(topic, name, {})
        self._add(channel, encode(message, name), publish_ns, log_ns)

    def _add(self, channel: int, data: bytes, publish_ns: int, log_ns: int) -> None:
        sequence = self._sequence[channel]
        self._sequence[channel] = (sequence + 1) & 0xFFFF_FFFF
        self._writer.add_message(channel, max(log_ns, 0), data, max(publish_ns, 0), sequence)

    def _frame_channel(self, bus: str, sent: bool, fd: bool) -> int:
        topics = self._topics.buses[bus]
        topic = (topics.received, topics.sent, topics.received_fd, topics.sent_fd)[2 * fd + sent]
        metadata = {BUS_KEY: bus, SENT_KEY: str(int(sent))}
        return self._register(topic, FD_FRAME if fd else CAN_FRAME, metadata)

    def _register(self, topic: str, name: str, metadata: dict[str, str]) -> int:
        schema = self._schemas.get(name)
        if schema is None:
            text = schema_text(name).encode()
            schema = self._schemas[name] = self._writer.register_schema(name, "ros2msg", text)
        qos = _LATCHED if topic == TF_STATIC else ""
        metadata = {"offered_qos_profiles": qos, **metadata}
        channel: int = self._writer.register_channel(topic, "cdr", schema, metadata)
        self._channels[topic] = channel
        self._sequence[channel] = 0
        return channel
