"""Identity, COB-IDs, indices and sub-indices, each defined only here.

:mod:`skinnode.canopen.communication` (CiA 301) and :mod:`skinnode.protocol.objects` (the patch) declare the
objects at these indices.
"""

from __future__ import annotations

from typing import Final

# --- identity (0x1018)
VENDOR_ID: Final = 0
"""Vendor-ID; 0, which CiA never assigns, because this project has no vendor-ID of its own."""
PRODUCT_CODE: Final = 0x534B494E
"""Product code, 'SKIN' in ASCII."""
REVISION_NUMBER: Final = 0x0001_0001
"""Revision number: major revision (CANopen behaviour) in the upper half, minor revision in the lower half."""
UNCHECKED_REVISION_NUMBER: Final = 0x0001_0000
"""Revision number of patches whose scan summaries carry no check."""
DEVICE_NAME: Final = "skinnode patch"

MAX_NODE_ID: Final = 127
"""Largest node-ID; the smallest is 1."""

# --- COB-IDs: the pre-defined connection set of CiA 301
FUNCTION_MASK: Final = 0x780
"""Bits of a COB-ID that hold the function code."""
NODE_ID_MASK: Final = 0x7F
"""Bits of a COB-ID that hold the node-ID."""
NMT_COB_ID: Final = 0x000
SYNC_COB_ID: Final = 0x080
TIME_COB_ID: Final = 0x100
LSS_RESPONSE_COB_ID: Final = 0x7E4
"""COB-ID of messages from LSS slave to master (CiA 305)."""
LSS_REQUEST_COB_ID: Final = 0x7E5
"""COB-ID of messages from LSS master to slaves."""


def emcy_cob_id(node_id: int) -> int:
    """Return the COB-ID of a node's emergency messages."""
    return 0x080 + node_id


def tpdo_cob_id(number: int, node_id: int) -> int:
    """Return the COB-ID of TPDO ``number``, 0 to 3, of a node."""
    return 0x180 + 0x100 * number + node_id


def rpdo_cob_id(number: int, node_id: int) -> int:
    """Return the COB-ID of RPDO ``number``, 0 to 3, of a node."""
    return 0x200 + 0x100 * number + node_id


def chunk_cob_id(node_id: int) -> int:
    """Return the COB-ID of TPDO1, which carries a chunk of a scan."""
    return tpdo_cob_id(0, node_id)


def command_cob_id(node_id: int) -> int:
    """Return the COB-ID of RPDO1, which carries a command."""
    return rpdo_cob_id(0, node_id)


def summary_cob_id(node_id: int) -> int:
    """Return the COB-ID of TPDO2, which carries the summary of a scan."""
    return tpdo_cob_id(1, node_id)


def sdo_response_cob_id(node_id: int) -> int:
    """Return the COB-ID of messages from a node's SDO server to its client."""
    return 0x580 + node_id


def sdo_request_cob_id(node_id: int) -> int:
    """Return the COB-ID of messages from a client to a node's SDO server."""
    return 0x600 + node_id


def heartbeat_cob_id(node_id: int) -> int:
    """Return the COB-ID of a node's boot-up, heartbeat and node guarding messages."""
    return 0x700 + node_id


def predefined_cob_ids(node_id: int) -> frozenset[int]:
    """Return the COB-IDs that the pre-defined connection set assigns to a node."""
    pdos = {cob_id(number, node_id) for cob_id in (tpdo_cob_id, rpdo_cob_id) for number in range(4)}
    services = {emcy_cob_id(node_id), sdo_response_cob_id(node_id), sdo_request_cob_id(node_id)}
    return frozenset(pdos | services | {heartbeat_cob_id(node_id)})


BIT_RATES_BPS: Final = (125_000, 250_000, 500_000, 1_000_000)
"""Bit rates that a patch supports, bit/s."""

