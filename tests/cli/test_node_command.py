"""``skinnode node`` as its user meets it: a process on a bus, a source of the user's own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skinnode.cli.node import _memory
from skinnode.config import BusConfig
from skinnode.errors import ConfigError
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import PatchLayout
from skinnode.node.patch.find_source import GROUP, load, make_source
from skinnode.transport import CanPort, Frame

from ..commands import Output, run_here, run_until_signal

ROOT = Path(__file__).parents[2]
SKINNODE = str(Path(sys.executable).with_name("skinnode"))
WAIT_S = 10.0

SOURCES = '''
import numpy as np

LIST = [1, 2]

class Board:
    """Fails from the third scan on, sixteen readings of a tare and one of the start before them."""

    def __init__(self, layout):
        self.ohm = np.full(layout.shape, 12e3)
        self.reads = 0

    def read(self, t_ns):
        self.reads += 1
        if self.reads > 19:
            raise OSError("the converter\\n does not answer")
        return self.ohm

def transposed(layout):
    board = Board(layout)
    board.ohm = board.ohm.T
    return board

def broken(layout):
    raise RuntimeError("no board at 0x48")

def dead(layout):
    board = Board(layout)
    board.reads = 100
    return board

def needs_more(layout, port):
    return Board(layout)

def gives_nothing(layout):
    return None
'''


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a module of sources, which is the working directory."""
    (tmp_path / "my_sources.py").write_text(SOURCES)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    yield tmp_path
    sys.modules.pop("my_sources", None)


def arguments(group: str, *more: str, node_id: int | None) -> list[str]:
    bus = ["--interface", "udp_multicast", "--channel", group]
    return [SKINNODE, "node", *bus, *more, *([] if node_id is None else ["--node-id", str(node_id)])]


@contextmanager
def running(group: str, *more: str, node_id: int | None = 4, cwd: Path) -> Iterator[subprocess.Popen[str]]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen(
        arguments(group, *more, node_id=node_id),
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=20)


class Master:
    """A CAN master in a few lines, on the multicast group."""

    def __init__(self, port: CanPort) -> None:
        self.port = port

    def send(self, can_id: int, data: str) -> None:
        self.port.send(can_id, bytes.fromhex(data))

    def next(self, *can_ids: int) -> Frame:
        while True:
            frame = self.port.recv(WAIT_S)
            assert frame is not None
            if frame.can_id in can_ids:
                return frame


@pytest.fixture
def master(multicast_group: str) -> Iterator[Master]:
    with CanPort(BusConfig(interface="udp_multicast", channel=multicast_group, fd=True)) as port:
        yield Master(port)


@pytest.mark.long
def test_a_node_of_the_users_own_source(sources: Path, multicast_group: str, master: Master) -> None:
    options = ["--source", "my_sources:Board", "--layout", "aligned", "--serial", "77", "--json"]
    with running(multicast_group, *options, cwd=sources) as process:
        assert bytes(master.next(0x704).data) == b"\0"
        master.send(0x604, "40 18 10 04 00 00 00 00")
        assert bytes(master.next(0x584).data) == bytes.fromhex("43 18 10 04 4d 00 00 00")
        master.send(0x000, "01 04")
        for scan in range(2):
            master.send(0x080, "")
            assert bytes(master.next(0x284).data)[:4] == bytes((scan, 0x20, 100, 0))  # with a check
        master.send(0x080, "")  # from here on the source fails
        assert bytes(master.next(0x084).data)[:2] == b"\x00\xff"
        assert bytes(master.next(0x284).data)[:4] == b"\x02\x30\0\0"
        master.send(0x604, "40 01 10 00 00 00 00 00")
        assert bytes(master.next(0x584).data)[4] == 0x81
        process.stdout.readline()  # what runs where
        process.stdout.readline()  # the first second
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (1, "")  # the source failed
    *seconds, fault = [json.loads(line) for line in out.splitlines()]
    assert fault == {
        "note": "fault: 1 failure of the source, most recently: source.read(): OSError: "
        "the converter does not answer"
    }
    for second in seconds:
        assert (second["state"], second["source_failures"]) == ("operational", 1)


