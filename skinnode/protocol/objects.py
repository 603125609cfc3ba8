"""Object dictionary of a patch.

This module declares the manufacturer objects (0x2000 to 0x2301) and the default PDO mappings. Only settings
and constants have default values.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from skinnode.canopen import indices as od
from skinnode.canopen.communication import PdoDefault, communication_objects, spare_pdo
from skinnode.canopen.dictionary import DataType, Entry, Object, array, record, var

if TYPE_CHECKING:
    from skinnode.protocol.profile import PatchProfile

_U8, _U16, _U32, _REAL32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32, DataType.REAL32

DEFAULT_CODE_LO: Final = 0.25
"""Default R/R0 of code 0."""
DEFAULT_CODE_HI: Final = 1.25
"""Default R/R0 of the highest measurement code. A press reduces R, but sliding moves some electrodes apart
and increases R above R0."""
DEFAULT_THRESHOLD_CODES: Final = 2
"""Default send threshold, in codes: the largest code change that is not sent in send mode 1."""
DEFAULT_REFRESH_SCANS: Final = 10
"""Default interval, in scans, between full scans in send mode 1 (changed chunks only). At 80 ms per scan, a
lost chunk is sent again within 0.8 s. The full scans add one tenth of the traffic of send mode 0."""


def patch_objects(profile: PatchProfile) -> tuple[Object, ...]:
    """Return all objects in a patch's object dictionary, in ascending order of index.

    Args:
        profile: Dimensions of the patch.
    """
    communication = communication_objects(
        _rpdos(profile), _tpdos(profile), profile.pdo_bytes, profile.revision_number
    )
    return (*communication, *_manufacturer_objects(profile))


def _rpdos(profile: PatchProfile) -> list[PdoDefault]:
    acquisition, policy = _acquisition_record(), _send_policy_record()
    mapped = acquisition[od.TARE], acquisition[od.SINGLE_SCAN], policy[od.SEND_MODE]
    command = PdoDefault("command", od.command_cob_id(0), kind=255, mapped=mapped)
    numbers = range(1, profile.rpdos)
    return [command, *(spare_pdo(od.rpdo_cob_id(n, 0) if n < 4 else None) for n in numbers)]


def _tpdos(profile: PatchProfile) -> list[PdoDefault]:
    chunk = PdoDefault(
        "chunk",
        od.chunk_cob_id(0),
        mapped=_chunk_record(profile).entries[1:],
        inhibit_100us=profile.default_inhibit_100us,
    )
    fields = _summary_record(profile)
    third = (od.SUMMARY_TIME_64US, od.SUMMARY_CHECK) if profile.checked else (od.SUMMARY_TIME,)
    subs = od.SUMMARY_SCAN, od.SUMMARY_FLAGS, od.SUMMARY_CHUNKS, *third
    mapped = tuple(fields[sub] for sub in subs)
    summary = PdoDefault("summary", od.summary_cob_id(0), kind=1, mapped=mapped)
    numbers = range(2, profile.tpdos)
    return [chunk, summary, *(spare_pdo(od.tpdo_cob_id(n, 0) if n < 4 else None) for n in numbers)]


def _chunk_record(profile: PatchProfile) -> Object:
    head = [("Chunk index", _U8), ("Chunk scan counter", _U8)]
    if profile.bus == "fd":
        head = [("Upper wire", _U8), ("Chunk scan counter", _U8), ("First column", _U16)]
    codes = [(f"Code {i}", profile.code_type) for i in range(1, profile.codes_per_chunk + 1)]
    return record(
        od.CHUNK,
        "Chunk of a scan",
        [
            Entry(od.CHUNK, sub, name, data_type, "ro", mappable=True)
            for sub, (name, data_type) in enumerate(head + codes, 1)
        ],
    )


def _summary_record(profile: PatchProfile) -> Object:
    fields = [
        (od.SUMMARY_SCAN, "Summary scan counter", _U8),
        (od.SUMMARY_FLAGS, "Flags", _U8),
        (od.SUMMARY_CHUNKS, "Chunks sent", _U16),
        (od.SUMMARY_TIME, "Device time us", _U32),
    ]
    if profile.checked:
        fields += [(od.SUMMARY_TIME_64US, "Device time 64us", _U16), (od.SUMMARY_CHECK, "Scan check", _U16)]
    return record(
        od.SUMMARY,
        "Scan summary",
        [Entry(od.SUMMARY, sub, name, data_type, "ro", mappable=True) for sub, name, data_type in fields],
    )


def _send_policy_record() -> Object:
    return record(
        od.SEND_POLICY,
        "Send policy",
        (
            Entry(od.SEND_POLICY, od.SEND_MODE, "Send mode", _U8, "rww", 0, mappable=True, high=1),
            Entry(
                od.SEND_POLICY,
                od.SEND_THRESHOLD,
                "Delta threshold in codes",
                _U16,
                "rw",
                DEFAULT_THRESHOLD_CODES,
            ),
            Entry(
                od.SEND_POLICY,
                od.SEND_REFRESH,
                "Full refresh every n scans",
                _U16,
                "rw",
                DEFAULT_REFRESH_SCANS,
            ),
        ),
    )


def _acquisition_record() -> Object:
    return record(
        od.ACQUISITION,
        "Acquisition",
        (
            Entry(od.ACQUISITION, od.ACQUISITION_PERIOD, "Period ms, 0 at SYNC", _U16, "rw", 0),
            Entry(od.ACQUISITION, od.ACQUISITION_AVERAGING, "Averaging", _U8, "rw", 1, low=1),
            Entry(od.ACQUISITION, od.SELF_TEST, "Self-test", _U32, "rw", 0),
            Entry(od.ACQUISITION, od.TARE, "Tare", _U32, "rww", 0, mappable=True),
            Entry(od.ACQUISITION, od.SINGLE_SCAN, "Single scan", _U8, "rww", 0, mappable=True, high=1),
        ),
    )


def _time_record() -> Object:
    return record(
        od.TIME_OF_DAY,
        "Time of day",
        (
            Entry(od.TIME_OF_DAY, od.TIME_DAYS, "Days since 1984-01-01", _U16, "ro", mappable=True),
            Entry(od.TIME_OF_DAY, od.TIME_MS, "Milliseconds after midnight", _U32, "ro", mappable=True),
            Entry(od.TIME_OF_DAY, od.TIME_MESSAGES, "TIME messages", _U32, "ro"),
            Entry(od.TIME_OF_DAY, od.TIME_DEVICE_US, "Device time us of the last TIME", _U32, "ro"),
        ),
    )


_REJECTED = ("NMT", "SYNC", "TIME", "Heartbeat", "SDO", "RPDO", "Error control of the own node-ID")


def _self_test_record() -> Object:
    fields = (
        (od.TEST_STATUS, "Self-test status", _U8),
        (od.TEST_FAULTS, "Self-test faults", _U16),
        (od.TEST_READINGS, "Self-test readings", _U8),
        (od.TEST_NOISE, "Self-test relative noise", _REAL32),
        (od.TEST_OPEN_WIRES, "Open wires", _U16),
        (od.TEST_SHORTED_WIRES, "Shorted wires", _U16),
        (od.TEST_OUT_OF_RANGE, "Crossings out of range", _U32),
        (od.TEST_UNTARED, "Crossings without a baseline", _U32),
    )
    return record(
        od.SELF_TEST_RESULT,
        "Self-test result",
        [Entry(od.SELF_TEST_RESULT, sub, name, data_type, "ro") for sub, name, data_type in fields],
    )


def _wire_faults(index: int, name: str, wires: int) -> Object:
    labels = [f"{kind} from wire {first}" for first in range(0, wires, 32) for kind in ("Open", "Shorted")]
    return array(index, name, labels, _U32, "ro", mappable=True)


def _descriptor_record(profile: PatchProfile) -> Object:
    sizes = (
        (od.ROWS, "Upper wires", profile.rows),
        (od.COLUMNS, "Lower wires", profile.columns),
        (od.UPPER_ELECTRODES, "Upper electrodes", profile.upper_electrodes),
        (od.LOWER_ELECTRODES, "Lower electrodes", profile.lower_electrodes),
        (od.CODE_BITS, "Code bits", profile.code_bits),
    )
    return record(
        od.DESCRIPTOR,
        "Patch descriptor",
        (
            *(Entry(od.DESCRIPTOR, sub, name, _U8, "const", value) for sub, name, value in sizes),
            Entry(od.DESCRIPTOR, od.CODE_LO, "Code range low, of R0", _REAL32, "ro", DEFAULT_CODE_LO),
            Entry(od.DESCRIPTOR, od.CODE_HI, "Code range high, of R0", _REAL32, "ro", DEFAULT_CODE_HI),
            Entry(od.DESCRIPTOR, od.RESISTIVITY, "Resistivity ohm per m", _REAL32, "ro"),
            Entry(od.DESCRIPTOR, od.LAYOUT_ID, "Layout", _U8, "ro"),
            Entry(od.DESCRIPTOR, od.LAYOUT_HASH, "Layout hash", _U32, "ro"),
            Entry(od.DESCRIPTOR, od.SERIAL, "Serial", _U32, "ro"),
            Entry(od.DESCRIPTOR, od.PDO_BYTES, "Bytes of a PDO", _U8, "const", profile.pdo_bytes),
        ),
    )


def _manufacturer_objects(profile: PatchProfile) -> tuple[Object, ...]:
    columns = [f"Column {k}" for k in range(profile.columns)]
    return (
        _descriptor_record(profile),
        _chunk_record(profile),
        _summary_record(profile),
        _send_policy_record(),
        _acquisition_record(),
        _time_record(),
        _self_test_record(),
        _wire_faults(od.UPPER_WIRE_FAULTS, "Faults of upper wires", profile.rows),
        _wire_faults(od.LOWER_WIRE_FAULTS, "Faults of lower wires", profile.columns),
        array(od.REJECTED_FRAMES, "Rejected frames", _REJECTED, _U32, "ro"),
        *(
            array(od.CODES + r, f"Codes of upper wire {r}", columns, profile.code_type, "ro", mappable=True)
            for r in range(profile.rows)
        ),
        *(
            array(od.BASELINE + r, f"Baseline of upper wire {r}", columns, _REAL32, "rw")
            for r in range(profile.rows)
        ),
        var(od.COORDINATES, "Electrode coordinates", DataType.DOMAIN, "ro"),
        var(od.BASELINE_DOMAIN, "Baseline of all wires", DataType.DOMAIN, "rw"),
    )
