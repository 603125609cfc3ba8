"""No frame kills a node, makes it grow, late, or forget what it was told: random and mutated frames.

`pytest tests/node/test_node_fuzz.py -s --frames 1000000` takes minutes and says what it saw; without the
option there are as many frames as fit into seconds.
"""

from __future__ import annotations

import gc
import random
import tracemalloc
from collections.abc import Callable, Iterator

import pytest

from skinnode.node import VolatileMemory

pytestmark = pytest.mark.long

MS = 1_000_000

# Frames that get somewhere, so that their mutations do too.
GOOD = [
    (0x000, "01 00"),
    (0x000, "80 04"),
    (0x000, "81 04"),
    (0x000, "82 00"),
    (0x080, ""),
    (0x080, "07"),
    (0x100, "00 00 00 01 02 00"),
    (0x204, "74 61 72 65 01 01"),
    (0x604, "40 08 10 00 00 00 00 00"),
    (0x604, "60 00 00 00 00 00 00 00"),
    (0x604, "70 00 00 00 00 00 00 00"),
    (0x604, "21 17 10 00 02 00 00 00"),
    (0x604, "0b 10 00 00 00 00 00 00"),
    (0x604, "a4 00 23 00 10 00 00 00"),
    (0x604, "a3 00 00 00 00 00 00 00"),
    (0x604, "a2 10 10 00 00 00 00 00"),
    (0x604, "c6 17 10 00 02 00 00 00"),
    (0x604, "81 05 00 00 00 00 00 00"),
    (0x604, "d5 bb d5 00 00 00 00 00"),
    (0x604, "23 01 18 01 84 02 00 80"),
    (0x604, "2f 01 1a 00 00 00 00 00"),
    (0x604, "23 01 1a 01 08 01 10 20"),
    (0x604, "2f 01 1a 00 03 00 00 00"),
    (0x604, "23 01 18 01 84 02 00 00"),
    (0x604, "2f 00 18 02 01 00 00 00"),
    (0x604, "2b 00 18 05 02 00 00 00"),
    (0x604, "2f 19 10 00 0a 00 00 00"),
    (0x604, "2b 17 10 00 05 00 00 00"),
    (0x604, "2b 0c 10 00 02 00 00 00"),
    (0x604, "2f 0d 10 00 03 00 00 00"),
    (0x604, "23 12 10 00 00 01 00 80"),
    (0x604, "23 14 10 00 84 00 00 80"),
    (0x604, "23 14 10 00 84 00 00 00"),
    (0x604, "2b 15 10 00 64 00 00 00"),
    (0x604, "23 16 10 01 0a 00 05 00"),
    (0x604, "23 05 10 00 80 00 00 00"),
    (0x604, "23 05 10 00 80 00 00 40"),
    (0x604, "23 06 10 00 10 27 00 00"),
    (0x604, "2f 29 10 01 01 00 00 00"),
    (0x604, "2b 21 20 01 03 00 00 00"),
    (0x604, "2f 20 20 01 01 00 00 00"),
    (0x604, "23 00 22 01 00 00 7a 44"),
    (0x604, "80 08 10 00 00 00 04 05"),
    (0x604, "23 10 10 01 73 61 76 65"),
    (0x604, "23 10 10 02 73 61 76 65"),
    (0x604, "23 11 10 01 6c 6f 61 64"),
    (0x704, ""),
    (0x705, "05"),
]
INDICES = [
    *(
        0x1000,
        0x1003,
        0x1005,
        0x1006,
        0x1007,
        0x100C,
        0x100D,
        0x1010,
        0x1011,
        0x1012,
        0x1014,
        0x1015,
        0x1016,
        0x1017,
    ),
    *(0x1019, 0x1020, 0x1029, 0x1400, 0x1402, 0x1600, 0x1602, 0x1800, 0x1801, 0x1803, 0x1A00, 0x1A01, 0x1A03),
    *(0x2020, 0x2021, 0x2022, 0x2040, 0x2200),
]
HEARTBEAT_EACH_5_MS = bytes.fromhex("2b 17 10 00 05 00 00 00")
VERIFICATION = {(0x1020, 1), (0x1020, 2)}
SEEDS = (1, 2, 3, 4)


