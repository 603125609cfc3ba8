"""The assembler of the C99 kit against that of the host: the same verdict on every frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.canopen.nmt import NmtState
from skinnode.protocol.profile import PatchProfile
from tests.lanes import some_long
from vcan_sim.faults import NO_FAULTS, OF_CHUNKS, OF_SCANS, Faults

from ..c_kit import Kit, kits
from ..sim.test_faults_in_time import COUNTERS, MS, PERIOD_MS, WIRES, Stream
from ..sim.test_faults_in_time import IDS as WIRE_IDS
from ..witness import Witness
from .test_assembler import GRACE, PERIOD, PROFILES, Frame, ModelNode, falsified, receive, worlds

KitOf = Callable[[PatchProfile], Kit]


@pytest.fixture(scope="module")
def kit_of() -> Iterator[KitOf]:
    """Starts the kit of a profile, once."""
    yield from kits()


@pytest.mark.long
@settings(deadline=None, max_examples=80)
@given(world=worlds(), polled=st.booleans(), under_way=st.booleans(), checked=st.booleans())
def test_any_channel(
    kit_of: KitOf, world: tuple[ModelNode, list[Frame]], polled: bool, under_way: bool, checked: bool
) -> None:
    node, frames = world
    witness = Witness(
        node.profile,
        counter_overflow=node.counter_overflow,
        period_ns=PERIOD,
        grace_ns=GRACE,
        under_way=under_way,
    )
    if checked and node.checked:
        witness.reset(under_way=under_way, checked=True)
    half = len(frames) // 2
    receive(witness, frames[:half], polled=polled)
    witness.reset(under_way=under_way)  # a boot-up message
    receive(witness, frames[half:], polled=polled, until_ns=frames[-1].t_ns + 4 * PERIOD if frames else 0)
    witness.confront(kit_of(node.profile))


@pytest.mark.long
@settings(deadline=None, max_examples=80)
@given(world=falsified())
def test_falsified_frames(kit_of: KitOf, world: tuple[ModelNode, list[Frame]]) -> None:
    node, frames = world
    witness = Witness(node.profile, counter_overflow=node.counter_overflow, period_ns=PERIOD, grace_ns=GRACE)
    witness.expect_check()
    receive(witness, frames, until_ns=frames[-1].t_ns + 4 * PERIOD if frames else 0)
    witness.confront(kit_of(node.profile))


# --- every fault of frames that the simulator injects


def stream_of(wire: dict[str, Any]) -> tuple[Stream, Witness]:
    stream = Stream(**wire)
    witness = Witness(stream.profile, counter_overflow=COUNTERS, period_ns=PERIOD_MS * MS, grace_ns=5_000_000)
    stream.assembler = witness
    return stream, witness


FAULTS = {
    **{name: Faults(**{name: 0.05}) for name in OF_CHUNKS},
    **{name: Faults(**{name: 0.3}) for name in OF_SCANS},
    "miscounted to come": Faults(miscounted=0.02, miscounted_by=2),
    "sync_lost": Faults(sync_lost=0.3),
    "flipped": Faults(flipped=0.5),
    "frozen": Faults(frozen=True),
    "silent": Faults(silent=True),
    "unplugged": Faults(unplugged=True),
    "duplicate_node_id": Faults(duplicate_node_id=True),
    "restart_every_s": Faults(restart_every_s=0.1),
}


def run(stream: Stream, mode: int, scans: int) -> None:
    """Let scans be taken in a send mode; a node that has restarted is configured and started as at first."""
    stream._sdo(0x2F, 0x2020, 1, mode)
    for _ in range(scans):
        stream.run(1)
        if stream.node.nmt_state is not NmtState.OPERATIONAL:
            stream._sdo(0x2F, 0x1019, 0, COUNTERS)
            stream._sdo(0x2F, 0x2020, 1, mode)
            stream._frame(0x000, bytes((1, 5)))
            stream.assembler.reset()  # as the host does at a boot-up


COUNTED = {
    "miscounted to come": "miscounted",
    "silent": "silenced",
    "duplicate_node_id": "twins",
    "restart_every_s": "restarts",
}
"""Counters with other names than their fault."""


@pytest.mark.parametrize("wire", some_long(WIRES, WIRES[0]), ids=WIRE_IDS)
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_of_the_simulator(kit_of: KitOf, fault: str, wire: dict[str, Any]) -> None:
    """With all chunks, then with only the changed ones."""
    stream, witness = stream_of(wire)
    for mode in (0, 1):
        run(stream, mode, 2)
        stream.node.faults = FAULTS[fault]
        run(stream, mode, 15)
        stream.node.faults = NO_FAULTS
        run(stream, mode, 6)
    assert getattr(stream.node.injected, COUNTED.get(fault, fault)) > 0
    assert witness.confront(kit_of(stream.profile)) > 5


@pytest.mark.parametrize("wire", some_long(WIRES, WIRES[0]), ids=WIRE_IDS)
def test_all_faults_at_once(kit_of: KitOf, wire: dict[str, Any]) -> None:
    stream, witness = stream_of(wire)
    shares = {**dict.fromkeys(OF_CHUNKS, 0.02), **dict.fromkeys(OF_SCANS, 0.04)}
    stream.node.faults = Faults(sync_lost=0.05, **shares)
    for mode in (0, 1):
        run(stream, mode, 120)
    assert witness.confront(kit_of(stream.profile)) > 50
    counted = witness.stats
    assert min(counted.scans_torn, counted.scans_mixed, counted.scans_corrupt, counted.scans_unchecked) > 0


# --- frames of any content


PAUSES_NS = [*[0, 1000, PERIOD // 20] * 10, *[PERIOD] * 3, 4 * PERIOD]


def random_frame(random: np.random.Generator, profile: PatchProfile, counter: int) -> tuple[bool, bytes]:
    """A frame that looks like a chunk or a summary, more or less."""
    is_summary = bool(random.random() < 0.3)
    size = 8 if is_summary else profile.chunk_bytes
    if random.random() < 0.05:
        size = int(random.integers(0, 65))
    data = bytearray(random.integers(0, 256, size, np.uint8).tobytes())
    if size > 3 and random.random() < 0.9:
        near = counter + int(random.choice([0, 0, 0, 0, 1, 1, 2, -1, 100]))
        at = 0 if is_summary else 1
        data[at] = near & 0xFF
        if is_summary:
            data[1] = int(random.choice([0x00, 0x01, 0x20, 0x21, 0x23, 0x28]))
            data[2:4] = int(random.integers(0, profile.n_chunks + 2)).to_bytes(2, "little")
        elif profile.bus == "fd":
            data[0] = int(random.integers(0, profile.rows + 1))
            data[2] = int(random.integers(0, 3)) * profile.codes_per_chunk
            data[3] = int(random.random() < 0.02)
        else:
            data[0] = int(random.integers(0, profile.n_chunks + 1))
        if random.random() < 0.5:
            data[4:] = bytes(len(data) - 4)  # equal frames
    return is_summary, bytes(data)


@pytest.mark.parametrize(
    "profile", some_long(PROFILES, PROFILES[0]), ids=lambda profile: f"u{profile.code_bits}-{profile.bus}"
)
@pytest.mark.parametrize("overflow", some_long([0, 2, 240], 240))
def test_random_frames(kit_of: KitOf, fuzz_frames: int, profile: PatchProfile, overflow: int) -> None:
    random = np.random.default_rng([overflow, profile.n_chunks])
    left = max(1000, fuzz_frames // 9)
    while left > 0:
        witness = Witness(profile, counter_overflow=overflow, period_ns=PERIOD, grace_ns=GRACE)
        t_ns, counter = int(random.integers(0, 1 << 50)), int(random.integers(0, 256))
        for _ in range(min(left, 2000)):
            t_ns += int(
                random.choice([0, 1000, PERIOD // 20, PERIOD, 4 * PERIOD], p=[0.3, 0.3, 0.3, 0.08, 0.02])
            )
            if random.random() < 0.15:
                counter = (counter + 1) % (overflow or 256)
            is_summary, data = random_frame(random, profile, counter)
            (witness.on_summary if is_summary else witness.on_chunk)(data, t_ns)
            if random.random() < 0.3:
                witness.poll(t_ns)
            if random.random() < 0.01:
                witness.reset(under_way=bool(random.random() < 0.5), checked=bool(random.random() < 0.3))
        witness.confront(kit_of(profile))
        left -= 2000


def test_settings_out_of_range_are_refused(kit_of: KitOf) -> None:
    kit = kit_of(PROFILES[0])
    for values in ((0, 1, 5, 0, 0), (1, 0, 5, 0, 0), (-1, 1, 5, 0, 0), (1, 1, 5, 1, 0), (1, 1, 5, 241, 0)):
        kit.add("A", "qqBBB", *values)
        assert kit.ask().take("B") == (0,)
