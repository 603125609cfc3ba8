"""Commands that wait: none is executed after its program has given up, and none holds up the daemon's end."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import skinnode as sk
from skinnode.config import HandConfig, parse_hand
from skinnode.errors import NodeError, SkinError
from skinnode.remote import keys
from skinnode.remote.command_server import CommandServer
from skinnode.remote.commands import Request, send
from skinnode.remote.session import SessionOptions, open_daemon
from tests.remote.conftest import PATIENCE_S, Process, eventually

if TYPE_CHECKING:
    import zenoh

pytestmark = pytest.mark.system_time


class SlowHost:
    """Host whose tares end when the test says so, or when they are cancelled."""

    def __init__(self) -> None:
        patches = [{"name": name, "node_id": i} for i, name in enumerate("ab", 1)]
        self.hand: HandConfig = parse_hand({"buses": [{"name": "can0"}], "patches": patches})
        self.tared: list[str] = []
        self.go = threading.Event()

    def tare(self, patch: str, *, deadline_s: float, cancelled: Callable[[], bool]) -> None:
        self.tared.append(patch)
        while not self.go.wait(0.005):
            if cancelled():
                raise SkinError("cancelled")


@pytest.fixture
def session(port: int) -> Iterator[zenoh.Session]:
    with open_daemon(SessionOptions(port=port)) as session:
        yield session


class Programs:
    """Programs that send commands, each in a thread."""

    def __init__(self, session: zenoh.Session, hand: str) -> None:
        self._session, self._hand = session, hand
        self._threads: list[threading.Thread] = []
        self.failures: dict[str, str] = {}

    def send(self, request: Request) -> None:
        def program() -> None:
            try:
                send(self._session, self._hand, request)
            except SkinError as error:
                self.failures[request.patch] = str(error)

        self._threads.append(threading.Thread(target=program))
        self._threads[-1].start()

    def join(self) -> None:
        for thread in self._threads:
            thread.join(PATIENCE_S)


def test_a_command_that_its_program_has_given_up_is_not_executed(session: zenoh.Session) -> None:
    host: Any = SlowHost()
    programs = Programs(session, host.hand.name)
    server = CommandServer(session, host)
    programs.send(Request("tare", "a", 30.0))
    eventually(lambda: host.tared == ["a"])
    programs.send(Request("tare", "b", 0.0))
    eventually(lambda: "b" in programs.failures)  # given up, while the first tare goes on
    assert "no reply to tare within 2 s" in programs.failures["b"]
    host.go.set()
    programs.send(Request("tare", "a", 30.0))
    programs.join()
    server.close()
    assert host.tared == ["a", "a"]


def test_the_end_of_the_daemon_waits_for_no_command(session: zenoh.Session) -> None:
    host: Any = SlowHost()
    programs = Programs(session, host.hand.name)
    server = CommandServer(session, host)
    programs.send(Request("tare", "a", 60.0))
    eventually(lambda: host.tared == ["a"])
    programs.send(Request("tare", "b", 60.0))
    eventually(lambda: server._waiting.qsize() == 1)
    closing = threading.Thread(target=server.close, daemon=True)
    closing.start()
    closing.join(10.0)
    assert not closing.is_alive()
    programs.join()
    assert host.tared == ["a"]
    assert programs.failures["a"].endswith("cancelled")
    assert "tare of 'b' not executed: the daemon is shutting down" in programs.failures["b"]
    server.close()


@pytest.mark.parametrize("deadline_s", ["NaN", "Infinity", "-1", "5000"])
def test_a_time_limit_from_the_network_is_checked(session: zenoh.Session, deadline_s: str) -> None:
    host: Any = SlowHost()
    server = CommandServer(session, host)
    data = f'{{"command": "tare", "patch": "a", "deadline_s": {deadline_s}}}'
    replies = list(session.get(keys.command_key(host.hand.name), payload=data, timeout=10.0))
    server.close()
    assert replies[0].err is not None
    text = json.loads(replies[0].err.payload.to_bytes())["text"]
    assert f"deadline_s: got {float(deadline_s)!r}, must be from 0 to 600" in text
    assert host.tared == []


def test_a_program_on_another_machine_needs_no_common_clock(session: zenoh.Session) -> None:
    host: Any = SlowHost()
    host.go.set()
    programs = Programs(session, host.hand.name)
    server = CommandServer(session, host)
    programs.send(replace(Request("tare", "a", 1.0), boot_id="another machine", sent_ns=1))
    programs.join()
    server.close()
    assert (programs.failures, host.tared) == ({}, ["a"])


def tared(hand: sk.RunningHand, patch: str) -> bool:
    """Tare a patch; return False if the host refuses, because it is not operational."""
    try:
        hand.tare(patch)
    except NodeError as error:
        if "not operational" not in str(error):
            raise
        return False
    return True


def is_suspended(pid: int) -> bool:
    """Whether all threads have stopped; some of them run on for a moment after the signal."""
    stats = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/stat")]
    return all(text.rpartition(")")[2].split()[0] == "T" for text in stats)


def test_a_daemon_that_was_suspended_does_not_execute_what_was_given_up(
    start: Callable[..., Process], port: int
) -> None:
    daemon = start(commands=True).wait_until_up()
    with sk.connect("hand", port=port) as hand:
        daemon.process.send_signal(signal.SIGSTOP)
        try:
            eventually(lambda: is_suspended(daemon.process.pid))
            with pytest.raises(SkinError, match=r"no reply to tare within 2 s"):
                hand.tare("p0", deadline_s=0.0)
        finally:
            daemon.process.send_signal(signal.SIGCONT)
        eventually(lambda: hand.away is None)
        eventually(lambda: tared(hand, "p1"))  # the host heard nothing of its patches for a while
        baselines = json.loads(daemon.tell("baselines"))
        assert (baselines["p0"], baselines["p1"] > 0) == (0, True)
