"""CAN bus endpoint with the same behaviour on every type of interface.

python-can errors are converted to :class:`~skinnode.errors.BusError` with a one-line message. Arrival times
are on the host's monotonic clock. The virtual, udp_multicast and socketcan interfaces provide wall-clock
timestamps, which are converted.
"""

from __future__ import annotations

import difflib
import errno
import logging
import threading
from typing import TYPE_CHECKING, Any, Final

import can

from skinnode.canopen.data_length import fd_length
from skinnode.errors import BusError
from skinnode.process import clock
from skinnode.process.closing import Closing
from skinnode.text.words import counted
from skinnode.transport.frame import Frame
from skinnode.transport.frame_interface import FrameInterface, SignallingInterface
from skinnode.transport.multicast import MulticastSocket, limit_to_group, new_tag
from skinnode.transport.socket_options import enlarge_receive_buffer, socket_of
from skinnode.transport.socketcan import BATCH_FRAMES, SocketReader, set_link_bitrate

if TYPE_CHECKING:
    from skinnode.config import BusConfig

VIRTUAL_QUEUE_FRAMES: Final = 32768
"""Capacity of an endpoint's receive queue on python-can's virtual bus, in frames. It holds 4 s of traffic
from a fully loaded 1 Mbit/s bus."""

_OLDEST_STAMP_S: Final = 10.0
"""Maximum plausible age of a timestamp, in s. An older timestamp, or one in the future, does not come from
this machine's wall clock and is replaced by the time at which the frame is read."""

_LINK_GONE: Final = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO)
"""Kernel error codes for an interface that has gone down. The kernel reports this only once, to the next send
or receive call."""

_SOCKETCAN: Final = "socketcan"
_MULTICAST: Final = "udp_multicast"
_VIRTUAL: Final = "virtual"

# Without a handler, programs that do not configure logging would print python-can's warnings to stderr.
# BusError already reports the same errors.
logging.getLogger("can").addHandler(logging.NullHandler())


def is_interface(config: BusConfig) -> bool:
    """Return whether python-can or one of its plugins provides the interface of a bus."""
    return config.interface in can.VALID_INTERFACES


def allowed_interfaces(config: BusConfig) -> str:
    """Return text that lists the names of all interfaces and suggests the closest match."""
    known = ", ".join(sorted(can.VALID_INTERFACES))
    near = difflib.get_close_matches(config.interface.lower(), can.VALID_INTERFACES, 1)
    return f"one of {known}; did you mean {near[0]!r}?" if near else f"one of {known}"


class _Message(can.Message):
    """CAN message that can be copied quickly.

    python-can's virtual bus copies each message for every receiver, and copying a plain ``can.Message`` takes
    five times as long.
    """

    __slots__ = ()

    def __deepcopy__(self, memo: dict[int, Any] | None) -> can.Message:
        copy = _Message.__new__(_Message)
        copy.timestamp = self.timestamp
        copy.arbitration_id = self.arbitration_id
        copy.is_extended_id = self.is_extended_id
        copy.is_remote_frame = self.is_remote_frame
        copy.is_error_frame = self.is_error_frame
        copy.channel = self.channel
        copy.dlc = self.dlc
        copy.data = self.data[:]
        copy.is_fd = self.is_fd
        copy.is_rx = self.is_rx
        copy.bitrate_switch = self.bitrate_switch
        copy.error_state_indicator = self.error_state_indicator
        return copy


def open_can_bus(config: BusConfig) -> can.BusABC:
    """Open a python-can bus. Most programs use :class:`CanPort` instead.

    Args:
        config: Interface, channel, bit rates and options of the bus.

    Raises:
        BusError: if the interface cannot be opened.
    """
    where = _where(config)
    options: dict[str, Any] = {**config.options, "bitrate": config.bitrate_bps}
    if config.interface == _VIRTUAL:
        options["rx_queue_size"] = VIRTUAL_QUEUE_FRAMES
    if config.interface == _MULTICAST or config.fd:
        options["fd"] = True
    if config.fd:
        options["data_bitrate"] = config.data_bitrate_bps
    if config.interface not in can.VALID_INTERFACES:
        raise BusError(f"{where}: no such interface, allowed: {allowed_interfaces(config)}")
    try:
        bus = can.Bus(interface=config.interface, channel=config.channel, ignore_config=True, **options)
    except Exception as error:  # drivers raise OSError, ImportError, TypeError and others
        raise BusError(
            f"{where}: cannot be opened ({_why(error)}), allowed: {_channel_hint(config)}"
        ) from error
    if config.interface in (_MULTICAST, _SOCKETCAN):
        with socket_of(bus.fileno()) as sock:
            enlarge_receive_buffer(sock)
            if config.interface == _MULTICAST:
                limit_to_group(sock)
    return bus


def _where(config: BusConfig) -> str:
    return f"{config.name}: interface {config.interface!r}, channel {config.channel!r}"


