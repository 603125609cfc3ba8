"""Exit statuses after signals and closed pipes, of every command, whenever they come: never a traceback."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator, Sequence
from itertools import cycle, product
from pathlib import Path

import pytest

from skinnode.config import BusConfig, load_hand
from tests.lanes import some_long
from vcan_sim.fleet import Fleet

from ..commands import SIGNALS, run_for_nobody, run_until_signal

PROGRAMS = {"skinnode": "skinnode.cli.main", "vcan-sim": "vcan_sim.cli"}

HOOKED = """
import json, os, signal, sys

modules, ended = {modules!r}, []

class Hook:
    def find_spec(self, name, path, target=None):
        if name not in modules:
            return
        modules.remove(name)
        for number in {numbers!r}:  # each comes to a copy of the process that is just here
            child = os.fork()
            if child == 0:
                os.kill(os.getpid(), number)
                return
            ended.append([name, number, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])])
        if not modules:
            os.write({result}, json.dumps(ended).encode())
            os._exit(0)

sys.meta_path.insert(0, Hook())
sys.argv = {arguments!r}
from {program} import main
main()
"""
"""A program that is sent each signal each time it begins to import one of ``modules``."""


def start(arguments: Sequence[str], folder: Path, **options: object) -> subprocess.Popen[str]:
    """``skinnode`` or ``vcan-sim``; SIGHUP and SIGINT as a terminal leaves them."""
    command = [str(Path(sys.executable).with_name(arguments[0])), *arguments[1:]]
    return subprocess.Popen(
        command,
        **{
            "stdout": subprocess.PIPE,
            "stderr": subprocess.PIPE,
            "text": True,
            "cwd": folder,
            "env": {**os.environ, "PYTHONUNBUFFERED": "1"},
            "start_new_session": True,
            "preexec_fn": lambda: [signal.signal(number, signal.SIG_DFL) for number in SIGNALS],
            **options,
        },
    )


def handles_signals(process: subprocess.Popen[str]) -> None:
    """Wait until the program handles signals: before that, they end Python while it starts."""
    caught = re.compile(r"(?m)^SigCgt:\s*([0-9a-f]+)$")
    end_s = time.monotonic() + 20.0
    while process.poll() is None and time.monotonic() < end_s:
        found = caught.search(Path(f"/proc/{process.pid}/status").read_text())
        if found and int(found[1], 16) >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(0.01)
    pytest.fail("the program never handled signals")


@pytest.fixture
def folder(tmp_path: Path, multicast_group: str) -> Path:
    """A hand of one small patch on a bus that processes share, which nobody else uses."""
    (tmp_path / "hand.toml").write_text(hand_text("udp_multicast", multicast_group))
    return tmp_path


def hand_text(interface: str, channel: str) -> str:
    """The hand file of one small patch."""
    sizes = "upper_wires = 2, upper_electrodes = 2, lower_wires = 6, lower_electrodes = 2"
    return (
        f'[[buses]]\nname = "can0"\ninterface = "{interface}"\nchannel = "{channel}"\n'
        f'[sync]\nperiod_ms = 250\n[[patches]]\nname = "thumb"\nnode_id = 5\ntolerances = "exact"\n'
        f'layout = {{ preset = "staggered", {sizes} }}\n'
    )


@pytest.mark.parametrize(
    ("arguments", "modules"),
    [
        pytest.param(["skinnode", "scan"], ["typer", "can"], marks=pytest.mark.long),
        pytest.param(
            ["skinnode", "--help"], ["skinnode.cli._errors", "skinnode.cli.lss"], marks=pytest.mark.long
        ),
        (["skinnode", "hand", "check", "hand.toml"], ["pydantic", "numpy", "numba"]),
        pytest.param(["vcan-sim", "hand.toml"], ["typer", "skinnode.node"], marks=pytest.mark.long),
    ],
    ids=lambda words: " ".join(words),
)
def test_a_signal_during_imports(folder: Path, arguments: list[str], modules: list[str]) -> None:
    result, theirs = os.pipe()
    code = HOOKED.format(
        modules=modules,
        numbers=[int(number) for number in SIGNALS],
        result=theirs,
        arguments=arguments,
        program=PROGRAMS[arguments[0]],
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=60,
        check=False,
        pass_fds=[theirs],
        preexec_fn=lambda: [signal.signal(each, signal.SIG_DFL) for each in SIGNALS],
    )
    os.close(theirs)
    with open(result) as pipe:
        ended = json.loads(pipe.read())
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert sorted((name, number) for name, number, _ in ended) == sorted(product(modules, SIGNALS))
    assert all(status == 128 + number for _, number, status in ended), ended


def simulated(folder: Path) -> Fleet:
    """The nodes of the hand, in the process of the test."""
    return Fleet(load_hand(folder / "hand.toml"))


BUS = ["--hand", "hand.toml"]
UNTIL_TOLD = {
    "host": ["skinnode", "host", "hand.toml"],
    "record": ["skinnode", "record", "hand.toml", "-o", ".", "--listen"],
    "monitor": ["skinnode", "monitor", "hand.toml", "--json"],
    "vcan-sim": ["vcan-sim", "hand.toml"],
    "node": [
        *["skinnode", "node", "--source", "simulated", "--node-id", "9", "--interface", "udp_multicast"],
        *["--channel", "MULTICAST GROUP"],
    ],
}


IN_PROCESSES = [("record", signal.SIGHUP), ("monitor", signal.SIGTERM), ("node", signal.SIGINT)]
"""Commands in processes of their own; tests/host/test_host_command.py has those of ``host`` and ``vcan-sim``.

