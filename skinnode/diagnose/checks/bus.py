"""Doctor checks for a bus: interface, controller, load, masters and frames of unknown origin."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np

from skinnode.diagnose.facts import BusFacts, Finding, Sure
from skinnode.text.words import counted

_SYNCS: Final = 10
_ASTRAY: Final = 0.25
"""Fraction of out-of-sequence SYNC counters above which a second SYNC producer is reported.

With two producers, about half of the counters are out of sequence. Lost SYNCs put far fewer counters out of
sequence.
"""

_BEATS: Final = 4
_TOO_OFTEN: Final = 0.7
"""Ratio of the measured to the configured heartbeat period below which a second sender is reported. A second
sender halves the measured period."""


def check_bus(bus: BusFacts) -> Iterator[Finding]:
    """Check the interface, controller, load and frame origins; report nodes without a node-ID."""

    def found(what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("bus", bus.name, what, sure, evidence, advice)

    if bus.failure:
        yield found(
            "the interface does not work",
            Sure.CERTAIN,
            bus.failure,
            "run ip link set NAME up type can bitrate BPS; check that the adapter is plugged in",
        )
        return
    if bus.link_state is not None and bus.link_state not in ("ERROR-ACTIVE", "ERROR-WARNING"):
        yield found(
            f"the controller is {bus.link_state}",
            Sure.CERTAIN,
            "reported by the kernel (ip -details link show)",
            "check the bit rate, the cable and the two 120 ohm terminations; then restart the interface",
        )
    if bus.link_bitrate_bps not in (None, bus.bitrate_bps):
        yield found(
            "the bit rate of the interface differs from the hand file",
            Sure.CERTAIN,
            f"{bus.link_bitrate_bps} bit/s; the hand file specifies {bus.bitrate_bps}",
            "set the interface and the hand file to the same bit rate",
        )
    if bus.error_frames:
        yield found(
            "error frames on the bus",
            Sure.CERTAIN,
            f"{bus.error_frames} in {bus.seconds:.1f} s",
            "check the termination, the stub lengths, and each node's bit rate and power supply",
        )
    if bus.load > bus.max_load:
        yield found(
            "the bus load exceeds the planning limit",
            Sure.CERTAIN,
            f"{bus.load:.0%} in the busiest second; at most {bus.max_load:.0%} is allowed",
            "increase sync.period_ms, set the send mode to changed, or put fewer patches on this bus",
        )
    if bus.outages:
        yield found(
            "the interface failed during the check",
            Sure.CERTAIN,
            counted(bus.outages, "time"),
            "check the adapter's cable and power, and the kernel log (dmesg)",
        )
    if bus.foreign:
        shown = ", ".join(f"0x{cob_id:03X}: {count}" for cob_id, count in Counter(bus.foreign).most_common(6))
        yield found(
            "frames of unknown origin",
            Sure.POSSIBLE,
            f"{shown} in {bus.seconds:.1f} s",
            "this is normal if drives or another master share the bus; otherwise find the sender",
        )
    for address in bus.unconfigured:
        yield found(
            "a node without a node-ID",
            Sure.CERTAIN,
            f"serial {address.serial_number} answers LSS",
            f"skinnode lss set --serial {address.serial_number} --node-id N",
        )


def check_masters(bus: BusFacts) -> Iterator[Finding]:
    """Check that only one master sends SYNC, master heartbeats and NMT commands."""

    def found(what: str, sure: Sure, evidence: str, advice: str) -> Finding:
        return Finding("bus", bus.name, what, sure, evidence, advice)

    stop_one = "run one host per hand: stop the other host, or configure this host as a guest (buses.role)"
    counters = [counter for counter in bus.sync_counters if counter]
    steps = list(pairwise(counters))
    astray = sum(after not in (before + 1, 1) for before, after in steps)
    if len(steps) >= _SYNCS and astray > _ASTRAY * len(steps):
        yield found(
            "two SYNC producers",
            Sure.CERTAIN,
            f"{astray} of {len(steps)} SYNC counters do not follow the previous counter",
            stop_one,
        )
    if bus.master_beats_s is not None and len(bus.master_beats_s) >= _BEATS and bus.heartbeat_ms:
        period_s = float(np.mean(np.diff(bus.master_beats_s)))
        if period_s < _TOO_OFTEN * bus.heartbeat_ms * 1e-3:
            yield found(
                "two masters send the same heartbeat",
                Sure.LIKELY,
                f"the heartbeat of node-ID {bus.master_node_id} arrives every {period_s * 1e3:.0f} ms; "
                f"the hand file specifies {bus.heartbeat_ms} ms",
                stop_one,
            )
    if bus.nmt_commands and bus.role == "master" and not any(patch.boot_ups for patch in bus.patches):
        yield found(
            "another device sends NMT commands",
            Sure.POSSIBLE,
            f"{counted(bus.nmt_commands, 'NMT command')} in {bus.seconds:.1f} s",
            f"this is normal while a host starts; otherwise there is a second master: {stop_one}",
        )
