"""A daemon in a process of its own, and ports that no other test uses."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import pytest
import zenoh

from skinnode.remote.session import PORTS
from tests.remote.forks import Forked, Forks
from tests.remote.ports import free_ports

PATIENCE_S = 60.0
"""Limit of every wait; a daemon on a busy machine takes several seconds to load."""


class Process:
    """A program of this folder, which ends with its standard input; ``begin`` starts it."""

    def __init__(self, begin: Callable[[], subprocess.Popen[str] | Forked]) -> None:
        self._begin = begin
        self.start()

    def start(self) -> None:
        self.process = self._begin()

    def wait_until_up(self) -> Self:
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        if self.process.stdout.readline() != "up\n":
            raise AssertionError(self.process.stderr.read())
        return self

    def restart(self) -> None:
        """Kill the program as ``kill -9`` does, and start it again."""
        self.kill()
        self.start()

    def tell(self, command: str) -> str:
        """Send a line, and return the answer."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().strip()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self._close()

    def end(self) -> tuple[int, str]:
        """End the program in order; return its exit status and what it said on stderr."""
        _, said = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, said

    def _close(self) -> None:
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            if pipe is not None and not pipe.closed:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()


@pytest.fixture
def port() -> int:
    """First of the ports of the daemons of a test."""
    return free_ports(PORTS)


@pytest.fixture
def running() -> Iterator[list[Process]]:
    """Programs that are killed at the end, if they still run."""
    processes: list[Process] = []
    yield processes
    for each in processes:
        each.kill()


@pytest.fixture
def run(running: list[Process]) -> Callable[..., Process]:
    """Start a program of this folder."""

    def run_one(program: str, *arguments: str) -> Process:
        command = [sys.executable, "-W", "error", str(Path(__file__).with_name(program)), *arguments]
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        running.append(Process(lambda: subprocess.Popen(command, text=True, **pipes)))
        return running[-1]

    return run_one


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """All daemons are forked from one process."""
    with contextlib.closing(Forks()) as forks:
        yield forks


@pytest.fixture
def start(port: int, running: list[Process], forks: Forks) -> Callable[..., Process]:
    """Start a daemon with a simulated hand; see ``daemon.py``."""

    def start_one(**options: Any) -> Process:
        running.append(Process(lambda: forks.start(json.dumps({"port": port, **options}))))
        return running[-1]

    return start_one


@pytest.fixture
def session(port: int) -> Iterator[zenoh.Session]:
    """A session as any Zenoh program opens it, connected to the first daemon of the machine."""
    config = zenoh.Config()
    endpoints = [f"tcp/127.0.0.1:{port}"]
    for key, value in (
        ("connect/endpoints", endpoints),
        ("listen/endpoints", []),
        ("scouting/multicast/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as opened:
        yield opened


def eventually(happens: Callable[[], Any], within_s: float = PATIENCE_S) -> float:
    """Wait until ``happens()`` is true; return the time it took, s."""
    begin_s = time.monotonic()
    while not happens():
        if time.monotonic() > begin_s + within_s:
            raise AssertionError(f"not within {within_s} s")
        time.sleep(0.005)
    return time.monotonic() - begin_s