def test_over_can_fd(sources: Path, multicast_group: str, master: Master) -> None:
    options = ["--source", "my_sources:Board", "--fd", "--code-bits", "24", "--strict-timing"]

    def receive(_: Output) -> None:
        master.next(0x704)
        master.send(0x000, "01 04")
        master.send(0x080, "")
        chunks = [master.next(0x184) for _ in range(20)]
        assert {(frame.fd, len(frame.data)) for frame in chunks} == {(True, 64)}
        assert bytes(master.next(0x284).data)[2] == 20

    done = run_until_signal(signal.SIGINT, *arguments(multicast_group, *options, node_id=4)[1:], when=receive)
    assert (done.returncode, done.stderr) == (0, "")
    head = done.stdout.splitlines()[0]
    assert "10 × 30 wires, 24-bit codes" in head
    assert "CAN FD" in head


def test_ends_by_itself_and_says_how_it_does(sources: Path, multicast_group: str) -> None:
    options = ["--source", "my_sources:Board", "--seconds", "1.2"]
    done = run_here(*arguments(multicast_group, *options, node_id=4)[1:])
    assert (done.returncode, done.stderr) == (0, "")
    head, *seconds = done.stdout.splitlines()
    assert head.startswith("node 4 (10 × 30 wires, 16-bit codes, source my_sources:Board) on udp_multicast")
    assert [line.split("  ", 1)[1].strip() for line in seconds] == [
        "1.0 s  4  pre-operational  0 scans  1 frames",
        "1.2 s  4  pre-operational  0 scans  0 frames",
    ]


def test_what_was_stored_is_there_at_the_next_start(
    sources: Path, multicast_group: str, master: Master
) -> None:
    options = ["--source", "my_sources:Board", "--store", "patch.json"]

    def at_the_first_start(_: Output) -> None:
        ask_for(2)
        for request in ("2b 20 20 02 63 00 00 00", "23 10 10 01 73 61 76 65"):
            master.send(0x604, request)
            assert bytes(master.next(0x584).data)[0] == 0x60

    def ask_for(value: int) -> None:
        master.next(0x704)
        master.send(0x604, "40 20 20 02 00 00 00 00")
        assert bytes(master.next(0x584).data)[4] == value

    for when in (at_the_first_start, lambda _: ask_for(99)):
        command = arguments(multicast_group, *options, node_id=4)[1:]
        done = run_until_signal(signal.SIGTERM, *command, when=when)
        assert (done.returncode, done.stderr) == (0, "")
    assert [file.name for file in sources.iterdir() if "patch.json" in file.name] == ["patch.json"]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "/patch.json: not a node's memory, or incomplete"),
        (None, "memory: the contents belong to the patch 'skinnode-10x30-u24"),
    ],
)
def test_a_memory_that_is_of_no_use_is_a_fault(
    sources: Path, multicast_group: str, content: str | None, says: str
) -> None:
    def run(*options: str) -> subprocess.CompletedProcess[str]:
        source = ["--source", "my_sources:Board", "--store", "patch.json", "--seconds", "0.2"]
        return run_here(*arguments(multicast_group, *source, *options, node_id=4)[1:])

    if content is None:
        assert run("--code-bits", "24").returncode == 0
    else:
        (sources / "patch.json").write_text(content)
    done = run()
    assert done.returncode == 1
    assert "fault: memory: " in done.stdout
    assert says in done.stdout
    assert run().returncode == 0  # put aside, and a new one begun


@pytest.mark.long
def test_two_processes_do_not_share_a_memory(sources: Path, multicast_group: str, master: Master) -> None:
    options = ["--source", "my_sources:Board", "--store", "patch.json"]
    with running(multicast_group, *options, cwd=sources) as owner:
        assert bytes(master.next(0x704).data) == b"\0"
        command = arguments(multicast_group, *options, node_id=5)
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
        assert (done.returncode, done.stdout) == (2, "")
        says = "error: --store: got 'patch.json', allowed: a file that no other process is using"
        assert done.stderr == f"{says} (in use by process {owner.pid})\n"


