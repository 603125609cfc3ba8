"""Replays recorded CAN traces with their original timing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skinnode.errors import BusError, ConfigError
from skinnode.process import clock
from skinnode.transport import CanPort, Frame
from skinnode.transport.frame_log import LoggedFrame
from skinnode.transport.frame_log_reader import FrameLogReader
from vcan_sim.recording import TRACE
from vcan_sim.tally import Kind, kind_of

FROM_NODES: Final = frozenset(
    {
        Kind.EMCY,
        Kind.CHUNK,
        Kind.SUMMARY,
        Kind.SDO_RESPONSE,
        Kind.HEARTBEAT,
        Kind.BOOT_UP,
        Kind.LSS_RESPONSE,
    }
)
"""Kinds of frames that nodes send. Hosts send the other kinds, and possibly heartbeats."""
_DRAINED_EVERY: Final = 64
"""Number of frames sent before the receive queues are cleared again."""


@dataclass(frozen=True, slots=True)
class Replayed:
    """Frame counts and duration of a replay."""

    sent: int
    left_out: int
    """Number of frames left out: unselected frames, extended frames, error frames and, on a classic CAN bus,
    CAN FD frames."""
    refused: int
    """Number of frames that the bus refused."""
    seconds: float
    """Duration of the replay, in s."""


def trace_of(recording: Path) -> Path:
    """Return the trace file of a recording.

    Args:
        recording: Folder of a recording, or a trace file.

    Raises:
        ConfigError: If there is no such file.
    """
    file = recording / TRACE if recording.is_dir() else recording
    if not file.is_file():
        raise ConfigError("RECORDING", str(recording), f"a folder with a {TRACE}, or a trace")
    return file


def channels_in(trace: Path) -> list[str]:
    """Return the channel names in a trace, in order of first appearance.

    Args:
        trace: Trace file.

    Raises:
        ConfigError: If the file cannot be read, or contains no frame.
    """
    found = list(dict.fromkeys(logged.channel for logged in FrameLogReader(trace)))
    if not found:
        raise ConfigError(
            "RECORDING", str(trace), "a trace in the format of candump -L with at least one frame"
        )
    return found


def replay(
    frames: Iterable[LoggedFrame],
    ports: Mapping[str, CanPort],
    *,
    wait: Callable[[float], bool],
    from_nodes: bool = False,
) -> Replayed:
    """Send recorded frames with their original timing.

    Args:
        frames: Recorded frames. Overdue frames are sent immediately.
        ports: Open endpoint for each channel. Frames from other channels are left out.
        wait: Function that waits for a given number of seconds and returns True to end the replay.
        from_nodes: Whether to send only the frames that nodes send.

    Returns:
        Frame counts and duration of the replay.
    """
    begin_ns, first_ns = clock.monotonic_ns(), None
    sent = left_out = refused = 0
    for logged in frames:
        frame = logged.frame
        first_ns = frame.t_ns if first_ns is None else first_ns
        port = ports.get(logged.channel)
        if port is None or not _can_send(port, frame) or (from_nodes and not _is_from_node(frame)):
            left_out += 1
            continue
        left_s = (begin_ns + frame.t_ns - first_ns - clock.monotonic_ns()) * 1e-9
        if left_s > 0.0 and wait(left_s):
            break
        try:
            port.send(frame.can_id, frame.data, remote=frame.remote)
            sent += 1
        except BusError:
            refused += 1
        if (sent + refused) % _DRAINED_EVERY == 0:
            for each in ports.values():
                _drain(each)
    return Replayed(sent, left_out, refused, (clock.monotonic_ns() - begin_ns) * 1e-9)


def _can_send(port: CanPort, frame: Frame) -> bool:
    return not (frame.extended or frame.error or (frame.fd and not port.config.fd))


def _is_from_node(frame: Frame) -> bool:
    return kind_of(frame.can_id, frame.data, frame.remote) in FROM_NODES


def _drain(port: CanPort) -> None:
    """Discard all received frames to keep the receive queue from filling up."""
    try:
        while port.recv(0.0) is not None:
            pass
    except BusError:  # the next send reports the error
        return
