"""Faults that can be injected into a simulated node, and counts of the injected faults.

A chunk has at most one fault, so that the counts of injected faults can be compared with a receiver's
counters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from skinnode.errors import ConfigError
from vcan_sim.tally import Kind

OF_CHUNKS: Final = ("lost", "duplicated", "reordered", "late", "short", "remote", "miscounted", "corrupted")
OF_SCANS: Final = ("torn", "summary_lost", "reset", "displaced", "understated", "unchecked")
LOST_OUT: Final = {
    Kind.SDO_RESPONSE: "sdo_response_lost",
    Kind.LSS_RESPONSE: "lss_response_lost",
    Kind.HEARTBEAT: "heartbeat_lost",
    Kind.BOOT_UP: "boot_up_lost",
    Kind.EMCY: "emcy_lost",
}
"""Fault that drops frames sent by the node, for each kind of frame."""
LOST_IN: Final = {
    Kind.NMT: "nmt_lost",
    Kind.SDO_REQUEST: "sdo_request_lost",
    Kind.LSS_REQUEST: "lss_request_lost",
    Kind.COMMAND: "command_lost",
    Kind.HEARTBEAT: "heartbeat_lost",
}
"""Fault that drops frames addressed to the node, for each kind of frame except SYNC (see ``sync_lost``)."""
_SHARES: Final = (
    *OF_CHUNKS,
    *OF_SCANS,
    "sync_lost",
    "long",
    "flipped",
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
"""Faults that specify a wire number, alternately of an upper wire and a lower wire."""
_RATES: Final = ("emcy_per_s", "babble_per_s", "restart_every_s")
_MOST: Final = {"drift_per_s": 1.0, "warmer_k": 100.0}
"""Maximum absolute value of each fault that can have a negative value."""


@dataclass(frozen=True, slots=True)
class Faults:
    """Faults of one simulated node. By default, there are no faults.

    Raises:
        ConfigError: If a value is out of range, or if the fractions of chunks or of scans add up to more than
            1.
    """

    seed: int = 1
    """Seed of the random numbers. The same seed and the same frames result in the same faults."""

    # --- fractions of the chunks
    lost: float = 0.0
    duplicated: float = 0.0
    """Fraction of the chunks that are sent twice."""
    reordered: float = 0.0
    """Fraction of the chunks that are sent after the next frame."""
    late: float = 0.0
    """Fraction of the chunks that are sent after the first frame of the next scan."""
    short: float = 0.0
    """Fraction of the chunks that are one byte too short."""
    remote: float = 0.0
    """Fraction of the chunks that are replaced by a remote frame."""
    miscounted: float = 0.0
    """Fraction of the chunks with a wrong scan counter."""
    miscounted_by: int | None = None
    """Value added to the scan counter of a ``miscounted`` chunk, modulo 256; None for a random value."""
    corrupted: float = 0.0
    """Fraction of the chunks in which one code is falsified. The length and the counters of the falsified
    chunks are correct."""

    # --- fractions of the scans
    torn: float = 0.0
    """Fraction of the scans whose second half and summary are not sent. The scan after a torn scan has the
    same scan counter."""
    summary_lost: float = 0.0
    reset: float = 0.0
    """Fraction of the scans during which the node is reset, as if by a watchdog, after half of the chunks."""
    displaced: float = 0.0
    """Fraction of the scans in which a chunk has the scan counter of the next scan. In the next scan, the
    chunk with the same index is lost."""
    understated: float = 0.0
    """Fraction of the scans in which a chunk is lost and the summary conceals this loss. In the falsified
    summary, the number of chunks is reduced by one, the flag for changed chunks only is set, and the check,
    if any, is valid. If the node itself sends only changed chunks, the summary is not falsified."""
    unchecked: float = 0.0
    """Fraction of the scans whose summary contains no check, as in protocol revision 1.0."""
    struck: int | None = None
    """Index of the chunk to which ``displaced`` or ``understated`` applies; None for a random chunk."""

    # --- fractions of other frames
    sync_lost: float = 0.0
    """Fraction of the SYNC messages that the node does not receive."""
    long: float = 0.0
    """Fraction of the heartbeats that are one byte too long. Chunks and summaries already have the maximum
    length."""
    nmt_lost: float = 0.0
    """Fraction of the NMT commands that the node does not receive."""
    sdo_request_lost: float = 0.0
    """Fraction of the SDO requests that the node does not receive."""
    sdo_response_lost: float = 0.0
    """Fraction of the SDO responses that are lost."""
    lss_request_lost: float = 0.0
    """Fraction of the LSS requests that the node does not receive."""
    lss_response_lost: float = 0.0
    """Fraction of the LSS responses that are lost."""
    heartbeat_lost: float = 0.0
    """Fraction of the heartbeats to and from the node that are lost."""
    boot_up_lost: float = 0.0
    """Fraction of the boot-up messages that are lost."""
    emcy_lost: float = 0.0
    """Fraction of the emergency messages that are lost, including *error reset* messages."""
    command_lost: float = 0.0
    """Fraction of the command PDOs, such as tare commands, that the node does not receive."""

    # --- faults of the node, the converter and the wires
    silent: bool = False
    """Whether the node is silent: its frames do not reach the bus."""
    deaf: bool = False
    """Whether the node is deaf: it does not receive any frames."""
    frozen: bool = False
    """Whether the converter is frozen: it repeats its last values and does not count conversions."""
    uncounted: bool = False
    """Whether the converter provides no count of its conversions. A host can then detect a stopped converter
    only by constant codes."""
    unplugged: bool = False
    """Whether the node is disconnected from the bus and from its power supply. The node boots when the fault
    ends."""
    wrong_identity: bool = False
    """Whether the node reports a wrong product code."""
    wrong_layout: bool = False
    """Whether the node reports a wrong layout hash."""
    open_upper: int | None = None
    """Number of a broken upper wire. Wires are numbered from 0. All wires are intact during the tare at
    power-on."""
    open_lower: int | None = None
    """Number of a broken lower wire."""
    shorted_upper: int | None = None
    """Number of an upper wire that is shorted to all lower wires."""
    shorted_lower: int | None = None
    """Number of a lower wire that is shorted to all upper wires."""
    noisy_upper: int | None = None
    """Number of an upper wire with a bad contact, so that its resistances have additional noise of 0.3 %."""
    noisy_lower: int | None = None
    """Number of a lower wire with a bad contact, so that its resistances have additional noise of 0.3 %."""
    frozen_upper: int | None = None
    """Number of an upper wire whose resistances remain constant from the start of the fault."""
    frozen_lower: int | None = None
    """Number of a lower wire whose resistances remain constant from the start of the fault."""
    stuck_upper: int | None = None
    """Number of the upper wire at a stuck crossing, whose resistance remains constant from the start of the
    fault. The lower wire at the crossing is ``stuck_lower``."""
    stuck_lower: int | None = None
    """Number of the lower wire at the stuck crossing; see ``stuck_upper``."""
    crossed_upper: int | None = None
    """Number of an upper wire whose connection is exchanged with that of the next upper wire."""
    crossed_lower: int | None = None
    """Number of a lower wire whose connection is exchanged with that of the next lower wire."""
    flipped: float = 0.0
    """Fraction of the readings in which one bit of one code is flipped. The check of the scan is computed
    after the bit is flipped."""
    drift_per_s: float = 0.0
    """Relative drift of all resistances per second, from -1 to 1. The drift accumulates up to a factor of 10
    or 0.1, and is reset to zero when the fault ends."""
    warmer_k: float = 0.0
    """Sudden temperature change of the patch, K, from -100 to 100. All resistances change according to the
    temperature coefficient ``Imperfections.temperature_per_k`` of the patch."""
    error_passive: bool = False
    """Whether the node's CAN controller is error-passive. The node reports the error-passive state as
    emergency 0x8120."""
    duplicate_node_id: bool = False
    """Whether there is a second node with the same node-ID on the bus. The second node boots, responds to all
    commands, and reports a skin at rest. The second node disappears when the fault ends."""
    restart_every_s: float = 0.0
    """Time between spontaneous resets of the node, s; 0 for no resets."""
    emcy_per_s: float = 0.0
    """Rate of additional emergency messages, 1/s. When the emergency messages end, the node sends an *error
    reset* message."""
    babble_per_s: float = 0.0
    """Rate of additional frames with the unused COB-ID 0x3F0, 1/s."""

    def __post_init__(self) -> None:
        for name in _SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(name, getattr(self, name), "a fraction from 0 to 1")
        for names in (OF_CHUNKS, OF_SCANS):
            total = math.fsum(getattr(self, name) for name in names)
            if total > 1.0 + 1e-9:
                raise ConfigError(" + ".join(names), total, "at most 1 together")
        for name in OF_WIRES:
            if (wire := getattr(self, name)) is not None and wire < 0:
                raise ConfigError(name, wire, "an integer of at least 0")
        self._check_crossing()
        self._check_numbers()

    def _check_crossing(self) -> None:
        if (self.stuck_upper is None) != (self.stuck_lower is None):
            given = {"stuck_upper": self.stuck_upper, "stuck_lower": self.stuck_lower}
            name = next(name for name, wire in given.items() if wire is not None)
            raise ConfigError(name, given[name], "both stuck_upper and stuck_lower, which name a crossing")

    def _check_numbers(self) -> None:
        for name in _RATES:
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ConfigError(name, getattr(self, name), "a number of at least 0")
        for name, most in _MOST.items():
            if not -most <= getattr(self, name) <= most:
                raise ConfigError(name, getattr(self, name), f"a number from {-most:g} to {most:g}")


@dataclass(slots=True)
class Injected:
    """Counts of the faults that have been injected into one node."""

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
    """Number of scans in which a chunk was sent with the counter of the next scan."""
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
    """Number of readings that repeated the previous reading due to a frozen converter."""
    uncounted: int = 0
    """Number of readings without a count of conversions."""
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
    """Number of times that the controller became error-passive."""
    twins: int = 0
    """Number of second nodes with the same node-ID that have been started."""
    twin_frames: int = 0
    """Number of frames sent by second nodes with the same node-ID."""
    restarts: int = 0
    """Number of resets caused by ``restart_every_s``."""
    impostures: int = 0
    """Number of SDO responses with a falsified product code or layout hash."""
    emergencies: int = 0
    babbled: int = 0
    scans_spoilt: int = 0
    """Number of scans with missing or wrong chunks: lost, late, short, remote, miscounted or corrupted."""
    pdos: int = 0
    """Number of data frames sent with the COB-ID of a chunk or summary, including frames from second
    nodes."""


NO_FAULTS: Final = Faults()


def check_wires(faults: Faults, patch: str, shape: tuple[int, int]) -> None:
    """Check that a patch has the wires to which its faults refer.

    Args:
        faults: Faults of the patch.
        patch: Name of the patch.
        shape: Numbers of upper and lower wires of the patch.

    Raises:
        ConfigError: If a wire number is too large for the patch.
    """
    for number, name in enumerate(OF_WIRES):
        wires = shape[number % 2] - name.startswith("crossed")  # the last wire has no next wire
        if (wire := getattr(faults, name)) is not None and wire >= wires:
            raise ConfigError(f"{patch}: {name}", wire, f"an integer from 0 to {wires - 1}")
