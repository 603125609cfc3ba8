"""Bit sequences of CAN frames, used to model errors in individual bits (ISO 11898-1:2015).

Building a bit sequence is slow. :mod:`vcan_sim.timed_bus.bus` does so only if a rule disturbs the frame, no
station acknowledges it, or two stations send the same identifier.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from skinnode.canopen.data_length import FD_LENGTHS
from vcan_sim.timed_bus.frame import CanFrame

FLAG_BITS: Final = 6
"""Length of one station's error flag, in bits. A run of this many equal bits violates the stuff rule."""

ACK_TO_END_BITS: Final = 9
"""Total length of the ACK slot, ACK delimiter and end of frame, in bits."""

_STUFF_AFTER: Final = 5
_FIXED_STUFF_SPACING: Final = 5
_MAX_LAG: Final = 7  # four recessive CRC bits, CRC delimiter, ACK slot and ACK delimiter
_CRC_15: Final = 0x4599
_CRC_17: Final = 0x1685B
_CRC_21: Final = 0x102899


@dataclass(frozen=True, slots=True)
class WireFrame:
    """Bit sequence of an acknowledged frame, including stuff bits. Dominant bits are 0."""

    bits: tuple[int, ...]
    """Bits from the start of frame to the last bit of the end of frame."""
    stuffed_end: int
    """Number of bits subject to the stuff rule, including stuff bits. These bits end with the CRC sequence;
    in CAN FD, they end with the data."""
    plain: int
    """Number of bits subject to the stuff rule, excluding stuff bits."""
    fixed_stuff: tuple[int, ...]
    """Positions of the fixed stuff bits; empty for a classic frame."""
    delimiter: int
    """Position of the CRC delimiter."""
    data_phase: range
    """Positions of the bits sent at the data bit rate; empty without a bit rate switch."""

    @property
    def ack_slot(self) -> int:
        """Position of the ACK slot."""
        return self.delimiter + 1

    def bits_through(self, position: int) -> tuple[int, int]:
        """Return the numbers of nominal and data bits up to and including ``position``."""
        fast = max(0, min(position + 1, self.data_phase.stop) - self.data_phase.start)
        return position + 1 - fast, fast


def wire_frame(frame: CanFrame, esi: bool = False) -> WireFrame:
    """Build the bit sequence of a frame.

    Args:
        frame: Frame to send.
        esi: Whether the error state indicator of a CAN FD frame is recessive.

    Returns:
        Bit sequence with a dominant ACK slot.
    """
    tail = (1, 0, 1, *(1,) * 7)  # CRC delimiter, ACK slot, ACK delimiter, end of frame
    head = tuple(_head(frame, esi))
    payload = tuple(byte >> shift & 1 for byte in frame.data for shift in range(7, -1, -1))
    if not frame.fd:
        crc = _crc((*head, *payload), 15, _CRC_15, 0)
        stuffed, places = _stuffed((*head, *payload, *crc))
        n = len(stuffed)
        return WireFrame((*stuffed, *tail), n, n - len(places), (), n, range(0))

    stuffed, places = _stuffed((*head, *payload))
    if places[-1:] == [len(stuffed) - 1]:  # replaced by the first fixed stuff bit
        del stuffed[-1], places[-1]
    count = len(places) % 8
    gray = count ^ count >> 1
    checked = [gray >> 2 & 1, gray >> 1 & 1, gray & 1, gray.bit_count() & 1]
    width, polynomial = (17, _CRC_17) if len(frame.data) <= 16 else (21, _CRC_21)
    checked += _crc((*stuffed, *checked), width, polynomial, 1 << width - 1)
    bits, fixed = list(stuffed), []
    for number, bit in enumerate(checked):
        if number % 4 == 0:
            fixed.append(len(bits))
            bits.append(1 - bits[-1])
        bits.append(bit)
    delimiter = len(bits)
    phase = range(0)
    if frame.brs:
        esi_place = len(head) - 5
        phase = range(_with_stuff_bits(esi_place, places), delimiter + 1)
    plain = len(head) + len(payload)
    return WireFrame((*bits, *tail), len(stuffed), plain, tuple(fixed), delimiter, phase)


