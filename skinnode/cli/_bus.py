"""Finds the bus and node that a command's options specify, with or without a hand file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from skinnode.config import BusConfig, HandConfig, PatchConfig


class Place(NamedTuple):
    """A bus and the hand that contains it; the hand is None if no hand file is given."""

    bus: BusConfig
    hand: HandConfig | None

    @property
    def patches(self) -> tuple[PatchConfig, ...]:
        """The hand's patches on the bus; empty if no hand file is given."""
        return () if self.hand is None else self.hand.patches_on(self.bus.name)

    def patch_name(self, node_id: int) -> str:
        """Return the name of the patch with this node-ID, or an empty string."""
        return next((patch.name for patch in self.patches if patch.node_id == node_id), "")


def find_buses(
    interface: str | None,
    channel: str | None,
    bitrate: int | None,
    fd: bool,
    hand: Path | None,
    bus: str | None,
) -> list[Place]:
    """Return the bus that the options specify or, without ``--bus``, every bus of the hand.

    Args:
        interface: Value of ``--interface``.
        channel: Value of ``--channel``.
        bitrate: Value of ``--bitrate``, in bits per second.
        fd: Whether ``--fd`` is given.
        hand: Value of ``--hand``.
        bus: Value of ``--bus``.

    Raises:
        ConfigError: The options are not valid.
    """
    from skinnode.errors import ConfigError

    if hand is None:
        if bus is not None:
            raise ConfigError("--bus", bus, "only with a hand file")
        return [Place(bus_of(interface, channel, bitrate, fd), None)]
    plan = _of_one_bus(_load(hand, bitrate, fd), bus).on(interface, channel)
    return [Place(item, plan) for item in plan.buses]


def bus_of(
    interface: str | None,
    channel: str | None,
    bitrate: int | None,
    fd: bool,
    data_bitrate: int = 5_000_000,
) -> BusConfig:
    """Return the bus that the options specify without a hand file; its name is that of the channel.

    Raises:
        ConfigError: An option is not valid.
    """
    from pydantic import ValidationError

    from skinnode.config import BusConfig
    from skinnode.errors import ConfigError

    try:
        return BusConfig(
            name="can0" if channel is None else channel[:64],
            interface="socketcan" if interface is None else interface,
            channel="can0" if channel is None else channel,
            bitrate_bps=1_000_000 if bitrate is None else bitrate,
            fd=fd,
            data_bitrate_bps=data_bitrate,
        )
    except ValidationError as error:
        wrong = error.errors()[0]
        if wrong["loc"][0] == "bitrate_bps":
            raise ConfigError("--bitrate", wrong["input"], "a bit rate from 10000 to 1000000") from None
        option = "--interface" if wrong["loc"][0] == "interface" else "--channel"
        raise ConfigError(option, wrong["input"], "a name of printable characters") from None


def find_bus(
    interface: str | None,
    channel: str | None,
    bitrate: int | None,
    fd: bool,
    hand: Path | None,
    bus: str | None,
) -> Place:
    """Return the single bus that the options specify. The arguments are the same as for :func:`find_buses`.

    Raises:
        ConfigError: The options are not valid, or they match several buses.
    """
    from skinnode.errors import NOTHING, ConfigError

    places = find_buses(interface, channel, bitrate, fd, hand, bus)
    if len(places) > 1:
        raise ConfigError("--bus", NOTHING, f"one of {', '.join(place.bus.name for place in places)}")
    return places[0]


def _of_one_bus(plan: HandConfig, bus: str | None) -> HandConfig:
    """Return the hand with only ``bus`` and its patches, or the whole hand if ``bus`` is None."""
    from skinnode.errors import ConfigError

    if bus is None:
        return plan
    names = [item.name for item in plan.buses]
    if bus not in names:
        raise ConfigError("--bus", bus, f"one of {', '.join(names)}")
    return plan.model_copy(update={"buses": (plan.bus(bus),), "patches": plan.patches_on(bus)})


def _load(hand: Path, bitrate: int | None, fd: bool) -> HandConfig:
    """Load a hand file, after checking that neither ``--bitrate`` nor ``--fd`` is given."""
    from skinnode.config import load_hand
    from skinnode.errors import ConfigError, Shown

    for option, value in (("--bitrate", bitrate), ("--fd", Shown("yes") if fd else None)):
        if value is not None:
            raise ConfigError(option, value, "only without a hand file, because the hand file sets it")
    return load_hand(hand)


def find_node(
    node: str,
    interface: str | None,
    channel: str | None,
    bitrate: int | None,
    fd: bool,
    hand: Path | None,
    bus: str | None,
) -> tuple[Place, int]:
    """Return the bus and node-ID of NODE: a node-ID, or the name of a patch on any bus of the hand.

    The other arguments are the same as for :func:`find_buses`.

    Raises:
        ConfigError: No patch has this name, or the bus of the node-ID is ambiguous.
    """
    places = find_buses(interface, channel, bitrate, fd, hand, bus)
    return node_among(node, places, "NODE")


def node_among(node: str, places: list[Place], key: str) -> tuple[Place, int]:
    """Return the bus and node-ID of a node.

    The name of a patch takes precedence, because a name that is a number is not always the patch's node-ID.

    Args:
        node: The name of a patch or a node-ID.
        places: Buses to search.
        key: Name of the command-line argument that contains the node, for error messages.

    Raises:
        ConfigError: No patch has this name, or the bus of the node-ID is ambiguous.
    """
    from skinnode.errors import ConfigError

    named = [(place, patch) for place in places for patch in place.patches]
    for place, patch in named:
        if patch.name == node:
            return place, patch.node_id
    try:
        node_id = int(node, 0)
    except ValueError:
        known = f", or {', '.join(patch.name for _, patch in named)}" if named else ""
        raise ConfigError(key, node, f"a node-ID from 1 to 127{known}") from None
    if not 1 <= node_id <= 127:
        raise ConfigError(key, node_id, "a node-ID from 1 to 127")
    if len(places) == 1:
        return places[0], node_id
    found = [(place, patch) for place, patch in named if patch.node_id == node_id]
    if len(found) == 1:
        return found[0][0], node_id
    buses = " or ".join(f"--bus {place.bus.name}" for place in places)
    if not found:
        raise ConfigError(key, node_id, f"a node-ID in the hand, or any node-ID with {buses}")
    which = " and ".join(f"{patch.name} on {place.bus.name}" for place, patch in found)
    raise ConfigError(
        key,
        node_id,
        f"a node-ID that is on one bus only; this node-ID is {which}; name the patch, or add {buses}",
    )
