"""Reads the identity, state, settings and errors of a node. Nothing is written to the node."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from skinnode.canopen import indices as od
from skinnode.canopen.emergency import history_text, register_text
from skinnode.conformance.eds_reader import Eds, parse_eds
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.diagnose.data_sheet import read_profile
from skinnode.diagnose.pdo_parameters import Pdo, pdo_text, read_pdos
from skinnode.errors import NodeError, SdoAbort
from skinnode.host.sdo_client import RemoteOd
from skinnode.model.layout import PRESET_IDS, Float
from skinnode.protocol.eds_files import eds_text
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.self_test import SelfTestFault, SelfTestStatus
from skinnode.text.printable import printable
from skinnode.text.words import counted


@dataclass(frozen=True, slots=True)
class PatchInfo:
    """Information that is specific to a skinnode patch."""

    upper_wires: int
    lower_wires: int
    upper_electrodes: int
    lower_electrodes: int
    layout: str
    layout_hash: int
    resistivity_ohm_per_m: float
    code_bits: int
    code_lo: float
    code_hi: float
    pdo_bytes: int
    baseline_missing: int
    """Number of crossings without a baseline."""
    baseline_ohm: tuple[float, float, float] | None
    """Minimum, median and maximum R0 in ohms; None if there is no baseline."""
    send_changed_only: bool
    send_threshold_codes: int
    send_refresh_scans: int
    period_ms: int
    """Period of the node's own scan timer, in ms; 0 if the node scans at SYNC."""
    averaging: int
    open_upper: tuple[int, ...]
    shorted_upper: tuple[int, ...]
    open_lower: tuple[int, ...]
    shorted_lower: tuple[int, ...]
    """Indices of the open and shorted wires, counted from 0."""
    self_test: str
    rejected: dict[str, int]
    """Number of received frames that the node rejected, by reason; counts of 0 are omitted."""


@dataclass(frozen=True, slots=True)
class NodeInfo:
    """Information about a node; None stands for an object that the node does not have."""

    node_id: int
    state: str
    state_known_by: str
    name: str | None
    hardware_version: str | None
    software_version: str | None
    device_type: int | None
    vendor_id: int | None
    product_code: int | None
    revision: int | None
    serial: int | None
    error_register: int | None
    errors: tuple[str, ...]
    """Error history, newest first."""
    heartbeat_ms: int | None
    heartbeats_watched: tuple[str, ...]
    guarding: str
    sync: str
    on_communication_error: str
    storing: str
    pdos: tuple[Pdo, ...]
    pdo_texts: tuple[str, ...]
    patch: PatchInfo | None

    @property
    def faults(self) -> tuple[str, ...]:
        """Faults that the node reports, as text."""
        found = [f"error register: {register_text(self.error_register)}"] if self.error_register else []
        if self.patch is not None:
            if self.patch.baseline_missing:
                found.append(f"{self.patch.baseline_missing} crossings have no baseline; run skinnode tare")
            for text, wires in (
                ("upper wires open", self.patch.open_upper),
                ("upper wires shorted", self.patch.shorted_upper),
                ("lower wires open", self.patch.open_lower),
                ("lower wires shorted", self.patch.shorted_lower),
            ):
                if wires:
                    found.append(f"{text}: {', '.join(map(str, wires))}")
        return tuple(found)


class _Reader:
    """Reads objects of a node; None stands for an object that the node refuses to return."""

    def __init__(self, remote: RemoteOd) -> None:
        self.remote = remote

    def number(self, index: int, subindex: int = 0) -> int | None:
        data = self.data(index, subindex)
        return None if data is None else int.from_bytes(data, "little")

    def real(self, index: int, subindex: int) -> float:
        data = self.data(index, subindex)
        return float("nan") if data is None or len(data) != 4 else float(struct.unpack("<f", data)[0])

    def text(self, index: int) -> str | None:
        data = self.data(index)
        return None if data is None else printable(data)

    def data(self, index: int, subindex: int = 0) -> bytes | None:
        try:
            return self.remote.read_bytes(index, subindex)
        except SdoAbort:
            return None


