"""Reads and writes the journal of a recording, which contains everything except the frames.

The journal is a JSON Lines file next to the log or, in an MCAP file, a topic with one message per line.
The first line contains the hand and the offset of the host's clock (:class:`Header`). Every other line is an
event that affected how the host decoded the frames: ``at`` is the number of frames received on ``bus`` before
the event, and ``t_ns`` is its time on the host's monotonic clock.

=============  ==============================================================================
``event``      meaning
=============  ==============================================================================
``resumed``    scans of ``patch`` are decoded with ``facts`` (baseline, scale, serial number, and the layout
               if it differs from that in the first line) or, without ``facts``, with the same solver as
               before;
               ``anew``: scans assembled so far are discarded
``withheld``   scans of ``patch`` are no longer decoded
``polled``     a timeout ended an incomplete scan
``overtaken``  ``scan`` of ``patch``, complete at ``received_ns``, was skipped for a newer one
``sync``       the SYNC sent at ``t_ns`` has this ``number``; written if its counter does not determine it
``dropped``    ``frames`` frames were not written because the disk was too slow
``repaired``   the file is a copy of the readable part of a recording, with ``frames`` frames; ``damaged``
               counts the unreadable parts before the end
``ended``      the recording was closed with ``frames`` frames in the log; if this event is missing, the
process was
               killed or the disk was full
=============  ==============================================================================
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from skinnode.config import BusConfig, HandConfig, PatchConfig, SyncConfig, parse_hand
from skinnode.errors import ConfigError
from skinnode.host.node_facts import NodeFacts
from skinnode.model.layout import PatchLayout
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile
from skinnode.transport.frame_log import WRITABLE

FORMAT: Final = "skinnode recording 1"
SUFFIX: Final = ".jsonl"


def journal_of(log: Path) -> Path:
    """Return the path of a log's journal: ``run.log.jsonl`` if it exists, otherwise ``run.jsonl``."""
    own = log.with_name(log.name + SUFFIX)
    return own if own.exists() else log.with_suffix(SUFFIX)


def new_journal_of(log: Path) -> Path:
    """Return the path of a new log's journal.

    The journal of ``run.blf`` is ``run.jsonl`` or, if another log such as ``run.log`` uses that name,
    ``run.blf.jsonl``.
    """
    others = [log.with_suffix(suffix) for suffix in WRITABLE if suffix != log.suffix]
    taken = log.with_suffix(SUFFIX).exists() and any(other.exists() for other in others)
    return log.with_name(log.name + SUFFIX) if taken else log.with_suffix(SUFFIX)


COMPLAINTS_KEPT: Final = 100
"""Maximum number of unreadable lines reported individually; further lines are only counted."""

_MOST: Final = 2**63 - 1
_MOST_SYNCS: Final = 2**53
"""Maximum accepted SYNC number, chosen so that the numbers of later SYNCs also fit in 64 bits."""
_LONGEST_HEADER: Final = 32 << 20
"""Maximum length of the first line in bytes. Long enough for the layout files of a hundred of the largest
patches."""
_LONGEST_LINE: Final = 2 << 20
"""Maximum length of a line in bytes. Long enough for an event containing the baseline and layout of the
largest patch; a longer line is read as several lines."""
_BESIDE_FILE: Final = {"coordinates"}
"""Keys that a patch's layout table may contain in addition to the name of a layout file."""
_OF_PATCHES: Final = ("resumed", "withheld", "polled", "overtaken")


@dataclass(frozen=True, slots=True)
class Header:
    """Contents of the first line of a journal."""

    hand: HandConfig
    started: str
    """Local date and time at which the recording began, in ISO 8601 format."""
    wall_minus_mono_ns: int
    """Log timestamp minus time on the host's monotonic clock, in ns."""
    layoutless: frozenset[str] = frozenset()
    """Names of the patches whose layout file is missing from an old journal."""

    def line(self) -> str:
        """Return the header as a line of JSON. Raises ConfigError if a layout file cannot be used."""
        table = _without_paths(self.hand.without_layout_files().table())
        times = {"started": self.started, "wall_minus_mono_ns": self.wall_minus_mono_ns}
        return json.dumps({"format": FORMAT, **times, "hand": table})


