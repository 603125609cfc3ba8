"""Tares patches by SDO, even while a host is running on the bus.

A write to 0x2021:4 starts the tare. The node responds only after the measurement, so the response confirms
the tare. The summary of the next scan reports the change, and a running host then uploads the new baseline.
An SDO server handles one transfer at a time: a request from this program would abort the host's upload. This
program therefore reads the baseline back only when the node's SDO channel is idle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode
from skinnode.canopen.nmt import NmtState
from skinnode.config import BusConfig, PatchConfig
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.diagnose.data_sheet import read_profile
from skinnode.errors import BusError, NodeError, SdoAbort
from skinnode.host.sdo_client import RemoteOd
from skinnode.model.baseline_change import touched_crossings
from skinnode.model.layout import Float
from skinnode.process import clock
from skinnode.protocol.profile import PatchProfile

QUIET_S: Final = 0.3
"""Time without SDO frames, in s, after which an SDO channel is considered idle."""

HOST_BEGINS_S: Final = 1.0
"""Maximum time in seconds, in addition to one SYNC period, from the tare to a running host's first SDO
request. A host on an idle machine needs 0.3 s."""

OTHERS_S: Final = 4.0
"""Maximum wait for the SDO transfers of other clients to end, in s."""

_ATTEMPTS: Final = 3
_POLL_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Tared:
    """Result of taring one patch."""

    patch: str
    """Name of the patch; empty if there is no hand file."""
    node_id: int
    bus: str
    problem: str
    """Reason why the patch was not tared; empty if it was tared."""
    crossings: int = 0
    """Number of crossings with a new R0."""
    median_ohm: float | None = None
    """Median of the new R0 values, in ohms."""
    median_change: float | None = None
    """Median of (new R0 / old R0) − 1; None if there were no old R0 values."""
    touched_crossings: int = 0
    """Number of crossings whose change in R0 suggests a touch during this or the previous tare."""
    touched_change: float = 0.0
    """Largest relative change among these crossings, after subtracting the changes of their wires."""

    @property
    def done(self) -> bool:
        """Whether the patch was tared."""
        return not self.problem


def refusal(patch: PatchConfig, bus: BusConfig) -> str:
    """Return the reason why the hand file rules out taring this patch; empty if it does not."""
    if patch.baseline is not None:
        return f"a host would overwrite the new baseline with {patch.baseline}"
    if bus.role == "guest" and bus.guest_sends == "nothing":
        return f"the hand file forbids sending on {bus.name} (role guest, guest_sends nothing)"
    return ""


def tare(
    connection: BusConnection,
    node_id: int,
    patch: str,
    *,
    sync_period_s: float = 0.0,
    progress: Callable[[str], None] = lambda _: None,
) -> Tared:
    """Tare one node and read back its new baseline.

    Args:
        connection: The bus.
        node_id: The node.
        patch: Name of the patch; empty if there is no hand file.
        sync_period_s: SYNC period of the hand, in s.
        progress: Called with a description of each step.

    Returns:
        The result, which also reports a node that does not answer or refuses to tare.

    Raises:
        BusError: The bus failed.
    """
    try:
        return _tare(connection, node_id, patch, sync_period_s, progress)
    except NodeError as error:
        problem = str(error).removeprefix(f"node {node_id}: ")
        return Tared(patch, node_id, connection.bus.name, problem)


def _tare(
    connection: BusConnection, node_id: int, patch: str, sync_period_s: float, progress: Callable[[str], None]
) -> Tared:
    who = patch or f"node {node_id}"
    remote = connection.od(node_id)
    progress(f"{who}: waiting for other SDO clients")
    _let_others_finish(connection, node_id, at_least_s=0.0)
    connection.require_answer(node_id)
    profile = read_profile(remote)
    if profile is None:
        raise NodeError(node_id, "is not a skinnode patch")
    before = _baseline(connection, remote, profile)
    progress(f"{who}: taring")
    try:
        remote.write(od.ACQUISITION, od.TARE, "u32", od.TARE_SIGNATURE)
    except SdoAbort as abort:
        if abort.code != AbortCode.HARDWARE:
            raise
        raise NodeError(
            node_id, f"its converter returned no reading (SDO abort 0x{abort.code:08X})"
        ) from None
    runs = _runs(connection, node_id)
    progress(f"{who}: reading its baseline")
    _let_others_finish(connection, node_id, at_least_s=HOST_BEGINS_S + sync_period_s if runs else 0.0)
    after = _baseline(connection, remote, profile)
    good = np.isfinite(after) & (after > 0)
    missing = int((~good).sum())
    known = good & np.isfinite(before) & (before > 0)
    change = float(np.median(after[known] / before[known] - 1.0)) if known.any() else None
    median_ohm = float(np.median(after[good])) if good.any() else None
    problem = f"{missing} of {after.size} crossings have no baseline" if missing else ""
    touched = touched_crossings(before, after)
    return Tared(patch, node_id, connection.bus.name, problem, int(good.sum()), median_ohm, change, *touched)


def _runs(connection: BusConnection, node_id: int) -> bool:
    """Return whether the node is running: it sends chunks, or its heartbeat reports OPERATIONAL."""
    beat = connection.listener.newest_beat(node_id)
    operational = beat is not None and beat.state == NmtState.OPERATIONAL
    return operational or connection.listener.cob_ids[od.chunk_cob_id(node_id)] > 0


def _baseline(connection: BusConnection, remote: RemoteOd, profile: PatchProfile) -> Float:
    """Read the (U, K) baseline R0 in ohms. An upload interrupted by another client is repeated.

    Raises NodeError if all attempts fail, or if the data have the wrong size.
    """
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            data = remote.read_block(od.BASELINE_DOMAIN)
            break
        except NodeError:
            if attempt == _ATTEMPTS:
                raise
            _let_others_finish(connection, remote.node_id, at_least_s=QUIET_S)
    values = np.frombuffer(data, dtype="<f4").astype(np.float64)
    if values.size != profile.n_codes:
        wanted = f"{profile.rows} × {profile.columns}"
        raise NodeError(remote.node_id, f"baseline (0x2301): got {values.size} values, allowed: {wanted}")
    return values.reshape(profile.rows, profile.columns)


def _let_others_finish(connection: BusConnection, node_id: int, *, at_least_s: float) -> None:
    """Wait until the node's SDO channel has been idle for QUIET_S, but no longer than OTHERS_S.

    Unless another client starts a transfer, the wait lasts at least ``at_least_s``.
    """
    begun_s = quiet_s = clock.monotonic()
    request, response = od.sdo_request_cob_id(node_id), od.sdo_response_cob_id(node_id)
    count, heard = -1, False
    while (now_s := clock.monotonic()) - begun_s < OTHERS_S:
        counted = connection.listener.cob_ids[request] + connection.listener.cob_ids[response]
        if counted != count:
            heard, count, quiet_s = count >= 0, counted, now_s
        waited = heard or now_s - begun_s >= at_least_s
        if waited and now_s - quiet_s >= QUIET_S:
            return
        connection.wait_until(lambda: False, _POLL_S)
    if connection.link.failure is not None:
        raise BusError(str(connection.link.failure))
