"""Stores a node's parameters, baseline and LSS configuration.

This module implements objects 0x1010 (store parameters), 0x1011 (restore default parameters) and 0x1020
(verify configuration) of CiA 301 v4.2. A *parameter* is an object that a client can write and read back.
Commands and computed objects are not parameters.
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
"""Sub-indices of 0x1010 and 0x1011 that select all, communication or application parameters."""

_CAN_ID_MASK: Final = 0x7FF

Rows = tuple[tuple[float, ...], ...]


class Storage:
    """Saves and restores the non-volatile values of a node.

    If saving or restoring fails, the node sends EMCY 0x6300, whose first manufacturer-specific byte is a
    :class:`~skinnode.node.memory.Fault`.

    Args:
        services: Resources that all services of the node share.
        memory: Memory of the node, or None. Without a memory, 0x1010 and 0x1011 read as 0 and refuse writes
            (CiA 301).
        patch: Identifier of the patch's dimensions and layout; see :class:`~skinnode.node.memory.Kept`.
    """

    def __init__(self, services: NodeServices, memory: Memory | None, patch: str) -> None:
        store = services.store
        self._store, self._emcy, self._memory, self._now = store, services.emcy, memory, services.now
        self._unreported: list[bytes] = []
        self._lasting: dict[Fault, bytes] = {}
        self._kept = Kept(patch)
        self.problem = ""
        """One-line description of the latest memory problem; empty if there has been none."""
        self.baseline_ohm: Callable[[], Rows] = tuple
        """Function that returns the baseline R0 in ohms. Set by the application."""
        # 1 means that the node saves or restores parameters on command.
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
        """Memory contents; empty if none are usable."""
        return self._kept

    @property
    def has_memory(self) -> bool:
        """Whether the node has non-volatile memory."""
        return self._memory is not None

    def load(self) -> None:
        """Load the memory contents at power-on. Unusable contents are treated as empty."""
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
                why=f"the contents belong to the patch {kept.patch!r}, but this patch is {patch!r}",
            )
        elif kept is not None:
            self._kept = kept

    def note(self, fault: Fault, index: int = 0, subindex: int = 0, why: str = "") -> None:
        """Record a fault for :meth:`report`.

        Args:
            fault: Type of the fault.
            index: Index of the refused parameter, if any.
            subindex: Sub-index of the refused parameter, if any.
            why: One-line description; by default, a description of the refused parameter.
        """
        self.problem = why or f"the stored value of 0x{index:04X}:{subindex} is not allowed"
        detail = struct.pack("<BHB", fault, index, subindex)
        if fault is Fault.REFUSED:
            self._unreported.append(detail)
        else:
            self._lasting[fault] = detail

    def report(self, t_ns: int) -> None:
        """Report the recorded faults in emergency messages.

        A refused parameter is reported once. Any other fault stays active, even across resets, until it has
        been resolved.
        """
        for fault, detail in self._lasting.items():
            self._emcy.report(EmcyCode.DATA_SET, detail, t_ns, fault)
        unreported, self._unreported = self._unreported, []
        for detail in unreported:
            self._emcy.report_once(EmcyCode.DATA_SET, detail, t_ns)

    def restore(self, first: int, last: int) -> None:
        """Set the objects with indices ``first`` to ``last`` to their power-on values.

        The power-on value is the saved value, or the default if nothing was saved. Saved values pass the same
        checks as values written by a client; a refused value is replaced by the default.
        """
        self._store.restore(first, last)
        values: dict[Key, bytes] = {}
        for group in (self._kept.communication, self._kept.application):
            values |= {
                key: self._for_this_node(key, value, group.node_id)
                for key, value in group.values.items()
                if first <= key[0] <= last
            }
        refused = write_configuration(self._store, values)
        for index, subindex in refused:
            self.note(Fault.REFUSED, index, subindex)
        if refused or self._present(*APPLICATION) != self._kept.application.values:
            self._clear_verification()  # this is not the configuration that was verified

    def keep_baseline(self) -> None:
        """Save the baseline if the node has non-volatile memory."""
        if self._memory is None:
            return
        try:
            self._keep(replace(self._kept, baseline_ohm=self.baseline_ohm()))
        except OSError as error:
            self.note(Fault.NOT_SAVED, why=f"baseline not saved: {error}")

    def keep_lss(self, node_id: int, bit_rate_bps: int | None) -> None:
        """Save the LSS configuration.

        Args:
            node_id: 1 to 127, or 255 for no node-ID.
            bit_rate_bps: Bit rate, in bit/s; None if LSS has not configured one.

        Raises:
            OSError: If saving fails.
        """
        self._keep(replace(self._kept, node_id=node_id, bit_rate_bps=bit_rate_bps))

    def _keep(self, kept: Kept) -> None:
        assert self._memory is not None
        self._memory.save(kept)
        self._kept = kept
        self._settle(Fault.NOT_SAVED)

    def _settle(self, *faults: Fault) -> None:
        """Clear the given faults and report that they have ended."""
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
            # With this command, the user accepts the current parameters, so any faults in the memory's
            # contents are cleared. Saving the baseline automatically does not clear them.
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
        # 0x1020 identifies a complete configuration, so it is saved only together with a complete
        # configuration.
        whole = kept.communication.values == communication and kept.application.values == application
        return kept if whole else _unverified(kept)

    def _forget(self, subindex: int) -> Kept:
        """Return the memory contents without the saved parameters."""
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
        """Mark the configuration as unverified."""
        for subindex in (od.VERIFY_DATE, od.VERIFY_TIME):
            self._store.put(od.VERIFY_CONFIGURATION, subindex, 0)

    def _present(self, first: int, last: int) -> dict[Key, bytes]:
        changed = self._store.not_at_default(first, last)
        return {key: value for key, value in changed.items() if key not in od.COMMANDS}

    def _for_this_node(self, key: Key, value: bytes, node_id: int) -> bytes:
        """Return a saved value.

        If the value is the default COB-ID of node ``node_id``, return this node's default COB-ID instead.
        """
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