def _without_paths(value: Any) -> Any:
    """Remove file names, because the journal contains the layouts and the baselines from those files."""
    if isinstance(value, Mapping):
        kept = {key: item for key, item in value.items() if not isinstance(item, Path)}
        return {key: _without_paths(item) for key, item in kept.items()}
    if isinstance(value, (list, tuple)):
        return [_without_paths(item) for item in value]
    return value


def _hand_of(table: Mapping[str, Any], where: str) -> HandConfig:
    """Parse the hand in a header, without the checks that require a baseline file or a non-default period."""
    buses = [{**bus, "guest_sends": "sdo"} if bus.get("role") == "guest" else bus for bus in table["buses"]]
    sync = {"period_ms": SyncConfig().period_ms, **table.get("sync", {})}
    return parse_hand({**table, "buses": buses, "sync": sync}, where=where)


def _layoutless(table: Mapping[str, Any]) -> frozenset[str]:
    """Return the names of the patches whose layout file was omitted by an older version.

    The older version removed the file name from the layout table. A table with no keys other than
    ``coordinates`` must therefore have contained a file name.
    """
    patches = [patch for patch in table["patches"] if "layout" in patch]
    return frozenset(patch["name"] for patch in patches if not {*patch["layout"]} - _BESIDE_FILE)


def facts_table(facts: NodeFacts, planned: PatchLayout) -> dict[str, Any]:
    """Convert NodeFacts to a JSON object that preserves every number exactly.

    Args:
        facts: The facts.
        planned: Layout that a reader builds from the hand; the object contains the layout if it differs.
    """
    layout = facts.layout
    same = np.array_equal(layout.upper_m, planned.upper_m) and np.array_equal(layout.lower_m, planned.lower_m)
    own = {"upper_m": layout.upper_m.tolist(), "lower_m": layout.lower_m.tolist(), "name": layout.name}
    own["resistivity_ohm_per_m"] = layout.resistivity_ohm_per_m
    return {
        "serial": facts.serial,
        "heartbeat_s": facts.heartbeat_s,
        "checked": facts.checked,
        "lo": facts.scale.lo,
        "hi": facts.scale.hi,
        "baseline_ohm": facts.baseline_ohm.tolist(),
        "layout": None if same and own["resistivity_ohm_per_m"] == planned.resistivity_ohm_per_m else own,
    }


def facts_of(table: Mapping[str, Any], patch: PatchConfig, bus: BusConfig) -> NodeFacts:
    """Rebuild NodeFacts from the result of :func:`facts_table`.

    Args:
        table: JSON object from a line of the journal.
        patch: Configuration of the patch.
        bus: Configuration of the patch's bus.

    Raises:
        KeyError, TypeError, OverflowError, ValueError: The JSON object is malformed.
    """
    profile = PatchProfile.from_config(patch, bus)
    baseline = np.array(table["baseline_ohm"], dtype=np.float64)
    if baseline.shape != (profile.rows, profile.columns):
        raise ValueError(
            f"baseline_ohm: got shape {baseline.shape}, must be ({profile.rows}, {profile.columns})"
        )
    good = np.isfinite(baseline) & (baseline > 0)
    if not good.all():
        raise ValueError(f"baseline_ohm: got {baseline[~good][0]:g}, must be positive")
    own, layout = table["layout"], patch.layout.build()
    if own is not None:
        supplied = PatchLayout(
            np.array(own["upper_m"], dtype=np.float64),
            np.array(own["lower_m"], dtype=np.float64),
            own["resistivity_ohm_per_m"],
            own["name"],
        )
        if patch.layout.coordinates == "node":  # skinnode resolve can set "preset" instead
            layout = supplied
    scale = CodeScale(patch.code_bits, table["lo"], table["hi"])
    checked = table.get("checked", False)  # missing from journals that predate the check
    if not isinstance(checked, bool):
        raise TypeError(f"checked: got {checked!r}, must be true or false")
    return NodeFacts(
        patch, layout, profile, scale, baseline, table["serial"], table["heartbeat_s"], checked=checked
    )


