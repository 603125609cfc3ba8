"""Sets exit statuses and handles signals and closed pipes, for every command.

======  ==============================================================================================
status  meaning
======  ==============================================================================================
0       success; also when SIGINT (Ctrl-C), SIGTERM or SIGHUP ends a command that runs until it is stopped
        (host, node, record, replay, monitor, vcan-sim)
1       a fault was found
2       the command could not run; one line on stderr states the reason
128+n   ended by signal n before its work was done: 129 SIGHUP, 130 SIGINT, 143 SIGTERM; 141 if the
        reader of its output closed the pipe (SIGPIPE)
======  ==============================================================================================

A command stopped by a signal prints nothing, because the signal was sent on purpose. The command releases
open resources before it exits. SIGHUP remains ignored if it was ignored at startup, as under nohup. This
module imports only modules that load fast, so that its handlers are installed before other modules are
loaded.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from types import FrameType
from typing import Final, NoReturn

FINE: Final = 0
COULD_NOT_RUN: Final = 2
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def status_of(number: int) -> int:
    """Return the exit status for signal ``number``, following the shell convention."""
    return 128 + number


class Stopped(SystemExit):
    """Raised when a signal stops the command."""


def main_of(module: str, argv: Sequence[str] | None = None) -> NoReturn:
    """Run a typer application and exit with its status.

    Before the application starts and after it ends, a termination signal ends the process at once.

    BLAS libraries are limited to one thread unless the environment sets a different number. BLAS threads
    busy-wait: under a real-time policy (``chrt -f``), they would occupy every processor and keep all other
    threads of a host from running.

    Args:
        module: Name of the module that defines the application as ``app``.
        argv: Command-line arguments; default: the arguments of the process.
    """
    _handle(_exit_at_once)
    atexit.register(_ignore_signals)
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    run: Callable[..., int] = import_module("skinnode.cli._errors").run
    app = import_module(module).app
    _handle(_stop)
    try:
        status = run(app, argv)
        status = _flush(status)
    except Stopped as stopped:
        status = int(stopped.code or 0)
        _flush(status)
    _handle(_exit_at_once)  # otherwise, a signal received while waiting for threads prints a traceback
    sys.exit(status)


def _handle(handler: Callable[[int, FrameType | None], object] | signal.Handlers) -> None:
    """Install a signal handler, except outside the main thread, where Python does not allow it."""
    import threading

    if threading.current_thread() is threading.main_thread():
        for number in _SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, handler)


def _ignore_signals() -> None:
    """Ignore signals after all threads have ended, because Python's handlers would change the exit status."""
    _handle(signal.SIG_IGN)


def _exit_at_once(number: int, _frame: FrameType | None) -> None:
    os._exit(status_of(number))


def _stop(number: int, frame: FrameType | None) -> None:
    """Unwind the stack, or exit immediately if the only thread is importing a module.

    During an import, some of Python's callbacks would swallow the exception or print it. An immediate exit is
    safe while there is only one thread, because no resource is open yet.
    """
    import threading

    if threading.active_count() == 1 and _imports(frame):
        _exit_at_once(number, frame)
    raise Stopped(status_of(number))


def _imports(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _flush(status: int) -> int:
    """Flush the output; return ``status``, or the SIGPIPE status if the reader has closed the pipe."""
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
    except BrokenPipeError:
        return closed_pipe()
    return status


def closed_pipe() -> int:
    """Discard the buffers of stdout and stderr, and return the exit status for a closed pipe."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (1, 2):
        os.dup2(nowhere, descriptor)
    os.close(nowhere)
    return status_of(signal.SIGPIPE)
