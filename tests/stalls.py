"""pytest plugin: run a test again that failed while the machine stood still.

Most tests run threads or child processes in real time, on machines that others use too. A test that fails
while a thread that only sleeps was kept from waking proves nothing. It runs again, and the summary lists it.
On a machine that always stands still, or if our own code keeps other threads from running, it still fails.
"""

from __future__ import annotations

import contextlib
import threading
import time
from types import TracebackType
from typing import Final, Self

import pytest
from _pytest.runner import runtestprotocol

TRIES: Final = 3
STALL_S: Final = 0.02
"""Less than one scan period of the tests; a thread that sleeps wakes within a few milliseconds otherwise."""

AGAIN_WITHIN_S: Final = 50.0
"""Time after which a test is not run again: its timeout covers all tries."""

STALLED: Final = "stalled"
"""Name of the property of a test's report that says how long nothing ran while the test failed."""

_NAP_S: Final = 0.008
"""Time between two looks; in seven processes, 4 ms would take a fourteenth of a processor all the time."""


class StallWatch:
    """Longest time for which a thread that only sleeps was kept from waking."""

    def __init__(self) -> None:
        self.worst_s = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stall watch")

    def _run(self) -> None:
        before_s = time.monotonic()
        while not self._over.wait(_NAP_S):
            now_s = time.monotonic()
            self.worst_s = max(self.worst_s, now_s - before_s - _NAP_S)
            before_s = now_s

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()


def pytest_addoption(parser: pytest.Parser) -> None:
    help = "do not run a test again that failed while the machine stood still"
    parser.addoption("--stalls-count", action="store_true", help=help)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    """Run a test again, with new fixtures, if it failed while the machine stood still; the summary lists it.

    With ``--stalls-count`` such a test fails."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    stalls: list[str] = []
    tries = 1 if item.config.getoption("--stalls-count") else TRIES
    start_s = time.monotonic()
    for left in reversed(range(tries)):
        with StallWatch() as watch:
            reports = runtestprotocol(item, log=False, nextitem=nextitem)
        if watch.worst_s < STALL_S or not any(report.failed for report in reports):
            break
        stalls.append(f"{item.nodeid}: nothing ran for {1e3 * watch.worst_s:.0f} ms")
        if not left or time.monotonic() - start_s > AGAIN_WITHIN_S:
            break
        with contextlib.suppress(Exception):  # shared fixtures too may have failed, or hold what failed
            item.session._setupstate.teardown_exact(None)
    reports[-1].user_properties += [(STALLED, stall) for stall in stalls]
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Collect the stalls of all processes in the one that writes the summary."""
    _stalls.extend(str(value) for name, value in report.user_properties if name == STALLED)


_stalls: list[str] = []


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if _stalls:
        what = "and counted" if config.getoption("--stalls-count") else "and run again"
        terminalreporter.section(f"failed while the machine stood still, {what}")
        for line in _stalls:
            terminalreporter.line(line)
