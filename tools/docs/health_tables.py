"""Generates the tables of patch conditions, simulated faults and imperfections from their definitions."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Final

import markdown_text as md

from skinnode.host.health import Condition
from vcan_sim.bus_attacker import BusFaults
from vcan_sim.faults import OF_CHUNKS, OF_READINGS, OF_SCANS, OF_WIRES, Faults
from vcan_sim.skin.imperfections import Imperfections

_PLAIN: Final = {
    "NEVER_SEEN": "No frame from the patch has arrived since the host started.",
    "OPERATIONAL": "All is well.",
}
"""Descriptions of conditions that have no docstring."""


def conditions() -> str:
    docs = {**_PLAIN, **md.member_docs(Condition)}
    return md.table(("condition", "when"), ((str(c), _without_reference(docs[c.name])) for c in Condition))


def _without_reference(text: str) -> str:
    return re.sub(r": see `\w+`", "", text)


def faults() -> str:
    """Return a table of the faults that `vcan-sim --fault` can inject into a node."""
    docs = md.member_docs(Faults)
    kinds = {"bool": "on or off", "int": "integer", "int | None": "integer"}
    rows = []
    for name, kind in inspect.get_annotations(Faults).items():
        value = kinds.get(str(kind), "fraction of the frames")
        if name in (*OF_CHUNKS, *OF_SCANS):
            value = "fraction of the chunks" if name in OF_CHUNKS else "fraction of the scans"
        elif name in OF_READINGS:
            value = "fraction of the readings"
        elif name in OF_WIRES:
            value = "number of a wire"
        elif name.endswith("_k"):
            value = "kelvin"
        elif name.endswith("_s"):
            value = "seconds" if name.startswith("restart") else "per second"
        rows.append((md.code(name), value, docs.get(name, "Does not arrive.")))
    return md.table(("fault", "value", "what happens"), rows)


def bus_faults() -> str:
    """Return a table of the faults that the simulator can inject into a bus."""
    docs, kinds = md.member_docs(BusFaults), {"bool": "on or off", "int": "integer"}
    rows = []
    for name, kind in inspect.get_annotations(BusFaults).items():
        value = "per second" if name.endswith("_per_s") else kinds.get(str(kind), "fraction")
        rows.append((md.code(name), value, docs[name]))
    return md.table(("fault", "value", "what happens"), rows)


def imperfections() -> str:
    """Return a table of patch imperfections, with their values for an ordinary simulated patch."""
    docs, ordinary = md.member_docs(Imperfections), Imperfections.ordinary()
    rows = [
        (md.code(name), docs[name], _size(getattr(ordinary, name)))
        for name in inspect.get_annotations(Imperfections)
    ]
    return md.table(("name", "what it is", "ordinary"), rows)


def _size(value: object) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_size, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


TABLES: Final[dict[str, Callable[[], str]]] = {
    "conditions": conditions,
    "injected-faults": faults,
    "injected-bus-faults": bus_faults,
    "imperfections": imperfections,
}