def read_info(connection: BusConnection, node_id: int, sheet: Eds | None = None) -> NodeInfo:
    """Read all information about a node.

    Args:
        connection: The bus.
        node_id: The node.
        sheet: EDS of the node, for the names of mapped objects; not needed for a patch.

    Raises:
        NodeError: The node does not answer.
    """
    remote = connection.od(node_id)

    def its_state() -> str:
        return f" (NMT state according to its heartbeat: {connection.state(node_id, None, guarding=False)})"

    connection.require_answer(node_id, its_state)
    read = _Reader(remote)
    try:
        profile = read_profile(remote)
    except SdoAbort:  # no identity object, or no patch descriptor
        profile = None
    if profile is not None and sheet is None:
        sheet = parse_eds(eds_text(profile), "profile")

    def name_of(index: int, subindex: int) -> str:
        entry = None if sheet is None else sheet.find(index, subindex)
        return entry.name if entry is not None else f"0x{index:04X}:{subindex}"

    heartbeat_s = connection.heartbeat_s(node_id)
    state = connection.state(node_id, heartbeat_s, guarding=not connection.guarded(node_id))
    pdos = read_pdos(remote)
    identity = [read.number(od.IDENTITY, sub) for sub in (1, 2, 3, 4)]
    return NodeInfo(
        node_id=node_id,
        state=str(state),
        state_known_by=state.how,
        name=read.text(od.DEVICE_NAME_INDEX),
        hardware_version=read.text(od.HARDWARE_VERSION),
        software_version=read.text(od.SOFTWARE_VERSION),
        device_type=read.number(od.DEVICE_TYPE),
        vendor_id=identity[0],
        product_code=identity[1],
        revision=identity[2],
        serial=identity[3],
        error_register=read.number(od.ERROR_REGISTER),
        errors=_history(read, ours=profile is not None),
        heartbeat_ms=None if heartbeat_s is None else round(heartbeat_s * 1e3),
        heartbeats_watched=_watched(read),
        guarding=_guarding(read),
        sync=_sync(read),
        on_communication_error={0: "pre-operational", 1: "stays", 2: "stopped"}.get(
            read.number(od.ERROR_BEHAVIOUR, 1) or 0, "its own way"
        ),
        storing=_storing(read),
        pdos=pdos,
        pdo_texts=tuple(pdo_text(pdo, name_of) for pdo in pdos),
        patch=None if profile is None else _patch(read, profile, name_of),
    )


def _history(read: _Reader, *, ours: bool) -> tuple[str, ...]:
    count = min(read.number(od.ERROR_FIELD) or 0, 254)
    entries = [read.number(od.ERROR_FIELD, sub) for sub in range(1, count + 1)]
    return tuple(history_text(entry, ours=ours) for entry in entries if entry is not None)


def _watched(read: _Reader) -> tuple[str, ...]:
    entries = []
    for sub in range(1, min(read.number(od.HEARTBEAT_CONSUMER) or 0, od.MAX_NODE_ID) + 1):
        entry = read.number(od.HEARTBEAT_CONSUMER, sub) or 0
        if entry & 0xFFFF and 1 <= entry >> 16 & 0xFF <= od.MAX_NODE_ID:
            entries.append(f"node {entry >> 16 & 0xFF} within {entry & 0xFFFF} ms")
    return tuple(entries)


def _guarding(read: _Reader) -> str:
    time_ms, factor = read.number(od.GUARD_TIME), read.number(od.LIFE_TIME_FACTOR)
    return f"within {time_ms * factor} ms" if time_ms and factor else "none"


def _sync(read: _Reader) -> str:
    cob_id, period_us = read.number(od.COB_ID_SYNC), read.number(od.CYCLE_PERIOD)
    if cob_id is None:
        return "none"
    overflow = read.number(od.SYNC_COUNTER_OVERFLOW) or 0
    parts = [f"{'produces' if cob_id >> 30 & 1 else 'consumes'} 0x{cob_id & 0x7FF:03X}"]
    parts.append(f"every {period_us / 1000:g} ms" if period_us else "at any period")
    parts.append(f"counted to {overflow}" if overflow else "not counted")
    return ", ".join(parts)


def _storing(read: _Reader) -> str:
    able = read.number(od.STORE, 1) or 0
    if not able & 3:
        return "not supported: settings are lost at power-off"
    how = "by itself" if able & 2 else "on command"
    date, time = read.number(od.VERIFY_CONFIGURATION, 1), read.number(od.VERIFY_CONFIGURATION, 2)
    if date is None:
        return how
    stamp = f"verified, stamp {date} {time}" if date or time else "no verified configuration (0x1020)"
    return f"{how}; {stamp}"


