"""Every exception this project raises.

::

    SkinError
     ├ ConfigError(ValueError)     which key, what it got, what is allowed
     │  ├ ProfileError             an EDS that contradicts itself or the profile
     │  └ BusLoadError             bus load needed against available
     ├ BusError                    a CAN interface that does not open, send or receive
     │  └ NodeError                one node misbehaves
     │     ├ NodeTimeout(TimeoutError)
     │     └ SdoAbort              code and text of CiA 301
     └ CodecError(ValueError)      a payload that is not what its COB-ID promises

A lost chunk, a stale patch or a solve that did not converge is normal operation: a status and a counter,
never an exception. An argument of the wrong shape is a plain ``ValueError``.
"""

from __future__ import annotations

from typing import Final

from skinnode.text.words import counted


class SkinError(Exception):
    """Root of all errors of this project. ``str(error)`` is one line that a technician can act on."""


class Shown(str):
    """A text that an error shows without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


NOTHING: Final = Shown("nothing")
"""Value that a message shows where a key is missing."""

_MOST_SHOWN: Final = 240


class ConfigError(SkinError, ValueError):
    """A configuration value that cannot be used.

    Args:
        key: Dotted path of the value, such as ``patches[1].node_id``, or name of the option.
        got: Value found there; None if there is none.
        allowed: Phrase that says what is accepted.
        where: File, line and column of the value, if known.
    """

    def __init__(self, key: str, got: object, allowed: str, *, where: str = "") -> None:
        self.key, self.got, self.allowed, self.where = key, got, allowed, where
        prefix = f"{where}: " if where else ""
        shown = repr(NOTHING if got is None else got)
        if len(shown) > _MOST_SHOWN:  # an overlong path, or an array
            shown = f"{shown[: _MOST_SHOWN - 40]}…{shown[-40:]}"
        super().__init__(f"{prefix}{key}: got {shown}, allowed: {allowed}")


class ProfileError(ConfigError):
    """An EDS that contradicts itself or the patch profile."""


class BusLoadError(ConfigError):
    """A plan that needs more of a bus than it may use. ``needed`` and ``available`` are shares of the bus."""

    def __init__(  # noqa: PLR0913 - one argument for each part of the message
        self, key: str, got: object, allowed: str, *, needed: float, available: float, where: str = ""
    ) -> None:
        self.needed, self.available = needed, available
        super().__init__(key, got, allowed, where=where)


class BusError(SkinError):
    """A CAN interface that does not open, send or receive. Raised ``from`` the library's own error."""


class NodeError(BusError):
    """One node does not do what it should."""

    def __init__(self, node_id: int, message: str) -> None:
        self.node_id = node_id
        super().__init__(f"node {node_id}: {message}")


class NodeTimeout(NodeError, TimeoutError):
    """A node did not answer in time."""


class SdoAbort(NodeError):
    """An SDO transfer was aborted; ``code`` is the abort code of CiA 301 table 22."""

    def __init__(self, node_id: int, code: int, text: str) -> None:
        self.code = code
        super().__init__(node_id, f"SDO abort 0x{code:08X}: {text}")


class CodecError(SkinError, ValueError):
    """A payload that cannot be decoded. ``cob_id`` and ``data`` are those of the frame."""

    def __init__(self, cob_id: int, data: bytes, allowed: str) -> None:
        self.cob_id, self.data, self.allowed = cob_id, bytes(data), allowed
        shown = self.data.hex(" ") or "nothing"
        super().__init__(
            f"COB-ID 0x{cob_id:03X}: got {counted(len(self.data), 'byte')} ({shown}), allowed: {allowed}"
        )
