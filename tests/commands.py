"""Run a command in the process of the test, as its entry point does: no start of Python for each message."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import TextIO
from unittest import mock

import skinnode.cli.main
import vcan_sim.cli
from skinnode.config import BusConfig
from skinnode.transport import CanPort
from vcan_sim.virtual_time import VirtualClock

MAINS = {"skinnode": skinnode.cli.main.main, "vcan-sim": vcan_sim.cli.main}
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PATIENCE_S = 20.0


class Output(io.StringIO):
    """What a command prints; it can wait for a text."""

    def has(self, text: str, count: int = 1) -> bool:
        """Whether ``text`` comes so many times."""
        end_s = time.monotonic() + PATIENCE_S
        while self.getvalue().count(text) < count:
            if time.monotonic() > end_s:
                return False
            time.sleep(0.005)
        return True


def run_here(
    *arguments: str, program: str = "skinnode", out: TextIO | None = None
) -> subprocess.CompletedProcess[str]:
    """Exit status, stdout and stderr of ``skinnode`` or ``vcan-sim``."""
    out, err, status = out or Output(), io.StringIO(), 0
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.object(sys, "argv", [program, *arguments]),  # the name of the program in messages
        mock.patch.object(sys.modules["__main__"], "__package__", None),  # or it would be python -m pytest
        mock.patch.object(logging.root, "handlers", []),  # Python itself prints warnings, on stderr
    ):
        try:
            MAINS[program](list(arguments))
        except SystemExit as ended:
            status = int(ended.code or 0)
    said = out.getvalue() if isinstance(out, Output) else ""
    return subprocess.CompletedProcess(list(arguments), status, said, err.getvalue())


@contextlib.contextmanager
def virtual_time(*channels: str) -> Iterator[None]:
    """Virtual time for commands that wait, on timed buses on which another device hears all frames.

    On a bus with one device, its first frame would be sent again and again, as nobody acknowledges it."""
    with VirtualClock(), contextlib.ExitStack() as devices:
        for channel in channels:
            devices.enter_context(CanPort(BusConfig(interface="timed", channel=channel)))
        yield


def run_for_nobody(*arguments: str, program: str = "skinnode") -> subprocess.CompletedProcess[str]:
    """As :func:`run_here`, but nobody reads its output: the pipe is closed."""
    reading, writing = os.pipe()
    os.close(reading)
    kept = [os.dup(descriptor) for descriptor in (1, 2)]  # such a command closes those of its process
    try:
        with contextlib.suppress(BrokenPipeError), open(writing, "w") as closed:
            done = run_here(*arguments, program=program, out=closed)
    finally:
        for descriptor, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
    return done


def run_until_signal(
    number: int, *arguments: str, when: Callable[[Output], object], program: str = "skinnode"
) -> subprocess.CompletedProcess[str]:
    """As :func:`run_here`, but the process gets signal ``number`` once ``when``, on another thread, returns.

    A command that leaves the signal to the handlers of the tests has status -1."""
    out = Output()

    def kill() -> None:
        try:
            when(out)
        finally:
            os.kill(os.getpid(), number)

    with _unhandled() as missed:
        killer = threading.Thread(target=kill)
        killer.start()
        try:
            done = run_here(*arguments, program=program, out=out)
        finally:
            killer.join()
    if missed:
        done.returncode = -1
    return done


@contextlib.contextmanager
def _unhandled() -> Iterator[list[int]]:
    """The signals that no command handled in the meantime."""
    missed: list[int] = []
    kept = {
        number: signal.signal(number, lambda received, _frame: missed.append(received)) for number in SIGNALS
    }
    try:
        yield missed
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
