"""Defines options and arguments used by several commands, and their shell completions."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.errors import SkinError

if TYPE_CHECKING:
    from skinnode.config import PatchConfig


def node_ids(ctx: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """Return shell completions for a node-ID, each with the name of its patch.

    The completions are the node-IDs in the --hand file or, by default, in hand.toml. If the file contains no
    node-IDs or cannot be read, all node-IDs are offered.
    """
    patches = _patches(ctx)
    offered = [(str(patch.node_id), patch.name) for patch in patches]
    return _beginning(incomplete, offered or [(str(node_id), "") for node_id in range(1, 128)])


def nodes(ctx: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """Return shell completions for NODE: node-IDs, and the names of patches if --hand is given."""
    named = _patches(ctx) if ctx.params.get("hand") is not None else []
    return node_ids(ctx, incomplete) + _beginning(incomplete, [(p.name, f"node {p.node_id}") for p in named])


def _patches(ctx: typer.Context) -> list[PatchConfig]:
    from skinnode.config import load_hand

    bus = ctx.params.get("bus")
    try:
        hand = load_hand(ctx.params.get("hand") or "hand.toml")
    except (SkinError, OSError):  # shell completion cannot show an error message
        return []
    return [patch for patch in hand.patches if bus in (None, patch.bus)]


def _beginning(incomplete: str, offered: list[tuple[str, str]]) -> list[tuple[str, str]]:
    return [(value, text) for value, text in offered if value.startswith(incomplete)]


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value < math.inf:
        raise typer.BadParameter(f"{text!r} is not a non-negative number of seconds")
    return value


Interface = Annotated[
    str | None, typer.Option(help="python-can interface; default socketcan.", metavar="NAME")
]
Channel = Annotated[str | None, typer.Option(help="Channel of the interface; default can0.", metavar="NAME")]
OtherInterface = Annotated[
    str | None,
    typer.Option(help="python-can interface to use instead of the interface in the file.", metavar="NAME"),
]
OtherChannel = Annotated[
    str | None, typer.Option(help="Channel to use instead of the channel in the file.", metavar="NAME")
]
Bitrate = Annotated[int | None, typer.Option(help="Bits per second; default 1000000.", metavar="BPS")]
Fd = Annotated[bool, typer.Option("--fd", help="Send PDOs in CAN FD frames.")]
Hand = Annotated[
    Path | None, typer.Option(help="Use the buses and patch names of this hand.", metavar="HAND.toml")
]
Bus = Annotated[
    str | None,
    typer.Option(help="Bus of the hand; default: the bus of the patch, or all buses.", metavar="NAME"),
]
Node = Annotated[
    str,
    typer.Argument(
        help="Node-ID, or the name of a patch in the --hand file.", metavar="NODE", autocompletion=nodes
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
JsonLines = Annotated[bool, typer.Option("--json", help="Print one JSON object per line instead of text.")]
Seconds = Annotated[
    float | None,
    typer.Option(
        parser=_seconds, help="End after this many seconds; default: run until Ctrl-C.", metavar="S"
    ),
]
