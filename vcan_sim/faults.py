"""Faults of a simulated node, and counts of injected faults.

At most one fault applies to each chunk, so a receiver's counters can be checked against these counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from skinnode.errors import ConfigError
from vcan_sim.tally import Kind

OF_CHUNKS: Final = ("lost", "duplicated", "reordered", "late", "short", "remote", "miscounted", "corrupted")
OF_READINGS: Final = ("flipped",)
OF_SCANS: Final = ("torn", "summary_lost", "reset", "displaced", "understated", "unchecked")
LOST_OUT: Final = {
    Kind.SDO_RESPONSE: "sdo_response_lost",
    Kind.LSS_RESPONSE: "lss_response_lost",
    Kind.HEARTBEAT: "heartbeat_lost",
    Kind.BOOT_UP: "boot_up_lost",
    Kind.EMCY: "emcy_lost",
}
"""Name of the fault that drops outgoing frames, by kind of frame."""
LOST_IN: Final = {
    Kind.NMT: "nmt_lost",
    Kind.SDO_REQUEST: "sdo_request_lost",
    Kind.LSS_REQUEST: "lss_request_lost",
    Kind.COMMAND: "command_lost",
    Kind.HEARTBEAT: "heartbeat_lost",
}
"""Name of the fault that drops incoming frames, by kind of frame. SYNC has its own fault, ``sync_lost``."""
_SHARES: Final = (
    *OF_CHUNKS,
    *OF_SCANS,
    "sync_lost",
    "long",
    *OF_READINGS,
    *dict.fromkeys((*LOST_OUT.values(), *LOST_IN.values())),
)
OF_WIRES: Final = (
    "open_upper",
    "open_lower",
    "shorted_upper",
    "shorted_lower",
    "noisy_upper",
    "noisy_lower",
    "frozen_upper",
    "frozen_lower",
    "stuck_upper",
    "stuck_lower",
    "crossed_upper",
    "crossed_lower",
)
"""Faults whose value is a wire number, with faults of upper and lower wires alternating."""
RATE_PER_S: Final = (1e-6, 1e5)
"""Minimum and maximum rate of a fault, in 1/s, unless the rate is 0. A 1 Mbit/s bus carries fewer frames per
second than this maximum."""
_RANGES: Final = {"emcy_per_s": RATE_PER_S, "babble_per_s": RATE_PER_S, "restart_every_s": (1e-3, 1e6)}
"""Minimum and maximum value of each repeating fault, unless the value is 0."""
_MOST: Final = {"drift_per_s": 1.0, "warmer_k": 100.0}
"""Maximum absolute value of each fault that can be negative."""


def check_range(name: str, value: float, least: float, greatest: float) -> None:
    """Raise ConfigError unless a rate or interval is either 0 or within a range.

    Args:
        name: Name of the fault.
        value: Its value.
        least: Minimum, if the value is not 0.
        greatest: Maximum.
    """
    if value != 0.0 and not least <= value <= greatest:
        raise ConfigError(name, value, f"0, or a number from {least:g} to {greatest:g}")


@dataclass(frozen=True, slots=True)
class Faults:
    """Faults of one simulated node; none by default.

    Raises:
        ConfigError: If a value is out of range, or if the chunk fractions or the scan fractions add up to
            more than 1.
    """

    seed: int = 1
    """Random seed. The same seed and the same sequence of frames always lead to the same faults."""

    # --- fractions of the chunks
    lost: float = 0.0
    duplicated: float = 0.0
    """Fraction of chunks sent twice."""
    reordered: float = 0.0
    """Fraction of chunks that swap places with the next frame."""
    late: float = 0.0
    """Fraction of chunks held back until the first frame of the next scan has been sent."""
    short: float = 0.0
    """Fraction of chunks sent without their last byte."""
    remote: float = 0.0
    """Fraction of chunks replaced by a remote frame."""
    miscounted: float = 0.0
    """Fraction of chunks with a wrong scan counter."""
    miscounted_by: int | None = None
    """Error in the scan counter of ``miscounted`` chunks, modulo 256; None for a random error."""
    corrupted: float = 0.0
    """Fraction of chunks in which one code is wrong. The length and the counters are correct."""

    # --- fractions of the scans
    torn: float = 0.0
    """Fraction of scans that are cut off: the summary and the second half of the chunks are not sent. The
    next scan has the same scan counter."""
    summary_lost: float = 0.0
    reset: float = 0.0
    """Fraction of scans in which the node is reset after sending half of the chunks, as if by a watchdog."""
    displaced: float = 0.0
    """Fraction of scans in which one chunk carries the scan counter of the next scan. The next scan then
    lacks the chunk with the same index."""
    understated: float = 0.0
    """Fraction of scans in which one chunk is lost and the summary hides the loss. The summary counts one
    chunk fewer, sets the changed-chunks-only flag, and has a valid check if the node sends checks. If the
    node itself sent only changed chunks, the summary is not altered."""
    unchecked: float = 0.0
    """Fraction of scans whose summary contains no check, as in protocol revision 1.0."""
    struck: int | None = None
    """Index of the chunk affected by ``displaced`` or ``understated``; None for a random chunk."""

    # --- fractions of other frames
    sync_lost: float = 0.0
    """Fraction of SYNC messages that never reach the node."""
    long: float = 0.0
    """Fraction of heartbeats with one extra byte. Chunks and summaries already have the maximum length."""
    nmt_lost: float = 0.0
    """Fraction of NMT commands that never reach the node."""
    sdo_request_lost: float = 0.0
    """Fraction of SDO requests that never reach the node."""
    sdo_response_lost: float = 0.0
    """Fraction of SDO responses lost."""
    lss_request_lost: float = 0.0
    """Fraction of LSS requests that never reach the node."""
    lss_response_lost: float = 0.0
    """Fraction of LSS responses lost."""
    heartbeat_lost: float = 0.0
    """Fraction of heartbeats lost, both to and from the node."""
    boot_up_lost: float = 0.0
    """Fraction of boot-up messages lost."""
    emcy_lost: float = 0.0
    """Fraction of emergency messages lost, including *error reset* messages."""
    command_lost: float = 0.0
    """Fraction of command PDOs, such as tare commands, that never reach the node."""

    # --- faults of the node, the converter and the wires
    silent: bool = False
    """Whether the node is silent: none of its frames reach the bus."""
    deaf: bool = False
    """Whether the node is deaf: it receives no frames."""
    frozen: bool = False
    """Whether the converter is frozen: its readings and its conversion count stop changing."""
    uncounted: bool = False
    """Whether the converter lacks a conversion count. A host can then detect a stopped converter only by its
    constant codes."""
    unplugged: bool = False
    """Whether the node is disconnected from the bus and the power supply. It boots when the fault ends."""
    wrong_identity: bool = False
    """Whether the node reports a wrong product code."""
    wrong_layout: bool = False
    """Whether the node reports a wrong layout hash."""
    open_upper: int | None = None
    """Number of an open upper wire. Wires are numbered from 0. Wire faults take effect after the tare at
    power-on."""
    open_lower: int | None = None
    """Number of an open lower wire."""
    shorted_upper: int | None = None
    """Number of an upper wire that is shorted to all lower wires."""
    shorted_lower: int | None = None
    """Number of a lower wire that is shorted to all upper wires."""
    noisy_upper: int | None = None
    """Number of an upper wire with a bad contact, which adds 0.3 % noise to its resistances."""
    noisy_lower: int | None = None
    """Number of a lower wire with a bad contact, which adds 0.3 % noise to its resistances."""
    frozen_upper: int | None = None
    """Number of an upper wire whose resistances stop changing when the fault starts."""
    frozen_lower: int | None = None
    """Number of a lower wire whose resistances stop changing when the fault starts."""
    stuck_upper: int | None = None
    """Upper wire of a stuck crossing, whose resistance stops changing when the fault starts. The lower wire
    of the crossing is ``stuck_lower``."""
    stuck_lower: int | None = None
    """Lower wire of the stuck crossing; see ``stuck_upper``."""
    crossed_upper: int | None = None
    """Number of an upper wire whose connection is swapped with the next upper wire's."""
    crossed_lower: int | None = None
    """Number of a lower wire whose connection is swapped with the next lower wire's."""
    flipped: float = 0.0
    """Fraction of readings with one flipped bit in one code. The check is computed after the bit is flipped,
    so the scan passes it."""
    drift_per_s: float = 0.0
    """Relative drift of all resistances per second, from -1 to 1. The accumulated factor stays between 0.1
    and 10, and the drift disappears when the fault ends."""
    warmer_k: float = 0.0
    """Temperature step of the patch, K, from -100 to 100. ``Imperfections.temperature_per_k`` is the
    temperature coefficient of the resistances."""
    error_passive: bool = False
    """Whether the node's CAN controller is error-passive. The node reports this with emergency 0x8120."""
    duplicate_node_id: bool = False
    """Whether a second node on the bus has the same node-ID. The second node boots, responds to all commands
    and reports an untouched patch. It disappears when the fault ends."""
    restart_every_s: float = 0.0
    """Interval between spontaneous resets of the node, in s, at least 1e-3; 0 for no resets."""
    emcy_per_s: float = 0.0
    """Rate of spurious emergency messages, 1/s, at most 1e5. When the fault ends, the node sends an *error
    reset* message."""
    babble_per_s: float = 0.0
    """Rate of stray frames with the unused COB-ID 0x3F0, 1/s, at most 1e5."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ConfigError("seed", self.seed, "a non-negative integer")
        for name in _SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(name, getattr(self, name), "a fraction from 0 to 1")
        for names in (OF_CHUNKS, OF_SCANS):
            total = math.fsum(getattr(self, name) for name in names)
            if total > 1.0 + 1e-9:
                raise ConfigError(" + ".join(names), total, "at most 1 together")
        for name in OF_WIRES:
            if (wire := getattr(self, name)) is not None and wire < 0:
                raise ConfigError(name, wire, "a non-negative integer")
        self._check_crossing()
        self._check_numbers()

    def _check_crossing(self) -> None:
        if (self.stuck_upper is None) != (self.stuck_lower is None):
            given = {"stuck_upper": self.stuck_upper, "stuck_lower": self.stuck_lower}
            name = next(name for name, wire in given.items() if wire is not None)
            raise ConfigError(name, given[name], "both stuck_upper and stuck_lower, which name a crossing")

    def _check_numbers(self) -> None:
        for name, (least, greatest) in _RANGES.items():
            check_range(name, getattr(self, name), least, greatest)
        if self.struck is not None and self.struck < 0:
            raise ConfigError("struck", self.struck, "a non-negative integer")
        if self.miscounted_by is not None and self.miscounted_by % 256 == 0:
            raise ConfigError("miscounted_by", self.miscounted_by, "an integer that 256 does not divide")
        for name, most in _MOST.items():
            if not -most <= getattr(self, name) <= most:
                raise ConfigError(name, getattr(self, name), f"a number from {-most:g} to {most:g}")


@dataclass(slots=True)
class Injected:
    """Counts of the faults injected into one node."""

    lost: int = 0
    duplicated: int = 0
    reordered: int = 0
    late: int = 0
    short: int = 0
    remote: int = 0
    miscounted: int = 0
    torn: int = 0
    torn_chunks: int = 0
    """Number of chunks sent in ``torn`` scans."""
    summary_lost: int = 0
    reset: int = 0
    """Number of resets in the middle of a scan."""
    corrupted: int = 0
    displaced: int = 0
    """Number of scans in which one chunk carried the counter of the next scan."""
    understated: int = 0
    unchecked: int = 0
    sync_lost: int = 0
    long: int = 0
    nmt_lost: int = 0
    sdo_request_lost: int = 0
    sdo_response_lost: int = 0
    lss_request_lost: int = 0
    lss_response_lost: int = 0
    heartbeat_lost: int = 0
    boot_up_lost: int = 0
    emcy_lost: int = 0
    command_lost: int = 0
    silenced: int = 0
    """Number of frames not sent because the node was silent, unplugged or about to be reset."""
    unheard: int = 0
    """Number of frames that the node missed because it was deaf or unplugged."""
    frozen: int = 0
    """Number of readings in which a frozen converter repeated the previous reading."""
    uncounted: int = 0
    """Number of readings without a conversion count."""
    miswired: int = 0
    """Number of readings with at least one faulty wire or crossing."""
    flipped: int = 0
    """Number of readings in which one bit of one code was flipped."""
    drifted: int = 0
    """Number of readings affected by ``drift_per_s``."""
    warmed: int = 0
    """Number of readings affected by ``warmer_k``."""
    unplugged: int = 0
    error_passive: int = 0
    """Number of times the controller became error-passive."""
    twins: int = 0
    """Number of times a second node with the same node-ID was started."""
    twin_frames: int = 0
    """Number of frames sent by second nodes with the same node-ID."""
    restarts: int = 0
    """Number of resets caused by ``restart_every_s``."""
    impostures: int = 0
    """Number of SDO responses with a falsified product code or layout hash."""
    emergencies: int = 0
    babbled: int = 0
    scans_spoilt: int = 0
    """Number of scans with missing or bad chunks: lost, late, short, remote, miscounted or corrupted."""
    pdos: int = 0
    """Number of data frames sent with the COB-ID of a chunk or summary, including frames of second nodes."""


NO_FAULTS: Final = Faults()


def check_places(faults: Faults, patch: str, shape: tuple[int, int], chunks: int) -> None:
    """Check that a patch has the wires and the chunk named in its faults.

    Args:
        faults: Faults of the patch.
        patch: Name of the patch.
        shape: Number of upper wires and number of lower wires of the patch.
        chunks: Number of chunks in a scan of the patch.

    Raises:
        ConfigError: If a number is too large for the patch.
    """
    if faults.struck is not None and faults.struck >= chunks:
        raise ConfigError(f"{patch}: struck", faults.struck, f"an integer from 0 to {chunks - 1}")
    for number, name in enumerate(OF_WIRES):
        wires = shape[number % 2] - name.startswith("crossed")  # the last wire has no next wire
        if (wire := getattr(faults, name)) is not None and wire >= wires:
            raise ConfigError(f"{patch}: {name}", wire, f"an integer from 0 to {wires - 1}")
