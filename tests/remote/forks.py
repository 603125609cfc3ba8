"""Daemons forked from one process that has loaded modules and kernels: each takes a fifth of the CPU time.

    forks.py SOCKET

is the program of that process, started by :class:`Forks`. A request is the options of ``daemon.py``, with the
file descriptors of standard input, output and error, and of a pipe for the process ID and the exit status.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import traceback
from pathlib import Path

ROOT = Path(__file__).parents[2]
LENGTH = 8
"""Bytes of a number in the pipe."""


class Forked:
    """A process with pipes, used as :class:`subprocess.Popen`."""

    def __init__(self, server: socket.socket, request: str) -> None:
        ends = [os.pipe() for _ in range(4)]
        theirs = [ends[0][0], ends[1][1], ends[2][1], ends[3][1]]
        socket.send_fds(server, [request.encode()], theirs)
        for descriptor in theirs:
            os.close(descriptor)
        self.stdin = open(ends[0][1], "w")  # noqa: SIM115
        self.stdout = open(ends[1][0])  # noqa: SIM115
        self.stderr = open(ends[2][0])  # noqa: SIM115
        self._status = ends[3][0]
        self.pid = self._number()
        self.returncode: int | None = None

    def _number(self) -> int:
        data = os.read(self._status, LENGTH)
        if len(data) < LENGTH:  # as process ID 0, it would mean all processes of the tests
            raise RuntimeError("the process from which daemons are forked has ended")
        return int.from_bytes(data, "little", signed=True)

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            if not select.select([self._status], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("daemon.py", timeout or 0.0)
            self.returncode = os.waitstatus_to_exitcode(self._number())
            os.close(self._status)
        return self.returncode

    def send_signal(self, number: int) -> None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)  # another process may have its ID if it has ended
        if self.returncode is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Close standard input and wait for the end; little enough is said to fit into a pipe."""
        self.stdin.close()
        self.wait(timeout)
        with self.stdout, self.stderr:
            return self.stdout.read(), self.stderr.read()


class Forks:
    """The process from which daemons are forked; close it."""

    def __init__(self) -> None:
        self._server, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, "-W", "error", str(Path(__file__)), str(theirs.fileno())]
            one_thread = {
                **os.environ,
                "OPENBLAS_NUM_THREADS": "1",
            }  # a process with threads cannot be forked
            self._process = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=one_thread)

    def start(self, options: str) -> Forked:
        return Forked(self._server, options)

    def close(self) -> None:
        self._server.close()
        self._process.wait()


def serve(requests: socket.socket) -> None:
    """Fork a process for each request until the other end is closed."""
    import skinnode as sk
    from tests.remote import daemon

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel forgets processes that have ended
    layout = daemon.hand_of("load", 1, 50, 4.0).patches[0].layout.build()
    tracker = sk.Tracker(layout, method="posterior")
    for _ in range(3):
        tracker.update(sk.resistance_ohm(layout, layout.upper_m))
    while True:
        data, descriptors, *_ = socket.recv_fds(requests, 65536, 4)
        if not data:
            return
        if os.fork() == 0:
            requests.close()
            _watch(data.decode(), descriptors)
        for descriptor in descriptors:
            os.close(descriptor)


def _watch(options: str, descriptors: list[int]) -> None:
    """Fork the daemon, and report its process ID and, when it has ended, its status."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    *standard, report = descriptors
    pid = os.fork()
    if pid == 0:
        os.close(report)
        _become_daemon(options, standard)
    for descriptor in standard:
        os.close(descriptor)
    os.write(report, pid.to_bytes(LENGTH, "little", signed=True))
    _, status = os.waitpid(pid, 0)
    os.write(report, status.to_bytes(LENGTH, "little", signed=True))
    os._exit(0)


def _become_daemon(options: str, standard: list[int]) -> None:
    from tests.remote import daemon

    for number, descriptor in enumerate(standard):
        os.dup2(descriptor, number)
        os.close(descriptor)
    status = 1
    try:
        status = daemon.main(json.loads(options))
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    with socket.socket(fileno=int(sys.argv[1])) as server:
        serve(server)
