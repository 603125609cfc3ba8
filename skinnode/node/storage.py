"""Parameters that outlive a power cycle: store (0x1010), restore defaults (0x1011) and verify configuration
(0x1020) of CiA 301 v4.2, and what else a node keeps in its memory.

A *parameter* is what a client may write and read back: not a command, and nothing that is computed.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.canopen.emergency import EmcyCode
from skinnode.node.clock import Clock
from skinnode.node.emcy import EmcyProducer
from skinnode.node.memory import Fault, Kept, Memory, MemoryFault, Parameters
from skinnode.node.object_dictionary import ObjectStore

COMMUNICATION: Final = 0x1000, 0x1FFF
APPLICATION: Final = 0x2000, 0x9FFF
EVERYTHING: Final = 0x1000, 0x9FFF
_ALL, _COMMUNICATION_ONLY, _APPLICATION_ONLY = 1, 2, 3
"""Sub-indices of 0x1010 and 0x1011."""

_PDO_END: Final = 0x1C00
_CAN_ID_MASK: Final = 0x7FF

Key = tuple[int, int]
"""Index and sub-index."""
Rows = tuple[tuple[float, ...], ...]


class Storage:
    """What one node keeps, and its objects around that.

    Args:
        store: its object dictionary.
        emcy: to whom it is told what could not be kept or restored (0x6300, the first byte is
            :class:`~skinnode.node.memory.Fault`).
        memory: None for a node that forgets: 0x1010 and 0x1011 read 0 and refuse, as the standard wants it.
        patch: see :class:`~skinnode.node.memory.Kept`.
        now: time of the event being handled.
    """

    def __init__(
        self, store: ObjectStore, emcy: EmcyProducer, memory: Memory | None, patch: str, now: Clock
    ) -> None:
        self._store, self._emcy, self._memory, self._now = store, emcy, memory, now
        self._untold: list[bytes] = []
        self._lasting: dict[Fault, bytes] = {}
        self._kept = Kept(patch)
        self.problem = ""
        """What went wrong with the memory last, in one line; empty if nothing did."""
        self.baseline_ohm: Callable[[], Rows] = tuple
        """The present R0; the application says what it is."""
        able = int(memory is not None).to_bytes(4, "little")  # 1: saves, restores, on command
        for index, signature, command in (
            (od.STORE, od.STORE_SIGNATURE, self._save),
            (od.RESTORE, od.RESTORE_SIGNATURE, self._forget),
        ):
            store.bind(index, lambda _: able)
            store.guard(index, self._obey(signature, command))
        store.watch_changes(self._on_change)

    @property
    def kept(self) -> Kept:
        """What the memory holds, as far as it is of use."""
        return self._kept

    @property
    def has_memory(self) -> bool:
        """Whether anything can be kept."""
        return self._memory is not None

    def load(self) -> None:
        """Power came. A memory whose content is of no use counts as empty."""
        patch = self._kept.patch
        self._kept, self._untold, self._lasting, self.problem = Kept(patch), [], {}, ""
        try:
            kept = self._memory.load() if self._memory is not None else None
        except MemoryFault as error:
            self.note(error.fault, why=str(error))
            return
        if kept is not None and kept.patch != patch:
            self.note(Fault.FOREIGN, why=f"it is of another patch, {kept.patch!r}; this one is {patch!r}")
        elif kept is not None:
            self._kept = kept

    def note(self, fault: Fault, index: int = 0, subindex: int = 0, why: str = "") -> None:
        """Something that :meth:`tell` is to tell."""
        self.problem = why or f"0x{index:04X}:{subindex} as it was kept is not allowed"
        detail = struct.pack("<BHB", fault, index, subindex)
        if fault is Fault.REFUSED:
            self._untold.append(detail)
        else:
            self._lasting[fault] = detail

    def tell(self, t_ns: int) -> None:
        """Report the failures since the last call as emergencies. A fault of the whole memory stays in the
        error register, even across resets, until :meth:`_settle`."""
        for fault, detail in self._lasting.items():
            self._emcy.present(EmcyCode.DATA_SET, detail, t_ns, fault)
        untold, self._untold = self._untold, []
        for detail in untold:
            self._emcy.happened(EmcyCode.DATA_SET, detail, t_ns)

    def restore(self, first: int, last: int) -> None:
        """Give the objects from ``first`` to ``last`` their power-on values: those that were saved, through
        the checks of any write, and their defaults where there is none or it is not allowed any more."""
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
            self._clear_verification()  # of a configuration of which only one part was restored

    def keep_baseline(self) -> None:
        """Keep R0 over a power cycle, and nothing else, if there is a memory."""
        if self._memory is None:
            return
        try:
            self._keep(replace(self._kept, baseline_ohm=self.baseline_ohm()))
        except OSError as error:
            self.note(Fault.NOT_SAVED, why=f"baseline not saved: {error}")

    def keep_lss(self, node_id: int, bit_rate_bps: int | None) -> None:
        """LSS stores its configuration. Raises OSError if that fails."""
        self._keep(replace(self._kept, node_id=node_id, bit_rate_bps=bit_rate_bps))

    def _keep(self, kept: Kept) -> None:
        assert self._memory is not None
        self._memory.save(kept)
        self._kept = kept
        self._settle(Fault.NOT_SAVED)

    def _settle(self, *faults: Fault) -> None:
        """Clear the faults: the memory is reliable again."""
        for fault in faults:
            if self._lasting.pop(fault, None) is not None:
                self._emcy.over(EmcyCode.DATA_SET, self._now(), fault)

    # --- objects

    def _obey(self, signature: int, command: Callable[[int], Kept]) -> Callable[[int, int], None]:
        def guard(subindex: int, value: int) -> None:
            if self._memory is None or value != signature:
                raise Refused(AbortCode.CANNOT_STORE)
            try:
                self._keep(command(subindex))
            except OSError:
                raise Refused(AbortCode.HARDWARE) from None
            # Stored on command, not a baseline stored automatically: the user knows the present parameters.
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
        # What 0x1020 says holds for the configuration as a whole: it is kept with all of it, or not at all.
        whole = kept.communication.values == communication and kept.application.values == application
        return kept if whole else _unverified(kept)

    def _forget(self, subindex: int) -> Kept:
        """The defaults become valid with the next reset, and stay so."""
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
        """Nobody has verified the configuration as it is now."""
        for subindex in (od.VERIFY_DATE, od.VERIFY_TIME):
            self._store.put(od.VERIFY_CONFIGURATION, subindex, 0)

    def _present(self, first: int, last: int) -> dict[Key, bytes]:
        changed = self._store.not_at_default(first, last)
        return {key: value for key, value in changed.items() if key not in od.COMMANDS}

    def _for_this_node(self, key: Key, value: bytes, node_id: int) -> bytes:
        """A CAN-ID that was the default one of ``node_id`` is the default one of this node, whatever bits go
        with it."""
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


# --- writing in an order that the standard's rules allow

_LATE: Final = (od.CYCLE_PERIOD, od.COB_ID_SYNC, od.VERIFY_CONFIGURATION)
"""The counter of SYNC may not change while there is a cycle period, the producer starts when both are there,
and any change takes 0x1020 back."""


def write_configuration(store: ObjectStore, values: Mapping[Key, bytes]) -> list[Key]:
    """Write ``values`` over the defaults: a PDO is switched off, mapped, given its parameters and switched
    on; EMCY is switched off before it gets another COB-ID. Returns index and sub-index of what is not
    allowed, which stays at its default: of a mapping all of it."""
    known = {key: value for key, value in values.items() if store.has(*key)}
    refused = [key for key in values if key not in known]
    pdos = {index & ~od.PDO_MAPPING_OFFSET for index, _ in known if od.RPDO1_PARAMETER <= index < _PDO_END}
    defaults = {pdo: store.raw(pdo, od.PDO_COB_ID) for pdo in sorted(pdos)}
    for pdo, default in defaults.items():  # all of them first: one may have another one's default COB-ID
        _accepted(store, [((pdo, od.PDO_COB_ID), _switched_off(default))])
    for pdo, default in defaults.items():
        refused += _write_pdo(store, known, pdo, default)
    others = [key for key in known if not od.RPDO1_PARAMETER <= key[0] < _PDO_END]
    for key in sorted(others, key=lambda key: (key[0] in _LATE and 1 + _LATE.index(key[0]), key)):
        emcy = key[0] == od.COB_ID_EMCY
        off = [(key, _switched_off(store.raw(*key)))] if emcy else []
        if not _accepted(store, [*off, (key, values[key])]):
            refused.append(key)
            if emcy:
                store.restore(key[0], key[0])
    return refused


def _write_pdo(store: ObjectStore, values: Mapping[Key, bytes], pdo: int, default: bytes) -> Iterator[Key]:
    """Write the two records of the PDO with parameters at ``pdo``; yields what was refused. ``default``: its
    COB-ID, where there is no other."""
    cob_id, count = (pdo, od.PDO_COB_ID), (pdo + od.PDO_MAPPING_OFFSET, 0)
    own = sorted(item for item in values.items() if item[0][0] == pdo and item[0] != cob_id)
    mapped = sorted(
        item for item in values.items() if item[0][0] == pdo + od.PDO_MAPPING_OFFSET and item[0] != count
    )
    off = _switched_off(default)
    if mapped or count in values:
        entries = values.get(count) or store.raw(*count)
        if not _accepted(store, [(cob_id, off), (count, bytes(1)), *mapped, (count, entries)]):
            store.restore(pdo + od.PDO_MAPPING_OFFSET, pdo + od.PDO_MAPPING_OFFSET)
            yield count
    for item in own:
        if not _accepted(store, [(cob_id, off), item]):
            yield item[0]
    if not _accepted(store, [(cob_id, off), (cob_id, values.get(cob_id, default))]):
        store.restore(pdo, pdo)
        yield cob_id


def _accepted(store: ObjectStore, steps: Iterable[tuple[Key, bytes]]) -> bool:
    try:
        for key, value in steps:
            store.write(*key, value)
    except Refused:
        return False
    return True


def _switched_off(cob_id: bytes) -> bytes:
    return (int.from_bytes(cob_id, "little") | od.PDO_INVALID).to_bytes(4, "little")
