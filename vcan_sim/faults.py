"""Faults that can be injected into a node, as data, and counts of those that were.

A chunk suffers at most one fault, so that counts can be compared with those of a receiver.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
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
"""Faults that drop frames sent by the node, by kind."""
LOST_IN: Final = {
    Kind.NMT: "nmt_lost",
    Kind.SDO_REQUEST: "sdo_request_lost",
    Kind.LSS_REQUEST: "lss_request_lost",
    Kind.COMMAND: "command_lost",
    Kind.HEARTBEAT: "heartbeat_lost",
}
"""Faults that drop frames meant for the node, by kind. For SYNC there is ``sync_lost``."""
_SHARES: Final = (
    *OF_CHUNKS,
    *OF_SCANS,
    "sync_lost",
    "long",
    *dict.fromkeys((*LOST_OUT.values(), *LOST_IN.values())),
)
OF_WIRES: Final = (
    "open_upper",
    "open_lower",
    "shorted_upper",
    "shorted_lower",
    "noisy_upper",
    "noisy_lower",
)
_RATES: Final = ("emcy_per_s", "babble_per_s", "restart_every_s")


@dataclass(frozen=True, slots=True)
class Faults:
    """Faults of one node. None by default.

    Raises:
        ConfigError: A share is not between 0 and 1, shares of chunks or of scans exceed 1 together, or a rate
            is negative.
    """

    seed: int = 1
    """The same seed and the same frames suffer the same faults."""

    # --- shares of the chunks
    lost: float = 0.0
    duplicated: float = 0.0
    """Sent twice."""
    reordered: float = 0.0
    """Changes places with the frame after it."""
    late: float = 0.0
    """Arrives after the first frame of the next scan."""
    short: float = 0.0
    """A byte is missing."""
    remote: float = 0.0
    """A remote frame is sent instead."""
    miscounted: float = 0.0
    """Has the counter of another scan."""
    miscounted_by: int | None = None
    """Error of that counter, modulo 256; None: a random error."""
    corrupted: float = 0.0
    """A code differs from the one that the node packed; length and counters are right."""

    # --- shares of the scans
    torn: float = 0.0
    """Breaks off after its first half, without a summary, and the next scan has the same counter."""
    summary_lost: float = 0.0
    reset: float = 0.0
    """The node resets itself after half of the chunks, as a watchdog would."""
    displaced: float = 0.0
    """A chunk has the counter of the next scan, whose own chunk of that index is lost."""
    understated: float = 0.0
    """A chunk is lost, and the summary says that only changed chunks were sent, one fewer; its check, if
    any, is correct for that summary. Scans of changed chunks only lose the chunk."""
    unchecked: float = 0.0
    """The summary carries no check: it has the form of revision 1.0."""
    struck: int | None = None
    """Index of the chunk that ``displaced`` and ``understated`` strike; None: any."""

    # --- shares of other frames
    sync_lost: float = 0.0
    """The node does not hear a SYNC."""
    long: float = 0.0
    """A heartbeat has one byte too many; chunks and summaries already fill their frames."""
    nmt_lost: float = 0.0
    """The node does not hear an NMT command."""
    sdo_request_lost: float = 0.0
    """The node does not hear an SDO request."""
    sdo_response_lost: float = 0.0
    """An SDO response does not arrive."""
    lss_request_lost: float = 0.0
    """The node does not hear an LSS request."""
    lss_response_lost: float = 0.0
    """An LSS response does not arrive."""
    heartbeat_lost: float = 0.0
    """A heartbeat does not arrive, whether sent by the node or meant for it."""
    boot_up_lost: float = 0.0
    """A boot-up message does not arrive."""
    emcy_lost: float = 0.0
    """An emergency message does not arrive; this includes *error reset*."""
    command_lost: float = 0.0
    """The node does not hear a command PDO, such as a tare."""

    # --- as long as they are set
    silent: bool = False
    """No frame of the node arrives."""
    deaf: bool = False
    """The node hears nothing: its receiver is stuck."""
    frozen: bool = False
    """The converter gives the same values again and again."""
    unplugged: bool = False
    """The node has neither bus nor supply. It boots when this ends."""
    wrong_identity: bool = False
    """The node reports another product code."""
    wrong_layout: bool = False
    """The node reports another layout hash."""
    open_upper: int | None = None
    """This upper wire is broken. Wires are counted from 0, and are sound while a node tares at power-on."""
    open_lower: int | None = None
    """This lower wire is broken."""
    shorted_upper: int | None = None
    """This upper wire touches all lower wires."""
    shorted_lower: int | None = None
    """This lower wire touches all upper wires."""
    noisy_upper: int | None = None
    """This upper wire has a bad contact: a noise of 0.3 % of each resistance."""
    noisy_lower: int | None = None
    """This lower wire has a bad contact."""
    restart_every_s: float = 0.0
    """Seconds between resets of the node by itself; 0: never."""
    emcy_per_s: float = 0.0
    """Emergency messages a second; after the last follows one that reports *error reset*."""
    babble_per_s: float = 0.0
    """Frames a second with COB-ID 0x3F0, which no device uses."""

    def __post_init__(self) -> None:
        for name in _SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(name, getattr(self, name), "a share from 0 to 1")
        for names in (OF_CHUNKS, OF_SCANS):
            total = math.fsum(getattr(self, name) for name in names)
            if total > 1.0 + 1e-9:
                raise ConfigError(" + ".join(names), total, "at most 1 together")
        for name in OF_WIRES:
            if (wire := getattr(self, name)) is not None and wire < 0:
                raise ConfigError(name, wire, "an integer of at least 0")
        for name in _RATES:
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ConfigError(name, getattr(self, name), "a number of at least 0")


@dataclass(slots=True)
class Injected:
    """Number of times that each fault was injected into one node."""

    lost: int = 0
    duplicated: int = 0
    reordered: int = 0
    late: int = 0
    short: int = 0
    remote: int = 0
    miscounted: int = 0
    torn: int = 0
    torn_chunks: int = 0
    """Chunks sent of the first halves of torn scans."""
    summary_lost: int = 0
    reset: int = 0
    """Resets in the middle of a scan."""
    corrupted: int = 0
    displaced: int = 0
    """Scans that lost a chunk to the next scan."""
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
    """Frames not sent because the node was silent, unplugged or about to be reset."""
    unheard: int = 0
    """Frames that the node missed because it was deaf or unplugged."""
    frozen: int = 0
    """Readings that repeated the previous reading."""
    miswired: int = 0
    """Readings with a wire open, shorted or noisy."""
    unplugged: int = 0
    restarts: int = 0
    """Resets by ``restart_every_s``."""
    impostures: int = 0
    """Wrong answers about identity or layout."""
    emergencies: int = 0
    babbled: int = 0
    scans_spoilt: int = 0
    """Scans with missing or wrong chunks: lost, late, short, remote, miscounted or corrupted."""
    pdos: int = 0
    """Data frames on the COB-IDs of chunks and summaries that were put on the bus."""


NO_FAULTS: Final = Faults()


def faults_of(texts: Sequence[str], patches: Sequence[str]) -> dict[str, Faults]:
    """Return the faults of each patch from the texts of ``--fault``.

    Args:
        texts: Such as ``lost=0.01,silent``, for all patches, and ``palm:open_upper=3``, for one; later texts
            add to earlier ones.
        patches: Names of the patches of the hand.

    Raises:
        ConfigError: As :func:`parse_faults`, or a patch is not in the hand.
    """
    found = dict.fromkeys(patches, NO_FAULTS)
    for text in texts:
        patch, colon, listed = text.rpartition(":")
        if colon and patch not in found:
            raise ConfigError("--fault", patch, f"a patch of the hand: {', '.join(patches)}")
        for name in [patch] if colon else patches:
            found[name] = parse_faults(listed, found[name])
    return found


def parse_faults(text: str, added_to: Faults = NO_FAULTS) -> Faults:
    """Return faults from a text such as ``lost=0.01,restart_every_s=2,silent``.

    Args:
        text: Names of faults with their values, separated by commas.
        added_to: Faults to which they are added.

    Raises:
        ConfigError: A name is unknown or a value is not possible.
    """
    kinds = {field.name: type(field.default) for field in dataclasses.fields(Faults)}
    values: dict[str, int | float | bool] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        if name not in kinds:
            raise ConfigError("--fault", name, ", ".join(kinds))
        try:
            values[name] = _value(kinds[name], value)
        except ValueError:
            raise ConfigError(f"--fault {name}", value, _allowed(kinds[name])) from None
    return dataclasses.replace(added_to, **values)  # type: ignore[arg-type]  # each of the kind of its field


def _value(kind: type, text: str) -> int | float | bool:
    if kind is bool:
        if text not in ("", "true", "false"):
            raise ValueError
        return text != "false"
    return float(text) if kind is float else int(text)


def _allowed(kind: type) -> str:
    if kind is bool:
        return "no value, or true or false"
    return "a number" if kind is float else "an integer"
