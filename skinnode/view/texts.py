"""Markdown text beside the picture: contacts and wrenches with standard deviations, health, bus load."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.host import HandFrame
from skinnode.model.hand_contact import HandContact, Wrench
from skinnode.model.layout import Float
from skinnode.monitor.view_model import View

_MARKS: Final = {"good": "✔", "note": "●", "bad": "✖"}
_NONE: Final = "not available"
_MARKDOWN: Final = str.maketrans({sign: f"\\{sign}" for sign in "\\`*_{}[]<>()#+!|~"} | {"\n": " "})


@dataclass(frozen=True, slots=True)
class DrawnCounts:
    """Field counts since the start. Their sum is the number of fields that the host has published."""

    drawn: int
    left_out: int
    """Number of fields replaced by a newer field of the same patch before they were drawn."""
    dropped: int
    """Number of fields lost because drawing was too slow."""


def contacts_text(frame: HandFrame) -> str:
    """Return the text that lists a hand's contacts and the total wrench on each link and on the hand.

    Args:
        frame: Newest fields of all patches.
    """
    if not frame.fields:
        return "No patch has a current field."
    wrenches = [*frame.wrenches.values(), frame.wrench]
    names = [*frame.wrenches, "whole hand"]
    one = len(frame.wrenches) == 1  # a single link's wrench equals the hand's in another coordinate frame
    rows = list(zip(names, wrenches, strict=True))[1 if one else 0 :]
    head = ("contact on", "normal force", "shear force", "position in the hand", "area")
    contacts = _table(head, [_contact_row(contact) for contact in frame.contacts])
    total = _table(("total on", "force x, y, z", "torque x, y, z"), [_wrench_row(*row) for row in rows])
    return "\n".join([*(contacts if frame.contacts else ["No contact."]), "", *total])


def _contact_row(contact: HandContact) -> tuple[str, ...]:
    along_n = float(contact.force_n @ contact.normal)
    shear_n = float(np.linalg.norm(contact.force_n - along_n * contact.normal))
    doubt = "" if contact.trusted else ", not trusted"
    return (
        f"{_plain(contact.patch)}{doubt}",
        f"{contact.normal_force_n:.2f} ± {contact.normal_force_std_n:.2f} N",
        f"{shear_n:.2f} N",
        f"{_three(1e3 * contact.position_m, 1)} ± {1e3 * float(contact.position_std_m.max()):.2f} mm",
        f"{1e6 * contact.area_m2:.0f} ± {1e6 * contact.area_std_m2:.0f} mm²",
    )


def _wrench_row(name: str, wrench: Wrench) -> tuple[str, ...]:
    return (
        _plain(name),
        f"{_three(wrench.force_n, 2)} ± {float(wrench.force_std_n.max()):.2f} N",
        f"{_three(1e3 * wrench.torque_nm, 1)} ± {1e3 * float(wrench.torque_std_nm.max()):.1f} N mm",
    )


def health_text(view: View, counts: DrawnCounts, notes: Iterable[str] = ()) -> str:
    """Return the text that describes the state of all patches and buses, including the field counts.

    Args:
        view: State of the hand.
        counts: Field counts.
        notes: Remarks about the picture, one line each.
    """
    patches = [
        (
            f"{_MARKS[patch.level]} {_plain(patch.name)}",
            _plain("; ".join([patch.condition, *patch.words, *_doubts(patch.trusted, patch.distrust)])),
            f"{patch.rate_hz:.1f} /s",
            "–" if patch.depth_m is None else f"{1e6 * patch.depth_m:.0f} µm",
        )
        for patch in view.patches
    ]
    buses = [
        (
            f"{_MARKS[bus.level]} {_plain(bus.name)}",
            _plain("; ".join(bus.words) or "no faults"),
            _NONE if bus.frames_hz is None else f"{bus.frames_hz:.0f} /s",
            _NONE if bus.load is None else f"{100 * bus.load:.0f} %",
        )
        for bus in view.buses
    ]
    late = "" if view.latency_s is None else f" Latency {1e3 * view.latency_s:.1f} ms (median)."
    drawn = f"Fields: {counts.drawn} drawn, {counts.left_out} left out, {counts.dropped} dropped.{late}"
    return "\n".join(
        [
            *_table(("patch", "state", "fields", "depth"), patches),
            "",
            *_table(("bus", "state", "frames", "load"), buses),
            "",
            drawn,
            *(f"\n{_plain(note)}" for note in notes),
        ]
    )


def _doubts(trusted: bool, distrust: str) -> list[str]:
    return [] if trusted or not distrust else [f"not trusted: {distrust}"]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]


def _three(vector: Float, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in vector)


def _plain(text: str) -> str:
    """Escape Markdown characters so that the viewer shows device names and messages literally."""
    return text.translate(_MARKDOWN)
