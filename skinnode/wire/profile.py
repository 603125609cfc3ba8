"""The object dictionary of a patch, written once. Who needs an index or a COB-ID takes it from here.

A patch of U×K codes sends them in *chunks*: TPDO1 carries u8 chunk index, u8 scan counter and 3 codes of
16 bits (or 2 of 24), codes in row-major order, upper wire first. TPDO2, the *summary*, ends each scan.
``python -m skinnode.wire.profile eds/`` writes the reference EDS files again.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from skinnode.wire.dictionary import DataType, Entry, Object, ObjectType, Value
from skinnode.wire.eds import DeviceInfo, render_eds

# --- identity (0x1018)
VENDOR_ID: Final = 0
"""No vendor-ID has been assigned by CiA to this project; 0 is never assigned to anybody."""
PRODUCT_CODE: Final = 0x534B494E
"""'SKIN'."""
REVISION_NUMBER: Final = 0x0001_0000
"""Major revision (CANopen behaviour) in the upper half, minor in the lower."""
DEVICE_NAME: Final = "skinnode patch"

# --- COB-IDs: the pre-defined connection set of CiA 301
NMT_COB_ID: Final = 0x000
SYNC_COB_ID: Final = 0x080


def emcy_cob_id(node_id: int) -> int:
    """Emergency message of a node."""
    return 0x080 + node_id


def chunk_cob_id(node_id: int) -> int:
    """TPDO1: a chunk of a scan."""
    return 0x180 + node_id


def command_cob_id(node_id: int) -> int:
    """RPDO1: tare, single scan, send mode."""
    return 0x200 + node_id


def summary_cob_id(node_id: int) -> int:
    """TPDO2: the end of a scan."""
    return 0x280 + node_id


def sdo_response_cob_id(node_id: int) -> int:
    """SDO server to client."""
    return 0x580 + node_id


def sdo_request_cob_id(node_id: int) -> int:
    """SDO client to server."""
    return 0x600 + node_id


def heartbeat_cob_id(node_id: int) -> int:
    """Boot-up, heartbeat and node guarding."""
    return 0x700 + node_id


# --- communication objects (CiA 301)
DEVICE_TYPE: Final = 0x1000
ERROR_REGISTER: Final = 0x1001
ERROR_FIELD: Final = 0x1003
COB_ID_SYNC: Final = 0x1005
CYCLE_PERIOD: Final = 0x1006
DEVICE_NAME_INDEX: Final = 0x1008
HARDWARE_VERSION: Final = 0x1009
SOFTWARE_VERSION: Final = 0x100A
STORE: Final = 0x1010
RESTORE: Final = 0x1011
COB_ID_EMCY: Final = 0x1014
EMCY_INHIBIT_TIME: Final = 0x1015
HEARTBEAT_CONSUMER: Final = 0x1016
HEARTBEAT_PRODUCER: Final = 0x1017
IDENTITY: Final = 0x1018
IDENTITY_VENDOR, IDENTITY_PRODUCT, IDENTITY_REVISION, IDENTITY_SERIAL = 1, 2, 3, 4
SYNC_COUNTER_OVERFLOW: Final = 0x1019
ERROR_BEHAVIOUR: Final = 0x1029
SDO_SERVER: Final = 0x1200
RPDO1_PARAMETER: Final = 0x1400
RPDO1_MAPPING: Final = 0x1600
TPDO1_PARAMETER: Final = 0x1800
TPDO2_PARAMETER: Final = 0x1801
TPDO1_MAPPING: Final = 0x1A00
TPDO2_MAPPING: Final = 0x1A01
PDO_COB_ID, PDO_TYPE, PDO_INHIBIT_TIME, PDO_EVENT_TIMER, PDO_SYNC_START = 1, 2, 3, 5, 6
"""Sub-indices of a PDO's communication parameter."""
MAPPING_SLOTS: Final = 8
"""Entries a PDO can map: eight bytes, and the smallest entry is one."""
ERROR_FIELD_LENGTH: Final = 8
HEARTBEAT_CONSUMERS: Final = 2

