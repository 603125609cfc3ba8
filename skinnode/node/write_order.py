"""Restores a saved configuration in an order that CiA 301 permits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.abort import Refused
from skinnode.node.object_dictionary import ObjectStore

Key = tuple[int, int]
"""Index and sub-index."""

_PDO_END: Final = 0x1C00
_LATE: Final = (od.CYCLE_PERIOD, od.COB_ID_SYNC, od.VERIFY_CONFIGURATION)
"""Objects that must be written last, in the given order.

Setting a cycle period locks the SYNC counter overflow. Writing the SYNC COB-ID starts the SYNC producer,
which needs the cycle period. Any write clears 0x1020.
"""


def write_configuration(store: ObjectStore, values: Mapping[Key, bytes]) -> list[Key]:
    """Write a saved configuration to an object dictionary that contains the defaults.

    PDOs are disabled while their parameters are written, and EMCY is disabled before its COB-ID is written.

    Args:
        store: Object dictionary.
        values: Saved bytes, by index and sub-index.

    Returns:
        Objects that refused their values and keep their defaults. If any entry of a mapping is refused, the
        whole mapping keeps its default.
    """
    known = {key: value for key, value in values.items() if store.has(*key)}
    refused = [key for key in values if key not in known]
    pdos = {index & ~od.PDO_MAPPING_OFFSET for index, _ in known if od.RPDO1_PARAMETER <= index < _PDO_END}
    defaults = {pdo: store.raw(pdo, od.PDO_COB_ID) for pdo in sorted(pdos)}
    # Disable all PDOs first, because a saved COB-ID may be the default COB-ID of another PDO.
    for pdo, default in defaults.items():
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
    """Write both records of a PDO and yield the objects that refused their values.

    ``pdo`` is the index of the communication record. ``default`` is the COB-ID if ``values`` contains none.
    """
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
