"""Connects the manufacturer objects (0x2000 to 0x2301) to the values of a running patch."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import numpy as np

from skinnode.canopen import indices as od
from skinnode.canopen.abort import AbortCode, Refused
from skinnode.model.layout import PRESET_IDS, PatchLayout
from skinnode.node.object_dictionary import ObjectStore
from skinnode.node.patch.acquisition import Acquisition
from skinnode.node.patch.scan_stream import ScanStream
from skinnode.node.patch.wire_faults import Mask
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.coordinates import pack_coordinates


def describe(store: ObjectStore, layout: PatchLayout, scale: CodeScale, serial: int) -> None:
    """Set the patch descriptor (0x2000) and the electrode coordinates (0x2300).

    Args:
        store: Object dictionary.
        layout: Electrodes of the patch.
        scale: Mapping of R/R0 to codes.
        serial: Serial number, u32.
    """
    put = store.put
    put(od.DESCRIPTOR, od.CODE_LO, scale.lo)
    put(od.DESCRIPTOR, od.CODE_HI, scale.hi)
    put(od.DESCRIPTOR, od.RESISTIVITY, layout.resistivity_ohm_per_m)
    put(od.DESCRIPTOR, od.LAYOUT_ID, PRESET_IDS.get(layout.name, PRESET_IDS["custom"]))
    put(od.DESCRIPTOR, od.LAYOUT_HASH, layout.layout_hash)
    put(od.DESCRIPTOR, od.SERIAL, serial)
    put(od.COORDINATES, 0, pack_coordinates(layout))


def bind_scan(store: ObjectStore, acquisition: Acquisition, stream: ScanStream) -> None:
    """Bind the objects of the last scan: chunk, summary, wire faults and codes.

    Args:
        store: Object dictionary.
        acquisition: Provides the codes and wire faults.
        stream: Provides the last chunk and summary.
    """
    chunk, summary = fields_of(store, od.CHUNK), fields_of(store, od.SUMMARY)
    store.bind(od.CHUNK, lambda sub: stream.chunk[chunk[sub]])
    store.bind(od.SUMMARY, lambda sub: stream.summary[summary[sub]])
    store.bind(od.UPPER_WIRE_FAULTS, lambda sub: _fault_word(acquisition.faults.masks[:2], sub))
    store.bind(od.LOWER_WIRE_FAULTS, lambda sub: _fault_word(acquisition.faults.masks[2:], sub))
    for row in range(acquisition.profile.rows):
        _bind_codes(store, acquisition, row)


def bind_baseline(
    store: ObjectStore, acquisition: Acquisition, changed: Callable[[], None], replaced: Callable[[], None]
) -> None:
    """Bind the objects of the baseline (0x2200 and above, 0x2301).

    Args:
        store: Object dictionary.
        acquisition: Contains the baseline.
        changed: Callback for a write to the R0 of one crossing.
        replaced: Callback for a write to the whole baseline.
    """
    profile = acquisition.profile
    for row in range(profile.rows):
        _bind_baseline_row(store, acquisition, row, changed)

    def read(_: int) -> bytes:
        return acquisition.baseline_ohm.astype("<f4").tobytes()

    def write(data: bytes) -> None:
        values = np.frombuffer(data, dtype="<f4").reshape(profile.rows, profile.columns)
        if not ((values > 0) & np.isfinite(values)).all():
            raise Refused(AbortCode.INVALID_VALUE)
        acquisition.set_baselines(values.astype(np.float32))
        replaced()

    store.bind_domain(od.BASELINE_DOMAIN, 4 * profile.n_codes, read, write)


def fields_of(store: ObjectStore, index: int) -> dict[int, slice]:
    """Return each sub-index's slice of the record's concatenated bytes.

    Args:
        store: Object dictionary.
        index: Index of the record.
    """
    fields, at = {}, 0
    for subindex in range(1, store.integer(index) + 1):
        size = store.find(index, subindex).data_type.bits // 8
        fields[subindex] = slice(at, at + size)
        at += size
    return fields


def _bind_codes(store: ObjectStore, acquisition: Acquisition, row: int) -> None:
    width = acquisition.profile.code_bits // 8
    store.bind(od.CODES + row, lambda sub: int(acquisition.codes[row, sub - 1]).to_bytes(width, "little"))


def _bind_baseline_row(
    store: ObjectStore, acquisition: Acquisition, row: int, changed: Callable[[], None]
) -> None:
    index = od.BASELINE + row

    def on_written(subindex: int) -> None:
        if subindex:
            (value,) = struct.unpack("<f", store.written(index, subindex))
            acquisition.set_baseline(row, subindex - 1, value)
            changed()

    store.bind(index, lambda sub: struct.pack("<f", acquisition.baseline_ohm[row, sub - 1]))
    store.guard(index, _only_resistance)
    store.watch(index, on_written)


def _fault_word(masks: tuple[Mask, ...], subindex: int) -> bytes:
    """Return the 32-wire bit mask at a sub-index: open wires if it is odd, shorted wires if it is even."""
    first = (subindex - 1) // 2 * 32
    bits = masks[(subindex - 1) % 2][first : first + 32]
    return np.packbits(bits, bitorder="little").tobytes().ljust(4, b"\0")


def _only_resistance(_: int, pattern: int) -> None:
    (value,) = struct.unpack("<f", pattern.to_bytes(4, "little"))
    if not 0 < value < math.inf:
        raise Refused(AbortCode.INVALID_VALUE)
