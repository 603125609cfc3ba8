"""pytest plugin: run the whole suite in several processes, and leave its long tests to lanes of their own.

A run without a file or folder is a run of the whole suite: it uses :data:`WORKERS` processes, and leaves out
the tests marked ``long`` or ``release`` unless ``-m`` chooses. A run of chosen files stays in one process and
has all tests.

Each test goes to the next worker that is free. Tests of one group run one after the other in one worker.
"""

from __future__ import annotations

import gc
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

from . import warm_up

WORKERS = 5
"""Processes for the whole suite. On two processors, the suite took 216 s with five and 227 s with four: each
imports all modules, and most tests compute rather than wait."""

REAL_TIME = "real_time"
"""Marker and group of the tests that count frames in real time and would disturb each other."""

DAEMONS = "daemons"
"""Group of the tests whose daemons are forked from one process, which takes 1.6 s of CPU time to load."""

PAGES = "pages"
"""Group of the pages of docs/: as long as all other real-time tests, but they mostly wait."""

RANKS = {REAL_TIME: 0, PAGES: 1, None: 3}
"""Order of the groups: real time takes longest, and its worker has priority."""

LANES = "long", "release"
"""Markers of the tests that run in a lane of their own."""

NICE = 3
"""Niceness of all workers but the first, so that they keep real-time tests from running less often."""

WHOLE, GROUPS = "skinnode_whole", "skinnode_groups"
"""Keys under which a worker learns whether the whole suite runs, and where to write the groups."""


def is_whole(config: pytest.Config) -> bool:
    """Return whether all tests were asked for: no file, no folder, no name."""
    if hasattr(config, "workerinput"):
        return bool(config.workerinput[WHOLE])
    return config.args_source is pytest.Config.ArgsSource.TESTPATHS


def group_of(item: pytest.Item) -> str | None:
    """Return the group of a test; None if it has none.

    Tests that share a fixture of their module are a group, as each worker would make that fixture again. So
    are those that share the process from which daemons are forked."""
    if item.get_closest_marker(REAL_TIME):
        return PAGES if item.path.name == "test_blocks.py" else REAL_TIME
    if "forks" in item.fixturenames:
        return DAEMONS
    fixtures = item._fixtureinfo.name2fixturedefs.values()
    return item.path.stem if any(found[-1].scope == "module" for found in fixtures) else None


class Scheduler(LoadScopeScheduling):
    """Deal groups, then single tests, in the order of collection: the first worker gets the first group.

    xdist's own ``--dist loadgroup`` tells groups by a suffix of the node ID, which pytest 9.2 does not let it
    add."""

    _groups: dict[str, str] | None = None

    def __init__(self, config: pytest.Config, log: Any) -> None:
        super().__init__(config, log)
        config.option.loadscopereorder = False

    def _split_scope(self, nodeid: str) -> str:
        if self._groups is None:  # all workers have collected, and wrote the same
            self._groups = json.loads((self.config.stash[FOLDER] / "gw0").read_text())
        return self._groups.get(nodeid, nodeid)


FOLDER = pytest.StashKey[Path]()
"""Where each worker writes the groups of the tests for the scheduler: only workers collect tests."""


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput") and config.workerinput["workerid"] != "gw0":
        os.nice(NICE)
    for name in ("COLUMNS", "LINES"):  # workers get a width of 80, and what is printed would be wrapped
        os.environ.pop(name, None)
    if not is_whole(config):
        return
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads that spin while others work slow all down
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # or hundreds of processes would each compile all modules


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile kernels and modules before the workers start; load kernels before the first test in real time.

    Loading them keeps all threads of a process from running for a second, also those of simulated nodes."""
    if getattr(session.config, "workerinput", {}).get("workerid") == "gw0" and is_whole(session.config):
        warm_up.main()
    if session.config.option.numprocesses and not session.config.option.collectonly:
        collecting = collect_once() if is_whole(session.config) and has_no_bytecode() else None
        if warm_up.is_needed():
            subprocess.run([sys.executable, warm_up.__file__], check=True)
        if collecting is not None:
            collecting.wait()


def has_no_bytecode() -> bool:
    """Return whether most test modules have not been compiled yet, as in a new clone."""
    modules = list(Path(__file__).parent.rglob("test_*.py"))
    compiled = [importlib.util.cache_from_source(str(module)) for module in modules]
    found = [
        os.path.exists(f"{path.removesuffix('.pyc')}-pytest-{pytest.__version__}.pyc") for path in compiled
    ]
    return sum(found) < len(found) / 2


def collect_once() -> subprocess.Popen[bytes]:
    """Start a process that collects the tests, which compiles all modules: or each worker would do it.

    What is wrong with a module, the workers report."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-n", "0", "-p", "no:cacheprovider"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect tests without garbage collections, which take a fifth of that time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish() -> None:
    """Exclude what has been collected from garbage collection.

    Commands of the product that run in this process collect garbage before they start: with all modules and
    tests, each time for a quarter of a second."""
    gc.collect()
    gc.freeze()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    return WORKERS if is_whole(config) else 0


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Scheduler:
    return Scheduler(config, log)


def pytest_configure_node(node: Any) -> None:
    config = node.config
    if FOLDER not in config.stash:
        folder = tempfile.TemporaryDirectory(prefix="skinnode-tests-")
        config.add_cleanup(folder.cleanup)
        config.stash[FOLDER] = Path(folder.name)
    node.workerinput[WHOLE] = is_whole(config)
    node.workerinput[GROUPS] = str(config.stash[FOLDER] / node.gateway.id)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if is_whole(config) and not config.option.markexpr:
        later = {item for item in items if any(item.get_closest_marker(lane) for lane in LANES)}
        config.hook.pytest_deselected(items=list(later))
        items[:] = [item for item in items if item not in later]
    if hasattr(config, "workerinput"):
        ranks = {item: RANKS.get(group_of(item), 2) for item in items}
        items.sort(key=ranks.__getitem__)
        groups = {item.nodeid: group for item in items if (group := group_of(item)) is not None}
        Path(config.workerinput[GROUPS]).write_text(json.dumps(groups))
