"""``skinnode monitor`` on a real terminal: keys, colours, one that vanishes and one that stalls."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skinnode.config import HandConfig
from skinnode.node import NmtState
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet

from .conftest import PATIENCE_S, PROGRAM, write_hand


class Terminal:
    """A terminal of 80 × 24 with a command on it; the kernel hangs up on it when it is closed."""

    def __init__(self, command: list[str], **environment: str) -> None:
        self._ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        variables = {key: value for key, value in os.environ.items() if key not in ("NO_COLOR", "COLORTERM")}
        self.process = subprocess.Popen(
            ["setsid", "--ctty", *command],  # which becomes the command: it leads no group yet
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**variables, "TERM": "xterm-256color", **environment},
        )
        os.close(theirs)
        self.said = b""

    def read_until(self, *wanted: str, within_s: float = PATIENCE_S) -> bool:
        """Whether all that comes to be written."""
        end_s = time.monotonic() + within_s
        while not all(text.encode() in self.said for text in wanted):
            if time.monotonic() > end_s or not self._read(0.2):
                return False
        return True

    def read_to_the_end(self) -> None:
        while self._read(PATIENCE_S):
            pass

    def ended_as_it_said(self) -> bool:
        """Whether the exit status is 0, or 1 with a fault named: on a busy machine, nodes may skip scans."""
        return self.process.wait(PATIENCE_S) == int(b"fault: " in self.said)

    def _read(self, timeout_s: float) -> bool:
        if not select.select([self._ours], [], [], timeout_s)[0]:
            return self.process.poll() is None
        try:
            self.said += os.read(self._ours, 65536)
        except OSError:  # the command has ended
            return False
        return True

    def type(self, keys: str) -> None:
        os.write(self._ours, keys.encode())

    def hang_up(self) -> None:
        if self._ours >= 0:
            os.close(self._ours)
            self._ours = -1

    def close(self) -> None:
        self.hang_up()
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


@contextmanager
def terminal(command: list[str], **environment: str) -> Iterator[Terminal]:
    opened = Terminal(command, **environment)
    try:
        yield opened
    finally:
        opened.close()


def states(fleet: Fleet) -> set[NmtState]:
    return {report.nmt_state for report in fleet.report()}


@pytest.mark.long
def test_keys_without_colours_and_a_clean_end(tmp_path: Path, crossing_hand: HandConfig) -> None:
    command = [*PROGRAM, str(write_hand(tmp_path, crossing_hand))]
    with Fleet(crossing_hand) as fleet, terminal(command, NO_COLOR="1") as screen:
        assert screen.read_until("\x1b[?1049h", "p0", "p1", "operational", "quit"), screen.said[-2000:]
        screen.type("q")
        screen.read_to_the_end()
        assert screen.ended_as_it_said(), screen.said[-2000:]
        assert b"\x1b[?1049l" in screen.said  # the screen from before is back
        assert b"\x1b[?25h" in screen.said  # and the cursor
        assert b"\x1b[?1000h" not in screen.said  # the mouse was left to the terminal
        assert states(fleet) == {NmtState.PRE_OPERATIONAL}
    colours = {str(number).encode() for number in (*range(30, 39), *range(40, 49), *range(90, 98))}
    assert parameters(screen.said) & colours == set()


def parameters(said: bytes) -> set[bytes]:
    """Of all sequences that set colours and the like."""
    sequences = (part.partition(b"m") for part in said.split(b"\x1b[")[1:])
    return {
        parameter
        for numbers, end, _ in sequences
        if end and numbers.replace(b";", b"").isdigit()
        for parameter in numbers.split(b";")
    }


@pytest.mark.long
def test_a_fault_of_the_session_is_its_exit_status(tmp_path: Path, crossing_hand: HandConfig) -> None:
    with (
        Fleet(crossing_hand) as fleet,
        terminal([*PROGRAM, str(write_hand(tmp_path, crossing_hand))]) as screen,
    ):
        assert screen.read_until("operational", "quit")
        fleet.inject(Faults(unplugged=True), "p1")
        assert screen.read_until(" lost ")
        screen.type("\x03")  # Ctrl-C
        screen.read_to_the_end()
        assert screen.process.wait(PATIENCE_S) == 1
        assert b"fault: p1: lost" in screen.said.rpartition(b"\x1b[?1049l")[2]


@pytest.mark.long
def test_a_terminal_that_vanishes_leaves_the_nodes_pre_operational(
    tmp_path: Path, crossing_hand: HandConfig
) -> None:
    with (
        Fleet(crossing_hand) as fleet,
        terminal([*PROGRAM, str(write_hand(tmp_path, crossing_hand))]) as screen,
    ):
        assert screen.read_until("operational", "quit")
        assert states(fleet) == {NmtState.OPERATIONAL}
        screen.hang_up()
        assert screen.process.wait(PATIENCE_S) in (0, 1)  # nodes may have skipped scans on a busy machine
        assert states(fleet) == {NmtState.PRE_OPERATIONAL}


@pytest.mark.long
def test_a_terminal_that_stalls_holds_up_neither_the_host_nor_the_end(
    tmp_path: Path, crossing_hand: HandConfig
) -> None:
    quick = crossing_hand.model_copy(
        update={"sync": crossing_hand.sync.model_copy(update={"period_ms": 100})}
    )
    with Fleet(quick) as fleet, terminal([*PROGRAM, str(write_hand(tmp_path, quick))]) as screen:
        assert screen.read_until("operational", "quit")
        time.sleep(2.5)  # nobody reads, and the simulated skin moves: the line is full
        before = [report.scans_sent for report in fleet.report()]
        time.sleep(1.0)
        after = [report.scans_sent for report in fleet.report()]
        assert all(new >= old + 5 for old, new in zip(before, after, strict=True)), (before, after)
        screen.type("?x" * 60)  # each wants to draw
        time.sleep(0.5)
        screen.process.send_signal(signal.SIGTERM)
        assert screen.process.wait(PATIENCE_S) in (0, 1)  # nodes may have skipped scans on a busy machine
        assert states(fleet) == {NmtState.PRE_OPERATIONAL}


@pytest.mark.long
def test_a_terminal_that_stalled_gets_a_whole_picture(tmp_path: Path, crossing_hand: HandConfig) -> None:
    with Fleet(crossing_hand), terminal([*PROGRAM, str(write_hand(tmp_path, crossing_hand))]) as screen:
        assert screen.read_until("operational", "quit")
        screen.type("?x" * 150)  # more pictures than the line takes
        time.sleep(2.0)
        screen.type("z")
        if not screen.read_until("node 5, can0", within_s=10.0):  # it closed a help page that was still open
            screen.type("z")
            assert screen.read_until("node 5, can0")
        screen.said = b""
        screen.type("z")
        assert screen.read_until(" 2 p1 ", "operational")
        screen.type("q")
        screen.read_to_the_end()
        assert screen.ended_as_it_said(), screen.said[-2000:]
