"""Encodes and decodes ROS 2 messages as CDR, using rosbags, an optional dependency."""

from __future__ import annotations

import functools
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

from skinnode.errors import ConfigError, Shown
from skinnode.messages.definitions import DEFINITIONS

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_LATEST_NS: Final = 2**31 * 1_000_000_000 - 1


def require_mcap(option: str) -> None:
    """Check that the packages for the ``mcap`` extra are installed.

    Args:
        option: Option or file that requires the packages; used in the error message.

    Raises:
        ConfigError: A package is missing.
    """
    missing = [name for name in ("mcap", "rosbags") if find_spec(name) is None]
    if missing:
        got = Shown(f"no package {' and no package '.join(missing)}")
        raise ConfigError(option, got, "the packages of the mcap extra (install: sh install.sh mcap)")


@functools.cache
def typestore() -> Typestore:
    """Return the rosbags typestore with the ROS 2 Humble standard messages and this project's messages."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for name, definition in DEFINITIONS.items():
        types.update(get_types_from_msg(definition, name))
    store.register(types)
    return store


def message_type(name: str) -> Any:
    """Return the class for a message name such as ``std_msgs/msg/Header``."""
    return typestore().types[name]


def encode(message: object, name: str) -> bytes:
    """Encode a message as little-endian CDR.

    Args:
        message: Instance of ``message_type(name)``.
        name: Name of the message.
    """
    return bytes(typestore().serialize_cdr(message, name, little_endian=True))


def decode(data: bytes, name: str) -> Any:
    """Decode a message from CDR.

    Raises:
        ValueError: The data are not a message of this type.
    """
    from rosbags.serde import SerdeError

    try:
        return typestore().deserialize_cdr(data, name)
    except (SerdeError, AssertionError, IndexError) as error:
        raise ValueError(f"{name}: {error}") from None


@functools.cache
def schema_text(name: str) -> str:
    """Return a message definition, including all nested messages, in ``ros2msg`` format."""
    text, _ = typestore().generate_msgdef(name, ros_version=2)
    return text


def seconds_and_ns(t_ns: int) -> tuple[int, int]:
    """Split a Unix time (ns) into the fields of ``builtin_interfaces/Time``.

    A time before 1970 or after 2038, which the message cannot represent, is clamped to the nearest limit.
    """
    return divmod(min(max(t_ns, 0), _LATEST_NS), 1_000_000_000)


def time_of(t_ns: int) -> Any:
    """Return a ``builtin_interfaces/Time`` for a Unix time (ns)."""
    return message_type("builtin_interfaces/msg/Time")(*seconds_and_ns(t_ns))


def header(t_ns: int, frame_id: str) -> Any:
    """Return a ``std_msgs/Header`` with a Unix time (ns) and the name of a coordinate frame."""
    return message_type("std_msgs/msg/Header")(time_of(t_ns), frame_id)
