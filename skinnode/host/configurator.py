"""Configure a node: check its identity and layout, write its parameters, and read its baseline.

A node-ID may belong to a different kind of device, such as a motor drive. The host therefore compares a
node's identity and layout with the hand file before it writes anything. It reads back every parameter that it
writes.

On a bus that another master runs, the host sends no NMT commands and leaves the SYNC parameters unchanged. It
writes a patch-specific parameter only if the node's value differs from the hand file. With
``guest_sends = "nothing"``, the host sends no frames and reads all facts about the node from files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skinnode.bus_load.plan import inhibit_time_100us
from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode
from skinnode.config import BusConfig, HandConfig, PatchConfig
from skinnode.errors import NodeError, NodeTimeout, SdoAbort
from skinnode.host import nmt_master
from skinnode.host.hand_files import load_baseline
from skinnode.host.node_facts import NodeFacts
from skinnode.host.sdo_client import Abandoned, RemoteOd
from skinnode.model.layout import Float, PatchLayout
from skinnode.process import clock
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.coordinates import unpack_coordinates
from skinnode.protocol.profile import PatchProfile
from skinnode.text.words import counted

BOOT_DEADLINE_S: Final = 3.0
"""Time limit (s) for a node's first response. Booting and the initial tare together take less than 1 s.
"""

HEARTBEATS_WATCHED: Final = 3
"""Number of heartbeat periods without a host heartbeat after which a node stops sending scans."""

_POLL_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Configurator:
    """Configurator for the nodes on one bus.

    Threads: nodes may be configured in parallel, one thread per node.
    """

    send: Callable[[int, bytes], None]
    hand: HandConfig
    bus: BusConfig
    boot_deadline_s: float
    abandoned: Callable[[], bool]
    """Function polled during configuration. If it returns True, :meth:`configure` raises Abandoned."""
    on_answer: Callable[[PatchConfig], None]
    """Function called when a node responds for the first time."""
    search: Callable[[PatchConfig], object]
    """Function that looks for a silent node by serial number."""

    def configure(self, patch: PatchConfig, profile: PatchProfile, remote: RemoteOd) -> NodeFacts:
        """Wait for the node, check its identity and configure it.

        If the host is the NMT master, it leaves the node in NMT state pre-operational.

        Args:
            patch: Configuration of the patch from the hand file.
            profile: PDO format of the patch.
            remote: Object dictionary of the patch's node.

        Raises:
            NodeTimeout: if the node does not respond in time.
            NodeError: if the node does not match the hand file or does not keep a parameter.
            SdoAbort: if the node aborts an SDO transfer.
            ConfigError: if the baseline file does not match the patch.
            Abandoned: if ``abandoned`` returned True.
        """
        if not (self.bus.role == "master" or self.bus.guest_sends == "sdo"):
            return self._from_files(patch, profile)
        master = self.bus.role == "master"
        self._wait_for(patch, remote)
        self.on_answer(patch)
        serial, revision = self._identify(patch, remote)
        profile = replace(profile, checked=revision > od.UNCHECKED_REVISION_NUMBER)
        layout = self._check_layout(patch, profile, remote)
        if master:
            nmt_master.stand_by(self.send, patch.node_id)
            self._configure_communication(remote)
        heartbeat_s = self._configure_heartbeat(remote, master=master)
        self._configure_patch(patch, profile, remote, master=master)
        scale = CodeScale(
            patch.code_bits,
            remote.read(od.DESCRIPTOR, od.CODE_LO, "f32"),
            remote.read(od.DESCRIPTOR, od.CODE_HI, "f32"),
        )
        baseline_ohm = self.settle_baseline(patch, profile, remote)
        return NodeFacts(
            patch, layout, profile, scale, baseline_ohm, serial, heartbeat_s, checked=profile.checked
        )

    def _from_files(self, patch: PatchConfig, profile: PatchProfile) -> NodeFacts:
        assert patch.baseline is not None  # checked when the hand file was loaded
        baseline_ohm = load_baseline(patch.baseline, profile)
        scale, heartbeat_s = CodeScale(patch.code_bits), self.hand.bring_up.heartbeat_s
        return NodeFacts(patch, patch.layout.build(), profile, scale, baseline_ohm, None, heartbeat_s)

    def _go_on(self) -> None:
        if self.abandoned():
            raise Abandoned

    def _wait_for(self, patch: PatchConfig, remote: RemoteOd) -> None:
        end_s = clock.monotonic() + self.boot_deadline_s
        while not remote.answers():
            self._go_on()
            self.search(patch)
            if clock.monotonic() > end_s:
                raise NodeTimeout(
                    patch.node_id,
                    f"patch {patch.name!r} on {patch.bus}: no response within {self.boot_deadline_s:g} s",
                )

    def _identify(self, patch: PatchConfig, remote: RemoteOd) -> tuple[int, int]:
        """Check the identity object (0x1018). Return the serial and revision numbers."""
        for subindex, what, expected in (
            (od.IDENTITY_VENDOR, "vendor-ID", od.VENDOR_ID),
            (od.IDENTITY_PRODUCT, "product code", od.PRODUCT_CODE),
        ):
            got = remote.read(od.IDENTITY, subindex, "u32")
            if got != expected:
                raise _mismatch(patch, what, f"0x{got:08X}", f"0x{expected:08X} (a skinnode patch)")
        revision = int(remote.read(od.IDENTITY, od.IDENTITY_REVISION, "u32"))
        if revision >> 16 != od.REVISION_NUMBER >> 16:  # the major revision identifies the CANopen behaviour
            allowed = f"{od.REVISION_NUMBER >> 16}.x"
            raise _mismatch(patch, "revision", f"{revision >> 16}.{revision & 0xFFFF}", allowed)
        serial = int(remote.read(od.IDENTITY, od.IDENTITY_SERIAL, "u32"))
        if patch.serial is not None and serial != patch.serial:
            raise _mismatch(patch, "serial number", str(serial), f"{patch.serial} as in the hand file")
        return serial, revision

    def _check_layout(self, patch: PatchConfig, profile: PatchProfile, remote: RemoteOd) -> PatchLayout:
        for subindex, what, expected in (
            (od.ROWS, "upper wires", profile.rows),
            (od.COLUMNS, "lower wires", profile.columns),
            (od.UPPER_ELECTRODES, "electrodes per upper wire", profile.upper_electrodes),
            (od.LOWER_ELECTRODES, "electrodes per lower wire", profile.lower_electrodes),
            (od.CODE_BITS, "code bits", profile.code_bits),
            (od.PDO_BYTES, "bytes of a PDO", profile.pdo_bytes),
        ):
            got = remote.read(od.DESCRIPTOR, subindex, "u8")
            if got != expected:
                raise _mismatch(patch, what, str(got), f"{expected} as in the hand file")
        got = remote.read(od.DESCRIPTOR, od.LAYOUT_HASH, "u32")
        layout, source = patch.layout.build(), "as in the hand file"
        if patch.layout.coordinates == "node":
            layout, source = self._read_layout(patch, profile, remote), "from the node's own coordinates"
        if got != layout.layout_hash:
            expected_hash = f"0x{layout.layout_hash:08X} ({layout.name} {source})"
            raise _mismatch(patch, "layout hash", f"0x{got:08X}", expected_hash)
        return layout

    def _read_layout(self, patch: PatchConfig, profile: PatchProfile, remote: RemoteOd) -> PatchLayout:
        """Build the layout from the electrode coordinates stored on the node."""
        self._go_on()
        data = remote.read_block(od.COORDINATES)
        resistivity = remote.read(od.DESCRIPTOR, od.RESISTIVITY, "f32")
        try:
            return unpack_coordinates(data, profile, resistivity)
        except ValueError as error:  # ConfigError is a ValueError
            raise _mismatch(patch, "electrode coordinates", counted(len(data), "byte"), str(error)) from None

    def _configure_communication(self, remote: RemoteOd) -> None:
        """Write the SYNC and heartbeat consumer parameters. Only the NMT master of the bus may set them."""
        self._go_on()
        sync = self.hand.sync
        remote.write_checked(od.COB_ID_SYNC, 0, "u32", od.SYNC_COB_ID)
        # The overflow value is writable only while the cycle period is 0 (CiA 301, 7.5.2.22).
        remote.write_checked(od.CYCLE_PERIOD, 0, "u32", 0)
        remote.write_checked(od.SYNC_COUNTER_OVERFLOW, 0, "u8", sync.counter_overflow)
        remote.write_checked(od.CYCLE_PERIOD, 0, "u32", sync.period_ms * 1000)
        _open_window(remote)
        watched = 0
        if self.bus.heartbeat_node_id is not None:
            within_ms = HEARTBEATS_WATCHED * self.hand.bring_up.heartbeat_ms
            watched = self.bus.heartbeat_node_id << 16 | within_ms
        _watch_master(remote, watched)

    def _configure_heartbeat(self, remote: RemoteOd, *, master: bool) -> float:
        """Set the heartbeat period, or keep the one set by another master. Return the period (s)."""
        heartbeat_ms = self.hand.bring_up.heartbeat_ms
        if not master:
            present_ms = int(remote.read(od.HEARTBEAT_PRODUCER, 0, "u16"))
            if present_ms:
                return present_ms * 1e-3
        remote.write_checked(od.HEARTBEAT_PRODUCER, 0, "u16", heartbeat_ms)
        return heartbeat_ms * 1e-3

    def _configure_patch(
        self, patch: PatchConfig, profile: PatchProfile, remote: RemoteOd, *, master: bool
    ) -> None:
        """Write the acquisition, send policy and TPDO parameters."""
        sync = self.hand.sync
        if not master:
            overflow = remote.read(od.SYNC_COUNTER_OVERFLOW, 0, "u8")
            if overflow != sync.counter_overflow:
                allowed = f"{sync.counter_overflow} as in sync.counter_overflow in the hand file"
                raise _mismatch(patch, "SYNC counter overflow, set by another master", str(overflow), allowed)
        write = remote.write_checked if master else remote.write_if_different
        write(od.ACQUISITION, od.ACQUISITION_PERIOD, "u16", 0)
        write(od.SEND_POLICY, od.SEND_MODE, "u8", 0)
        self._check_mapping(patch, profile, remote)
        inhibit_100us = inhibit_time_100us(sync.period_ms, profile.n_chunks + 1)
        for index, cob_id, kind, inhibit in (
            (od.TPDO1_PARAMETER, od.chunk_cob_id(patch.node_id), 254, inhibit_100us),
            (od.TPDO2_PARAMETER, od.summary_cob_id(patch.node_id), 1, 0),
        ):
            self._go_on()
            expected = (
                (od.PDO_TYPE, "u8", kind),
                (od.PDO_INHIBIT_TIME, "u16", inhibit),
                (od.PDO_EVENT_TIMER, "u16", 0),
                (od.PDO_COB_ID, "u32", cob_id),
            )
            if not master and all(remote.read(index, sub, size) == value for sub, size, value in expected):
                continue
            remote.write_checked(index, od.PDO_COB_ID, "u32", cob_id | od.PDO_INVALID)
            for sub, size, value in expected:
                remote.write_checked(index, sub, size, value)

    def _check_mapping(self, patch: PatchConfig, profile: PatchProfile, remote: RemoteOd) -> None:
        """Check the node's PDO mapping against the mapping that the decoder expects for this revision."""
        expected = {item.index: item for item in profile.objects()}
        for index in (od.TPDO1_MAPPING, od.TPDO2_MAPPING):
            count = int(expected[index][0].default or 0)
            got = remote.read(index, 0, "u8")
            if got != count:
                raise _mismatch(patch, f"entries mapped in 0x{index:04X}", str(got), str(count))
            for subindex in range(1, count + 1):
                entry, mapped = expected[index][subindex].default, remote.read(index, subindex, "u32")
                if mapped != entry:
                    what = f"object mapped by 0x{index:04X}:{subindex}"
                    raise _mismatch(patch, what, f"0x{mapped:08X}", f"0x{entry:08X}")

    def settle_baseline(self, patch: PatchConfig, profile: PatchProfile, remote: RemoteOd) -> Float:
        """Return the node's baseline.

        If the hand file names a baseline file, its values are first written to the node, unless the node
        already has them. During a tare, the baseline reads as zeros. The tare must finish before the boot
        deadline.

        Returns:
            (U, K) resistances at rest, in ohms.

        Raises:
            NodeError: if the node does not keep the written baseline, or a resistance is not positive.
            SkinError: for the reasons listed under :meth:`configure`.
        """
        expected = None if patch.baseline is None else load_baseline(patch.baseline, profile)
        end_s = clock.monotonic() + self.boot_deadline_s
        while True:
            self._go_on()
            baseline = self._read_baseline(patch, profile, remote)
            if expected is not None and not np.array_equal(baseline, expected):
                remote.write_block(od.BASELINE_DOMAIN, expected.astype("<f4").tobytes())
                baseline = self._read_baseline(patch, profile, remote)
                if not np.array_equal(baseline, expected):
                    expected_from = f"those of {patch.baseline}"
                    raise _mismatch(patch, "baseline (0x2301)", "other values back", expected_from)
            if baseline.any() or clock.monotonic() > end_s:
                break
            clock.sleep(_POLL_S)
        bad = np.argwhere(~(np.isfinite(baseline) & (baseline > 0)))
        if len(bad):
            row, column = (int(i) for i in bad[0])
            what = f"baseline of upper wire {row}, lower wire {column}"
            raise _mismatch(
                patch, what, f"{baseline[row, column]:g} ohm", "a positive resistance (tare the patch)"
            )
        return baseline

    def _read_baseline(self, patch: PatchConfig, profile: PatchProfile, remote: RemoteOd) -> Float:
        """Read the baseline by block transfer, or value by value if the node does not support block transfer.

        At 1 Mbit/s, a block transfer of 300 values takes 176 frames and 86 ms, limited by the rate at which
        the node sends segments. Single reads take 600 frames and 75 ms, plus the node's response times.
        """
        try:
            data = remote.read_block(od.BASELINE_DOMAIN, 4 * profile.n_codes)
        except SdoAbort as abort:
            if abort.code not in (AbortCode.NO_OBJECT, AbortCode.UNKNOWN_COMMAND):
                raise
            return self._read_baseline_singly(profile, remote)
        if len(data) != 4 * profile.n_codes:
            raise _mismatch(
                patch, "baseline (0x2301)", counted(len(data), "byte"), f"{4 * profile.n_codes} bytes"
            )
        return np.frombuffer(data, dtype="<f4").reshape(profile.rows, profile.columns).astype(np.float64)

    def _read_baseline_singly(self, profile: PatchProfile, remote: RemoteOd) -> Float:
        baseline = np.empty((profile.rows, profile.columns))
        for row in range(profile.rows):
            self._go_on()
            for column in range(profile.columns):
                baseline[row, column] = remote.read(od.BASELINE + row, column + 1, "f32")
        return baseline


