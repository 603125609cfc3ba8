"""``vcan-sim replay``: replay a recorded bus trace on a bus."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinnode.cli._options import Hand, OtherChannel, OtherInterface

if TYPE_CHECKING:
    from skinnode.config import BusConfig


def replay(
    recording: Annotated[
        Path,
        typer.Argument(
            help="Folder created by `vcan-sim run --record`, or a trace in candump -L format.",
            metavar="RECORDING",
        ),
    ],
    hand: Hand = None,
    interface: OtherInterface = None,
    channel: OtherChannel = None,
    from_nodes: Annotated[
        bool, typer.Option("--from-nodes", help="Send only the frames from nodes, to test a host.")
    ] = False,
) -> None:
    """Send the frames of a recorded bus trace on a bus, with their original timing.

    With --hand, the frames from each recorded bus are sent on the hand's bus of the same name. Without
    --hand, all frames are sent on the bus selected by --interface and --channel.
    """
    from contextlib import ExitStack

    from skinnode.process.signals import stop_on_signal
    from skinnode.text.words import counted
    from skinnode.transport import CanPort
    from skinnode.transport.frame_log_reader import FrameLogReader
    from vcan_sim.replay import replay, trace_of

    trace = trace_of(recording)
    buses = _buses(trace, hand, interface, channel)
    with stop_on_signal() as stop, ExitStack() as opened:
        ports = {name: opened.enter_context(CanPort(bus)) for name, bus in buses.items()}
        where = ", ".join(f"{name} on {bus.interface} {bus.channel}" for name, bus in buses.items())
        print(f"replaying {where}; press Ctrl-C to stop", flush=True)
        done = replay(FrameLogReader(trace), ports, wait=stop.wait, from_nodes=from_nodes)
    notes = [f"; {done.left_out} left out"] * bool(done.left_out)
    notes += [f"; {done.refused} refused by the bus"] * bool(done.refused)
    print(f"sent {counted(done.sent, 'frame')} in {done.seconds:.1f} s{''.join(notes)}", flush=True)


def _buses(
    trace: Path, hand: Path | None, interface: str | None, channel: str | None
) -> dict[str, BusConfig]:
    """Return the bus on which to replay each channel of a trace.

    Raises:
        ConfigError: If the hand has no bus for a channel, or the trace has several channels and no hand is
            given.
    """
    from skinnode.config import BusConfig, load_hand
    from skinnode.errors import ConfigError
    from vcan_sim.recording import channels_of
    from vcan_sim.replay import channels_in

    channels = channels_in(trace)
    if hand is not None:
        buses = load_hand(hand).on(interface, channel).buses
        channel_of = channels_of(bus.name for bus in buses)
        known = {channel_of[bus.name]: bus for bus in buses}
        for name in channels:
            if name not in known:
                raise ConfigError(str(trace), name, f"a bus of the hand: {', '.join(known)}")
        return {name: known[name] for name in channels}
    if len(channels) > 1:
        raise ConfigError("--hand", None, f"a hand with the buses of this trace: {', '.join(channels)}")
    bus = BusConfig(interface=interface or "socketcan", channel=channel or "can0")
    return dict.fromkeys(channels, bus)
