"""Describes a published hand to programs: its configuration, its layouts and its message versions.

The daemon sends the description as JSON in reply to a query.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from skinnode.config import HandConfig
from skinnode.errors import ConfigError, SkinError
from skinnode.messages.definitions import DEFINITIONS, FIELD, HEALTH_REPORT, version_of
from skinnode.model.layout import PatchLayout
from skinnode.record.journal import Header, parse_journal
from skinnode.remote import keys

if TYPE_CHECKING:
    import zenoh

_ANSWER_S: Final = 1.0
_VERSIONS: Final = {name: version_of(DEFINITIONS[name]) or 0 for name in (FIELD, HEALTH_REPORT)}
"""Versions of the messages that this package sends and reads."""


@dataclass(frozen=True, slots=True)
class Description:
    """Facts about a published hand. While it runs, only layouts that nodes supply can change."""

    hand: HandConfig
    """Configuration of the hand, without file names; programs always receive ``guest_sends`` as ``sdo``."""
    layouts: Mapping[str, PatchLayout]
    """Electrode layout of each patch, by patch name; the planned layout until the node has supplied its
    own."""
    boot_id: str
    """Boot ID of the daemon's operating system. Processes with the same boot ID share a monotonic clock."""
    commands: bool
    """Whether the daemon accepts commands."""
    started_ns: int
    """Unix time at which the daemon started, in ns; identifies the daemon's run in its fields and reports."""

    def agrees_with(self, other: Description) -> bool:
        """Return whether both descriptions have the same configuration and the same electrodes.

        Electrodes that the nodes supply may differ, because they are unknown before a node has appeared.
        """
        if self.hand.model_dump() != other.hand.model_dump() or self.layouts.keys() != other.layouts.keys():
            return False
        planned = [patch.name for patch in self.hand.patches if patch.layout.coordinates != "node"]
        return all(self.layouts[name].layout_hash == other.layouts[name].layout_hash for name in planned)

    def hashes(self) -> dict[str, int]:
        """Return the hash of each patch's layout, by patch name."""
        return {name: layout.layout_hash for name, layout in self.layouts.items()}

    def encode(self) -> bytes:
        """Encode the description as JSON."""
        layouts = {
            name: {
                "upper_m": layout.upper_m.tolist(),
                "lower_m": layout.lower_m.tolist(),
                "resistivity_ohm_per_m": layout.resistivity_ohm_per_m,
                "name": layout.name,
            }
            for name, layout in self.layouts.items()
        }
        table = {
            "versions": _VERSIONS,
            "header": Header(self.hand, "", 0).line(),
            "layouts": layouts,
            "boot_id": self.boot_id,
            "commands": self.commands,
            "started_ns": self.started_ns,
        }
        return json.dumps(table).encode()

    @classmethod
    def decode(cls, data: bytes, hand: str) -> Description:
        """Decode a description from JSON.

        Args:
            data: JSON text.
            hand: Name of the hand, for error messages.

        Raises:
            SkinError: if the daemon runs a version of skinnode with different messages.
        """
        try:
            table = json.loads(data)
            versions = {name: int(table["versions"][name]) for name in _VERSIONS}
            for name, ours in _VERSIONS.items():
                if versions[name] != ours:
                    what = f"sends version {versions[name]} of {name}, but this program reads version {ours}"
                    raise SkinError(
                        f"hand {hand!r}: its daemon {what}; install the same version on both sides"
                    )
            header, _, _ = parse_journal(f"hand {hand!r}", "description", [table["header"].encode()])
            layouts = {name: _layout(each) for name, each in table["layouts"].items()}
            return cls(
                header.hand,
                layouts,
                str(table["boot_id"]),
                bool(table["commands"]),
                int(table["started_ns"]),
            )
        except ConfigError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            why = f"its daemon sent no valid description ({error!r}); install the same version on both sides"
            raise SkinError(f"hand {hand!r}: {why}") from None


def boot_id() -> str:
    """Return the boot ID of this machine's operating system, or an empty string if it is unknown."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return ""


def ask(session: zenoh.Session, hand: str) -> Description | None:
    """Request a hand's description from its daemon; return None if no reply arrives within a second.

    Raises:
        SkinError: see :meth:`Description.decode`.
    """
    for reply in session.get(keys.description_key(hand), timeout=_ANSWER_S):
        if reply.ok is not None:
            return Description.decode(reply.ok.payload.to_bytes(), hand)
    return None


def _layout(table: Mapping[str, Any]) -> PatchLayout:
    upper_m, lower_m = (np.array(table[key], dtype=np.float64) for key in ("upper_m", "lower_m"))
    return PatchLayout(upper_m, lower_m, table["resistivity_ohm_per_m"], table["name"])