:func:`test_every_signal_ends_what_runs_until_it_is_told` has every signal."""


def marked(cases: list[tuple[str, int]], *plain: tuple[str, int]) -> Iterator[object]:
    """The host and the monitor count the scans of another process or thread, in real time. Only the ``plain``
    cases are part of a plain run."""
    for command, number in cases:
        marks = [pytest.mark.real_time] if command in ("host", "monitor") else []
        marks += [] if (command, number) in plain else [pytest.mark.long]
        yield pytest.param(command, number, marks=marks)


def is_stall(err: str) -> bool:
    """Whether the machine stood still for a scan: the command then has nothing but faults to report."""
    return re.fullmatch(r"((fault: thumb: |node 5 \().*\n)+", err) is not None


@pytest.mark.long
@pytest.mark.parametrize(("command", "number"), list(marked(IN_PROCESSES, IN_PROCESSES[0])))
def test_what_runs_until_it_is_told_has_done_its_work(
    folder: Path, multicast_group: str, command: str, number: int
) -> None:
    arguments = [multicast_group if word == "MULTICAST GROUP" else word for word in UNTIL_TOLD[command]]
    for _ in range(10):
        with contextlib.ExitStack() as stack:
            if command in ("host", "monitor"):
                stack.enter_context(simulated(folder))
            process = stack.enter_context(start(arguments, folder))
            assert process.stdout is not None
            process.stdout.readline()
            process.stdout.readline()
            process.send_signal(number)
            _, err = process.communicate(timeout=30)
        if not is_stall(err):
            break
        assert process.returncode == 1
    assert (process.returncode, err) == (0, "")


@pytest.mark.parametrize(
    ("command", "number"),
    list(marked(list(product(UNTIL_TOLD, SIGNALS)), *zip(UNTIL_TOLD, cycle(SIGNALS), strict=False))),
)
def test_every_signal_ends_what_runs_until_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, number: int
) -> None:
    bus = BusConfig(name="can0", interface="virtual", channel=uuid.uuid4().hex)
    (tmp_path / "hand.toml").write_text(hand_text(bus.interface, bus.channel))
    monkeypatch.chdir(tmp_path)
    words = {"MULTICAST GROUP": bus.channel, "udp_multicast": bus.interface}
    program, *arguments = [words.get(word, word) for word in UNTIL_TOLD[command]]
    for _ in range(10):
        with Fleet(load_hand("hand.toml")) if command in ("host", "monitor") else contextlib.nullcontext():
            done = run_until_signal(number, *arguments, program=program, when=lambda said: said.has("\n", 2))
        if not is_stall(done.stderr):
            break
        assert done.returncode == 1
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\n") >= 2


WITH_AN_END = {
    "demo": ["skinnode", "demo", "--patches", "1", "--seconds", "60"],
    "scan": ["skinnode", "scan", *BUS],
    "lss list": ["skinnode", "lss", "list", *BUS],
    "doctor": ["skinnode", "doctor", "hand.toml"],
    "conformance": [
        *[
            "skinnode",
            "conformance",
            "--node-id",
            "5",
            "--interface",
            "udp_multicast",
            "--channel",
            "{group}",
        ],
    ],
    "bench path": ["skinnode", "bench", "path"],
    "bench stability": ["skinnode", "bench", "stability", "--seeds", "50", "--jobs", "2"],
    "bench node": ["skinnode", "bench", "node"],
    "bench soak": ["skinnode", "bench", "soak", "--minutes", "5"],
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "number"),
    some_long(zip(WITH_AN_END, cycle(SIGNALS), strict=False), ("demo", SIGNALS[0]), ("scan", SIGNALS[1])),
)
def test_what_has_an_end_did_not_come_to_it(
    folder: Path, command: str, number: int, multicast_group: str
) -> None:
    arguments = [argument.replace("{group}", multicast_group) for argument in WITH_AN_END[command]]
    with contextlib.ExitStack() as stack:
        if command == "conformance":
            stack.enter_context(simulated(folder))
        process = stack.enter_context(start(arguments, folder))
        handles_signals(process)
        time.sleep(0.4)  # the shortest of them takes about a second
        if process.poll() is None:
            os.killpg(process.pid, number)  # as a terminal does: its children too
        begun_s = time.monotonic()
        _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (128 + number, "")
    assert time.monotonic() - begun_s < 10.0


@pytest.mark.parametrize("number", SIGNALS)
def test_every_signal_ends_a_search(folder: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.chdir(folder)
    done = run_until_signal(number, "scan", *BUS, when=lambda _: time.sleep(0.2))
    assert (done.returncode, done.stderr) == (128 + number, "")


STARTING = """
import os, sys
from multiprocessing import util

