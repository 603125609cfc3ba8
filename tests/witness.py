"""The assembler of the C99 kit against the assembler of the host, call by call."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan import AssemblerStats, Scan

from .c_kit import COMPLETE, CORRUPT, JOINED, MIXED, NO_SCAN, TORN, UNCHECKED, CScan, Kit

CHUNK, SUMMARY, NODE_ID = 0x180, 0x280, 5
VERDICTS = {
    "scans_complete": COMPLETE,
    "scans_torn": TORN,
    "scans_unchecked": UNCHECKED,
    "scans_mixed": MIXED,
    "scans_corrupt": CORRUPT,
    "scans_joined": JOINED,
}


@dataclass(frozen=True)
class Said:
    """What the host's assembler said to a call."""

    scan: Scan | None
    verdicts: frozenset[int]
    deadline_ns: int | None


class Witness(ScanAssembler):
    """The host's assembler, with times in whole microseconds. It records all calls for :meth:`confront`."""

    def __init__(self, profile: PatchProfile, **settings: Any) -> None:
        super().__init__(profile, **settings)
        self._settings = settings
        self._kit_profile = profile
        self._calls: list[tuple[str, tuple[Any, ...], Said | None]] = []
        self._doubts = 0
        self.on_discarded = self._doubt

    def _doubt(self) -> None:
        self._doubts += 1

    def on_chunk(self, data: bytes, t_ns: int) -> Scan | None:
        return self._note(CHUNK, data, t_ns, super().on_chunk)

    def on_summary(self, data: bytes, t_ns: int) -> Scan | None:
        return self._note(SUMMARY, data, t_ns, super().on_summary)

    def poll(self, t_ns: int) -> Scan | None:
        t_ns = t_ns // 1000 * 1000
        before = self.stats
        scan = super().poll(t_ns)
        self._calls.append(("p", (t_ns // 1000,), self._said(before, scan)))
        return scan

    def reset(self, *, under_way: bool = False, checked: bool = False) -> None:
        super().reset(under_way=under_way, checked=checked)
        self._calls.append(("R", (under_way, checked), None))

    def expect_check(self) -> None:
        """Only before the first frame, where it is a reset."""
        self.reset(checked=True)

    def _note(self, function: int, data: bytes, t_ns: int, take: Any) -> Scan | None:
        t_ns = t_ns // 1000 * 1000
        before = self.stats
        scan: Scan | None = take(data, t_ns)
        self._calls.append(("C", (function + NODE_ID, data, t_ns // 1000), self._said(before, scan)))
        return scan

    def _said(self, before: AssemblerStats, scan: Scan | None) -> Said:
        after = self.stats
        grown = {name for name in VERDICTS if getattr(after, name) > getattr(before, name)}
        published = {name for name in grown if VERDICTS[name] in (COMPLETE, TORN, UNCHECKED)}
        names = published if scan is not None else grown
        verdicts = frozenset(VERDICTS[name] for name in names) or frozenset({NO_SCAN})
        return Said(scan, verdicts, self.next_deadline_ns())

    def confront(self, kit: Kit) -> int:
        """Make all calls to the kit, and compare each answer. Returns the number of published scans."""
        settings = {"counter_overflow": 0, "grace_ns": 5_000_000, "under_way": False, **self._settings}
        kit.add(
            "A",
            "qqBBB",
            settings["period_ns"] // 1000,
            settings["grace_ns"] // 1000,
            NODE_ID,
            settings["counter_overflow"],
            settings["under_way"],
        )
        for command, arguments, _ in self._calls:
            if command == "C":
                kit.add_frame(*arguments)
            else:
                kit.add(command, "q" if command == "p" else "BB", *arguments)
        kit.add("T")
        reply = kit.ask()
        assert reply.take("B") == (1,)
        published = 0
        for number, (command, arguments, said) in enumerate(self._calls):
            if said is not None:
                where = f"call {number}: {command} {arguments}"
                got = reply.scan_received()
                self._compare(got, said, where)
                published += said.scan is not None
        *counters, doubts = reply.stats()
        expected = dataclasses.asdict(self.stats)
        assert dict(zip(expected, counters, strict=True)) == expected
        assert doubts == self._doubts
        assert reply.is_over
        return published

    def _compare(self, got: CScan, said: Said, where: str) -> None:
        assert got.verdict in said.verdicts, where
        assert (got.deadline_us is None) == (said.deadline_ns is None), where
        assert got.deadline_us is None or got.deadline_us * 1000 == said.deadline_ns, where
        scan = said.scan
        if scan is None:
            return
        assert got.fields == (
            scan.t_first_ns // 1000,
            scan.t_last_ns // 1000,
            scan.scan,
            scan.device_time_us or 0,
            scan.chunks_expected,
            scan.chunks_received,
            scan.counter,
            scan.flags,
            scan.device_time_us is not None,
        ), where
        np.testing.assert_array_equal(got.codes, scan.codes, err_msg=where)
