"""Identity, COB-IDs, indices and sub-indices of a patch.

The objects of CiA 301 are declared in :mod:`skinnode.canopen.communication`, and the manufacturer objects in
:mod:`skinnode.protocol.objects`.
"""

from __future__ import annotations

from typing import Final

# --- identity (0x1018)
VENDOR_ID: Final = 0
"""Vendor-ID of a patch; 0, because this project has no vendor-ID assigned by CiA."""
PRODUCT_CODE: Final = 0x534B494E
"""Product code of a patch, 'SKIN' in ASCII."""
REVISION_NUMBER: Final = 0x0001_0001
"""Revision number of a patch. The upper 16 bits are the major revision (CANopen behaviour), and the lower 16
bits the minor revision."""
UNCHECKED_REVISION_NUMBER: Final = 0x0001_0000
"""Revision number of a patch whose summaries contain no scan check."""
DEVICE_NAME: Final = "skinnode patch"

MAX_NODE_ID: Final = 127
"""Highest node-ID. The lowest is 1."""

# --- COB-IDs in the pre-defined connection set of CiA 301
FUNCTION_MASK: Final = 0x780
"""Mask of the function code in a COB-ID."""
NODE_ID_MASK: Final = 0x7F
"""Mask of the node-ID in a COB-ID."""
NMT_COB_ID: Final = 0x000
SYNC_COB_ID: Final = 0x080
TIME_COB_ID: Final = 0x100
LSS_RESPONSE_COB_ID: Final = 0x7E4
"""COB-ID of responses from LSS slaves (CiA 305)."""
LSS_REQUEST_COB_ID: Final = 0x7E5
"""COB-ID of requests from the LSS master (CiA 305)."""


def emcy_cob_id(node_id: int) -> int:
    """Return the default COB-ID of a node's emergency messages."""
    return 0x080 + node_id


def tpdo_cob_id(number: int, node_id: int) -> int:
    """Return the default COB-ID of a TPDO, where ``number`` is 0 (TPDO1) to 3 (TPDO4)."""
    return 0x180 + 0x100 * number + node_id


def rpdo_cob_id(number: int, node_id: int) -> int:
    """Return the default COB-ID of an RPDO, where ``number`` is 0 (RPDO1) to 3 (RPDO4)."""
    return 0x200 + 0x100 * number + node_id


def chunk_cob_id(node_id: int) -> int:
    """Return the default COB-ID of TPDO1, which carries chunks."""
    return tpdo_cob_id(0, node_id)


def command_cob_id(node_id: int) -> int:
    """Return the default COB-ID of RPDO1, which carries commands."""
    return rpdo_cob_id(0, node_id)


def summary_cob_id(node_id: int) -> int:
    """Return the default COB-ID of TPDO2, which carries summaries."""
    return tpdo_cob_id(1, node_id)


def sdo_response_cob_id(node_id: int) -> int:
    """Return the COB-ID of responses from a node's SDO server."""
    return 0x580 + node_id


def sdo_request_cob_id(node_id: int) -> int:
    """Return the COB-ID of requests to a node's SDO server."""
    return 0x600 + node_id


def heartbeat_cob_id(node_id: int) -> int:
    """Return the COB-ID of a node's boot-up messages, heartbeats and guarding responses."""
    return 0x700 + node_id


def predefined_cob_ids(node_id: int) -> frozenset[int]:
    """Return all COB-IDs that the pre-defined connection set assigns to a node."""
    pdos = {cob_id(number, node_id) for cob_id in (tpdo_cob_id, rpdo_cob_id) for number in range(4)}
    services = {emcy_cob_id(node_id), sdo_response_cob_id(node_id), sdo_request_cob_id(node_id)}
    return frozenset(pdos | services | {heartbeat_cob_id(node_id)})


BIT_RATES_BPS: Final = (125_000, 250_000, 500_000, 1_000_000)
"""Bit rates supported by a patch, in bit/s."""

# --- communication objects (CiA 301)
DEVICE_TYPE: Final = 0x1000
ERROR_REGISTER: Final = 0x1001
ERROR_FIELD: Final = 0x1003
COB_ID_SYNC: Final = 0x1005
CYCLE_PERIOD: Final = 0x1006
SYNC_WINDOW: Final = 0x1007
"""Index of the synchronous window length (in µs)."""
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
"""Index of the mapping record of TPDO2. The records of consecutive TPDOs have consecutive indices."""
MAX_PDOS: Final = 512
"""Maximum number of RPDOs; the same limit applies separately to TPDOs. It equals the number of indices in a
range such as 0x1400 to 0x15FF."""
PDO_MAPPING_OFFSET: Final = 0x200
"""Offset from the index of a PDO's communication record to the index of its mapping record."""
PDO_INVALID: Final = 1 << 31
"""COB-ID bit that disables a PDO."""
PDO_COB_ID, PDO_TYPE, PDO_INHIBIT_TIME, PDO_EVENT_TIMER, PDO_SYNC_START = 1, 2, 3, 5, 6
"""Sub-indices of the communication record of a PDO."""
DUMMY_BITS: Final = {0x0002: 8, 0x0003: 16, 0x0004: 32, 0x0005: 8, 0x0006: 16, 0x0007: 32}
"""Lengths in bits of the data types that can be mapped into an RPDO as dummies, keyed by data type index.

A node ignores the bytes of a dummy. BOOLEAN is not supported, because mapped objects must consist of whole
bytes.
"""
ERROR_FIELD_LENGTH: Final = 8
HEARTBEAT_CONSUMERS: Final = 8