def test_a_memory_is_not_looked_for_behind_a_symbolic_link(sources: Path, multicast_group: str) -> None:
    (sources / "patch.json").symlink_to(sources / "elsewhere")
    options = ["--source", "my_sources:Board", "--store", "patch.json", "--seconds", "0.1"]
    done = run_here(*arguments(multicast_group, *options, node_id=4)[1:])
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: --store: got 'patch.json', allowed: a file, not a symbolic link\n"


@pytest.mark.parametrize(
    ("kind", "allowed"),
    [
        ("pipe", "a regular file, or a name that does not exist"),
        ("device", "a regular file, or a name that does not exist"),
        ("folder", "a regular file, or a name that does not exist"),
        ("linked lock", "is a symbolic link, which is not followed"),
        ("piped lock", "is not a regular file"),
        ("lock that is a folder", "is not a regular file"),
    ],
)
def test_a_memory_is_a_regular_file_and_so_is_its_lock(sources: Path, kind: str, allowed: str) -> None:
    store, lock = sources / "patch.json", sources / ".patch.json.lock"
    match kind:
        case "pipe":
            os.mkfifo(store)
        case "device":
            store = Path("/dev/null")
        case "folder":
            store.mkdir()
        case "linked lock":
            lock.symlink_to(sources / "elsewhere")
        case "piped lock":
            os.mkfifo(lock)
        case _:
            lock.mkdir()
    with pytest.raises(ConfigError) as caught, _memory(store):
        pass
    if kind in ("pipe", "device", "folder"):
        says = f"--store: got '{store}', allowed: {allowed}"
    else:
        lock_allowed = "allowed: a regular file, or a name that does not exist"
        why = f"its lock file .patch.json.lock {allowed}; {lock_allowed}"
        says = f"--store: got '{store}', allowed: a file that can be locked ({why})"
    assert str(caught.value) == says


def test_another_node_with_the_same_node_id_is_a_fault(
    sources: Path, multicast_group: str, master: Master
) -> None:
    def interfere(_: Output) -> None:
        assert bytes(master.next(0x704).data) == b"\0"
        master.send(0x704, "00")
        assert bytes(master.next(0x084).data)[:2] == b"\x50\x81"

    command = arguments(multicast_group, "--source", "my_sources:Board", node_id=4)[1:]
    done = run_until_signal(signal.SIGTERM, *command, when=interfere)
    assert (done.returncode, done.stderr) == (1, "")
    assert "fault: 1 boot-up or heartbeat from another node with this node-ID" in done.stdout


@pytest.mark.long
def test_a_node_id_by_lss(sources: Path, multicast_group: str, master: Master) -> None:
    """Switch state global, configure node-ID 9, store, waiting state (CiA 305); then as after a power cut."""
    options = ["--source", "my_sources:Board", "--store", "patch.json", "--serial", "5"]
    with running(multicast_group, *options, node_id=None, cwd=sources) as process:
        assert "without a node-ID" in process.stdout.readline()
        master.send(0x7E5, "04 01 00 00 00 00 00 00")
        master.send(0x7E5, "11 09 00 00 00 00 00 00")
        assert bytes(master.next(0x7E4).data)[:2] == b"\x11\0"
        master.send(0x7E5, "17 00 00 00 00 00 00 00")
        assert bytes(master.next(0x7E4).data)[:2] == b"\x17\0"
        master.send(0x7E5, "04 00 00 00 00 00 00 00")
        assert bytes(master.next(0x709).data) == b"\0"
    for given, says in ((None, "node 9 ("), (4, "node 9 (stored by LSS; 4 is not used) (")):
        with running(multicast_group, *options, node_id=given, cwd=sources) as process:
            assert bytes(master.next(0x709).data) == b"\0"
            assert process.stdout.readline().startswith(says)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            [],
            "error: --node-id: got nothing, allowed: 1 to 127, or --store FILE and a node-ID",
        ),
        (["--store", "/no/such/folder/x"], "error: --store: got '/no/such/folder/x', allowed: a file in an"),
        (["--node-id", "4", "--layout", "wavy"], "error: --layout: got 'wavy', allowed: aligned"),
        (["--node-id", "4", "--channel", ""], "error: --channel: got '', allowed: a name of printable"),
        (["--node-id", "4", "--interface", ""], "error: --interface: got '', allowed: a name of printable"),
        (["--node-id", "4", "--code-bits", "12"], "error: code_bits: got 12, allowed: 16 or 24"),
    ],
)
def test_options_that_cannot_be(sources: Path, options: list[str], says: str) -> None:
    done = run_here("node", "--source", "my_sources:Board", "--interface", "virtual", *options)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(says)


