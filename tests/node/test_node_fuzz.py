"""No frame kills a node: random and mutated frames, then it still answers, beats and obeys."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

FRAMES = 20_000
SEEDS = (1, 2, 3, 4)

# Frames that get somewhere, so that their mutations do too.
GOOD = [
    (0x000, "01 00"),
    (0x000, "80 04"),
    (0x000, "81 04"),
    (0x000, "82 00"),
    (0x080, ""),
    (0x080, "07"),
    (0x204, "74 61 72 65 01 01"),
    (0x604, "40 08 10 00 00 00 00 00"),
    (0x604, "60 00 00 00 00 00 00 00"),
    (0x604, "70 00 00 00 00 00 00 00"),
    (0x604, "21 17 10 00 02 00 00 00"),
    (0x604, "0b 10 00 00 00 00 00 00"),
    (0x604, "23 01 18 01 84 02 00 80"),
    (0x604, "2f 01 1a 00 00 00 00 00"),
    (0x604, "23 01 1a 01 08 01 10 20"),
    (0x604, "2f 01 1a 00 03 00 00 00"),
    (0x604, "23 01 18 01 84 02 00 00"),
    (0x604, "2f 00 18 02 01 00 00 00"),
    (0x604, "2b 00 18 05 02 00 00 00"),
    (0x604, "2f 19 10 00 0a 00 00 00"),
    (0x604, "2b 17 10 00 05 00 00 00"),
    (0x604, "23 16 10 01 0a 00 05 00"),
    (0x604, "23 05 10 00 80 00 00 00"),
    (0x604, "2b 21 20 01 03 00 00 00"),
    (0x604, "2f 20 20 01 01 00 00 00"),
    (0x604, "23 00 22 01 00 00 7a 44"),
    (0x604, "80 08 10 00 00 00 04 05"),
    (0x705, "05"),
]
INDICES = [
    0x1000,
    0x1003,
    0x1005,
    0x1014,
    0x1016,
    0x1400,
    0x1600,
    0x1800,
    0x1801,
    0x1A00,
    0x1A01,
    0x2020,
    0x2021,
]


def frames(seed: int) -> list[tuple[int, bytes, bool]]:
    """Random frames, and known ones with some bytes changed or the length wrong."""
    chance = random.Random(seed)
    made = []
    for _ in range(FRAMES):
        can_id, data = chance.choice(GOOD)
        payload = bytearray.fromhex(data)
        kind = chance.random()
        if kind < 0.3:
            can_id, payload = (
                chance.choice([can_id, chance.randrange(0x800)]),
                bytearray(chance.randbytes(chance.randrange(9))),
            )
        elif kind < 0.7:
            for _ in range(chance.randrange(3)):
                if payload:
                    payload[chance.randrange(len(payload))] = chance.randrange(256)
        elif kind < 0.8:
            payload = (payload + chance.randbytes(8))[: chance.randrange(9)]
        elif can_id == 0x604:
            payload[1:3] = chance.choice(INDICES).to_bytes(2, "little")
            payload[3] = chance.choice([payload[3], chance.randrange(9)])
        made.append((can_id, bytes(payload), chance.random() < 0.02))
    return made


@pytest.mark.parametrize("seed", SEEDS)
def test_any_frame(make: Callable, seed: int) -> None:
    desk = make()
    chance = random.Random(-seed)
    lengths: set[int] = set()
    for number, (can_id, data, remote) in enumerate(frames(seed)):
        desk.node.on_frame(can_id, data, desk.t_ns, remote)
        if number % 4 == 0:
            step_ns = desk.t_ns + chance.randrange(3_000_000)
            for _ in range(50):  # a node may want to be called often, but not without end
                due_ns = desk.node.next_deadline_ns()
                if due_ns is None or due_ns > step_ns:
                    break
                desk.t_ns = max(desk.t_ns, due_ns)
                desk.node.on_timer(desk.t_ns)
            desk.t_ns = step_ns
        lengths.update(len(sent) for _, sent, _ in desk.sent)
        assert all(0 <= sent_id <= 0x7FF for sent_id, _, _ in desk.sent)
        desk.sent.clear()
    assert max(lengths) <= 8

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


def test_every_length_on_every_identifier(make: Callable) -> None:
    desk = make()
    for state in ("80 00", "01 00", "02 00"):
        for can_id in range(1, 0x800):
            for length in range(9):
                desk.node.on_frame(can_id, bytes(length), desk.t_ns)
                desk.node.on_frame(can_id, b"\xff" * length, desk.t_ns)
        desk.frame(0, state)
        desk.sent.clear()
    desk.frame(0, "81 04")
    assert desk.sdo("40 00 10 00 00 00 00 00") == "43 00 10 00 00 00 00 00"


def test_deadlines_always_lie_ahead_after_they_were_served(make: Callable) -> None:
    """A deadline that stays in the past would spin the thread that serves it."""
    desk = make()
    for can_id, data, remote in frames(3)[:5000]:
        desk.node.on_frame(can_id, data, desk.t_ns, remote)
        desk.t_ns += 500_000
        desk.node.on_timer(desk.t_ns)
        due_ns = desk.node.next_deadline_ns()
        assert due_ns is None or due_ns > desk.t_ns
        desk.sent.clear()
