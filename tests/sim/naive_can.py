"""CAN frames bit by bit, as the standard draws them. Shares no table and no function with the product."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass

from vcan_sim.timed_bus import CanFrame

FD_CODES = {**{n: n for n in range(9)}, 12: 9, 16: 10, 20: 11, 24: 12, 32: 13, 48: 14, 64: 15}
"""Bytes to length code: ISO 11898-1, table of the data length code."""
CRC_15 = sum(1 << power for power in (14, 10, 8, 7, 4, 3, 0))
CRC_17 = sum(1 << power for power in (16, 14, 13, 11, 6, 4, 3, 1, 0))
CRC_21 = sum(1 << power for power in (20, 13, 11, 7, 4, 3, 0))
GRAY = {0: "0000", 1: "0011", 2: "0110", 3: "0101", 4: "1100", 5: "1111", 6: "1010", 7: "1001"}
"""Stuff count modulo 8 to its Gray code and parity bit: ISO 11898-1:2015, table of the stuff count."""
FIVE_EQUAL = re.compile("0{5}|1{5}")
OTHER = {"0": "1", "1": "0"}


@dataclass
class Drawn:
    """A frame on the bus: its bits from start of frame to the end of the end of frame."""

    bits: str
    at_data_rate: list[bool]
    """For each bit whether it has the data bit rate."""
    stuffed: int
    """How many bits follow the stuff rule."""
    plain: int
    """How many of them are not stuff bits."""
    fixed: list[int]
    """Where the fixed stuff bits are."""

    @property
    def counts(self) -> tuple[int, int]:
        """Bits at the nominal and at the data bit rate, with the intermission."""
        fast = sum(self.at_data_rate)
        return len(self.bits) - fast + 3, fast


def head(frame: CanFrame, esi: bool = False) -> tuple[str, int | None]:
    """Bits before the data, and the place of ESI if the bit rate changes there."""
    identifier = f"{frame.can_id:029b}" if frame.extended else f"{frame.can_id:011b}"
    flag = "1" if frame.remote else "0"
    bits = f"0{identifier[:11]}11{identifier[11:]}{flag}" if frame.extended else f"0{identifier}{flag}0"
    if frame.fd:
        bits += "10" + ("1" if frame.brs else "0")
        place = len(bits) if frame.brs else None
        return f"{bits}{'1' if esi else '0'}{FD_CODES[len(frame.data)]:04b}", place
    bits += "00" if frame.extended else "0"
    return f"{bits}{frame.dlc if frame.remote else len(frame.data):04b}", None


def shift(bits: str, width: int, polynomial: int, register: int) -> int:
    """The CRC register after the bits, each shifted in by itself."""
    for bit in bits:
        top = register >> (width - 1)
        register = (register << 1) % (1 << width)
        if top != int(bit):
            register ^= polynomial
    return register


@functools.cache
def shift_eight(width: int, polynomial: int) -> list[int]:
    """The register after eight bits, if it was 0 before; eight bits at a time take a fifth of the time."""
    return [shift(f"{byte:08b}", width, polynomial, 0) for byte in range(256)]


def shift_out(bits: str, width: int, polynomial: int, register: int) -> str:
    """The CRC register after the bits."""
    after, whole = shift_eight(width, polynomial), len(bits) // 8 * 8
    for byte in int(bits[:whole], 2).to_bytes(whole // 8, "big"):
        register = (register << 8) % (1 << width) ^ after[register >> (width - 8) ^ byte]
    return f"{shift(bits[whole:], width, polynomial, register):0{width}b}"


def draw(frame: CanFrame, esi: bool = False) -> Drawn:
    """The frame on the bus."""
    bits, fast_from = head(frame, esi)
    bits += "".join(f"{byte:08b}" for byte in frame.data)
    if not frame.fd:
        bits += shift_out(bits, 15, CRC_15, 0)
    plain, at = len(bits), 0
    while (five := FIVE_EQUAL.search(bits, at)) and not (frame.fd and five.end() == len(bits)):
        at = five.end()  # place of the stuff bit, which is the first of the next run
        bits = bits[:at] + OTHER[bits[at - 1]] + bits[at:]
        if fast_from is not None and at <= fast_from:
            fast_from += 1
    stuffed, fixed = len(bits), []
    if frame.fd:
        count = GRAY[(stuffed - plain) % 8]
        wide = len(frame.data) > 16
        crc = (21, CRC_21, 1 << 20) if wide else (17, CRC_17, 1 << 16)
        field = count + shift_out(bits + count, *crc)
        for place in range(0, len(field), 4):
            fixed.append(len(bits))
            bits += OTHER[bits[-1]] + field[place : place + 4]
    slow = len(bits) + 1 if fast_from is None else fast_from
    at_data_rate = [False] * slow + [True] * (len(bits) + 1 - slow) + [False] * 9
    tail = "1" + "0" + "1" + "1" * 7  # CRC delimiter, ACK slot, ACK delimiter, end of frame
    return Drawn(bits + tail, at_data_rate, stuffed, plain, fixed)


def error_seen_at(drawn: Drawn, bit: int, value: str, flag: str) -> int:
    """Place of the bit in which a receiver detects an error by stuffing, by form or, at the ACK delimiter, by
    the CRC, if it sees ``value`` in place of a bit and an error flag after it."""
    seen = drawn.bits[:bit] + value + flag * 50
    field = len(drawn.bits) - 10 - drawn.stuffed  # CRC field of CAN FD
    taken, place = 0, 0
    while True:
        stuff_bit_is_due = seen[max(0, place - 5) : place] in ("0" * 5, "1" * 5)
        if taken == drawn.plain and (field or not stuff_bit_is_due):
            break
        if stuff_bit_is_due and seen[place] == seen[place - 1]:
            return place
        taken += not stuff_bit_is_due
        place += 1
    for fixed in range(place, place + field, 5):
        if seen[fixed] == seen[fixed - 1]:
            return fixed
    place += field
    wrong = [at for at in range(place, len(seen)) if at == place + 2 or (seen[at] == "0" and at != place + 1)]
    return next(at for at in wrong if at >= bit)