def mutated(chance: random.Random, count: int) -> Iterator[tuple[int, bytes, bool]]:
    """Random frames, and known ones with some bytes changed or the length wrong: identifier, data, remote."""
    good = [(can_id, bytes.fromhex(data)) for can_id, data in GOOD]
    for _ in range(count):
        can_id, data = chance.choice(good)
        payload = bytearray(data)
        kind = chance.random()
        if kind < 0.3:
            can_id = chance.choice([can_id, chance.randrange(0x800)])
            payload = bytearray(chance.randbytes(chance.randrange(9)))
        elif kind < 0.6:
            for _ in range(chance.randrange(3)):
                if payload:
                    payload[chance.randrange(len(payload))] = chance.randrange(256)
        elif kind < 0.7:
            payload = (payload + chance.randbytes(8))[: chance.randrange(9)]
        elif can_id == 0x604 and kind < 0.9:
            payload[1:3] = chance.choice(INDICES).to_bytes(2, "little")
            payload[3] = chance.choice([payload[3], chance.randrange(9)])
        yield can_id, bytes(payload), chance.random() < (0.5 if can_id == 0x704 else 0.02)


class Dictionary:
    """What clients may write, as they wrote it; looked at from inside, since asking would end transfers."""

    def __init__(self, desk) -> None:
        self._store = desk.node._store
        entries = self._store._entries
        self.keys = [key for key, entry in entries.items() if entry.access not in ("ro", "const")]
        self.values = self.now()

    def now(self) -> list[bytes]:
        values = self._store._values
        return [values[key] for key in self.keys]

    def changes(self) -> set[tuple[int, int]]:
        """Objects that are not what they were when last asked."""
        now = self.now()
        if now == self.values:
            return set()
        pairs = zip(self.keys, self.values, now, strict=True)
        changed = {key for key, before, after in pairs if before != after}
        self.values = now
        return changed

    def mapped_to_rpdos(self) -> set[tuple[int, int]]:
        values = dict(zip(self.keys, self.values, strict=True))
        words = [value for (index, sub), value in values.items() if sub and 0x1600 <= index < 0x1800]
        return {(int.from_bytes(word[2:], "little"), word[1]) for word in words}


