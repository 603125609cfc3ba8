"""Tare a patch: the node measures a new baseline, and the host uses it to solve subsequent scans."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from skinnode.config import HandConfig
from skinnode.errors import NodeTimeout, SkinError
from skinnode.host.health import PatchHealth
from skinnode.host.remote_node import RemoteNode
from skinnode.process import clock

TARE_DEADLINE_S: Final = 5.0
"""Default time limit (s) for a tare, to which :data:`TARE_DEADLINE_SYNCS` SYNC periods are added.

A tare usually takes 0.1 s to 0.3 s, but the host may wait up to 2 s between reads of a baseline.
"""

TARE_DEADLINE_SYNCS: Final = 3
"""Number of SYNC periods added to the time limit of a tare, because the node announces the new baseline in
the summary of the next scan.
"""

_LONGEST_S: Final = 600.0
"""Largest time limit (s) that a program may set. Larger values are probably milliseconds."""

_POLL_S: Final = 0.005


def tare_deadline_s(hand: HandConfig, deadline_s: float | None) -> float:
    """Return the time limit (s) for a tare.

    Args:
        hand: Configuration of the hand.
        deadline_s: Time limit (s) set by the program; None for the default.

    Raises:
        ValueError: if ``deadline_s`` is negative, above 600 s or not a number.
    """
    if deadline_s is None:
        return TARE_DEADLINE_S + TARE_DEADLINE_SYNCS * hand.sync.period_s
    if not 0 <= deadline_s <= _LONGEST_S:
        raise ValueError(f"deadline_s: got {deadline_s!r}, must be from 0 to {_LONGEST_S:g}")
    return deadline_s


def tare(
    node: RemoteNode,
    baselines: Callable[[], int],
    health: Callable[[], PatchHealth],
    deadline_s: float,
    cancelled: Callable[[], bool],
) -> None:
    """Tare a patch. Return as soon as the solver is using the new baseline.

    Args:
        node: The patch's node.
        baselines: Function that returns the number of new baselines that the host has read so far.
        health: Function that returns the current health of the patch.
        deadline_s: Time limit (s) for the new baseline.
        cancelled: Function that returns True to end the wait for the new baseline.

    Raises:
        NodeTimeout: if the solver does not have a new baseline in time.
        SkinError: if ``cancelled`` returned True, and for the reasons listed under :meth:`RemoteNode.tare`.
    """
    before, emergencies = baselines(), health().emergencies
    node.tare()
    end_s = clock.monotonic() + deadline_s
    while baselines() == before or node.stream.withholding:
        if clock.monotonic() > end_s:
            raise NodeTimeout(node.patch.node_id, _why(node, health(), emergencies, deadline_s))
        if cancelled():
            where = f"patch {node.patch.name!r} on {node.patch.bus}"
            raise SkinError(f"{where}: tare commanded, but the wait for the new baseline was cancelled")
        clock.sleep(_POLL_S)


def _why(node: RemoteNode, now: PatchHealth, emergencies: int, deadline_s: float) -> str:
    said = f"the patch is {now.condition}"
    if now.emergencies > emergencies and now.emergency_text:
        said += f" and reported {now.emergency_text}"
    where = f"patch {node.patch.name!r} on {node.patch.bus}"
    return f"{where}: tare commanded, but no new baseline arrived within {deadline_s:g} s; {said}"
