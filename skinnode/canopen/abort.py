"""SDO abort codes (CiA 301 v4.2, table 22), and an exception that carries an abort code."""

from __future__ import annotations

from enum import IntEnum


class AbortCode(IntEnum):
    """SDO abort codes of CiA 301."""

    TOGGLE_BIT = 0x05030000
    TIMED_OUT = 0x05040000
    UNKNOWN_COMMAND = 0x05040001
    INVALID_BLOCK_SIZE = 0x05040002
    INVALID_SEQUENCE = 0x05040003
    CRC = 0x05040004
    OUT_OF_MEMORY = 0x05040005
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_TOO_LONG = 0x06040042
    INCOMPATIBLE = 0x06040043
    INTERNAL_INCOMPATIBLE = 0x06040047
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    VALUE_TOO_HIGH = 0x06090031
    VALUE_TOO_LOW = 0x06090032
    MAXIMUM_BELOW_MINIMUM = 0x06090036
    NO_CONNECTION = 0x060A0023
    GENERAL = 0x08000000
    CANNOT_STORE = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DICTIONARY = 0x08000023
    NO_DATA = 0x08000024


class Refused(Exception):
    """Access to an object was refused. The SDO server sends the abort code to the client.

    Args:
        code: abort code.
    """

    def __init__(self, code: AbortCode) -> None:
        self.code = code
        """Abort code."""
        super().__init__(f"0x{code:08X} {code.name}")
