"""Nodes with a fault between them and their bus."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import cast

from skinnode.conformance import Dut, Verdict, run_cases, select
from skinnode.transport import CanPort, Frame

from .conftest import NODE_ID, bench_on, patch_on

ANSWER, ERROR_CONTROL, EMCY, CHUNK, SUMMARY = (base + NODE_ID for base in (0x580, 0x700, 0x080, 0x180, 0x280))
SYNC = 0x80
OK, BAD = Verdict.PASSED, Verdict.FAILED

Alter = Callable[[int, bytes], bytes | list[bytes] | None]
"""The payload to send instead; several for several frames, None for none."""
Hear = Callable[[Frame], list[tuple[int, bytes]] | None]
"""Frames the node sends at once when it hears a frame; None if it shall not hear it."""


class FaultyPort:
    """Stands between a node and its port."""

    def __init__(self, port: CanPort, alter: Alter, hear: Hear) -> None:
        self._port, self._alter, self._hear = port, alter, hear
        self.config = port.config

    @property
    def sent(self) -> int:
        return self._port.sent

    def reopen(self) -> None:
        self._port.reopen()

    def send(self, can_id: int, data: bytes, *, remote: bool = False) -> None:
        altered = self._alter(can_id, data)
        for payload in altered if isinstance(altered, list) else [altered]:
            if payload is not None:
                self._port.send(can_id, payload, remote=remote)

    def recv(self, timeout_s: float) -> Frame | None:
        frame = self._port.recv(timeout_s)
        extra = self._hear(frame) if frame is not None else []
        for can_id, data in extra or []:
            self._port.send(can_id, data)
        return frame if extra is not None else None


def honest(can_id: int, data: bytes) -> bytes:
    return data


def attentive(frame: Frame) -> list[tuple[int, bytes]]:
    return []


@contextmanager
def faulty(alter: Alter = honest, hear: Hear = attentive) -> Iterator[Dut]:
    channel = f"faulty-{uuid.uuid4().hex[:8]}"
    with (
        patch_on(channel, lambda port: cast(CanPort, FaultyPort(port, alter, hear))),
        bench_on(channel) as dut,
    ):
        yield dut


def found(dut: Dut, *names: str) -> dict[str, Verdict]:
    """Verdicts of the cases named."""
    return {result.case.id: result.verdict for result in run_cases(dut, select(names)).results}


def expected(fail: str, pass_: str) -> dict[str, Verdict]:
    """Ids with a space between."""
    return {**dict.fromkeys(fail.split(), BAD), **dict.fromkeys(pass_.split(), OK)}
