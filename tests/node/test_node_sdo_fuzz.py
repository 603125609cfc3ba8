"""Conversations with the SDO server that go wrong at any point: it always answers, or waits for a bounded
time; it keeps nothing; and the object dictionary changes by nothing but writes it has confirmed."""

from __future__ import annotations

import binascii
import gc
import random
import struct
import tracemalloc
from collections.abc import Callable, Iterator

import pytest

pytestmark = pytest.mark.long

FRAMES = 20_000
SEEDS = (1, 2, 3)

FIXED = {0x1014: 4, 0x1015: 2, 0x1016: 4, 0x1017: 2, 0x1019: 1, 0x2020: 1, 0x2200: 4, 0x2201: 4}
"""Objects to talk about, and their bytes."""
READ_ONLY = (0x1000, 0x1001, 0x1008, 0x1018, 0x2000, 0x2100, 0x2300)
NOWHERE = (0x0005, 0x1FFF, 0x3000, 0xFFFF)


def expedited(chance: random.Random) -> Iterator[bytes]:
    index = chance.choice([*FIXED, *READ_ONLY, *NOWHERE])
    subindex = chance.choice([0, 1, 1, 2, 3, 0xFF])
    yield struct.pack("<BHB4x", 0x40, index, subindex)
    size = FIXED.get(index, chance.randrange(1, 5))
    data = (
        chance.randbytes(size) if chance.random() < 0.5 else bytes((chance.randrange(3),)).ljust(size, b"\0")
    )
    yield struct.pack("<BHB4s", 0x23 | (4 - size) << 2, index, subindex, data)


def segmented_upload(chance: random.Random) -> Iterator[bytes]:
    yield struct.pack("<BHB4x", 0x40, chance.choice([0x1008, 0x2300, 0x2301]), 0)
    for number in range(chance.randrange(30)):
        yield bytes((0x60 | (number & 1) << 4,)) + bytes(7)


def value_for(chance: random.Random) -> tuple[int, int, bytes]:
    if chance.random() < 0.5:
        return 0x2301, 0, struct.pack("<12f", *(chance.uniform(1, 1000) for _ in range(12)))
    return 0x1015, 0, chance.randbytes(2)


def parts_of(value: bytes) -> list[bytes]:
    return [value[at : at + 7] for at in range(0, len(value), 7)]


def segmented_download(chance: random.Random) -> Iterator[bytes]:
    index, subindex, value = value_for(chance)
    yield struct.pack("<BHBI", 0x21, index, subindex, len(value))
    parts = parts_of(value)
    for number, part in enumerate(parts):
        command = (number & 1) << 4 | (7 - len(part)) << 1 | (number + 1 == len(parts))
        yield bytes((command,)) + part.ljust(7, b"\0")


def block_upload(chance: random.Random) -> Iterator[bytes]:
    index, block_size = chance.choice([0x1008, 0x2300, 0x2301]), chance.choice([1, 5, 127])
    yield struct.pack("<BHBBB2x", 0xA4, index, 0, block_size, chance.choice([0, 0, 20]))
    yield b"\xa3" + bytes(7)
    for _ in range(chance.randrange(6)):
        yield bytes((0xA2, chance.choice([block_size, 2, 7]), block_size)) + bytes(5)
    yield b"\xa1" + bytes(7)


def block_download(chance: random.Random) -> Iterator[bytes]:
    index, subindex, value = value_for(chance)
    yield struct.pack("<BHBI", 0xC6, index, subindex, len(value))
    parts = parts_of(value)
    for number, part in enumerate(parts, 1):
        yield bytes((number | (number == len(parts)) << 7,)) + part.ljust(7, b"\0")
    yield struct.pack("<BH5x", 0xC1 | (-len(value) % 7) << 2, binascii.crc_hqx(value, 0))


CONVERSATIONS = (expedited, segmented_upload, segmented_download, block_upload, block_download)


def mutated(frames: Iterator[bytes], chance: random.Random) -> Iterator[bytes]:
    """The conversation with frames changed, cut, lost, doubled, and strange ones between them."""
    for frame in frames:
        match chance.randrange(40):
            case 0:
                changed = bytearray(frame)
                changed[chance.randrange(8)] = chance.randrange(256)
                yield bytes(changed)
            case 1:
                yield frame[: chance.randrange(8)]
            case 2:
                pass
            case 3:
                yield from (frame, frame)
            case 4:
                yield from (frame, chance.randbytes(8))
            case 5:
                yield b"\x80" + chance.randbytes(7)
            case 6:
                return
            case _:
                yield frame


class Watch:
    """Sees to it that an object changes when a write to it is confirmed, and at no other time."""

    def __init__(self, desk) -> None:
        self._store = desk.node._store
        items = desk.node.profile.objects()
        self._keys = [(e.index, e.subindex) for item in items for e in item.entries if e.access[:2] == "rw"]
        self._seen = self._now()
        self._target = 0
        self.changes = 0

    def _now(self) -> dict[tuple[int, int], bytes]:
        return {key: self._store.raw(*key) for key in self._keys}

    def check(self, request: bytes, answers: list[bytes]) -> None:
        written = set()
        for answer in answers:
            assert len(answer) == 8
            if answer[0] in (0x60, 0xA0, 0xA4):  # a download has begun, or is over already if expedited
                self._target = int.from_bytes(answer[1:3], "little")
                if request[0] & 0xE2 == 0x22:
                    written.add(self._target)
            elif answer[0] in (0x20, 0x30, 0xA1):
                written.add(self._target)
        now = self._now()
        changed = {key[0] for key in self._keys if now[key] != self._seen[key]}
        baselines = {0x2200, 0x2201, 0x2301}  # three objects, one memory
        if written & baselines:
            written |= baselines
        assert changed <= written, (request.hex(" "), [answer.hex(" ") for answer in answers])
        self.changes += bool(changed)
        self._seen = now


@pytest.mark.parametrize("seed", SEEDS)
def test_conversations_that_go_wrong(make: Callable, seed: int) -> None:
    chance = random.Random(seed)
    desk = make()
    watch = Watch(desk)
    frames = 0
    while frames < FRAMES:
        for frame in mutated(chance.choice(CONVERSATIONS)(chance), chance):
            frames += 1
            desk.node.on_frame(0x604, frame, desk.t_ns)
            if chance.random() < 0.3:
                desk.run(chance.choice([0.2, 1, 3, 30]))
            watch.check(frame, [data for can_id, data, _ in desk.sent if can_id == 0x584])
            desk.sent.clear()
    assert watch.changes > FRAMES / 100
    # A second of silence later the server is the one it was.
    desk.run(1001)
    desk.take()
    desk.write(0x1017, 0, 0, 2)
    assert desk.node.next_deadline_ns() is None
    desk.sent.clear()
    assert desk.sdo("40 00 10 00 00 00 00 00") == "43 00 10 00 00 00 00 00"


def test_nothing_is_kept_of_conversations_that_went_wrong(make: Callable) -> None:
    """Memory after twenty thousand frames is what it was after the first two thousand."""
    chance = random.Random(4)
    desk = make()

    def talk(frames: int) -> int:
        while frames > 0:
            for frame in mutated(chance.choice(CONVERSATIONS)(chance), chance):
                frames -= 1
                desk.node.on_frame(0x604, frame, desk.t_ns)
                desk.run(chance.choice([0, 0, 1]))
                desk.sent.clear()
        desk.frame(0x604, "80" + 7 * "00")
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = talk(2000)
        assert talk(FRAMES) < before + 4096
    finally:
        tracemalloc.stop()
