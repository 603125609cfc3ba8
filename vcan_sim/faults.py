"""What can go wrong between a node and its bus, as data: faults to inject, and a count of each that was.

One chunk suffers one fault at most, so that counts can be compared with those of whoever listens.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from skinnode.errors import ConfigError

OF_CHUNKS: Final = ("lost", "duplicated", "reordered", "late", "short", "remote", "miscounted")
OF_SCANS: Final = ("torn", "summary_lost", "reset")
_SHARES: Final = (*OF_CHUNKS, *OF_SCANS, "sync_lost", "long")
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

    Raises ConfigError for a share that is not 0 to 1, shares that are more than 1 together, or a rate that is
    negative.
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
    """Comes after the first frame of the next scan."""
    short: float = 0.0
    """A byte is missing."""
    remote: float = 0.0
    """A remote frame comes instead."""
    miscounted: float = 0.0
    """Has the counter of another scan."""
    miscounted_by: int | None = None
    """How far that counter is off, modulo 256; None: any other value."""

    # --- shares of the scans
    torn: float = 0.0
    """Breaks off after its first half, without a summary, and the next scan has the same counter."""
    summary_lost: float = 0.0
    reset: float = 0.0
    """The node resets itself after half of the chunks, as a watchdog does."""

    # --- shares of other frames
    sync_lost: float = 0.0
    """The node does not hear it."""
    long: float = 0.0
    """A heartbeat has a byte too many; chunks and summaries fill their frame already."""

    # --- as long as they are set
    silent: bool = False
    """Nothing of what the node sends arrives."""
    deaf: bool = False
    """The node hears nothing: its receiver is stuck."""
    frozen: bool = False
    """The converter gives the same values again and again."""
    unplugged: bool = False
    """Neither bus nor supply. It boots when this ends."""
    wrong_identity: bool = False
    """It says to be of another product."""
    wrong_layout: bool = False
    """It gives another layout hash."""
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
    """This lower wire has such a contact."""
    restart_every_s: float = 0.0
    """It resets itself this often; 0: never."""
    emcy_per_s: float = 0.0
    """Emergency messages; one that says that the error is gone follows the last."""
    babble_per_s: float = 0.0
    """Frames of COB-ID 0x3F0, which is nobody's."""

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
    """How often each fault was injected into one node, and what arrived on the bus all the same."""

    lost: int = 0
    duplicated: int = 0
    reordered: int = 0
    late: int = 0
    short: int = 0
    remote: int = 0
    miscounted: int = 0
    torn: int = 0
    torn_chunks: int = 0
    """Chunks that were sent of the first halves."""
    summary_lost: int = 0
    reset: int = 0
    """Resets in the middle of a scan."""
    sync_lost: int = 0
    long: int = 0
    silenced: int = 0
    """Frames that were not let out while silent, unplugged or cut off by a reset."""
    unheard: int = 0
    """Frames that the node would have heard."""
    frozen: int = 0
    """Readings that were those of before."""
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
    """Scans of which chunks are missing: lost, late, short, remote or miscounted ones."""
    pdos: int = 0
    """Data frames on the COB-IDs of chunks and summaries that were put on the bus."""


NO_FAULTS: Final = Faults()


def faults_of(texts: Sequence[str], patches: Sequence[str]) -> dict[str, Faults]:
    """Faults of each patch from texts such as ``lost=0.01,silent``, of all, and ``palm:open_upper=3``, of it;
    what comes later is added. Raises ConfigError as :func:`parse_faults`, and for no patch of the hand."""
    found = dict.fromkeys(patches, NO_FAULTS)
    for text in texts:
        patch, colon, listed = text.rpartition(":")
        if colon and patch not in found:
            raise ConfigError("--fault", patch, f"a patch of the hand: {', '.join(patches)}")
        for name in [patch] if colon else patches:
            found[name] = parse_faults(listed, found[name])
    return found


def parse_faults(text: str, added_to: Faults = NO_FAULTS) -> Faults:
    """Faults from ``lost=0.01,restart_every_s=2,silent``. Raises ConfigError for a name or value that cannot
    be."""
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
        return "nothing, true or false"
    return "a number" if kind is float else "an integer"