# --- communication objects (CiA 301)
DEVICE_TYPE: Final = 0x1000
ERROR_REGISTER: Final = 0x1001
ERROR_FIELD: Final = 0x1003
COB_ID_SYNC: Final = 0x1005
CYCLE_PERIOD: Final = 0x1006
SYNC_WINDOW: Final = 0x1007
"""Synchronous window length, µs."""
DEVICE_NAME_INDEX: Final = 0x1008
HARDWARE_VERSION: Final = 0x1009
SOFTWARE_VERSION: Final = 0x100A
GUARD_TIME: Final = 0x100C
LIFE_TIME_FACTOR: Final = 0x100D
STORE: Final = 0x1010
RESTORE: Final = 0x1011
COB_ID_TIME: Final = 0x1012
COB_ID_EMCY: Final = 0x1014
EMCY_INHIBIT_TIME: Final = 0x1015
HEARTBEAT_CONSUMER: Final = 0x1016
HEARTBEAT_PRODUCER: Final = 0x1017
IDENTITY: Final = 0x1018
IDENTITY_VENDOR, IDENTITY_PRODUCT, IDENTITY_REVISION, IDENTITY_SERIAL = 1, 2, 3, 4
SYNC_COUNTER_OVERFLOW: Final = 0x1019
VERIFY_CONFIGURATION: Final = 0x1020
VERIFY_DATE, VERIFY_TIME = 1, 2
ERROR_BEHAVIOUR: Final = 0x1029
SDO_SERVER: Final = 0x1200
RPDO1_PARAMETER: Final = 0x1400
RPDO1_MAPPING: Final = 0x1600
TPDO1_PARAMETER: Final = 0x1800
TPDO2_PARAMETER: Final = 0x1801
TPDO1_MAPPING: Final = 0x1A00
TPDO2_MAPPING: Final = 0x1A01
"""Indices of the first PDOs; add n for PDO n, counted from 0."""
MAX_PDOS: Final = 512
"""Maximum number of RPDOs, and also of TPDOs; each index range, such as 0x1400 to 0x15FF, has this length."""
PDO_MAPPING_OFFSET: Final = 0x200
"""Offset from the index of a PDO's communication parameter to the index of its mapping."""
PDO_INVALID: Final = 1 << 31
"""Bit of a COB-ID that disables its PDO."""
PDO_COB_ID, PDO_TYPE, PDO_INHIBIT_TIME, PDO_EVENT_TIMER, PDO_SYNC_START = 1, 2, 3, 5, 6
"""Sub-indices of a PDO's communication parameter."""
DUMMY_BITS: Final = {0x0002: 8, 0x0003: 16, 0x0004: 32, 0x0005: 8, 0x0006: 16, 0x0007: 32}
"""Lengths in bits of the data types that an RPDO can map as dummy objects, whose bytes this node ignores.

BOOLEAN is not included because PDOs consist of whole bytes.
"""
ERROR_FIELD_LENGTH: Final = 8
HEARTBEAT_CONSUMERS: Final = 8

# --- manufacturer objects
DESCRIPTOR: Final = 0x2000
ROWS, COLUMNS, UPPER_ELECTRODES, LOWER_ELECTRODES, CODE_BITS = 1, 2, 3, 4, 5
CODE_LO, CODE_HI, RESISTIVITY, LAYOUT_ID, LAYOUT_HASH, SERIAL = 6, 7, 8, 9, 10, 11
PDO_BYTES: Final = 12
"""Sub-index of the maximum PDO length, which is 8 bytes, or 64 over CAN FD."""
CHUNK: Final = 0x2010
CHUNK_INDEX, CHUNK_SCAN = 1, 2
"""Sub-indices before the codes; over CAN FD they hold the wire and the scan counter, and the codes start with
the first column."""
SUMMARY: Final = 0x2011
SUMMARY_SCAN, SUMMARY_FLAGS, SUMMARY_CHUNKS, SUMMARY_TIME = 1, 2, 3, 4
SUMMARY_TIME_64US, SUMMARY_CHECK = 5, 6
"""Sub-indices that TPDO2 carries from revision 1.1 on, instead of the device time in µs."""
SEND_POLICY: Final = 0x2020
SEND_MODE, SEND_THRESHOLD, SEND_REFRESH = 1, 2, 3
ACQUISITION: Final = 0x2021
ACQUISITION_PERIOD, ACQUISITION_AVERAGING, SELF_TEST, TARE, SINGLE_SCAN = 1, 2, 3, 4, 5
COMMANDS: Final = frozenset({(ACQUISITION, SELF_TEST), (ACQUISITION, TARE), (ACQUISITION, SINGLE_SCAN)})
"""Objects that a client writes as commands; they are not parameters, so they are neither saved nor
verified."""
TIME_OF_DAY: Final = 0x2022
TIME_DAYS, TIME_MS, TIME_MESSAGES, TIME_DEVICE_US = 1, 2, 3, 4
SELF_TEST_RESULT: Final = 0x2023
TEST_STATUS, TEST_FAULTS, TEST_READINGS, TEST_NOISE = 1, 2, 3, 4
TEST_OPEN_WIRES, TEST_SHORTED_WIRES, TEST_OUT_OF_RANGE, TEST_UNTARED = 5, 6, 7, 8
UPPER_WIRE_FAULTS: Final = 0x2030
LOWER_WIRE_FAULTS: Final = 0x2031
"""Masks for 32 wires each, from wire 32 i on: open wires at sub-index 2 i + 1, shorted wires at 2 i + 2."""
REJECTED_FRAMES: Final = 0x2040
"""Counters; see :class:`skinnode.node.rejected.Rejected`."""
CODES: Final = 0x2100
"""Index of the latest codes of upper wire 0, with one sub-index per column; add r for upper wire r."""
BASELINE: Final = 0x2200
"""Index of R0 of upper wire 0 in ohm (0: unknown), with one sub-index per column; add r for upper wire r."""
COORDINATES: Final = 0x2300
"""DOMAIN; see :func:`skinnode.protocol.coordinates.pack_coordinates`."""
BASELINE_DOMAIN: Final = 0x2301
"""DOMAIN: R0 of all crossings in ohm as U·K REAL32, one upper wire after another; written as a whole."""

TARE_SIGNATURE: Final = int.from_bytes(b"tare", "little")
SELF_TEST_SIGNATURE: Final = int.from_bytes(b"test", "little")
STORE_SIGNATURE: Final = int.from_bytes(b"save", "little")
RESTORE_SIGNATURE: Final = int.from_bytes(b"load", "little")
