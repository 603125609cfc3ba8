"""CAN frames bit by bit, as the standard draws them. Shares no table and no function with the product."""

from __future__ import annotations

from dataclasses import dataclass

from vcan_sim.timed_bus import CanFrame

FD_CODES = {**{n: n for n in range(9)}, 12: 9, 16: 10, 20: 11, 24: 12, 32: 13, 48: 14, 64: 15}
"""Bytes to length code: ISO 11898-1, table of the data length code."""
CRC_15 = sum(1 << power for power in (14, 10, 8, 7, 4, 3, 0))
CRC_17 = sum(1 << power for power in (16, 14, 13, 11, 6, 4, 3, 1, 0))
CRC_21 = sum(1 << power for power in (20, 13, 11, 7, 4, 3, 0))
GRAY = {0: "0000", 1: "0011", 2: "0110", 3: "0101", 4: "1100", 5: "1111", 6: "1010", 7: "1001"}
"""Stuff count modulo 8 to its Gray code and parity bit: ISO 11898-1:2015, table of the stuff count."""


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


def shift_out(bits: str, width: int, polynomial: int, register: int) -> str:
    """The CRC register after the bits, each shifted in by itself."""
    for bit in bits:
        top = register >> (width - 1)
        register = (register << 1) % (1 << width)
        if top != int(bit):
            register ^= polynomial
    return f"{register:0{width}b}"


def draw(frame: CanFrame, esi: bool = False) -> Drawn:
    """The frame on the bus."""
    before, esi_at = head(frame, esi)
    plain = before + "".join(f"{byte:08b}" for byte in frame.data)
    if not frame.fd:
        plain += shift_out(plain, 15, CRC_15, 0)
    bits: list[str] = []
    fast: list[bool] = []
    run, stuff_bits, is_fast = 0, 0, False
    for place, bit in enumerate(plain):
        is_fast = is_fast or place == esi_at
        run = run + 1 if bits and bits[-1] == bit else 1
        bits.append(bit)
        fast.append(is_fast)
        if run == 5 and not (frame.fd and place + 1 == len(plain)):
            bits.append("0" if bit == "1" else "1")
            fast.append(is_fast)
            run, stuff_bits = 1, stuff_bits + 1
    stuffed, fixed = len(bits), []
    if frame.fd:
        count = GRAY[stuff_bits % 8]
        covered = "".join(bits) + count
        wide = len(frame.data) > 16
        crc = shift_out(covered, 21, CRC_21, 1 << 20) if wide else shift_out(covered, 17, CRC_17, 1 << 16)
        for place, bit in enumerate(count + crc):
            if place % 4 == 0:
                fixed.append(len(bits))
                bits.append("0" if bits[-1] == "1" else "1")
            bits.append(bit)
    fast += [is_fast] * (len(bits) + 1 - len(fast))
    tail = "1" + "0" + "1" + "1" * 7  # CRC delimiter, ACK slot, ACK delimiter, end of frame
    return Drawn("".join(bits) + tail, fast + [False] * 9, stuffed, len(plain), fixed)


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
