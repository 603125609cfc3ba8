"""Faults that can be injected into a node, as data, and counts of the injected faults.

Each chunk has at most one fault, so that the counts can be compared with the counters of a receiver.
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
"""Faults that drop frames sent by the node, by frame kind."""
LOST_IN: Final = {
    Kind.NMT: "nmt_lost",
    Kind.SDO_REQUEST: "sdo_request_lost",
    Kind.LSS_REQUEST: "lss_request_lost",
    Kind.COMMAND: "command_lost",
    Kind.HEARTBEAT: "heartbeat_lost",
}
"""Faults that drop frames addressed to the node, by frame kind; for SYNC, see ``sync_lost``."""
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
"""Faults whose value is a wire number; faults of upper and lower wires alternate."""
_RATES: Final = ("emcy_per_s", "babble_per_s", "restart_every_s")
_MOST: Final = {"drift_per_s": 1.0, "warmer_k": 100.0}
"""Maximum absolute value of each fault that may be negative."""


@dataclass(frozen=True, slots=True)
class Faults:
    """Faults of one simulated node; by default there are none.

    Raises:
        ConfigError: If a fraction is not between 0 and 1, the fractions of chunks or of scans add up to more
            than 1, or a rate is negative.
    """

    seed: int = 1
    """Seed of the random draws; the same seed and the same frames produce the same faults."""

    # --- fractions of the chunks
    lost: float = 0.0
    duplicated: float = 0.0
    """Fraction of the chunks that are sent twice."""
    reordered: float = 0.0
    """Fraction of the chunks that swap places with the next frame."""
    late: float = 0.0
    """Fraction of the chunks that arrive after the first frame of the next scan."""
    short: float = 0.0
    """Fraction of the chunks that are one byte too short."""
    remote: float = 0.0
    """Fraction of the chunks that are replaced by a remote frame."""
    miscounted: float = 0.0
    """Fraction of the chunks that carry the counter of another scan."""
    miscounted_by: int | None = None
    """Error of the scan counter in a ``miscounted`` chunk, modulo 256; None for a random error."""
    corrupted: float = 0.0
    """Fraction of the chunks in which one code differs from the code packed by the node; length and counters
    are correct."""

    # --- fractions of the scans
    torn: float = 0.0
    """Fraction of the scans that stop after their first half, without a summary; the next scan has the same
    counter."""
    summary_lost: float = 0.0
    reset: float = 0.0
    """Fraction of the scans in which the node is reset after half of the chunks, as if by a watchdog."""
    displaced: float = 0.0
    """Fraction of the scans in which a chunk carries the counter of the next scan; the chunk with the same
    index in the next scan is lost."""
    understated: float = 0.0
    """Fraction of the scans in which a chunk is lost, and the summary claims that only changed chunks were
    sent and counts one chunk fewer. If the summary carries a check, the check is correct for the falsified
    summary. In a scan in which the node sends only changed chunks, the chunk is lost but the summary is not
    falsified."""
    unchecked: float = 0.0
    """Fraction of the scans whose summary carries no check, as in protocol revision 1.0."""
    struck: int | None = None
    """Index of the chunk that ``displaced`` and ``understated`` affect; None for a random chunk."""

    # --- fractions of other frames
    sync_lost: float = 0.0
    """Fraction of the SYNCs that the node does not receive."""
    long: float = 0.0
    """Fraction of the heartbeats that are one byte too long. (A chunk or summary cannot be lengthened,
    because it already fills its frame.)"""
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
    """Fraction of the heartbeats, sent by the node or received by it, that are lost."""
    boot_up_lost: float = 0.0
    """Fraction of the boot-up messages that are lost."""
    emcy_lost: float = 0.0
    """Fraction of the emergency messages, including *error reset*, that are lost."""
    command_lost: float = 0.0
    """Fraction of the command PDOs, such as a tare, that the node does not receive."""

    # --- active while they are set
    silent: bool = False
    """Whether the node is silent: none of its frames reaches the bus."""
    deaf: bool = False
    """Whether the node is deaf: it receives no frames, because its receiver is stuck."""
    frozen: bool = False
    """Whether the converter is frozen: it keeps returning the same values and counts no conversions."""
    uncounted: bool = False
    """Whether the converter does not count its conversions, so that the host must infer from the codes
    whether the converter is running."""
    unplugged: bool = False
    """Whether the node is disconnected from the bus and its supply; the node boots when the fault ends."""
    wrong_identity: bool = False
    """Whether the node reports a wrong product code."""
    wrong_layout: bool = False
    """Whether the node reports a wrong layout hash."""
    open_upper: int | None = None
    """Number of a broken upper wire. Wires are numbered from 0 and are intact during the tare at power-on."""
    open_lower: int | None = None
    """Number of a broken lower wire."""
    shorted_upper: int | None = None
    """Number of an upper wire that touches all lower wires."""
    shorted_lower: int | None = None
    """Number of a lower wire that touches all upper wires."""
    noisy_upper: int | None = None
    """Number of an upper wire with a bad contact, which adds noise of 0.3 % to each of its resistances."""
    noisy_lower: int | None = None
    """Number of a lower wire with a bad contact, which adds noise of 0.3 % to each of its resistances."""
    frozen_upper: int | None = None
    """Number of an upper wire with frozen resistances, which keep their values from the start of the
    fault."""
    frozen_lower: int | None = None
    """Number of a lower wire with frozen resistances, which keep their values from the start of the fault."""
    stuck_upper: int | None = None
    """Number of the upper wire of a stuck crossing; ``stuck_lower`` is the lower wire. The crossing's
    resistance keeps its value from the start of the fault."""
    stuck_lower: int | None = None
    """Number of the lower wire of the stuck crossing; see ``stuck_upper``."""
    crossed_upper: int | None = None
    """Number of an upper wire that is exchanged with the next upper wire."""
    crossed_lower: int | None = None
    """Number of a lower wire that is exchanged with the next lower wire."""
    flipped: float = 0.0
    """Fraction of the readings in which one bit of one code is flipped before the node computes its check."""
    drift_per_s: float = 0.0
    """Relative drift of every resistance per second, from -1 to 1. The accumulated drift is zero when the
    fault starts, and returns to zero when the fault ends. Drift changes a resistance by at most a factor of
    10."""
    warmer_k: float = 0.0
    """Step change in the temperature of the patch, K, from -100 to 100. Every resistance changes according to
    the temperature coefficient of the patch, ``Imperfections.temperature_per_k``."""
    error_passive: bool = False
    """Whether the node's controller is error-passive, which the node reports as emergency 0x8120."""
    duplicate_node_id: bool = False
    """Whether a second node with the same node-ID is on the bus. The second node boots, responds to all
    commands, and reports skin at rest; it disappears when the fault ends."""
    restart_every_s: float = 0.0
    """Time between spontaneous resets of the node, s; 0 for no resets."""
    emcy_per_s: float = 0.0
    """Number of emergency messages per second; after the last of them, a further message reports *error
    reset*."""
    babble_per_s: float = 0.0
    """Number of frames per second with COB-ID 0x3F0, which no device uses."""

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
    """Number of times that each fault has been injected into one node."""

    lost: int = 0
    duplicated: int = 0
    reordered: int = 0
    late: int = 0
    short: int = 0
    remote: int = 0
    miscounted: int = 0
    torn: int = 0
    torn_chunks: int = 0
    """Number of chunks sent in scans with the fault ``torn``."""
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
    """Number of readings that repeated the previous reading."""
    uncounted: int = 0
    """Number of readings by a converter that does not count its conversions."""
    miswired: int = 0
    """Number of readings with a faulty wire or crossing: open, shorted, noisy, frozen, stuck or crossed."""
    flipped: int = 0
    """Number of readings in which one bit of one code was flipped."""
    drifted: int = 0
    """Number of readings with resistance drift."""
    warmed: int = 0
    """Number of readings at a changed temperature."""
    unplugged: int = 0
    error_passive: int = 0
    """Number of times that the controller became error-passive."""
    twins: int = 0
    """Number of times that a second node with the same node-ID appeared."""
    twin_frames: int = 0
    """Number of frames sent by second nodes with the same node-ID."""
    restarts: int = 0
    """Number of resets caused by ``restart_every_s``."""
    impostures: int = 0
    """Number of falsified responses about identity or layout."""
    emergencies: int = 0
    babbled: int = 0
    scans_spoilt: int = 0
    """Number of scans with missing or wrong chunks: lost, late, short, remote, miscounted or corrupted."""
    pdos: int = 0
    """Number of data frames with the COB-ID of a chunk or summary put on the bus, including those of second
    nodes."""


NO_FAULTS: Final = Faults()


def check_wires(faults: Faults, patch: str, shape: tuple[int, int]) -> None:
    """Check that a patch has the wires named by its faults.

    Args:
        faults: Faults of the patch.
        patch: Name of the patch.
        shape: Numbers of upper and lower wires of the patch.

    Raises:
        ConfigError: If the patch does not have a named wire.
    """
    for number, name in enumerate(OF_WIRES):
        wires = shape[number % 2] - name.startswith("crossed")  # no wire follows the last one
        if (wire := getattr(faults, name)) is not None and wire >= wires:
            raise ConfigError(f"{patch}: {name}", wire, f"an integer from 0 to {wires - 1}")
