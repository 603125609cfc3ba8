"""The bus a command works on: by its interface, or one of a hand file; and the node on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from skinnode.errors import SkinError

if TYPE_CHECKING:
    from skinnode.model.config import BusConfig, HandConfig, PatchConfig


def node_ids(ctx: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """What a shell offers for a node-ID: those of the hand, --hand or hand.toml where there is one, with the
    names of their patches; else all."""
    patches = _patches(ctx)
    offered = [(str(patch.node_id), patch.name) for patch in patches]
    return _beginning(incomplete, offered or [(str(node_id), "") for node_id in range(1, 128)])


def nodes(ctx: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """The same, and the names of patches where --hand is given."""
    named = _patches(ctx) if ctx.params.get("hand") is not None else []
    return node_ids(ctx, incomplete) + _beginning(incomplete, [(p.name, f"node {p.node_id}") for p in named])


def _patches(ctx: typer.Context) -> list[PatchConfig]:
    from skinnode.model.config import load_hand

    bus = ctx.params.get("bus")
    try:
        hand = load_hand(ctx.params.get("hand") or "hand.toml")
    except (SkinError, OSError):  # a shell cannot be told what is wrong
        return []
    return [patch for patch in hand.patches if bus in (None, patch.bus)]


def _beginning(incomplete: str, offered: list[tuple[str, str]]) -> list[tuple[str, str]]:
    return [(value, text) for value, text in offered if value.startswith(incomplete)]


Interface = Annotated[
    str | None, typer.Option(help="python-can interface; default socketcan.", metavar="NAME")
]
Channel = Annotated[str | None, typer.Option(help="Its channel; default can0.", metavar="NAME")]
OtherInterface = Annotated[
    str | None, typer.Option(help="python-can interface instead of the file's.", metavar="NAME")
]
OtherChannel = Annotated[
    str | None, typer.Option(help="Channel of the interface instead of the file's.", metavar="NAME")
]
Bitrate = Annotated[int | None, typer.Option(help="Bits per second; default 1000000.", metavar="BPS")]
Fd = Annotated[bool, typer.Option("--fd", help="PDOs over CAN FD.")]
Hand = Annotated[
    Path | None, typer.Option(help="Take the bus from this hand; patches by name.", metavar="HAND.toml")
]
Bus = Annotated[str | None, typer.Option(help="Which bus of the hand.", metavar="NAME")]
Node = Annotated[
    str,
    typer.Argument(help="Node-ID, or the name of a patch of --hand.", metavar="NODE", autocompletion=nodes),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


class Place(NamedTuple):
    """A bus, and the hand it belongs to."""

    bus: BusConfig
    hand: HandConfig | None

    def patch_name(self, node_id: int) -> str:
        """What the hand calls the patch at that node-ID; empty for none."""
        if self.hand is None:
            return ""
        return next((p.name for p in self.hand.patches_on(self.bus.name) if p.node_id == node_id), "")


def find_bus(
    interface: str | None,
    channel: str | None,
    bitrate: int | None,
    fd: bool,
    hand: Path | None,
    bus: str | None,
) -> Place:
    """The bus that the options name. Raises ConfigError."""
    from pydantic import ValidationError

    from skinnode.errors import ConfigError
    from skinnode.model.config import BusConfig

    if hand is None:
        if bus is not None:
            raise ConfigError("--bus", bus, "nothing without a hand file")
        try:
            config = BusConfig(
                name="can0" if channel is None else channel[:64],
                interface="socketcan" if interface is None else interface,
                channel="can0" if channel is None else channel,
                bitrate_bps=1_000_000 if bitrate is None else bitrate,
                fd=fd,
            )
        except ValidationError as error:
            wrong = error.errors()[0]
            if wrong["loc"][0] == "bitrate_bps":
                raise ConfigError("--bitrate", wrong["input"], "a bit rate from 10000 to 1000000") from None
            option = "--interface" if wrong["loc"][0] == "interface" else "--channel"
            raise ConfigError(option, wrong["input"], "a name of printable characters") from None
        return Place(config, None)
    plan = find_hand(hand, interface, channel, bitrate, fd)
    names = [item.name for item in plan.buses]
    if bus is None and len(names) > 1:
        raise ConfigError("--bus", bus, f"one of {', '.join(names)}")
    if bus is not None and bus not in names:
        raise ConfigError("--bus", bus, f"one of {', '.join(names)}")
    return Place(plan.bus(bus or names[0]), plan)


def find_hand(
    hand: Path, interface: str | None, channel: str | None, bitrate: int | None, fd: bool
) -> HandConfig:
    """The hand of that file, on another interface or channel if they are given. Raises ConfigError."""
    from skinnode.errors import ConfigError
    from skinnode.model.config import load_hand

    for option, value in (("--bitrate", bitrate), ("--fd", fd or None)):
        if value is not None:
            raise ConfigError(option, value, "nothing beside a hand file, which says it")
    return load_hand(hand).on(interface, channel)


def find_node(node: str, place: Place) -> int:
    """The node-ID that an argument means. Raises ConfigError."""
    from skinnode.errors import ConfigError

    try:
        node_id = int(node, 0)
    except ValueError:
        patches = () if place.hand is None else place.hand.patches_on(place.bus.name)
        for patch in patches:
            if patch.name == node:
                return patch.node_id
        named = f", or {', '.join(patch.name for patch in patches)}" if patches else ""
        raise ConfigError("NODE", node, f"a node-ID from 1 to 127{named}") from None
    if not 1 <= node_id <= 127:
        raise ConfigError("NODE", node_id, "a node-ID from 1 to 127")
    return node_id