class CanPort(Closing):
    """Endpoint on a CAN bus, open until :meth:`close` is called or a ``with`` block ends.

    An endpoint does not receive its own frames. python-can's configuration files and environment variables
    are ignored.

    Threads: any thread may send, but only one thread may receive.

    Args:
        config: Interface, channel, bit rates and options of the bus.

    Raises:
        BusError: if the interface cannot be opened.
    """

    def __init__(self, config: BusConfig) -> None:
        self.config = config
        self._where = _where(config)
        self._longest = 64 if config.fd else 8
        self._closed = False
        self._link_gone: Exception | None = None
        self._counting = threading.Lock()  # protects the counters of send()
        self._sent = self._received = self._errors = self._undelivered = 0
        self._dropped_before = self._malformed_before = 0  # counters of sockets closed by reopen()
        self._away = False
        # Keep the same tag after reopen(), because the kernel may deliver a frame late.
        self._tag = new_tag()
        self._connect()
        self._send_timeout_s = 0.0 if config.interface == _VIRTUAL else None

    def _connect(self) -> None:
        self._bus = self._open()
        self._reader = self._open_reader()
        self._multicast = (
            MulticastSocket(self._bus, self.config.channel, self._tag)
            if self.config.interface == _MULTICAST
            else None
        )
        self._socket = self._multicast or self._reader
        self._direct: FrameInterface | None = self._multicast or _direct(self._bus)
        self._signalling = self._direct if isinstance(self._direct, SignallingInterface) else None
        self._shutdown = (self._multicast or self._bus).shutdown

    def _open(self) -> can.BusABC:
        return open_can_bus(self.config)

    def _open_reader(self) -> SocketReader | None:
        """Return a reader for SocketCAN frames, or None for other interfaces."""
        bus: Any = self._bus  # python-can's SocketcanBus
        return SocketReader(bus.socket) if self.config.interface == _SOCKETCAN else None

    @property
    def reads_batches(self) -> bool:
        """Whether :meth:`recv_batch` may return more than one frame."""
        return self._reader is not None or self._direct is not None

    @property
    def signalling(self) -> SignallingInterface | None:
        """Interface that announces arriving frames by function call; None if a thread must wait for them.

        After :meth:`reopen`, this is a different object.
        """
        return self._signalling

    @property
    def pollable(self) -> bool:
        """Whether :meth:`fileno` returns a file descriptor that can be polled for frames."""
        return self._socket is not None

    def fileno(self) -> int:
        """Return the file descriptor of the socket, or -1 if the port is closed or not pollable."""
        return -1 if self._socket is None else self._socket.fileno()

    @property
    def sent(self) -> int:
        """Number of frames that the interface has accepted for sending."""
        return self._sent

    @property
    def received(self) -> int:
        """Number of frames received from other endpoints."""
        return self._received

    @property
    def errors(self) -> int:
        """Number of send and receive calls that raised BusError."""
        return self._errors

    @property
    def undelivered(self) -> int:
        """Number of frames sent on a virtual bus but lost because a receiving endpoint's queue was full."""
        return self._undelivered

    @property
    def malformed(self) -> int:
        """Number of multicast packets received that were not CAN frames."""
        return self._malformed_before + (0 if self._multicast is None else self._multicast.malformed)

    @property
    def dropped(self) -> int:
        """Number of frames dropped because the kernel's receive buffer was full.

        On udp_multicast, the kernel also counts this endpoint's own frames and malformed packets. On
        interfaces other than socketcan and udp_multicast, the number is 0.
        """
        return self._dropped_before + (0 if self._socket is None else self._socket.dropped)

    def send(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
        """Send a frame with an 11-bit identifier.

        Payloads longer than 8 bytes are sent in a CAN FD frame with bit rate switching, padded with zeros to
        a valid length. On a virtual bus, an endpoint whose receive queue is full loses the frame.

        Args:
            can_id: Identifier, 0 to 0x7FF.
            data: Payload of up to 8 bytes, or up to 64 bytes on a CAN FD bus.
            remote: Whether to send a remote frame.

        Raises:
            BusError: if the interface rejects the frame.
            ValueError: if the identifier or the payload length is out of range.
        """
        if not 0 <= can_id <= 0x7FF:
            raise ValueError(f"can_id: got {can_id}, must be 0 to 0x7FF")
        fd = len(data) > 8
        if fd:
            if len(data) > self._longest:
                raise ValueError(f"data: got {counted(len(data), 'byte')}, must be at most {self._longest}")
            data = data.ljust(fd_length(len(data)), b"\0")
        undelivered = 0
        try:
            if self._direct is not None:
                self._direct.send_frame(can_id, data, remote=remote, fd=fd)
            else:
                self._bus.send(self._message(can_id, data, remote, fd), self._send_timeout_s)
        except (can.CanError, OSError, ValueError) as error:
            if self._closed or self._away or self.config.interface != _VIRTUAL:
                with self._counting:
                    self._errors += 1
                    if getattr(error, "error_code", None) in _LINK_GONE:
                        self._link_gone = error
                raise BusError(f"{self._where}: 0x{can_id:03X} not sent ({_why(error)})") from error
            undelivered = 1
        with self._counting:
            self._sent += 1
            self._undelivered += undelivered

    def _message(self, can_id: int, data: bytes, remote: bool, fd: bool) -> can.Message:
        return _Message(
            arbitration_id=can_id,
            is_extended_id=False,
            is_remote_frame=remote,
            is_fd=fd,
            bitrate_switch=fd,
            data=data,
        )

    def recv(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None if none arrives within ``timeout_s``.

        Raises:
            BusError: if the interface fails or is closed.
        """
        batch = self.recv_batch(timeout_s, 1)
        return batch[0] if batch else None

    def recv_batch(self, timeout_s: float, most: int = BATCH_FRAMES) -> list[Frame]:
        """Return the frames that have arrived; if there are none, wait for the next frame.

        Args:
            timeout_s: Maximum time to wait for a frame, in s.
            most: Maximum number of frames. Interfaces other than socketcan, udp_multicast and timed return
                one frame at a time.

        Raises:
            BusError: if the interface fails or is closed.
        """
        if self._reader is None and self._direct is None:
            return self._recv_message(timeout_s)
        try:
            if self._direct is not None:
                frames = self._direct.read_frames(timeout_s, most)
            else:
                assert self._reader is not None
                frames = self._reader.read(timeout_s, most)
        except (can.CanError, OSError, ValueError) as error:  # ValueError: the socket was closed
            self._errors += 1
            raise BusError(f"{self._where}: cannot receive ({_why(error)})") from error
        self._received += len(frames)
        if not frames and self._link_gone is not None:
            self._errors += 1
            raise BusError(f"{self._where}: cannot receive ({_why(self._link_gone)})") from self._link_gone
        return frames

    def _recv_message(self, timeout_s: float) -> list[Frame]:
        try:
            message = self._bus.recv(timeout_s)
        except (can.CanError, OSError, ValueError) as error:
            self._errors += 1
            raise BusError(f"{self._where}: cannot receive ({_why(error)})") from error
        if message is None:
            return []
        self._received += 1
        return [_frame(message)]

    def reopen(self) -> None:
        """Close and reopen the interface after a failure. The counters are not reset.

        The receiving thread must have ended. While the interface is closed, :meth:`send` raises BusError.

        Raises:
            BusError: if the interface cannot be opened. The caller may try again.
        """
        if not self._away:
            self._away = True
            self._dropped_before, self._malformed_before = self.dropped, self.malformed
            self._reader = self._socket = self._multicast = None
            self._shutdown()
        self._link_gone = None
        self._connect()
        self._away = False

    def set_bitrate(self, bitrate_bps: int) -> None:
        """Change the bit rate and reopen the interface.

        The receiving thread must have ended. On socketcan, the bit rate is set with ``ip link``, which
        requires the CAP_NET_ADMIN capability.

        Raises:
            BusError: if the interface rejects the bit rate. The interface is then open at the previous bit
                rate.
        """
        before = self.config
        self.config = before.model_copy(update={"bitrate_bps": bitrate_bps})
        try:
            if self.config.interface == _SOCKETCAN:
                set_link_bitrate(self.config)
        except BusError:
            self.config = before
            raise
        finally:
            self.reopen()

    def close(self) -> None:
        """Close the interface. The receiving thread must have ended. Repeated calls have no effect."""
        if not self._closed:
            self._closed = True
            self._shutdown()

    def __repr__(self) -> str:
        return f"<CanPort {self._where}>"


def _direct(bus: can.BusABC) -> FrameInterface | None:
    return bus if isinstance(bus, FrameInterface) else None


def _frame(message: can.Message) -> Frame:
    now_ns = clock.monotonic_ns()
    age_s = clock.time() - message.timestamp
    if 0.0 < age_s < _OLDEST_STAMP_S:
        now_ns -= int(age_s * 1e9)
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        now_ns,
        message.is_remote_frame,
        message.is_error_frame,
        message.is_extended_id,
        message.is_fd,
    )


def _why(error: BaseException) -> str:
    """Return the message of the original exception in a chain of exceptions, as a single line."""
    while error.__cause__ is not None:
        error = error.__cause__
    if error.__context__ is not None and isinstance(error.__context__, OSError):
        error = error.__context__
    return " ".join(str(error).split()) or type(error).__name__


def _channel_hint(config: BusConfig) -> str:
    match config.interface:
        case "socketcan":
            return "a CAN network interface that exists and is up (see `ip -details link show type can`)"
        case "udp_multicast":
            return "a multicast address of a network that is up, such as 239.74.163.2"
        case _:
            return f"a channel that python-can's {config.interface} interface can open"