real, turn = util.spawnv_passfds, 0

def spawned(*arguments):
    global turn
    child, turn = real(*arguments), turn + 1
    if turn == {turn}:
        os.killpg(0, {number})
    return child

util.spawnv_passfds = spawned
sys.argv = ["skinnode", "bench", "stability", "--seeds", "50", "--jobs", "2"]
from skinnode.cli.main import main
main()
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("turn", "number"),
    some_long(list(zip([1, 2, 3], SIGNALS, strict=True)), (2, SIGNALS[1])),
    ids=["resource tracker", "first process", "second process"],
)
def test_a_signal_while_child_processes_start(tmp_path: Path, turn: int, number: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", STARTING.format(turn=turn, number=int(number))],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=30,
        check=False,
        start_new_session=True,
        preexec_fn=lambda: [signal.signal(each, signal.SIG_DFL) for each in SIGNALS],
    )
    assert (done.returncode, done.stderr) == (128 + number, "")


LATE = """
import os, sys

class Late:
    def __del__(self):
        for number in {numbers!r}:
            os.kill(os.getpid(), number)

sys.modules["late"] = Late()  # freed when Python frees the modules, after its handlers
sys.argv = ["skinnode", "eds"]
from skinnode.cli.main import main
main()
"""


@pytest.mark.long
def test_one_while_python_frees_its_modules_does_not_matter() -> None:
    done = subprocess.run(
        [sys.executable, "-c", LATE.format(numbers=[int(number) for number in SIGNALS])],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
        preexec_fn=lambda: [signal.signal(each, signal.SIG_DFL) for each in SIGNALS],
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_a_second_one_does_not_matter(folder: Path) -> None:
    with start(["skinnode", "scan", *BUS], folder) as process:
        handles_signals(process)
        time.sleep(0.3)
        for _ in range(5):
            process.send_signal(signal.SIGINT)
            time.sleep(0.02)
        _, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (130, "")


@pytest.mark.parametrize(
    "arguments",
    [
        ["skinnode", "eds"],
        pytest.param(["skinnode", "scan", *BUS, "--json"], marks=pytest.mark.long),
        pytest.param(["skinnode", "record", "hand.toml", "-o", ".", "--listen"], marks=pytest.mark.long),
        pytest.param(["vcan-sim", "hand.toml"], marks=pytest.mark.long),
    ],
)
def test_who_reads_may_go(folder: Path, arguments: list[str]) -> None:
    """As in ``skinnode eds | head -1``."""
    with start(arguments, folder) as process:
        assert process.stdout is not None
        process.stdout.close()
        assert process.stderr is not None
        err = process.stderr.read()
        process.wait(timeout=30)
    assert (process.returncode, err) == (141, "")


@pytest.mark.parametrize(
    "arguments", [["hand", "check", "hand.toml"], ["hand", "new"], ["--help"], ["conformance", "--list"]]
)
def test_who_reads_may_go_from_any_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    monkeypatch.chdir(folder)
    done = run_for_nobody(*arguments)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.long
@pytest.mark.parametrize("program", PROGRAMS.values())
def test_a_command_starts_no_threads_for_linear_algebra(program: str) -> None:
    """They wait by spinning: on every processor, under a real-time policy, they stopped a host for good."""
    code = (
        "import atexit, os, sys\n"
        "def count():\n"
        "    import numpy\n"
        "    numpy.ones((600, 600)) @ numpy.ones((600, 600))\n"
        "    print(len(os.listdir('/proc/self/task')))\n"
        "atexit.register(count)\n"
        "sys.argv[1:] = ['--help']\n"
        f"from {program} import main\n"
        "main()\n"
    )
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split()[-1] == "1"