def is_configured(patch: PatchConfig, hand: HandConfig, remote: RemoteOd) -> bool:
    """Return whether a node still has the parameters that it needs to send scans.

    The parameters are lost if the node resets during bring-up without the host noticing, or if another master
    reconfigures the node.

    Returns:
        True if the node has the values that the host would write.

    Raises:
        NodeError: if reading fails; see :class:`RemoteOd`.
    """
    expected = (
        (od.SYNC_COUNTER_OVERFLOW, 0, "u8", hand.sync.counter_overflow),
        (od.TPDO1_PARAMETER, od.PDO_COB_ID, "u32", od.chunk_cob_id(patch.node_id)),
        (od.TPDO2_PARAMETER, od.PDO_COB_ID, "u32", od.summary_cob_id(patch.node_id)),
    )
    return all(remote.read(index, subindex, kind) == value for index, subindex, kind, value in expected)


def _open_window(remote: RemoteOd) -> None:
    """Disable the synchronous window (0x1007), which may be too short for a whole scan.

    A node without this object has no synchronous window.
    """
    try:
        remote.write_checked(od.SYNC_WINDOW, 0, "u32", 0)
    except SdoAbort as abort:
        if abort.code != AbortCode.NO_OBJECT:
            raise


def _watch_master(remote: RemoteOd, watched: int) -> None:
    """Make the node monitor the host's heartbeat, using entry 1 of object 0x1016.

    Two entries must not contain the same node-ID, so any other entry with the host's node-ID is cleared. The
    remaining entries are left unchanged.
    """
    try:
        remote.write_checked(od.HEARTBEAT_CONSUMER, 1, "u32", watched)
    except SdoAbort as abort:
        if abort.code != AbortCode.INCOMPATIBLE:
            raise
        for subindex in range(2, int(remote.read(od.HEARTBEAT_CONSUMER, 0, "u8")) + 1):
            entry = int(remote.read(od.HEARTBEAT_CONSUMER, subindex, "u32"))
            if entry >> 16 == watched >> 16:
                remote.write_checked(od.HEARTBEAT_CONSUMER, subindex, "u32", 0)
        remote.write_checked(od.HEARTBEAT_CONSUMER, 1, "u32", watched)


def _mismatch(patch: PatchConfig, what: str, got: str, expected: str) -> NodeError:
    return NodeError(
        patch.node_id, f"patch {patch.name!r} on {patch.bus}: {what}: got {got}, expected {expected}"
    )