def allowed_changes(dictionary: Dictionary, sent: list[tuple[int, bytes]]) -> set[tuple[int, int]]:
    """What may have changed, going by what the node said: a confirmed download, or process data."""
    allowed = dictionary.mapped_to_rpdos()
    for can_id, data in sent:
        if can_id == 0x584 and data[0] == 0x60:
            allowed.add((int.from_bytes(data[1:3], "little"), data[3]))
    return allowed


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("seed", SEEDS)
def test_any_frame(make: Callable, seed: int, fuzz_frames: int) -> None:
    desk = make(memory=VolatileMemory())
    chance = random.Random(-seed)
    dictionary = Dictionary(desk)
    count = fuzz_frames // len(SEEDS)
    settled, grown_before = count // 4, 0
    beat_ns = desk.t_ns
    beats = confirmed = resets = 0
    tracemalloc.start()
    for number, (can_id, data, remote) in enumerate(mutated(random.Random(seed), count)):
        desk.node.on_frame(can_id, data, desk.t_ns, remote)
        end_ns = desk.t_ns + chance.randrange(50 * MS if chance.random() < 0.01 else MS // 2)
        for _ in range(20_000):
            due_ns = desk.node.next_deadline_ns()
            if due_ns is None or due_ns > end_ns:
                break
            desk.t_ns = max(desk.t_ns, due_ns)
            desk.node.on_timer(desk.t_ns)
        else:
            pytest.fail(f"frame {number}: the node wants to be called without end")
        desk.t_ns = end_ns

        sent = [(sent_id, payload) for sent_id, payload, _ in desk.sent]
        assert all(0 <= sent_id <= 0x7FF and len(payload) <= 8 for sent_id, payload in sent), number
        for sent_id, _, t_ns in desk.sent:
            if sent_id == 0x704:
                beat_ns, beats = t_ns, beats + 1
        desk.sent.clear()
        # Never longer without a heartbeat than it was told, whatever it has to listen to.
        period_ns = int.from_bytes(desk.node._store._values[0x1017, 0], "little") * MS
        assert not period_ns or end_ns - beat_ns < period_ns, number

        changed = dictionary.changes()
        if (0x704, b"\0") in sent:
            resets += 1
            desk.node.on_frame(0x604, HEARTBEAT_EACH_5_MS, desk.t_ns)
            dictionary.changes()
        elif changed:
            ended = sum(sent_id == 0x584 and payload[0] & 0xE0 in (0x20, 0xA0) for sent_id, payload in sent)
            confirmed += len(changed)
            beyond = changed - allowed_changes(dictionary, sent)
            if changed - VERIFICATION:  # whatever changes takes it back
                beyond -= VERIFICATION
            assert len(beyond) <= ended, f"frame {number}: {beyond} changed"  # by the end of a transfer
        if number == settled:
            gc.collect()
            grown_before = tracemalloc.get_traced_memory()[0]
    gc.collect()
    grown = tracemalloc.get_traced_memory()[0] - grown_before
    tracemalloc.stop()
    assert grown < 64 * 1024, f"{grown} bytes more than after {settled} frames"
    assert min(beats, confirmed, resets) > count // 200  # it was a conversation
    print(
        f"seed {seed}: {count} frames, {beats} error control, {confirmed} writes, {resets} resets, {grown} B"
    )

    # Whatever it was told: a reset, and it is the node it was.
    desk.frame(0, "81 04")
    assert desk.sdo("40 00 10 00 00 00 00 00") == "43 00 10 00 00 00 00 00"
    desk.write(0x1017, 0, 100, 2)
    desk.start()
    desk.run(350)
    assert [data for can_id, data in desk.take() if can_id == 0x704] == ["05"] * 4
    desk.frame(0x80)
    desk.run(80)
    assert desk.node.nmt_state == 5


def expected(state: str, can_id: int, data: bytes, remote: bool) -> tuple[set[int], set[int]]:
    """COB-IDs that a node fresh in ``state`` may answer on, and those that it must (CiA 301 v4.2, table
    39)."""
    communicates, operational = state != "04", state == "05"
    if remote:
        must = {0x704} if can_id == 0x704 else set()
        return must | ({can_id} if operational and can_id in (0x184, 0x284) else set()), must
    match can_id:
        case 0x604 if communicates and len(data) == 8:
            must = {0x584} if data[0] >> 5 != 4 else set()  # an abort is not answered
        case 0x080 if communicates and data:
            must = {0x084}
        case 0x080 if operational:
            must = {0x184}  # a scan begins
        case 0x204 if operational and len(data) < 6:
            must = {0x084}
        case 0x704 if communicates:
            must = {0x084}  # another node with this node-ID
        case 0x204 if operational:
            return {0x084, 0x184}, set()
        case _:
            must = set()
    return must, must


@pytest.mark.parametrize("state", ["7f", "05", "04"])
@pytest.mark.parametrize("remote", [False, True])
def test_every_length_on_every_identifier(make: Callable, state: str, remote: bool) -> None:
    """And nothing but what the standard answers is sent; the state stays what it was."""
    into = {"7f": "80 00", "05": "01 00", "04": "02 00"}[state]
    desk = make()
    desk.frame(0, into)
    for can_id in range(0x800):
        for length in range(9):
            for fill in (0x00, 0xFF):
                data = bytes((fill,)) * length
                sent = {sent_id for sent_id, _ in desk.frame(can_id, data.hex(), remote=remote)}
                may, must = expected(state, can_id, data, remote)
                assert must <= sent <= may, f"0x{can_id:03X} {data.hex(' ')}: answered on {sent}"
                if sent - {0x584, 0x704}:
                    desk.frame(0, "81 00")  # what it told once it tells again
                    desk.frame(0, into)
                    desk.run(20)  # inhibit times outlast a reset
                    desk.take()
    ((_, told),) = [each for each in desk.frame(0x704, remote=True) if each[0] == 0x704]
    assert f"{int(told, 16) & 0x7F:02x}" == state


def test_deadlines_always_lie_ahead_after_they_were_served(make: Callable) -> None:
    """A deadline that stays in the past would spin the thread that serves it."""
    desk = make()
    for can_id, data, remote in mutated(random.Random(3), 5000):
        desk.node.on_frame(can_id, data, desk.t_ns, remote)
        desk.t_ns += 500_000
        for _ in range(2):  # the first may ask to be told the time after it has sampled
            desk.node.on_timer(desk.t_ns)
        due_ns = desk.node.next_deadline_ns()
        assert due_ns is None or due_ns > desk.t_ns
        desk.sent.clear()