# --- manufacturer objects
DESCRIPTOR: Final = 0x2000
ROWS, COLUMNS, UPPER_ELECTRODES, LOWER_ELECTRODES, CODE_BITS = 1, 2, 3, 4, 5
CODE_LO, CODE_HI, RESISTIVITY, LAYOUT_ID, LAYOUT_HASH, SERIAL = 6, 7, 8, 9, 10, 11
PDO_BYTES: Final = 12
"""Sub-index of the maximum PDO length: 8 bytes on classic CAN, 64 bytes on CAN FD."""
CHUNK: Final = 0x2010
CHUNK_INDEX, CHUNK_SCAN = 1, 2
"""Sub-indices of the chunk index and the scan counter. On CAN FD, sub-index 1 is the number of the upper wire
instead, and sub-index 3 is the number of the first lower wire."""
SUMMARY: Final = 0x2011
SUMMARY_SCAN, SUMMARY_FLAGS, SUMMARY_CHUNKS, SUMMARY_TIME = 1, 2, 3, 4
SUMMARY_TIME_64US, SUMMARY_CHECK = 5, 6
"""Sub-indices of the 16-bit device time (in steps of 64 µs) and the scan check. Since revision 1.1, summaries
contain these instead of the 32-bit device time."""
SEND_POLICY: Final = 0x2020
SEND_MODE, SEND_THRESHOLD, SEND_REFRESH = 1, 2, 3
ACQUISITION: Final = 0x2021
ACQUISITION_PERIOD, ACQUISITION_AVERAGING, SELF_TEST, TARE, SINGLE_SCAN = 1, 2, 3, 4, 5
COMMANDS: Final = frozenset({(ACQUISITION, SELF_TEST), (ACQUISITION, TARE), (ACQUISITION, SINGLE_SCAN)})
"""Index and sub-index of each command. Writing a command triggers an action. Commands are not parameters, so
they are neither saved nor verified."""
TIME_OF_DAY: Final = 0x2022
TIME_DAYS, TIME_MS, TIME_MESSAGES, TIME_DEVICE_US = 1, 2, 3, 4
SELF_TEST_RESULT: Final = 0x2023
TEST_STATUS, TEST_FAULTS, TEST_READINGS, TEST_NOISE = 1, 2, 3, 4
TEST_OPEN_WIRES, TEST_SHORTED_WIRES, TEST_OUT_OF_RANGE, TEST_UNTARED = 5, 6, 7, 8
UPPER_WIRE_FAULTS: Final = 0x2030
LOWER_WIRE_FAULTS: Final = 0x2031
"""Index of the fault masks of the lower wires. A mask covers 32 wires. The masks of wires 32 i to 32 i + 31
are at sub-indices 2 i + 1 (open wires) and 2 i + 2 (shorted wires)."""
REJECTED_FRAMES: Final = 0x2040
"""Index of the counters of rejected frames; see :class:`skinnode.node.rejected.Rejected`."""
CODES: Final = 0x2100
"""Index of the latest codes of upper wire 0, one code per sub-index. The codes of upper wire r are at index
CODES + r."""
BASELINE: Final = 0x2200
"""Index of the R0 values of upper wire 0, in ohms (0 if unknown), one crossing per sub-index. The values of
upper wire r are at index BASELINE + r."""
COORDINATES: Final = 0x2300
"""Index of the electrode coordinates, a DOMAIN; see :mod:`skinnode.protocol.coordinates`."""
BASELINE_DOMAIN: Final = 0x2301
"""Index of the whole baseline, a DOMAIN: U·K REAL32 values of R0 in ohms, ordered by upper wire. The baseline
must be written as a whole."""

TARE_SIGNATURE: Final = int.from_bytes(b"tare", "little")
SELF_TEST_SIGNATURE: Final = int.from_bytes(b"test", "little")
STORE_SIGNATURE: Final = int.from_bytes(b"save", "little")
RESTORE_SIGNATURE: Final = int.from_bytes(b"load", "little")
