"""Definitions of layer setting services (LSS, CiA 305 v3.0), shared by LSS masters and slaves."""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

NOT_CONFIGURED: Final = 0xFF
"""Value that replaces the node-ID in a device without a node-ID."""

BIT_RATES_BPS: Final = {
    0: 1_000_000,
    1: 800_000,
    2: 500_000,
    3: 250_000,
    4: 125_000,
    6: 50_000,
    7: 20_000,
    8: 10_000,
}
"""Bit rates in bit/s, keyed by index in the CiA 301 bit timing table. Index 5 is reserved, and index 9
selects automatic bit rate detection."""

LSS_DONE: Final = 0
"""Error code of a successful configuration request."""

LSS_MANUFACTURER_ERROR: Final = 0xFF
"""Error code of a manufacturer-specific error, which the next byte of the response specifies."""

RESET_SCAN: Final = 0x80
"""Bit-check value in a fastscan request that restarts the scan at the vendor-ID. Every node without a node-ID
responds."""


class LssCommand(IntEnum):
    """LSS command specifiers. Most responses have the same command specifier as the request."""

    SWITCH_GLOBAL = 0x04
    CONFIGURE_NODE_ID = 0x11
    CONFIGURE_BIT_TIMING = 0x13
    ACTIVATE_BIT_TIMING = 0x15
    STORE = 0x17
    SELECT_VENDOR = 0x40
    SELECT_SERIAL = 0x43
    SELECTED = 0x44
    IDENTIFY_VENDOR = 0x46
    IDENTIFY_SERIAL_HIGH = 0x4B
    IDENTIFY_NOT_CONFIGURED = 0x4C
    IDENTIFIED = 0x4F
    IDENTIFIED_NOT_CONFIGURED = 0x50
    FASTSCAN = 0x51
    INQUIRE_VENDOR = 0x5A
    INQUIRE_SERIAL = 0x5D
    INQUIRE_NODE_ID = 0x5E


class LssState(IntEnum):
    """States of an LSS slave, with their values in the service *switch state global*."""

    WAITING = 0
    CONFIGURATION = 1


class LssAddress(NamedTuple):
    """LSS address of a device: the four values of its identity object (0x1018), unique in combination."""

    vendor_id: int
    product_code: int
    revision_number: int
    serial_number: int