def repaired_line(frames: int, damaged: int) -> str:
    """Return the journal line that marks a copy of a damaged recording.

    Args:
        frames: Number of frames in the copy.
        damaged: Number of unreadable parts before the end of the recording.
    """
    event = {"bus": "", "at": 0, "t_ns": 0, "event": "repaired", "frames": frames, "damaged": damaged}
    return json.dumps(event)


def read_journal(path: Path) -> tuple[Header, list[dict[str, Any]], list[str], list[bytes]]:
    """Read a journal.

    Args:
        path: The journal.

    Returns:
        The header, the events, a one-line message for each unreadable line, and all lines.

    Raises:
        ConfigError: The journal cannot be read, or its first line is not a header.
    """
    try:
        with path.open("rb") as file:
            kept: list[bytes] = []
            first = file.read(1)  # stop reading if this is not a journal
            if first == b"{":
                first += file.readline(_LONGEST_HEADER)
            lines = chain((first,), iter(lambda: file.readline(_LONGEST_LINE), b""))
            parsed = parse_journal(str(path), path.name, _noted(lines, kept))
            return *parsed, kept
    except OSError as error:
        allowed = (
            f"a journal next to the log ({error.strerror}); for a log without a journal, give --hand to "
            "skinnode replay, convert or resolve"
        )
        raise ConfigError("recording", str(path), allowed) from None


def _noted(lines: Iterable[bytes], kept: list[bytes]) -> Iterator[bytes]:
    """Yield the lines and append them to ``kept``."""
    for line in lines:
        kept.append(line)
        yield line


def parse_journal(
    where: str, name: str, lines: Iterable[bytes]
) -> tuple[Header, list[dict[str, Any]], list[str]]:
    """Parse the lines of a journal.

    Args:
        where: Path of the file, for error messages.
        name: Name of the file in messages about unreadable lines.
        lines: The lines, including their line feeds.

    Returns:
        The header, the events, and a one-line message for each unreadable line.

    Raises:
        ConfigError: The first line is not a header.
    """
    rest = iter(lines)
    line = next(rest, b"")
    try:
        first = json.loads(line)
        if first["format"] != FORMAT:
            raise ConfigError("format", first["format"], repr(FORMAT), where=where)
        header = Header(
            _hand_of(first["hand"], where),
            str(first["started"]),
            _whole(first["wall_minus_mono_ns"], least=-_MOST),
            _layoutless(first["hand"]),
        )
    except ConfigError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        shown = line.rstrip(b"\n")[:40].decode("ascii", "replace")
        raise ConfigError("line 1", shown, "the header of a recording's journal", where=where) from None
    events: list[dict[str, Any]] = []
    complaints: list[str] = []
    bad = 0
    for number, line in enumerate(rest, 2):
        if not line.strip():
            continue
        try:
            events.append({**_event(line, header.hand), "line": number})
        except (ValueError, KeyError, TypeError, RecursionError):
            bad += 1
            if bad <= COMPLAINTS_KEPT:
                what = "no event" if line.endswith(b"\n") else "truncated"
                complaints.append(f"{name} line {number}: {what}")
    if bad > COMPLAINTS_KEPT:
        complaints.append(f"{bad - COMPLAINTS_KEPT} more unreadable lines")
    return header, events, complaints


def _event(line: bytes, hand: HandConfig) -> dict[str, Any]:
    """Parse a line. Raises KeyError, TypeError, RecursionError or ValueError if the event is invalid."""
    event: dict[str, Any] = json.loads(line)
    _whole(event["at"])
    _whole(event["t_ns"])
    if not isinstance(event["bus"], str):
        raise TypeError
    match event["event"]:
        case "dropped":
            _whole(event["frames"])
        case "sync":
            _whole(event["number"], least=1, most=_MOST_SYNCS)
        case "ended":
            _whole(event.get("frames", 0))  # missing from old journals
        case "repaired":
            _whole(event["frames"])
            _whole(event["damaged"])

        case kind if kind in _OF_PATCHES and hand.patch(event["patch"]).bus == event["bus"]:
            if kind == "overtaken":
                _whole(event["scan"])
                _whole(event["received_ns"])
        case _:
            raise ValueError
    return event


def _whole(value: object, least: int = 0, most: int = _MOST) -> int:
    """Return ``value``. Raises ValueError if it is not an integer from ``least`` to ``most``."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError
    return value
