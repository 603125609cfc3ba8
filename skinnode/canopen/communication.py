"""Communication objects of a patch, 0x1000 to 0x1FFF (CiA 301 v4.2, 7.5.2), with their default values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from skinnode.canopen import indices as od
from skinnode.canopen.dictionary import DataType, Entry, Object, array, record, var

_U8, _U16, _U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
_STRING = DataType.VISIBLE_STRING

_GROUPS = ("all", "communication", "application")


@dataclass(frozen=True, slots=True)
class PdoDefault:
    """Default parameters of a PDO."""

    purpose: str
    """Purpose of the PDO, used in the names of its records."""
    cob_id: int
    """COB-ID with its flag bits, as in 0x1800:1, but without the node-ID if ``plus_node_id`` is true."""
    kind: int = 254
    """Transmission type."""
    mapped: tuple[Entry, ...] = ()
    """Mapped objects, in payload order."""
    inhibit_100us: int = 0
    """Inhibit time, in units of 100 µs."""
    plus_node_id: bool = True
    """Whether the node-ID is added to the COB-ID."""


def spare_pdo(cob_id: int | None) -> PdoDefault:
    """Return the defaults for a spare PDO, which is disabled and has no mapped objects.

    Args:
        cob_id: COB-ID in the pre-defined connection set, without the node-ID; None if the set does not
            contain this PDO.
    """
    return PdoDefault("spare", od.PDO_INVALID | (cob_id or 0), plus_node_id=cob_id is not None)


def communication_objects(
    rpdos: Sequence[PdoDefault],
    tpdos: Sequence[PdoDefault],
    slots: int,
    revision: int = od.REVISION_NUMBER,
) -> tuple[Object, ...]:
    """Return all communication objects in ascending order of index.

    Args:
        rpdos: defaults of the RPDOs, starting with RPDO1.
        tpdos: defaults of the TPDOs, starting with TPDO1.
        slots: maximum number of objects mapped into a PDO.
        revision: revision number (0x1018:3).
    """
    return (
        *_device_objects(revision),
        *(_rpdo_parameter(od.RPDO1_PARAMETER + i, i + 1, pdo) for i, pdo in enumerate(rpdos)),
        *(_mapping(od.RPDO1_MAPPING + i, f"RPDO{i + 1}", pdo, slots) for i, pdo in enumerate(rpdos)),
        *(_tpdo_parameter(od.TPDO1_PARAMETER + i, i + 1, pdo) for i, pdo in enumerate(tpdos)),
        *(_mapping(od.TPDO1_MAPPING + i, f"TPDO{i + 1}", pdo, slots) for i, pdo in enumerate(tpdos)),
    )


def _device_objects(revision: int) -> tuple[Object, ...]:
    no_errors = Entry(od.ERROR_FIELD, 0, "Number of errors", _U8, "rw", 0)
    error_fields = [f"Standard error field {i}" for i in range(1, od.ERROR_FIELD_LENGTH + 1)]
    consumers = [f"Consumer heartbeat time {i}" for i in range(1, od.HEARTBEAT_CONSUMERS + 1)]
    save = [f"Save {group} parameters" for group in _GROUPS]
    restore = [f"Restore {group} defaults" for group in _GROUPS]
    return (
        var(od.DEVICE_TYPE, "Device type", _U32, "const", 0),
        var(od.ERROR_REGISTER, "Error register", _U8, "ro", 0, mappable=True),
        array(od.ERROR_FIELD, "Pre-defined error field", error_fields, _U32, "ro", 0, first=no_errors),
        var(od.COB_ID_SYNC, "COB-ID SYNC message", _U32, "rw", od.SYNC_COB_ID),
        var(od.CYCLE_PERIOD, "Communication cycle period", _U32, "rw", 0),
        var(od.SYNC_WINDOW, "Synchronous window length", _U32, "rw", 0),
        var(od.DEVICE_NAME_INDEX, "Manufacturer device name", _STRING, "const", od.DEVICE_NAME),
        var(od.HARDWARE_VERSION, "Manufacturer hardware version", _STRING, "const"),
        var(od.SOFTWARE_VERSION, "Manufacturer software version", _STRING, "const"),
        var(od.GUARD_TIME, "Guard time", _U16, "rw", 0),
        var(od.LIFE_TIME_FACTOR, "Life time factor", _U8, "rw", 0),
        array(od.STORE, "Store parameters", save, _U32, "rw", 1),
        array(od.RESTORE, "Restore default parameters", restore, _U32, "rw", 1),
        var(od.COB_ID_TIME, "COB-ID time stamp message", _U32, "rw", od.TIME_COB_ID),
        var(od.COB_ID_EMCY, "COB-ID emergency message", _U32, "rw", od.emcy_cob_id(0), plus_node_id=True),
        var(od.EMCY_INHIBIT_TIME, "Inhibit time EMCY", _U16, "rw", 0),
        array(od.HEARTBEAT_CONSUMER, "Consumer heartbeat time", consumers, _U32, "rw", 0),
        var(od.HEARTBEAT_PRODUCER, "Producer heartbeat time", _U16, "rw", 0),
        record(
            od.IDENTITY,
            "Identity object",
            (
                Entry(od.IDENTITY, od.IDENTITY_VENDOR, "Vendor-ID", _U32, "ro", od.VENDOR_ID),
                Entry(od.IDENTITY, od.IDENTITY_PRODUCT, "Product code", _U32, "ro", od.PRODUCT_CODE),
                Entry(od.IDENTITY, od.IDENTITY_REVISION, "Revision number", _U32, "ro", revision),
                Entry(od.IDENTITY, od.IDENTITY_SERIAL, "Serial number", _U32, "ro"),
            ),
        ),
        var(od.SYNC_COUNTER_OVERFLOW, "Synchronous counter overflow value", _U8, "rw", 0, high=240),
        array(
            od.VERIFY_CONFIGURATION,
            "Verify configuration",
            ["Configuration date", "Configuration time"],
            _U32,
            "rw",
            0,
        ),
        array(od.ERROR_BEHAVIOUR, "Error behaviour", ["Communication error"], _U8, "rw", 0, high=2),
        record(
            od.SDO_SERVER,
            "SDO server parameter",
            (
                _sdo_cob_id(1, "COB-ID client to server", od.sdo_request_cob_id(0)),
                _sdo_cob_id(2, "COB-ID server to client", od.sdo_response_cob_id(0)),
            ),
        ),
    )


def _sdo_cob_id(subindex: int, name: str, cob_id: int) -> Entry:
    return Entry(od.SDO_SERVER, subindex, name, _U32, "ro", cob_id, plus_node_id=True)


def _cob_id(index: int, name: str, pdo: PdoDefault) -> Entry:
    return Entry(index, od.PDO_COB_ID, name, _U32, "rw", pdo.cob_id, plus_node_id=pdo.plus_node_id)


def _rpdo_parameter(index: int, number: int, pdo: PdoDefault) -> Object:
    return record(
        index,
        f"RPDO{number} communication parameter: {pdo.purpose}",
        (
            _cob_id(index, "COB-ID used by RPDO", pdo),
            Entry(index, od.PDO_TYPE, "Transmission type", _U8, "rw", pdo.kind),
            Entry(index, od.PDO_EVENT_TIMER, "Event timer", _U16, "rw", 0),
        ),
    )


def _tpdo_parameter(index: int, number: int, pdo: PdoDefault) -> Object:
    return record(
        index,
        f"TPDO{number} communication parameter: {pdo.purpose}",
        (
            _cob_id(index, "COB-ID used by TPDO", pdo),
            Entry(index, od.PDO_TYPE, "Transmission type", _U8, "rw", pdo.kind),
            Entry(index, od.PDO_INHIBIT_TIME, "Inhibit time", _U16, "rw", pdo.inhibit_100us),
            Entry(index, od.PDO_EVENT_TIMER, "Event timer", _U16, "rw", 0),
            Entry(index, od.PDO_SYNC_START, "SYNC start value", _U8, "rw", 0, high=240),
        ),
    )


def _mapping(index: int, name: str, pdo: PdoDefault, slots: int) -> Object:
    values = [entry.mapping for entry in pdo.mapped] + [0] * (slots - len(pdo.mapped))
    entries = tuple(
        Entry(index, sub, f"Mapped object {sub}", _U32, "rw", value) for sub, value in enumerate(values, 1)
    )
    # No upper limit is declared: CiA 301 has a separate abort code for too many mapped objects.
    first = Entry(index, 0, "Number of mapped objects", _U8, "rw", len(pdo.mapped))
    return record(index, f"{name} mapping parameter: {pdo.purpose}", entries, first)
