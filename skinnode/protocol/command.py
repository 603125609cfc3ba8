"""Packs and unpacks RPDO1, in which a host sends commands to a patch."""

from __future__ import annotations

import enum
import struct
from typing import Final, NamedTuple

from skinnode.canopen import indices as od
from skinnode.errors import CodecError

_COB_ID: Final = od.command_cob_id(0)


class SendMode(enum.IntEnum):
    """Send mode of a patch (0x2020:1): all chunks of each scan, or only changed chunks."""

    FULL = 0
    CHANGED = 1


class Command(NamedTuple):
    """Contents of a command, as sent on the bus."""

    tare: int
    """Tare command: :data:`~skinnode.canopen.indices.TARE_SIGNATURE` to tare; other values have no effect."""
    single_scan: int
    """Single-scan command: 1 to take one scan immediately, 0 for none."""
    send_mode: int
    """Value of :class:`SendMode`."""


_COMMAND: Final = struct.Struct("<IBB")


def pack_command(
    *, tare: bool = False, single_scan: bool = False, send_mode: SendMode = SendMode.FULL
) -> bytes:
    """Pack the payload of RPDO1.

    Args:
        tare: Whether to make the current resistances the baseline.
        single_scan: Whether to take one scan immediately.
        send_mode: Send mode of the patch from now on.
    """
    return _COMMAND.pack(od.TARE_SIGNATURE if tare else 0, single_scan, send_mode)


def unpack_command(data: bytes, *, cob_id: int = _COB_ID) -> Command:
    """Unpack the payload of RPDO1. Bytes beyond the six mapped bytes are ignored (CiA 301).

    Args:
        data: Payload of the frame.
        cob_id: COB-ID for the error message.

    Raises:
        CodecError: If the payload is shorter than six bytes.
    """
    if len(data) < _COMMAND.size:
        raise CodecError(cob_id, data, f"at least {_COMMAND.size} bytes (command)")
    return Command(*_COMMAND.unpack_from(data))
