"""A Dask cluster: the same bytes when a worker is killed; other software, lost clusters, wrong addresses."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

import skinnode
from skinnode.cli.main import app
from skinnode.config import parse_hand
from skinnode.errors import SkinError
from skinnode.record.convert import convert
from skinnode.resolve import cluster
from skinnode.resolve.cluster import Cluster
from skinnode.resolve.part_files import PartFiles
from skinnode.resolve.plan import make_plan
from skinnode.resolve.recording import Recording, recording_at
from skinnode.resolve.run import run, work_folder
from skinnode.resolve.units import Unit

pytest.importorskip("distributed")
pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("ignore"),  # of the libraries of Dask
]

DASK = Path(sys.executable).with_name("dask")


class Lan:
    """A scheduler and its workers, each a process of its own."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self._stack, self._folder = stack, folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        host, port = self.address.removeprefix("tcp://").split(":")
        self.scheduler = self._start("scheduler", "--host", host, "--port", port, "--no-dashboard")

    def worker(self, **environment: str) -> subprocess.Popen[bytes]:
        folder = ["--local-directory", str(self._folder), "--no-dashboard", "--no-nanny"]
        return self._start("worker", self.address, "--nthreads", "1", *folder, **environment)

    def await_workers(self, count: int) -> None:
        from distributed import Client

        with Client(self.address, timeout=60) as client:
            if count:
                client.wait_for_workers(count, timeout=60)

    def _start(self, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
        import os

        log = (self._folder / "dask.log").open("ab")
        self._stack.callback(log.close)
        child = subprocess.Popen(
            [str(DASK), *arguments], stdout=log, stderr=log, env={**os.environ, **environment}
        )
        self._stack.callback(child.wait)
        self._stack.callback(child.kill)
        return child


@pytest.fixture
def lan(tmp_path: Path) -> Iterator[Lan]:
    with ExitStack() as stack:
        yield Lan(stack, tmp_path)


def solve_on(lan: Lan, recording: Path, out: Path, tell: Callable[[int, int, str], None]) -> None:
    with work_folder(out) as folder, Cluster(lan.address, folder) as workers:
        assert workers.count == 2
        jobs = make_plan([recording_at(recording, None)], [()], out, ".parquet", workers.count)
        run(jobs, workers, PartFiles(folder), tell)


def test_a_worker_that_is_killed_changes_nothing(lan: Lan, recording: Path, tmp_path: Path) -> None:
    wanted = tmp_path / "wanted.parquet"
    convert(recording, wanted)
    doomed, _ = lan.worker(), lan.worker()
    lan.await_workers(2)

    def tell(done: int, total: int, newest: str) -> None:
        if done == 1:
            doomed.kill()

    solve_on(lan, recording, tmp_path / "out", tell)
    assert doomed.wait() != 0
    assert (tmp_path / "out" / "run.parquet").read_bytes() == wanted.read_bytes()


@dataclass(frozen=True)
class Slow(Unit):
    """Unit that takes so long that two commands want its result at the same time."""

    def run(self, parts: PartFiles) -> None:
        time.sleep(1.0)
        with parts.new(self.key) as part:
            part.summary = None


def test_two_commands_on_one_cluster_have_their_own_parts(tmp_path: Path) -> None:
    from distributed import LocalCluster

    hand = parse_hand({"buses": [{"name": "can0"}], "patches": [{"name": "p0", "node_id": 5}]})
    unit = Slow(Recording(tmp_path / "run.log", False, ()), hand)
    folders = [tmp_path / "one", tmp_path / "other"]
    for folder in folders:
        folder.mkdir()
    with ExitStack() as stack:
        lan = stack.enter_context(LocalCluster(1, 1, processes=False, dashboard_address=None))  # type: ignore[no-untyped-call]
        commands = [stack.enter_context(Cluster(lan.scheduler_address, folder)) for folder in folders]
        for command in commands:
            command.submit(unit)
        for command in commands:
            while not command.finished(0.5):
                pass
    assert [unit.key in PartFiles(folder) for folder in folders] == [True, True]


def test_a_cluster_that_goes_is_named_and_the_next_run_continues(
    lan: Lan, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted, out = tmp_path / "wanted.parquet", tmp_path / "out"
    convert(recording, wanted)
    lan.worker(), lan.worker()
    lan.await_workers(2)
    monkeypatch.setattr(cluster, "_GONE_S", 2.0)

    def tell(done: int, total: int, newest: str) -> None:
        if done == 2:
            lan.scheduler.kill()

    with pytest.raises(SkinError, match=rf"--scheduler: the cluster at {lan.address} is gone; start it"):
        solve_on(lan, recording, out, tell)
    done = CliRunner().invoke(app, ["resolve", str(recording), "-o", str(out), "--processes", "1"])
    assert done.exit_code == 0, done.output
    assert (out / "run.parquet").read_bytes() == wanted.read_bytes()


def test_a_worker_with_other_software_is_refused_by_name(lan: Lan, recording: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "skinnode"
    shutil.copytree(Path(skinnode.__file__).parent, other, ignore=shutil.ignore_patterns("__pycache__"))
    (other / "solve" / "roots.py").open("a").write("# another rule\n")
    lan.worker(PYTHONPATH=str(other.parent))
    lan.await_workers(1)
    done = CliRunner().invoke(
        app, ["resolve", str(recording), "-o", str(tmp_path / "out"), "--scheduler", lan.address]
    )
    said = str(done.exception)
    assert said.startswith("worker tcp://127.0.0.1:")
    assert "refused, because it has source code" in said
    assert "install the same version there" in said
    assert not (tmp_path / "out").exists()


def test_an_address_without_a_scheduler_or_workers_is_one_line(
    lan: Lan, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 5.0)
    for address, wanted in (
        ("tcp://127.0.0.1:1", "--scheduler: got 'tcp://127.0.0.1:1', allowed: the address of a running Dask"),
        ("nonsense://x", "--scheduler: got 'nonsense://x', allowed: the address of a running Dask scheduler"),
        (lan.address, f"--scheduler: the cluster at {lan.address} has no workers; start some"),
    ):
        if address == lan.address:
            lan.await_workers(0)
        done = CliRunner().invoke(
            app, ["resolve", str(recording), "-o", str(tmp_path), "--scheduler", address]
        )
        assert isinstance(done.exception, SkinError)
        assert str(done.exception).startswith(wanted)


def test_the_missing_package_is_named(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "find_spec", lambda name: None)
    done = CliRunner().invoke(
        app, ["resolve", str(recording), "-o", str(tmp_path / "out"), "--scheduler", "x"]
    )
    assert str(done.exception).endswith("the package of the cluster extra (install: sh install.sh cluster)")
