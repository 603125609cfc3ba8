"""Saves and restores parameters: objects 0x1010 (store), 0x1011 (restore defaults) and 0x1020 (verify).

The objects are defined in CiA 301 v4.2. This module also saves the baseline and the LSS configuration of a
node. A *parameter* is an object that a client can write and read back; commands and computed objects are not
parameters.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.emergency import EmcyCode
from skinnode.node.memory import Fault, Kept, Memory, MemoryFault, Parameters
from skinnode.node.services import NodeServices
from skinnode.node.write_order import Key, write_configuration

COMMUNICATION: Final = 0x1000, 0x1FFF
"""First and last index of the communication parameters (CiA 301)."""
APPLICATION: Final = 0x2000, 0x9FFF
"""First and last index of the application parameters (CiA 301)."""
EVERYTHING: Final = 0x1000, 0x9FFF
"""First and last index of all parameters."""
_ALL, _COMMUNICATION_ONLY, _APPLICATION_ONLY = 1, 2, 3
"""Sub-indices of 0x1010 and 0x1011: all, communication or application parameters."""

_CAN_ID_MASK: Final = 0x7FF

Rows = tuple[tuple[float, ...], ...]


class Storage:
    """Saves and restores a node's non-volatile values, and implements the store and restore objects.

    If a value cannot be saved or restored, the node sends EMCY 0x6300. The first manufacturer-specific byte
    of this message is a :class:`~skinnode.node.memory.Fault`.

    Args:
        services: resources that all services of the node share.
        memory: memory of the node; None for a node without a memory. Without a memory, 0x1010 and 0x1011 read
            as 0 and refuse writes (CiA 301).
        patch: sizes and layout of the patch; see :class:`~skinnode.node.memory.Kept`.
    """

    def __init__(self, services: NodeServices, memory: Memory | None, patch: str) -> None:
        store = services.store
        self._store, self._emcy, self._memory, self._now = store, services.emcy, memory, services.now
        self._unreported: list[bytes] = []
        self._lasting: dict[Fault, bytes] = {}
        self._kept = Kept(patch)
        self.problem = ""
        """One-line description of the latest memory problem; empty if no problem has occurred."""
        self.baseline_ohm: Callable[[], Rows] = tuple
        """Function that returns the current baseline R0 in ohms; set by the application."""
        # The value 1 indicates that the node saves and restores parameters on command.
        able = int(memory is not None).to_bytes(4, "little")
        for index, signature, command in (
            (od.STORE, od.STORE_SIGNATURE, self._save),
            (od.RESTORE, od.RESTORE_SIGNATURE, self._forget),
        ):
            store.bind(index, lambda _: able)
            store.guard(index, self._obey(signature, command))
        store.watch_changes(self._on_change)

    @property
    def kept(self) -> Kept:
        """Usable content of the memory."""
        return self._kept

    @property
    def has_memory(self) -> bool:
        """Whether the node has a memory."""
        return self._memory is not None

    def load(self) -> None:
        """Load the memory's content at power-on. A memory without usable content is treated as empty."""
        patch = self._kept.patch
        self._kept, self._unreported, self._lasting, self.problem = Kept(patch), [], {}, ""
        try:
            kept = self._memory.load() if self._memory is not None else None
        except MemoryFault as error:
            self.note(error.fault, why=str(error))
            return
        if kept is not None and kept.patch != patch:
            self.note(
                Fault.FOREIGN,
                why=f"the content belongs to the patch {kept.patch!r}, but this patch is {patch!r}",
            )
        elif kept is not None:
            self._kept = kept

    def note(self, fault: Fault, index: int = 0, subindex: int = 0, why: str = "") -> None:
        """Record a fault, which :meth:`report` will report.

        Args:
            fault: type of the fault.
            index: index of a refused parameter.
            subindex: sub-index of a refused parameter.
            why: one-line description of the fault; if empty, the refused parameter is reported.
        """
        self.problem = why or f"the stored value of 0x{index:04X}:{subindex} is not allowed"
        detail = struct.pack("<BHB", fault, index, subindex)
        if fault is Fault.REFUSED:
            self._unreported.append(detail)
        else:
            self._lasting[fault] = detail

    def report(self, t_ns: int) -> None:
        """Send emergency messages for the faults recorded since the last call.

        A fault that affects the whole memory remains active, even across resets, until the memory is reliable
        again.
        """
        for fault, detail in self._lasting.items():
            self._emcy.report(EmcyCode.DATA_SET, detail, t_ns, fault)
        unreported, self._unreported = self._unreported, []
        for detail in unreported:
            self._emcy.report_once(EmcyCode.DATA_SET, detail, t_ns)

    def restore(self, first: int, last: int) -> None:
        """Set the objects from index ``first`` to index ``last`` to their power-on values.

        A saved value must pass the same checks as a value written by a client. An object without a
        saved value, or with a saved value that is not allowed, is set to its default.
        """
        self._store.restore(first, last)
        values: dict[Key, bytes] = {}
        for group in (self._kept.communication, self._kept.application):
            values |= {
                key: self._for_this_node(key, value, group.node_id)
                for key, value in group.values.items()
                if first <= key[0] <= last
            }
        for index, subindex in write_configuration(self._store, values):
            self.note(Fault.REFUSED, index, subindex)
        if self._present(*APPLICATION) != self._kept.application.values:
            self._clear_verification()  # the restored configuration differs from the verified one

    def keep_baseline(self) -> None:
        """Save only the baseline, if the node has a memory."""
        if self._memory is None:
            return
        try:
            self._keep(replace(self._kept, baseline_ohm=self.baseline_ohm()))
        except OSError as error:
            self.note(Fault.NOT_SAVED, why=f"baseline not saved: {error}")

    def keep_lss(self, node_id: int, bit_rate_bps: int | None) -> None:
        """Save the node-ID and bit rate configured by LSS.

        Args:
            node_id: 1 to 127, or 255 for no node-ID.
            bit_rate_bps: bit rate, bit/s; None to keep the current bit rate.

        Raises:
            OSError: if saving fails.
        """
        self._keep(replace(self._kept, node_id=node_id, bit_rate_bps=bit_rate_bps))

    def _keep(self, kept: Kept) -> None:
        assert self._memory is not None
        self._memory.save(kept)
        self._kept = kept
        self._settle(Fault.NOT_SAVED)

    def _settle(self, *faults: Fault) -> None:
        """Clear the given memory faults and report that they have ended."""
        for fault in faults:
            if self._lasting.pop(fault, None) is not None:
                self._emcy.clear(EmcyCode.DATA_SET, self._now(), fault)

    # --- objects

    def _obey(self, signature: int, command: Callable[[int], Kept]) -> Callable[[int, int], None]:
        def guard(subindex: int, value: int) -> None:
            if self._memory is None or value != signature:
                raise Refused(AbortCode.CANNOT_STORE)
            try:
                self._keep(command(subindex))
            except OSError:
                raise Refused(AbortCode.HARDWARE) from None
            # By giving the command, the user accepts the current parameters, so memory faults are cleared.
            # Automatic saving of the baseline does not clear memory faults.
            self._settle(Fault.UNREADABLE, Fault.DAMAGED, Fault.FOREIGN)

        return guard

    def _save(self, subindex: int) -> Kept:
        kept, node_id = self._kept, self._store.node_id
        communication, application = self._present(*COMMUNICATION), self._present(*APPLICATION)
        if subindex in (_ALL, _COMMUNICATION_ONLY):
            kept = replace(kept, communication=Parameters(node_id, communication))
        if subindex in (_ALL, _APPLICATION_ONLY):
            application_kept = Parameters(node_id, application)
            kept = replace(kept, application=application_kept, baseline_ohm=self.baseline_ohm())
        # Object 0x1020 identifies a whole configuration, so 0x1020 is saved only if the memory contains the
        # whole configuration.
        whole = kept.communication.values == communication and kept.application.values == application
        return kept if whole else _unverified(kept)

    def _forget(self, subindex: int) -> Kept:
        """Return the memory's content without the saved parameters; a reset then restores the defaults."""
        kept = _unverified(self._kept)
        if subindex in (_ALL, _COMMUNICATION_ONLY):
            kept = replace(kept, communication=Parameters())
        if subindex in (_ALL, _APPLICATION_ONLY):
            kept = replace(kept, application=Parameters())
        return kept

    def _on_change(self, index: int, subindex: int) -> None:
        if index != od.VERIFY_CONFIGURATION and (index, subindex) not in od.COMMANDS:
            self._clear_verification()

    def _clear_verification(self) -> None:
        """Mark the current configuration as not verified."""
        for subindex in (od.VERIFY_DATE, od.VERIFY_TIME):
            self._store.put(od.VERIFY_CONFIGURATION, subindex, 0)

    def _present(self, first: int, last: int) -> dict[Key, bytes]:
        changed = self._store.not_at_default(first, last)
        return {key: value for key, value in changed.items() if key not in od.COMMANDS}

    def _for_this_node(self, key: Key, value: bytes, node_id: int) -> bytes:
        """Return the value; change a COB-ID that is the default of ``node_id`` to this node's default."""
        if not self._store.has(*key):
            return value
        entry = self._store.find(*key)
        if not entry.plus_node_id or not isinstance(entry.default, int):
            return value
        number = int.from_bytes(value, "little")
        if (number ^ (entry.default + node_id)) & _CAN_ID_MASK:
            return value
        return (number - node_id + self._store.node_id).to_bytes(len(value), "little")


def _unverified(kept: Kept) -> Kept:
    group = kept.communication
    values = {key: value for key, value in group.values.items() if key[0] != od.VERIFY_CONFIGURATION}
    return replace(kept, communication=Parameters(group.node_id, values))
