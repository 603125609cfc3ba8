"""Controls a running simulator from another process, using JSON messages on a Unix socket.

Each simulator listens on its own socket, ``PID.sock``, in a folder that only the user can access. A request
and its response are one line each::

    {"faults": ["palm:unplugged"]}
    {"hand": "gripper", "now": ["palm:unplugged"], "counts": {"palm": {"unplugged": 1}, "can0": {}}}
    {"error": "inject: got 'plam', allowed: a patch of the hand: palm; or a bus: can0"}
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol, Self

from skinnode.errors import ConfigError, SkinError

_LONGEST_LINE: Final = 1 << 16
_ANSWER_S: Final = 10.0
"""Time-out for the response of a simulator, in s."""
_POLL_S: Final = 0.2
"""Interval at which the server thread checks whether to stop, in s."""
KEY: Final = "inject"
"""Key under which error messages report invalid requests."""


class ControlError(SkinError):
    """A simulator cannot be controlled, for example because none is running."""


class Controlled(Protocol):
    """Fleet whose faults can be read and changed through a control socket."""

    @property
    def faults(self) -> Any:
        """Faults of the fleet."""

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the nonzero counts of injected faults, by patch and bus."""


@dataclass(frozen=True, slots=True)
class Answer:
    """Response of a simulator: current faults and counts of injected faults."""

    hand: str
    now: tuple[str, ...]
    """Current faults in text form, one string per faulty patch or bus."""
    counts: dict[str, dict[str, int]]
    """Counts of the faults injected so far, by patch and bus."""

    def lines(self) -> list[str]:
        """Return one line of text per patch and bus, with its current faults and counts."""
        now = dict(text.rpartition(":")[::2] for text in self.now)
        return [
            f"{place}: {now.get(place, 'none')} now; {_listed(counts)} so far"
            for place, counts in self.counts.items()
        ]


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "nothing"


def control_folder() -> Path:
    """Return the folder for control sockets; create it if necessary, accessible only to this user.

    Raises:
        ControlError: If the folder cannot be created, or other users can access it.
    """
    base, user = os.environ.get("XDG_RUNTIME_DIR"), os.getuid()
    folder = Path(base) / "vcan-sim" if base else Path(tempfile.gettempdir()) / f"vcan-sim-{user}"
    try:
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700, parents=False)
        found = folder.lstat()
    except OSError as error:
        raise ControlError(f"{folder}: cannot be used for control sockets ({error.strerror})") from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != user or stat.S_IMODE(found.st_mode) & 0o077:
        raise ControlError(f"{folder}: must be a folder of user {user} with mode 700, for control sockets")
    return folder


class ControlServer:
    """Control socket of this process, open during a ``with`` block.

    Args:
        fleet: Fleet to control.
        hand: Name of the fleet's hand.

    Raises:
        ControlError: On entry, if the socket cannot be created.
    """

    def __init__(self, fleet: Controlled, hand: str) -> None:
        self._fleet, self._hand = fleet, hand
        self._path = Path()
        self._stop = threading.Event()
        self._socket: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)

    def __enter__(self) -> Self:
        self._path = control_folder() / f"{os.getpid()}.sock"
        self._path.unlink(missing_ok=True)  # left behind by an earlier process with the same ID
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(str(self._path))
            self._socket.listen(8)
        except OSError as error:
            self._socket.close()
            raise ControlError(
                f"{self._path}: cannot create the control socket ({error.strerror or error})"
            ) from None
        self._socket.settimeout(_POLL_S)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        assert self._socket is not None
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def _run(self) -> None:
        assert self._socket is not None
        while not self._stop.is_set():
            try:
                connection, _ = self._socket.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            with connection, contextlib.suppress(OSError):  # the client may have disconnected
                connection.settimeout(_ANSWER_S)
                _send(connection, self._answer(_receive(connection)))

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            faults = json.loads(line)["faults"]
            if not isinstance(faults, list) or not all(isinstance(text, str) for text in faults):
                raise TypeError
        except (ValueError, TypeError, KeyError):
            return {"error": 'control: got no request, allowed: a line such as {"faults": ["palm:lost=0.1"]}'}
        try:
            self._fleet.faults.inject(*faults, key=KEY)
        except ConfigError as error:
            return {"error": str(error)}
        return {"hand": self._hand, "now": self._fleet.faults.texts(), "counts": self._fleet.counts()}


def running_simulator(wanted: str | None = None) -> Path:
    """Return the control socket of a running simulator.

    Args:
        wanted: Process ID of the simulator, or name of its hand; None for the only running simulator.

    Raises:
        ControlError: If no simulator is running, or if ``wanted`` matches none or more than one.
    """
    found = dict(_running())
    if not found:
        raise ControlError("no simulator is running; start one with: vcan-sim run HAND.toml")
    chosen = [path for path, hand in found.items() if wanted in (None, path.stem, hand)]
    if len(chosen) == 1:
        return chosen[0]
    listed = ", ".join(f"{path.stem} ({hand})" for path, hand in found.items())
    got = "nothing" if wanted is None else repr(wanted)
    raise ControlError(f"--simulator: got {got}, allowed: one of the running simulators: {listed}")


def request(path: Path, faults: list[str]) -> Answer:
    """Change the faults of a running simulator, or only read them.

    Args:
        path: Control socket of the simulator.
        faults: Changes in text form; an empty list leaves the faults unchanged.

    Returns:
        Faults after the change, and counts of injected faults.

    Raises:
        ControlError: If the simulator rejects a change or does not respond.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(_ANSWER_S)
            connection.connect(str(path))
            _send(connection, {"faults": faults})
            answer = json.loads(_receive(connection))
    except (OSError, ValueError) as error:
        raise ControlError(f"simulator {path.stem}: does not answer ({error})") from error
    if "error" in answer:
        raise ControlError(answer["error"])
    return Answer(answer["hand"], tuple(answer["now"]), answer["counts"])


def _running() -> Iterator[tuple[Path, str]]:
    """Yield the socket and the hand of each running simulator, and delete stale sockets."""
    for path in sorted(control_folder().glob("*.sock")):
        try:
            yield path, request(path, []).hand
        except ControlError as error:
            if isinstance(error.__cause__, ConnectionRefusedError | FileNotFoundError):
                path.unlink(missing_ok=True)


def _send(connection: socket.socket, message: dict[str, Any]) -> None:
    connection.sendall(json.dumps(message).encode() + b"\n")


def _receive(connection: socket.socket) -> bytes:
    """Receive one line of at most 64 KiB."""
    received = b""
    while len(received) < _LONGEST_LINE and (part := connection.recv(4096)):
        received += part
        if part.endswith(b"\n"):
            break
    return received