def _patch(read: _Reader, profile: PatchProfile, name_of: Callable[[int, int], str]) -> PatchInfo:
    number, layouts = read.number, {value: name for name, value in PRESET_IDS.items()}
    baseline = read_baseline(read.remote, profile)
    known = baseline[baseline > 0]
    upper, lower = _masks(read, od.UPPER_WIRE_FAULTS), _masks(read, od.LOWER_WIRE_FAULTS)
    rejected = {name_of(od.REJECTED_FRAMES, sub): number(od.REJECTED_FRAMES, sub) or 0 for sub in range(1, 8)}
    return PatchInfo(
        upper_wires=profile.rows,
        lower_wires=profile.columns,
        upper_electrodes=profile.upper_electrodes,
        lower_electrodes=profile.lower_electrodes,
        layout=layouts.get(number(od.DESCRIPTOR, od.LAYOUT_ID) or 0, "unknown"),
        layout_hash=number(od.DESCRIPTOR, od.LAYOUT_HASH) or 0,
        resistivity_ohm_per_m=read.real(od.DESCRIPTOR, od.RESISTIVITY),
        code_bits=profile.code_bits,
        code_lo=read.real(od.DESCRIPTOR, od.CODE_LO),
        code_hi=read.real(od.DESCRIPTOR, od.CODE_HI),
        pdo_bytes=profile.pdo_bytes,
        baseline_missing=int(baseline.size - known.size),
        baseline_ohm=_spread(known) if known.size else None,
        send_changed_only=bool(number(od.SEND_POLICY, od.SEND_MODE)),
        send_threshold_codes=number(od.SEND_POLICY, od.SEND_THRESHOLD) or 0,
        send_refresh_scans=number(od.SEND_POLICY, od.SEND_REFRESH) or 0,
        period_ms=number(od.ACQUISITION, od.ACQUISITION_PERIOD) or 0,
        averaging=number(od.ACQUISITION, od.ACQUISITION_AVERAGING) or 1,
        open_upper=upper[0],
        shorted_upper=upper[1],
        open_lower=lower[0],
        shorted_lower=lower[1],
        self_test=_self_test(read),
        rejected={name: count for name, count in rejected.items() if count},
    )


def _spread(values: Float) -> tuple[float, float, float]:
    return float(values.min()), float(np.median(values)), float(values.max())


def read_baseline(remote: RemoteOd, profile: PatchProfile) -> Float:
    """Read the (U, K) baseline R0 in ohms; 0 for a crossing without a baseline.

    Raises NodeError if the transfer fails or the data have the wrong size.
    """
    data = remote.read_large(od.BASELINE_DOMAIN)
    if len(data) != 4 * profile.n_codes:
        raise NodeError(
            remote.node_id,
            f"baseline (0x2301): got {counted(len(data), 'byte')}, allowed: {4 * profile.n_codes}",
        )
    return np.frombuffer(data, "<f4").astype(np.float64).reshape(profile.rows, profile.columns)


def _masks(read: _Reader, index: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the open wires and the shorted wires from the fault masks in 0x2030 or 0x2031."""
    wires: tuple[list[int], list[int]] = ([], [])
    for sub in range(1, (read.number(index) or 0) + 1):
        word, first = read.number(index, sub) or 0, (sub - 1) // 2 * 32
        wires[(sub - 1) % 2].extend(first + bit for bit in range(32) if word >> bit & 1)
    return tuple(wires[0]), tuple(wires[1])


def _self_test(read: _Reader) -> str:
    status = read.number(od.SELF_TEST_RESULT, od.TEST_STATUS)
    if status is None or status == SelfTestStatus.NEVER_RUN:
        return "never run"
    noise = read.real(od.SELF_TEST_RESULT, od.TEST_NOISE)
    if status == SelfTestStatus.PASSED:
        return f"passed, noise {noise:.1e}"
    faults = SelfTestFault(read.number(od.SELF_TEST_RESULT, od.TEST_FAULTS) or 0)
    words = ", ".join((fault.name or "").lower().replace("_", " ") for fault in faults)
    return f"FAILED: {words}; noise {noise:.1e}"