# --- manufacturer objects
DESCRIPTOR: Final = 0x2000
ROWS, COLUMNS, UPPER_ELECTRODES, LOWER_ELECTRODES, CODE_BITS = 1, 2, 3, 4, 5
CODE_LO, CODE_HI, RESISTIVITY, LAYOUT_ID, LAYOUT_HASH, SERIAL = 6, 7, 8, 9, 10, 11
CHUNK: Final = 0x2010
CHUNK_INDEX, CHUNK_SCAN, CHUNK_FIRST_CODE = 1, 2, 3
SUMMARY: Final = 0x2011
SUMMARY_SCAN, SUMMARY_FLAGS, SUMMARY_CHUNKS, SUMMARY_TIME = 1, 2, 3, 4
SEND_POLICY: Final = 0x2020
SEND_MODE, SEND_THRESHOLD, SEND_REFRESH = 1, 2, 3
ACQUISITION: Final = 0x2021
ACQUISITION_PERIOD, ACQUISITION_AVERAGING, SELF_TEST, TARE, SINGLE_SCAN = 1, 2, 3, 4, 5
UPPER_WIRE_FAULTS: Final = 0x2030
LOWER_WIRE_FAULTS: Final = 0x2031
"""Masks of 32 wires: sub-index 2i+1 open, 2i+2 shorted, for the wires from 32 i on."""
CODES: Final = 0x2100
"""+ r: the last codes of upper wire r, one sub-index a column."""
BASELINE: Final = 0x2200
"""+ r: R0 of upper wire r in ohm, one sub-index a column; 0 where there is none yet."""
COORDINATES: Final = 0x2300
"""DOMAIN: see :func:`skinnode.wire.coordinates.pack_coordinates`."""

TARE_SIGNATURE: Final = int.from_bytes(b"tare", "little")
STORE_SIGNATURE: Final = int.from_bytes(b"save", "little")
RESTORE_SIGNATURE: Final = int.from_bytes(b"load", "little")

DEFAULT_CODE_LO: Final = 0.25
DEFAULT_CODE_HI: Final = 1.25
"""Codes span R/R0 from lo to hi: a press brings electrodes closer and R down, a slide some of them apart."""
DEFAULT_PERIOD_MS: Final = 80
"""SYNC period the defaults are made for: four 10×30 patches load 1 Mbit/s to about two thirds."""
DEFAULT_REFRESH_SCANS: Final = 10
"""What a lost scan left unknown is known again within 0.8 s, for a tenth of the full traffic."""

_PAYLOAD_BYTES: Final = 6  # of a chunk's eight, after chunk index and scan counter
_MOST_SUBINDICES: Final = 254  # CiA 301: sub-index 255 is reserved


