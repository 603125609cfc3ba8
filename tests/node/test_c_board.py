"""A board that packs its scans with the C99 kit sends what the node in Python sends, byte for byte."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.node import Pacing
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan_check import check_of_codes
from skinnode.protocol.summary import pack_checked_summary

from ..c_kit import Kit, kits
from .conftest import Desk

OPEN_CIRCUIT = 0xFFFF_FFFF
FRACTION_BITS = 8
"""A resistance is a number of 1/256 ohm, in C and in Python."""
LAYOUT = PatchLayout.preset("staggered", upper_wires=3, upper_electrodes=2, lower_wires=7)
"""21 codes: 7 chunks of 3, or 11 of 2 with one code to spare, or 3 of one wire and a padded length."""
WIRES: list[dict[str, Any]] = [{}, {"code_bits": 24}, {"bus": "fd"}, {"bus": "fd", "code_bits": 24}]
KitOf = Callable[[PatchProfile], Kit]


@pytest.fixture(scope="module")
def kit_of() -> Iterator[KitOf]:
    yield from kits()


class Readings:
    """A converter whose readings a test sets, or that fails."""

    def __init__(self, parts: NDArray[np.int64]) -> None:
        self.parts, self.fails = parts, False

    def read(self, t_ns: int) -> Float:
        if self.fails:
            raise OSError("no answer from the converter")
        return np.where(self.parts == OPEN_CIRCUIT, np.inf, self.parts / (1 << FRACTION_BITS))


class Board:
    """The firmware of a board, in C where the kit has it."""

    def __init__(self, kit: Kit, readings: Readings) -> None:
        self._kit, self._readings = kit, readings
        self._baseline = np.zeros(kit.profile.n_codes, np.float32)
        self._codes = np.full(kit.profile.n_codes, (1 << kit.profile.code_bits) - 1, np.uint32)
        kit.add("I")
        self.tare(announce=False)

    def tare(self, *, announce: bool) -> None:
        """16 readings, all alike here; crossings without a resistance keep their R0."""
        parts = self._readings.parts.ravel()
        for part in parts.tolist():
            self._kit.add("f", "QB", 16 * part, FRACTION_BITS + 4)
        measured = (parts > 0) & (parts < OPEN_CIRCUIT)
        self._baseline = np.where(measured, self._kit.ask().words().view(np.float32), self._baseline)
        if announce:
            self._kit.add("B")

    def policy(self, mode: int, threshold: int, refresh: int) -> None:
        self._kit.add("P", "BHH", mode, threshold, refresh)

    def scan(self, counter: int, t_ns: int, conversions: int | None) -> tuple[list[tuple[int, bytes]], bytes]:
        if self._readings.fails:
            flags = 0x10
        else:
            if conversions is not None:
                self._kit.add("V", "I", conversions)
                self._kit.ask()
            parts = self._readings.parts.ravel().tolist()
            self._codes = self._kit.encode(parts, FRACTION_BITS, self._baseline.tolist())
            self._kit.add("w")
            self._kit._commands += self._codes.astype("<u4").tobytes()
            flags = 0x04 * self._kit.ask().take("B")[0]
        self._kit.add_scan(self._codes, counter, t_ns // 1000, flags=flags)
        return self._kit.ask().scan_sent()


@st.composite
def steps(draw: st.DrawFn) -> list[tuple[str, Any]]:
    """What happens between scans."""
    rows, columns = LAYOUT.upper_m.shape[0], LAYOUT.lower_m.shape[0]
    factor = st.one_of(st.floats(0.2, 1.3), st.floats(0.9999, 1.0001), st.sampled_from([0.0, np.inf]))
    touch = st.lists(st.tuples(st.integers(0, rows - 1), st.integers(0, columns - 1), factor), max_size=4)
    wire = st.tuples(st.sampled_from([0, 1]), st.integers(0, rows - 1), st.sampled_from([0.0, np.inf, 1.0]))
    policy = st.tuples(st.integers(0, 1), st.sampled_from([0, 2, 500]), st.sampled_from([0, 1, 3, 10]))
    kinds = {
        "touch": touch,
        "wire": wire,
        "policy": policy,
        "tare": st.none(),
        "fails": st.booleans(),
        "counts": st.integers(0, 2),
        "scan": st.none(),
    }
    names = st.lists(st.sampled_from([*kinds, "scan", "scan", "touch"]), min_size=5, max_size=40)
    return [("policy", draw(policy)), *((name, draw(kinds[name])) for name in draw(names)), ("scan", None)]


class Pair:
    """A node in Python and a board in C that measure the same skin."""

    def __init__(self, kit: Kit, profile: PatchProfile, *, counts: bool) -> None:
        rest = np.rint(resistance_ohm(LAYOUT, LAYOUT.upper_m) * (1 << FRACTION_BITS)).astype(np.int64)
        self._rest, self.readings = rest, Readings(rest.copy())
        self.desk = Desk(LAYOUT, profile=profile, pacing=Pacing(slack_ns=0, catch_up_ns=0))
        self._conversions = 7 if counts else None
        self.desk.source.read = self._read  # type: ignore[method-assign]
        self._offer_count()
        self.desk.power_on()
        self.desk.write(0x1019, 0, 240, 1)
        self.desk.start()
        self.desk.take()
        self.board = Board(kit, self.readings)
        self._counter = 0
        self.flags = 0
        """Of all summaries."""

    def _read(self, t_ns: int) -> Float:
        return self.readings.read(t_ns)

    def _offer_count(self) -> None:
        if self._conversions is not None:
            self.desk.source.conversions = self._conversions  # type: ignore[attr-defined]

    def do(self, what: str, value: Any) -> None:
        getattr(self, f"_{what}")(value)

    def _touch(self, places: list[tuple[int, int, float]]) -> None:
        for row, column, factor in places:
            self.readings.parts[row, column] = self._part(self._rest[row, column], factor)

    def _wire(self, which: tuple[int, int, float]) -> None:
        axis, wire, factor = which
        for part, rest in zip(
            np.moveaxis(self.readings.parts, axis, 0)[wire : wire + 1],
            np.moveaxis(self._rest, axis, 0)[wire : wire + 1],
            strict=True,
        ):
            part[:] = [self._part(each, factor) for each in rest]

    def _part(self, rest: int, factor: float) -> int:
        return OPEN_CIRCUIT if np.isinf(factor) else round(rest * factor)

    def _policy(self, values: tuple[int, int, int]) -> None:
        for sub, (value, size) in enumerate(zip(values, (1, 2, 2), strict=True), 1):
            self.desk.write(0x2020, sub, value, size)
        self.board.policy(*values)

    def _tare(self, _: None) -> None:
        if not self.readings.fails:
            self.desk.write(0x2021, 4, int.from_bytes(b"tare", "little"), 4)
            self.board.tare(announce=True)

    def _fails(self, value: bool) -> None:
        self.readings.fails = value

    def _counts(self, more: int) -> None:
        if self._conversions is not None:
            self._conversions += more
            self._offer_count()

    def _scan(self, _: None) -> None:
        self._counter = self._counter % 240 + 1
        self.desk.sent.clear()
        t_ns = self.desk.t_ns
        self.desk.node.on_frame(0x080, bytes((self._counter,)), t_ns)
        self.desk.run(79)
        by_node = [(can_id - 4, data) for can_id, data, _ in self.desk.sent if can_id in (0x184, 0x284)]
        frames, record = self.board.scan(self._counter, t_ns, self._conversions)
        assert [(can_id, data.hex(" ")) for can_id, data in frames] == [
            (can_id, data.hex(" ")) for can_id, data in by_node
        ]
        assert struct.unpack("<BBHIHH", record) == tuple(self.desk.read(0x2011, sub) for sub in range(1, 7))
        self.flags |= frames[-1][1][1]


@pytest.mark.long
@settings(deadline=None, max_examples=40)
@given(steps=steps(), wire=st.sampled_from(WIRES), counts=st.booleans())
def test_any_course_of_events(
    kit_of: KitOf, steps: list[tuple[str, Any]], wire: dict[str, Any], counts: bool
) -> None:
    profile = dataclasses.replace(PatchProfile.from_layout(LAYOUT), **wire)
    pair = Pair(kit_of(profile), profile, counts=counts)
    for what, value in steps:
        pair.do(what, value)


@pytest.mark.parametrize("wire", WIRES, ids=["u16", "u24", "fd-u16", "fd-u24"])
def test_each_flag_once(kit_of: KitOf, wire: dict[str, Any]) -> None:
    profile = dataclasses.replace(PatchProfile.from_layout(LAYOUT), **wire)
    pair = Pair(kit_of(profile), profile, counts=True)
    course: list[tuple[str, Any]] = [
        ("policy", (1, 2, 3)),
        ("scan", None),
        ("counts", 1),
        ("touch", [(1, 2, 0.8)]),
        ("scan", None),
        ("scan", None),
        ("scan", None),
        ("wire", (0, 1, np.inf)),
        ("scan", None),
        ("fails", True),
        ("scan", None),
        ("fails", False),
        ("tare", None),
        ("scan", None),
        ("counts", 2),
        ("scan", None),
    ]
    for what, value in course:
        pair.do(what, value)
    assert pair.flags == 0xFF & ~0x02  # all but the overrun: see below


@pytest.mark.parametrize("wire", WIRES, ids=["u16", "u24", "fd-u16", "fd-u24"])
def test_a_reserved_code_is_sent_whatever_the_threshold(kit_of: KitOf, wire: dict[str, Any]) -> None:
    """From the top of the range to open and back: a change of fewer codes than the threshold."""
    profile = dataclasses.replace(PatchProfile.from_layout(LAYOUT), **wire)
    pair = Pair(kit_of(profile), profile, counts=True)
    pair.do("policy", (1, 60_000, 0))
    for factor in (1.2499, np.inf, np.inf, 1.2499, 1.2498):
        pair.do("touch", [(1, 2, factor)])
        pair.do("scan", None)


@pytest.mark.parametrize("wire", WIRES, ids=["u16", "u24", "fd-u16", "fd-u24"])
def test_chunks_that_the_bus_refuses_are_missing(kit_of: KitOf, wire: dict[str, Any]) -> None:
    profile = dataclasses.replace(PatchProfile.from_layout(LAYOUT), **wire)
    kit, codes = kit_of(profile), np.arange(21, dtype=np.uint32)
    check = check_of_codes(codes.reshape(3, 7), profile)
    kit.add("I")
    kit.add_scan(codes, 9, 0xFFFF_FFFF, refused=1)
    kit.add_scan(codes, 10, 0xFFFF_FFFF, stop=2)
    kit.add_scan(codes, 11, 0xFFFF_FFFF)
    reply = kit.ask()
    n = profile.n_chunks
    for counter, overrun, sent in ((9, 0x02, n - 1), (10, 0x02, 2), (11, 0, n)):
        frames, _ = reply.scan_sent()
        assert len(frames) == sent + 1
        assert frames[-1][1] == pack_checked_summary(counter, overrun, sent, 0xFFFF_FFFF, check)