def receiver_lag(wire: WireFrame, position: int, seen: int, flag: int) -> int:
    """Return the number of error flag bits after which a receiver detects an error.

    The flag starts after ``position``. It violates the stuff rule, the rule for fixed stuff bits, or the form
    of the delimiters and the end of frame. If it violates none of these rules, it corrupts the CRC, and a
    receiver signals the error after the ACK delimiter (ISO 11898-1:2015). The receiver destuffs the bits that
    it sees.

    Args:
        wire: Bit sequence of the frame.
        position: Position of the bit in which another station detects the error.
        seen: Value that the receiver sees at ``position``.
        flag: 0 for an active error flag, 1 for a passive error flag.

    Returns:
        0 to 6 bits of an active error flag, or 0 to 7 bits of a passive error flag. 0 means that the receiver
        already detects an error in the bit at ``position``.
    """
    stream = (*wire.bits[:position], seen, *(flag,) * _MAX_LAG)
    last = run = plain = 0
    start = 0
    for at, bit in enumerate(stream):
        if plain == wire.plain and (wire.fixed_stuff or run < _STUFF_AFTER):
            start = at
            break
        if run == _STUFF_AFTER:  # this bit must be a stuff bit
            if bit == last:
                return at - position
            run = 1
        else:
            plain += 1
            run = run + 1 if bit == last and run else 1
        last = bit
    else:
        return _MAX_LAG
    delimiter = start + wire.delimiter - wire.stuffed_end
    for at in range(start, len(stream)):
        before, bit = stream[at - 1], stream[at]
        if at < delimiter:
            wrong = bool(wire.fixed_stuff) and (at - start) % _FIXED_STUFF_SPACING == 0 and bit == before
        elif at == delimiter + 2:
            wrong = bit == 0 or at > position  # form error or CRC error
        else:
            wrong = bit == 0 and at != delimiter + 1
        if wrong and at >= position:
            return at - position
    return 0


def _head(frame: CanFrame, esi: bool) -> Iterator[int]:
    """Yield the bits of a frame from the start of frame to the data length code."""

    def field(value: int, width: int) -> Iterator[int]:
        return (value >> shift & 1 for shift in range(width - 1, -1, -1))

    yield 0
    if frame.extended:
        yield from field(frame.can_id >> 18, 11)
        yield from (1, 1)  # SRR, IDE
        yield from field(frame.can_id, 18)
        yield int(frame.remote)
    else:
        yield from field(frame.can_id, 11)
        yield from (int(frame.remote), 0)  # RTR or RRS, IDE
    if frame.fd:
        yield from (1, 0, int(frame.brs), int(esi))  # FDF, res, BRS, ESI
        yield from field(FD_LENGTHS.index(len(frame.data)), 4)
        return
    yield from (0, 0) if frame.extended else (0,)  # FDF and r0; a base frame has FDF only
    yield from field(frame.dlc if frame.remote else len(frame.data), 4)


def _stuffed(bits: Sequence[int]) -> tuple[list[int], list[int]]:
    """Insert stuff bits into a bit sequence; return the result and the positions of the stuff bits."""
    out: list[int] = []
    places: list[int] = []
    run = 0
    for bit in bits:
        run = run + 1 if out and out[-1] == bit else 1
        out.append(bit)
        if run == _STUFF_AFTER:
            places.append(len(out))
            out.append(1 - bit)
            run = 1
    return out, places


def _with_stuff_bits(place: int, stuff_places: Sequence[int]) -> int:
    """Convert a bit position in the unstuffed frame to the position of the same bit in the stuffed frame."""
    for stuff in stuff_places:
        if stuff > place:
            break
        place += 1
    return place


def _crc(bits: Sequence[int], width: int, polynomial: int, register: int) -> list[int]:
    top, mask = width - 1, (1 << width) - 1
    for bit in bits:
        feedback = bit ^ register >> top
        register = (register << 1 & mask) ^ (polynomial if feedback else 0)
    return [register >> shift & 1 for shift in range(top, -1, -1)]