@dataclass(frozen=True, slots=True)
class PatchProfile:
    """Sizes of a patch as its wire format knows them.

    Raises ConfigError for a size that does not fit an array of the object dictionary (254) or the chunk
    index (256 chunks), and for a code width other than 16 and 24 bits.
    """

    rows: int
    """Upper wires, U."""
    columns: int
    """Lower wires, K."""
    upper_electrodes: int
    """Electrodes of an upper wire, N."""
    lower_electrodes: int
    """Electrodes of a lower wire, M."""
    code_bits: int = 16

    def __post_init__(self) -> None:
        for name, most in (
            ("rows", _MOST_SUBINDICES),
            ("columns", _MOST_SUBINDICES),
            ("upper_electrodes", 255),
            ("lower_electrodes", 255),
        ):
            value = getattr(self, name)
            if not 1 <= value <= most:
                raise ConfigError(name, value, f"1 to {most}")
        if self.code_bits not in (16, 24):
            raise ConfigError("code_bits", self.code_bits, "16 or 24")
        if self.n_chunks > 256:
            raise ConfigError(
                "rows × columns",
                self.n_codes,
                f"at most {256 * self.codes_per_chunk} codes of {self.code_bits} bits",
            )

    @classmethod
    def from_layout(cls, layout: PatchLayout, code_bits: int = 16) -> PatchProfile:
        """The profile of a patch with the electrodes of ``layout``."""
        rows, upper_electrodes = layout.upper_m.shape[:2]
        columns, lower_electrodes = layout.lower_m.shape[:2]
        return cls(rows, columns, upper_electrodes, lower_electrodes, code_bits)

    @property
    def n_codes(self) -> int:
        """Codes of a scan, U·K."""
        return self.rows * self.columns

    @property
    def codes_per_chunk(self) -> int:
        """3 of 16 bits, 2 of 24."""
        return 8 * _PAYLOAD_BYTES // self.code_bits

    @property
    def n_chunks(self) -> int:
        """Chunks of a full scan. The unused codes of the last are sent as 0 and ignored."""
        return -(-self.n_codes // self.codes_per_chunk)

    @property
    def code_type(self) -> DataType:
        """Type of a code in the object dictionary."""
        return DataType.UNSIGNED16 if self.code_bits == 16 else DataType.UNSIGNED24

    @property
    def default_inhibit_100us(self) -> int:
        """Pace of the chunks (0x1800:3): a full scan in nine tenths of the default period, 1 ms at most."""
        return max(1, min(10, 9 * DEFAULT_PERIOD_MS // self.n_chunks))

    def objects(self) -> tuple[Object, ...]:
        """The whole object dictionary, by ascending index."""
        return (*_communication_objects(self), *_manufacturer_objects(self))


_U8, _U16, _U32, _REAL32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32, DataType.REAL32


def _var(
    index: int,
    name: str,
    data_type: DataType,
    access: str,
    default: Value | None = None,
    *,
    plus_node_id: bool = False,
    mappable: bool = False,
    high: int | None = None,
) -> Object:
    entry = Entry(index, 0, name, data_type, access, default, plus_node_id, mappable, None, high)
    kind = ObjectType.DOMAIN if data_type is DataType.DOMAIN else ObjectType.VAR
    return Object(index, name, kind, (entry,))


def _highest(index: int, highest: int, access: str = "const", default: int | None = None) -> Entry:
    value = highest if default is None else default
    high = highest if access == "rw" else None
    return Entry(index, 0, "Highest sub-index supported", _U8, access, value, high=high)


def _record(index: int, name: str, entries: Sequence[Entry], first: Entry | None = None) -> Object:
    first = first or _highest(index, entries[-1].subindex)
    return Object(index, name, ObjectType.RECORD, (first, *entries))


def _array(
    index: int,
    name: str,
    labels: Sequence[str],
    data_type: DataType,
    access: str,
    default: Value | None = None,
    *,
    first: Entry | None = None,
    high: int | None = None,
) -> Object:
    entries = tuple(
        Entry(index, sub, label, data_type, access, default, high=high) for sub, label in enumerate(labels, 1)
    )
    return Object(index, name, ObjectType.ARRAY, (first or _highest(index, len(entries)), *entries))


def _tpdo_parameter(index: int, name: str, cob_id: int, kind: int, inhibit_100us: int) -> Object:
    return _record(
        index,
        name,
        (
            Entry(index, PDO_COB_ID, "COB-ID used by TPDO", _U32, "rw", cob_id, plus_node_id=True),
            Entry(index, PDO_TYPE, "Transmission type", _U8, "rw", kind),
            Entry(index, PDO_INHIBIT_TIME, "Inhibit time", _U16, "rw", inhibit_100us),
            Entry(index, PDO_EVENT_TIMER, "Event timer", _U16, "rw", 0),
            Entry(index, PDO_SYNC_START, "SYNC start value", _U8, "rw", 0, high=240),
        ),
    )


def _mapping(index: int, name: str, mapped: Sequence[Entry]) -> Object:
    values = [entry.mapping for entry in mapped] + [0] * (MAPPING_SLOTS - len(mapped))
    entries = tuple(
        Entry(index, sub, f"Mapped object {sub}", _U32, "rw", value) for sub, value in enumerate(values, 1)
    )
    first = _highest(index, MAPPING_SLOTS, "rw", len(mapped))
    return _record(index, name, entries, first)


def _communication_objects(profile: PatchProfile) -> tuple[Object, ...]:
    chunk, summary = _chunk_record(profile), _summary_record()
    command = (
        _acquisition_record()[TARE],
        _acquisition_record()[SINGLE_SCAN],
        _send_policy_record()[SEND_MODE],
    )
    no_errors = Entry(ERROR_FIELD, 0, "Number of errors", _U8, "rw", 0, high=ERROR_FIELD_LENGTH)
    groups = ("all", "communication", "application")
    request, response = sdo_request_cob_id(0), sdo_response_cob_id(0)
    return (
        _var(DEVICE_TYPE, "Device type", _U32, "const", 0),
        _var(ERROR_REGISTER, "Error register", _U8, "ro", 0, mappable=True),
        _array(
            ERROR_FIELD,
            "Pre-defined error field",
            [f"Standard error field {i}" for i in range(1, ERROR_FIELD_LENGTH + 1)],
            _U32,
            "ro",
            0,
            first=no_errors,
        ),
        _var(COB_ID_SYNC, "COB-ID SYNC message", _U32, "rw", SYNC_COB_ID),
        _var(CYCLE_PERIOD, "Communication cycle period", _U32, "rw", 0),
        _var(DEVICE_NAME_INDEX, "Manufacturer device name", DataType.VISIBLE_STRING, "const", DEVICE_NAME),
        _var(HARDWARE_VERSION, "Manufacturer hardware version", DataType.VISIBLE_STRING, "const"),
        _var(SOFTWARE_VERSION, "Manufacturer software version", DataType.VISIBLE_STRING, "const"),
        _array(STORE, "Store parameters", [f"Save {g} parameters" for g in groups], _U32, "rw", 1),
        _array(
            RESTORE,
            "Restore default parameters",
            [f"Restore {group} defaults" for group in groups],
            _U32,
            "rw",
            1,
        ),
        _var(COB_ID_EMCY, "COB-ID emergency message", _U32, "rw", emcy_cob_id(0), plus_node_id=True),
        _var(EMCY_INHIBIT_TIME, "Inhibit time EMCY", _U16, "rw", 0),
        _array(
            HEARTBEAT_CONSUMER,
            "Consumer heartbeat time",
            [f"Consumer heartbeat time {i}" for i in range(1, HEARTBEAT_CONSUMERS + 1)],
            _U32,
            "rw",
            0,
        ),
        _var(HEARTBEAT_PRODUCER, "Producer heartbeat time", _U16, "rw", 0),
        _record(
            IDENTITY,
            "Identity object",
            (
                Entry(IDENTITY, IDENTITY_VENDOR, "Vendor-ID", _U32, "ro", VENDOR_ID),
                Entry(IDENTITY, IDENTITY_PRODUCT, "Product code", _U32, "ro", PRODUCT_CODE),
                Entry(IDENTITY, IDENTITY_REVISION, "Revision number", _U32, "ro", REVISION_NUMBER),
                Entry(IDENTITY, IDENTITY_SERIAL, "Serial number", _U32, "ro"),
            ),
        ),
        _var(SYNC_COUNTER_OVERFLOW, "Synchronous counter overflow value", _U8, "rw", 0, high=240),
        _array(ERROR_BEHAVIOUR, "Error behaviour", ["Communication error"], _U8, "rw", 0, high=2),
        _record(
            SDO_SERVER,
            "SDO server parameter",
            (
                Entry(SDO_SERVER, 1, "COB-ID client to server", _U32, "ro", request, plus_node_id=True),
                Entry(SDO_SERVER, 2, "COB-ID server to client", _U32, "ro", response, plus_node_id=True),
            ),
        ),
        _record(
            RPDO1_PARAMETER,
            "RPDO1 communication parameter: command",
            (
                Entry(
                    RPDO1_PARAMETER,
                    PDO_COB_ID,
                    "COB-ID used by RPDO",
                    _U32,
                    "rw",
                    command_cob_id(0),
                    plus_node_id=True,
                ),
                Entry(RPDO1_PARAMETER, PDO_TYPE, "Transmission type", _U8, "rw", 255),
            ),
        ),
        _mapping(RPDO1_MAPPING, "RPDO1 mapping parameter: command", command),
        _tpdo_parameter(
            TPDO1_PARAMETER,
            "TPDO1 communication parameter: chunk",
            chunk_cob_id(0),
            254,
            profile.default_inhibit_100us,
        ),
        _tpdo_parameter(TPDO2_PARAMETER, "TPDO2 communication parameter: summary", summary_cob_id(0), 1, 0),
        _mapping(TPDO1_MAPPING, "TPDO1 mapping parameter: chunk", chunk.entries[1:]),
        _mapping(TPDO2_MAPPING, "TPDO2 mapping parameter: summary", summary.entries[1:]),
    )


def _chunk_record(profile: PatchProfile) -> Object:
    codes = tuple(
        Entry(CHUNK, CHUNK_FIRST_CODE + i, f"Code {i + 1}", profile.code_type, "ro", 0, mappable=True)
        for i in range(profile.codes_per_chunk)
    )
    return _record(
        CHUNK,
        "Chunk of a scan",
        (
            Entry(CHUNK, CHUNK_INDEX, "Chunk index", _U8, "ro", 0, mappable=True),
            Entry(CHUNK, CHUNK_SCAN, "Chunk scan counter", _U8, "ro", 0, mappable=True),
            *codes,
        ),
    )


def _summary_record() -> Object:
    return _record(
        SUMMARY,
        "Scan summary",
        (
            Entry(SUMMARY, SUMMARY_SCAN, "Summary scan counter", _U8, "ro", 0, mappable=True),
            Entry(SUMMARY, SUMMARY_FLAGS, "Flags", _U8, "ro", 0, mappable=True),
            Entry(SUMMARY, SUMMARY_CHUNKS, "Chunks sent", _U16, "ro", 0, mappable=True),
            Entry(SUMMARY, SUMMARY_TIME, "Device time us", _U32, "ro", 0, mappable=True),
        ),
    )


def _send_policy_record() -> Object:
    return _record(
        SEND_POLICY,
        "Send policy",
        (
            Entry(SEND_POLICY, SEND_MODE, "Send mode", _U8, "rww", 0, mappable=True, high=1),
            Entry(SEND_POLICY, SEND_THRESHOLD, "Delta threshold in codes", _U16, "rw", 2),
            Entry(SEND_POLICY, SEND_REFRESH, "Full refresh every n scans", _U16, "rw", DEFAULT_REFRESH_SCANS),
        ),
    )


def _acquisition_record() -> Object:
    return _record(
        ACQUISITION,
        "Acquisition",
        (
            Entry(ACQUISITION, ACQUISITION_PERIOD, "Period ms, 0 at SYNC", _U16, "rw", 0),
            Entry(ACQUISITION, ACQUISITION_AVERAGING, "Averaging", _U8, "rw", 1, low=1),
            Entry(ACQUISITION, SELF_TEST, "Self-test", _U32, "rw", 0),
            Entry(ACQUISITION, TARE, "Tare", _U32, "rww", 0, mappable=True),
            Entry(ACQUISITION, SINGLE_SCAN, "Single scan", _U8, "rww", 0, mappable=True, high=1),
        ),
    )


def _wire_faults(index: int, name: str, wires: int) -> Object:
    labels = [f"{kind} from wire {first}" for first in range(0, wires, 32) for kind in ("Open", "Shorted")]
    return _array(index, name, labels, _U32, "ro", 0)


def _descriptor_record(profile: PatchProfile) -> Object:
    sizes = (
        (ROWS, "Upper wires", profile.rows),
        (COLUMNS, "Lower wires", profile.columns),
        (UPPER_ELECTRODES, "Upper electrodes", profile.upper_electrodes),
        (LOWER_ELECTRODES, "Lower electrodes", profile.lower_electrodes),
        (CODE_BITS, "Code bits", profile.code_bits),
    )
    return _record(
        DESCRIPTOR,
        "Patch descriptor",
        (
            *(Entry(DESCRIPTOR, sub, name, _U8, "const", value) for sub, name, value in sizes),
            Entry(DESCRIPTOR, CODE_LO, "Code range low, of R0", _REAL32, "ro", DEFAULT_CODE_LO),
            Entry(DESCRIPTOR, CODE_HI, "Code range high, of R0", _REAL32, "ro", DEFAULT_CODE_HI),
            Entry(DESCRIPTOR, RESISTIVITY, "Resistivity ohm per m", _REAL32, "ro"),
            Entry(DESCRIPTOR, LAYOUT_ID, "Layout", _U8, "ro"),
            Entry(DESCRIPTOR, LAYOUT_HASH, "Layout hash", _U32, "ro"),
            Entry(DESCRIPTOR, SERIAL, "Serial", _U32, "ro"),
        ),
    )


def _manufacturer_objects(profile: PatchProfile) -> tuple[Object, ...]:
    columns = [f"Column {k}" for k in range(profile.columns)]
    return (
        _descriptor_record(profile),
        _chunk_record(profile),
        _summary_record(),
        _send_policy_record(),
        _acquisition_record(),
        _wire_faults(UPPER_WIRE_FAULTS, "Faults of upper wires", profile.rows),
        _wire_faults(LOWER_WIRE_FAULTS, "Faults of lower wires", profile.columns),
        *(
            _array(CODES + r, f"Codes of upper wire {r}", columns, profile.code_type, "ro", 0)
            for r in range(profile.rows)
        ),
        *(
            _array(BASELINE + r, f"Baseline of upper wire {r}", columns, _REAL32, "rw", 0)
            for r in range(profile.rows)
        ),
        _var(COORDINATES, "Electrode coordinates", DataType.DOMAIN, "ro"),
    )


def eds_name(profile: PatchProfile) -> str:
    """File name of the reference EDS of this wire format."""
    return f"skinnode-{profile.rows}x{profile.columns}-u{profile.code_bits}.eds"


def eds_text(profile: PatchProfile) -> str:
    """The electronic data sheet (CiA 306) of a patch; the same bytes for the same profile, always."""
    info = DeviceInfo(
        file_name=eds_name(profile),
        description=f"{profile.rows} x {profile.columns} wires, {profile.code_bits}-bit codes",
        vendor_name="skinnode",
        vendor_number=VENDOR_ID,
        product_name=DEVICE_NAME,
        product_number=PRODUCT_CODE,
        revision_number=REVISION_NUMBER,
        rpdos=1,
        tpdos=2,
    )
    return render_eds(info, profile.objects())


REFERENCE_PROFILES: Final = (PatchProfile(10, 30, 10, 10, 16), PatchProfile(10, 30, 10, 10, 24))
"""One for each wire format; their EDS are kept in ``eds/``."""


def write_reference_files(folder: Path) -> None:
    """Write the EDS of every reference profile into ``folder``."""
    for profile in REFERENCE_PROFILES:
        (folder / eds_name(profile)).write_text(eds_text(profile), encoding="ascii", newline="\n")


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        sys.exit("usage: python -m skinnode.wire.profile FOLDER (an existing folder, normally eds/)")
    write_reference_files(Path(sys.argv[1]))