def test_a_channel_may_have_a_long_name() -> None:
    """Such as /dev/serial/by-id/usb-Protofusion_Labs_CANable_…-if00 of an adapter with a serial line."""
    options = ["--interface", "virtual", "--channel", "/dev/serial/by-id/" + 100 * "x", "--seconds", "0.1"]
    done = run_here("node", "--source", "simulated", "--node-id", "4", *options)
    assert (done.returncode, done.stderr) == (0, "")


BAD = [
    ("my_sources:transposed", "(source.read(): got shape (30, 10), must be (10, 30))"),
    ("my_sources:dead", "(source.read(): OSError: the converter does not answer)"),
    ("my_sources:broken", "(RuntimeError: no board at 0x48)"),
    ("my_sources:needs_more", "(TypeError: needs_more() missing 1 required positional argument: 'port')"),
    ("my_sources:gives_nothing", "a source with a method read(t_ns), not None"),
    ("my_sources:LIST", "a class or a function that takes the layout"),
    ("my_sources:absent", "(AttributeError: module 'my_sources' has no attribute 'absent')"),
    ("absent:x", "(ModuleNotFoundError: No module named 'absent')"),
    ("nobody", "allowed: MODULE:NAME, or a registered source ("),
]


@pytest.mark.parametrize(("name", "says"), BAD)
def test_a_source_that_is_none_is_one_line(sources: Path, name: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_source(name, PatchLayout.preset("staggered"), "--source")
    line = str(caught.value)
    assert line.startswith(f"--source: got {name!r}, allowed: ")
    assert says in line
    assert "\n" not in line


def test_a_bad_source_ends_with_status_2_before_a_frame_is_sent(
    sources: Path, multicast_group: str, master: Master
) -> None:
    done = run_here(*arguments(multicast_group, "--source", "my_sources:dead", node_id=4)[1:])
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        "error: --source: got 'my_sources:dead', allowed: a source that returns readings ("
    )
    assert master.port.recv(0.05) is None


def test_an_installed_package_registers_a_source(sources: Path, multicast_group: str, master: Master) -> None:
    """By the metadata of its distribution, as pip lays it down."""
    info = sources / "skin_board-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: skin-board\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\nboard7 = my_sources:Board\nbad = my_sources:nil\n")
    source = make_source("board7", PatchLayout.preset("aligned"))
    assert source.read(0).shape == (10, 30)
    with pytest.raises(ConfigError, match=r"board7.*\)"):
        make_source("board8", PatchLayout.preset("aligned"))
    with pytest.raises(ConfigError, match=r"source bad: got 'my_sources:nil'"):
        make_source("bad", PatchLayout.preset("aligned"))


def test_the_simulator_is_registered_and_presses_the_patch() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"][GROUP]
    assert declared == {"simulated": "vcan_sim.sensor:simulated"}
    layout = PatchLayout.preset("staggered")
    source = load(declared["simulated"], "--source")(layout)
    now_ns = time.monotonic_ns()
    rest, pressed = source.read(now_ns), source.read(now_ns + 2_500_000_000)  # 1.4 s of press after 0.8 s
    ratio = pressed / rest
    assert abs(rest / resistance_ohm(layout, layout.upper_m) - 1).max() < 1e-4
    assert ratio.min() < 0.997
