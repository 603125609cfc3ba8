"""Runs the ``rerun`` program from the rerun-sdk package as a child process: a window or a server.

The program sends usage statistics unless its configuration file disables them. The child process therefore
gets a separate configuration folder with a file that disables them. The user's settings are neither read nor
changed.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from skinnode.errors import ConfigError, Shown, SkinError
from skinnode.process.child_processes import starting_children
from skinnode.process.closing import Closing

LOCAL: Final = "127.0.0.1"
MEMORY: Final = "512MB"
"""Memory limit for data buffered for browsers. Beyond this limit, the oldest data are dropped."""
_STYLES: Final = re.compile(r"\x1b\[[0-9;]*m")
_READY_S: Final = 30.0
_END_S: Final = 5.0
_PR_SET_PDEATHSIG: Final = 1
"""``prctl`` option: signal that the kernel sends to a child when its parent ends (prctl(2))."""


class ViewerProcess(Closing):
    """Child process that receives data on a TCP port until :meth:`close`, or until this process exits.

    Args:
        address: Address on which the process listens.
        port: Port on which the process receives data.
        options: Further options for the ``rerun`` program.
        files_port: Port on which these options make the program serve its files; None if there is none.

    Raises:
        ConfigError: The port is in use or the address does not belong to this machine.
        SkinError: The program ended before it started to listen.
    """

    def __init__(self, address: str, port: int, options: list[str], *, files_port: int | None = None) -> None:
        require_free(address, port)
        self._folder = tempfile.TemporaryDirectory(prefix="skinnode-view-")
        self._errors = Path(self._folder.name, "stderr.txt")
        program = [str(_program()), "--bind", address, "--port", str(port), *options]
        with starting_children(), self._errors.open("wb") as errors:
            self._process = subprocess.Popen(
                program,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=_environment(Path(self._folder.name)),
                preexec_fn=_end_with_parent if sys.platform == "linux" else None,
            )
        self.url = f"rerun+http://{in_url(reachable(address))}:{port}/proxy"
        """URL to which the SDK sends data."""
        try:
            for each in (port, files_port):
                if each is not None:
                    self._wait_until_it_listens(address, each)
        except BaseException:
            self.close()
            raise

    @property
    def ended(self) -> bool:
        """Whether the process has ended, for example because its window was closed."""
        return self._process.poll() is not None

    @property
    def closed(self) -> bool:
        """Whether the process has exited normally because its window was closed."""
        return self._process.poll() == 0

    def why(self) -> str:
        """Return the last line of the process's stderr or, if it is empty, the signal that ended it."""
        lines = _STYLES.sub("", self._errors.read_text("utf-8", "replace")).splitlines()
        status = self._process.poll()
        silent = "no message" if status is None or status >= 0 else signal.strsignal(-status)
        return next((line.strip() for line in reversed(lines) if line.strip()), silent or "no message")

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()

    def _wait_until_it_listens(self, address: str, port: int) -> None:
        end_s = time.monotonic() + _READY_S
        while time.monotonic() < end_s:
            if self.ended:
                raise SkinError(f"the viewer ended: {self.why()}")
            try:
                socket.create_connection((reachable(address), port), timeout=1.0).close()
            except OSError:
                time.sleep(0.05)
            else:
                return
        raise SkinError(f"the viewer is not listening on port {port} after {_READY_S:.0f} s: {self.why()}")


def require_viewer(key: str = "skinnode view") -> None:
    """Raise ConfigError if the rerun-sdk package is not installed.

    Args:
        key: Command or argument that requires the package, for the error message.
    """
    if find_spec("rerun") is None or find_spec("rerun_bindings") is None:
        allowed = "the package rerun-sdk (sh install.sh view)"
        raise ConfigError(key, Shown("no package rerun-sdk"), allowed)


def require_display() -> None:
    """Raise ConfigError if there is no display for a window."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError("display", Shown("none"), "a graphical session, or --web, or --save FILE.rrd")


def require_free(address: str, port: int) -> None:
    """Raise ConfigError if a port cannot be opened on an address."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((address, port))
        except (OSError, OverflowError) as error:
            why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise ConfigError("port", f"{address}:{port}", f"a free port ({why})") from None


def free_port() -> int:
    """Return a port that is currently free on this machine."""
    with socket.socket() as trial:
        trial.bind((LOCAL, 0))
        port: int = trial.getsockname()[1]
        return port


def reachable(address: str) -> str:
    """Return the address at which this machine reaches a server that listens on ``address``."""
    return LOCAL if address in ("0.0.0.0", "::") else address


def in_url(address: str) -> str:
    """Return an address as it is written in a URL: an IPv6 address has brackets."""
    return f"[{address}]" if ":" in address else address


def _program() -> Path:
    spec = find_spec("rerun_cli")
    found = None if spec is None or spec.origin is None else Path(spec.origin).with_name("rerun")
    if found is None or not found.is_file():
        raise ConfigError("skinnode view", Shown("no program rerun"), "the package rerun-sdk, complete")
    return found


def _environment(folder: Path) -> dict[str, str]:
    """Return the child process's environment, with usage statistics and telemetry disabled."""
    config = folder / "config" / "rerun" / "analytics.json"
    config.parent.mkdir(parents=True)
    settings = {
        "analytics_enabled": False,
        "analytics_id": "none",
        "metadata": {},
        "config_file_path": str(config),
        "data_dir_path": str(folder / "data"),
    }
    config.write_text(json.dumps(settings))
    kept = {name: value for name, value in os.environ.items() if name != "FORCE_RERUN_ANALYTICS"}
    own = {"XDG_CONFIG_HOME": str(folder / "config"), "TELEMETRY_ENABLED": "false", "RUST_LOG": "error"}
    return {**kept, **own}


def _end_with_parent() -> None:
    """Make the kernel end this child when its parent ends, even if the parent is killed."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
