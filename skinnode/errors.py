"""Exceptions of this project.

::

    SkinError
     ├ ConfigError(ValueError)     names the key, the value found and the values allowed
     │  ├ ProfileError             an EDS contradicts itself or the profile
     │  └ BusLoadError             the planned bus load exceeds a limit
     ├ BusError                    a CAN interface fails to open, send or receive
     │  └ NodeError                a node violates the protocol
     │     ├ NodeTimeout(TimeoutError)
     │     └ SdoAbort              with the code and text from CiA 301
     └ CodecError(ValueError)      a payload does not match its COB-ID

Lost chunks, stale patches and solves that do not converge occur in normal operation. They are reported by
statuses and counters, not by exceptions. An array of the wrong shape raises a plain ``ValueError``.
"""

from __future__ import annotations

from typing import Final

from skinnode.text.words import counted


class SkinError(Exception):
    """Base class of all skinnode exceptions; ``str(error)`` is a one-line message for a technician."""


class Shown(str):
    """String shown without quotes in error messages."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


NOTHING: Final = Shown("nothing")
"""Value shown for a missing key in error messages."""

_MOST_SHOWN: Final = 240


class ConfigError(SkinError, ValueError):
    """Invalid value in a configuration file, in another input file, or on the command line.

    Args:
        key: Dotted path of the key, such as ``patches[1].node_id``, or the name of the option.
        got: Value found; None if there is none.
        allowed: Description of the valid values.
        where: File, line and column of the value, if known.
    """

    def __init__(self, key: str, got: object, allowed: str, *, where: str = "") -> None:
        self.key, self.got, self.allowed, self.where = key, got, allowed, where
        prefix = f"{where}: " if where else ""
        shown = repr(NOTHING if got is None else got)
        if len(shown) > _MOST_SHOWN:  # such as an array or a long path
            shown = f"{shown[: _MOST_SHOWN - 40]}…{shown[-40:]}"
        super().__init__(f"{prefix}{key}: got {shown}, allowed: {allowed}")


class ProfileError(ConfigError):
    """EDS that contradicts itself or the patch profile."""


class BusLoadError(ConfigError):
    """Planned bus load above a limit; ``needed`` and ``available`` are fractions of the bus capacity."""

    def __init__(  # noqa: PLR0913 - one argument per part of the message
        self, key: str, got: object, allowed: str, *, needed: float, available: float, where: str = ""
    ) -> None:
        self.needed, self.available = needed, available
        super().__init__(key, got, allowed, where=where)


class BusError(SkinError):
    """Failure to open a CAN interface, or to send or receive on it; the cause is the python-can error."""


class NodeError(BusError):
    """Protocol violation by a CANopen node, or failure to communicate with it."""

    def __init__(self, node_id: int, message: str) -> None:
        self.node_id = node_id
        super().__init__(f"node {node_id}: {message}")


class NodeTimeout(NodeError, TimeoutError):
    """A node did not respond in time."""


class SdoAbort(NodeError):
    """Aborted SDO transfer; ``code`` is the SDO abort code (CiA 301, table 22)."""

    def __init__(self, node_id: int, code: int, text: str) -> None:
        self.code = code
        super().__init__(node_id, f"SDO abort 0x{code:08X}: {text}")


class CodecError(SkinError, ValueError):
    """Frame whose payload cannot be decoded; ``cob_id`` and ``data`` are its COB-ID and payload."""

    def __init__(self, cob_id: int, data: bytes, allowed: str) -> None:
        self.cob_id, self.data, self.allowed = cob_id, bytes(data), allowed
        shown = self.data.hex(" ") or "nothing"
        super().__init__(
            f"COB-ID 0x{cob_id:03X}: got {counted(len(self.data), 'byte')} ({shown}), allowed: {allowed}"
        )
