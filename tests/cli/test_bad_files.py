"""Every option that reads a file, with files that are none: exit status 2, and one line that says so."""

from __future__ import annotations

import io
import os
import random
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from skinnode.cli.main import main
from skinnode.errors import ConfigError
from skinnode.files.input_file import read_input
from skinnode.protocol.eds_files import eds_text
from skinnode.protocol.profile import PatchProfile
from skinnode.record.journal import read_journal
from tests.commands import virtual_time
from tests.lanes import some_long
from vcan_sim.cli import main as simulate

EDS = (
    "[FileInfo]\nFileName=x\n[DeviceInfo]\nVendorName=x\n"
    "[1000]\nParameterName=Device type\nObjectType=7\nDataType=7\nAccessType=ro\nDefaultValue=0\n"
)


def npz(compression: int = zipfile.ZIP_STORED, **changes: int) -> bytes:
    """A layout; ``method`` and ``flags`` are written over those of its members."""
    file = io.BytesIO()
    array = io.BytesIO()
    np.save(array, np.zeros((2, 2, 3)))
    with zipfile.ZipFile(file, "w", compression) as members:
        for name in ("upper_m.npy", "lower_m.npy"):
            members.writestr(name, array.getvalue())
    data = bytearray(file.getvalue())
    for signature, offsets in (
        (b"PK\3\4", {"flags": 6, "method": 8}),
        (b"PK\1\2", {"flags": 8, "method": 10}),
    ):
        at = data.find(signature)
        while at >= 0:
            for name, value in changes.items():
                data[at + offsets[name] : at + offsets[name] + 2] = value.to_bytes(2, "little")
            at = data.find(signature, at + 4)
    return bytes(data)


def huge_npz() -> bytes:
    head = b"\x93NUMPY\1\0v\0{'descr': '<f8', 'fortran_order': False, 'shape': (100000000000, 3), }"
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as members:
        members.writestr("upper_m.npy", head.ljust(127) + b"\n")
    return file.getvalue()


def flipped(data: bytes, seed: int) -> bytes:
    rng, flipped = random.Random(seed), bytearray(data)
    for _ in range(3):
        flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(flipped)


CONTENTS: dict[str, bytes] = {
    "empty": b"",
    "random": random.Random(1).randbytes(3000),
    "nul": bytes(5000),
    "deep.json": b"[" * 100_000,
    "deep.toml": b"a=" + b"[" * 50_000,
    "inline.toml": b"a=" + b"{a=" * 20_000,
    "long-key.toml": b".".join([b"a"] * 20_000) + b"=1",
    "utf-16": "[DeviceInfo]\n".encode("utf-16"),
    "one-line": b"x" * 1_000_000,
    "empty.mcap": b"",
    "magic.mcap": b"\x89MCAP0\r\n",
    "random.mcap": b"\x89MCAP0\r\n" + random.Random(2).randbytes(5000),
    "text.mcap": b"no recording\n",
    "random.parquet": random.Random(3).randbytes(3000),
    "magic.parquet": b"PAR1" + bytes(100) + b"PAR1",
    "random.asc": random.Random(4).randbytes(3000),
    "bzip2.npz": npz(zipfile.ZIP_BZIP2)[:-40],
    "odd-compression.npz": npz(method=97),
    "encrypted.npz": npz(flags=1),
    "huge.npz": huge_npz(),
    **{f"flipped-{seed}.npz": flipped(npz(), seed) for seed in range(5)},
    "201q.eds": (EDS + "[OptionalObjects]\nSupportedObjects=1\n1=201q\n").encode(),
    "dummy.eds": (EDS + "[DummyUsage]\nDummy0001=q\n").encode(),
    "compact.eds": (
        EDS + "[2000]\nObjectType=9\nCompactSubObj=99999999\nDataType=5\nAccessType=ro\n"
    ).encode(),
}


@pytest.fixture
def bad(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths of all kinds of files that are no input of ours."""
    monkeypatch.chdir(tmp_path)
    for name, content in CONTENTS.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    others = [
        ".",
        "missing",
        "x" * 300,
        "/".join(["x" * 200] * 30),
        "loop",
        "empty/x",
        "pipe",
        "/proc/self/mem",
    ]
    return [*CONTENTS, *others]


CHANNEL = "nobody"
BUS = ["--interface", "timed", "--channel", CHANNEL]
NODE = ["node", "--source", "simulated", "--node-id", "4", *BUS, "--seconds", "0"]
OPTIONS: dict[str, Callable[[str], list[str]]] = {
    "hand check": lambda file: ["hand", "check", file],
    "hand ros2": lambda file: ["hand", "ros2", file, "-o", "."],
    "host": lambda file: ["host", file],
    "vcan-sim": lambda file: ["vcan-sim", file],
    "scan --hand": lambda file: ["scan", "--hand", file],
    "node --layout": lambda file: [*NODE, "--layout", f"./{file}" if len(file) < 300 else file],
    "replay": lambda file: ["replay", file],
    "replay --hand": lambda file: ["replay", "x.log", "--hand", file],
    "convert": lambda file: ["convert", file, "y.npz"],
    "convert --hand": lambda file: ["convert", "x.log", "y.npz", "--hand", file],
    "resolve": lambda file: ["resolve", file, "-o", "solved"],
    "resolve --hand": lambda file: ["resolve", "x.log", "-o", "solved", "--hand", file],
    "monitor --replay": lambda file: ["monitor", "--json", "--replay", file],
    "view --replay": lambda file: ["view", "--web", "--replay", file],
    "info --eds": lambda file: ["info", "5", *BUS, "--eds", file],
    "od --diff": lambda file: ["od", "5", *BUS, "--diff", file],
    "conformance --eds": lambda file: ["conformance", "--node-id", "5", *BUS, "--eds", file],
}


@pytest.mark.parametrize("option", some_long(OPTIONS, "hand check", "replay", "od --diff", "convert"))
def test_a_file_that_is_none_is_one_line(
    option: str, bad: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    for file in bad:
        arguments = OPTIONS[option](file)
        with pytest.raises(SystemExit) as ended, virtual_time(CHANNEL):
            (simulate if option == "vcan-sim" else main)(arguments[option == "vcan-sim" :])
        told = capsys.readouterr()
        assert (ended.value.code, told.out) == (2, ""), file
        (line,) = told.err.splitlines()
        assert line.startswith("error: ")
        assert len(line) < 600
        assert "Errno" not in line
        assert "invalid literal" not in line or "allowed" in line


def test_a_pipe_with_a_writer_is_a_file(capfd: pytest.CaptureFixture[str]) -> None:
    """As in ``skinnode hand check <(skinnode hand new)``."""
    reading, writing = os.pipe()
    os.write(writing, b"text")
    os.close(writing)
    assert read_input("hand file", Path(f"/dev/fd/{reading}")) == b"text"
    os.close(reading)


def test_a_file_without_an_end_is_refused() -> None:
    with pytest.raises(ConfigError, match="at most 1 MiB"):
        read_input("hand file", Path("/dev/zero"), 1 << 20)


MISTAKES = {
    "[2010]": ("[201q]", "section: got '[201q]', allowed: [1018] for an object, "),
    "[2010sub1]": ("[201qsub1]", "section: got '[201qsub1]', allowed: [1018] for an object, "),
    "[2010sub3]": ("[2010sb3]", "section: got '[2010sb3]', allowed: [1018] for an object, "),
    "[2010sub2]": ("[2010subq]", "section: got '[2010subq]', allowed: [1018] for an object, "),
    "2=0x2010": ("2=0x201q", "[ManufacturerObjects] 2: got '0x201q', allowed: an index such as 0x1018"),
    "1=0x1000": ("1=0x11000", "[MandatoryObjects] 1: got '0x11000', allowed: an index such as 0x1018"),
    "SupportedObjects=3": ("SupportedObjects=x", "[MandatoryObjects] SupportedObjects: got 'x', allowed: a "),
    "[MandatoryObjects]": ("[Mandatory", "EDS: got '[Mandatory', allowed: a file in CiA 306 format"),
    "[2011]": ("[2010]", "EDS: got '[2010]', allowed: a file in CiA 306 format"),
    "DataType=0x0007": ("DataType=zz", "[1000] DataType: got 'zz', allowed: a number"),
}
OF_ONE_READER = ("[MandatoryObjects]", "[2011]", "DataType=0x0007")
"""Mistakes that ``od --diff`` takes for a line to skip, or leaves to case EDS-01."""


@pytest.mark.parametrize("right", MISTAKES)
def test_a_mistake_in_an_eds_is_named_by_its_line(
    right: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    wrong, says = MISTAKES[right]
    lines = eds_text(PatchProfile(10, 30, 10, 10, 16)).split("\n")
    number = lines.index(right)
    lines[number] = wrong
    Path("x.eds").write_text("\n".join(lines))
    Path("hand.toml").write_text(
        '[[buses]]\nname = "can0"\n[[patches]]\nname = "thumb"\nnode_id = 4\neds = "x.eds"\n'
    )
    commands = [["hand", "check", "hand.toml"], ["od", "5", *BUS, "--diff", "x.eds"]]
    for command in commands[: 1 if right in OF_ONE_READER else 2]:
        with pytest.raises(SystemExit) as ended, virtual_time(CHANNEL):
            main(command)
        (line,) = capsys.readouterr().err.splitlines()
        assert ended.value.code == 2
        assert line.startswith(f"error: x.eds:{number + 1}: {says}")


def claims(shape: str, kind: str = "<f8", zeros: int = 0, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """An NPZ file whose upper_m says it is of that shape, and is that many megabytes of zeros."""
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as members, members.open("upper_m.npy", "w") as member:
        member.write(b"\x93NUMPY\1\0v\0" + head.ljust(117) + b"\n")
        for _ in range(zeros):
            member.write(bytes(1 << 20))
    return file.getvalue()


BOMBS: dict[str, tuple[Callable[[], bytes], str]] = {
    "size.npz": (
        lambda: claims("(2, 2, 3)", zeros=300),
        "upper_m: got 314572928 bytes, allowed: at most 3072 numbers",
    ),
    "shape.npz": (
        lambda: claims("(13333333, 10, 3)"),
        "upper_m: got shape (13333333, 10, 3), allowed: at most 3072",
    ),
    "type.npz": (
        lambda: claims("(2, 2, 3)", "<U90000000"),
        "upper_m: got shape (2, 2, 3) of <U90000000, allowed: at ",
    ),
    "bzip2.npz": (
        lambda: claims("(2, 2, 3)", zeros=300, method=zipfile.ZIP_BZIP2),
        "upper_m: got compression method 12",
    ),
    "ints.toml": (lambda: b"a=[" + b"0," * (4 << 20) + b"]", "allowed: a file of at most 1 MiB"),
    "long.eds": (
        lambda: b"[DeviceInfo]\n" + b"[z]\n" * (1 << 20),
        "allowed: a file of at most 2 MiB",
    ),
    "compact.eds": (
        lambda: (
            EDS.encode()
            + b"".join(
                b"[%04x]\nObjectType=8\nCompactSubObj=254\nDataType=5\nAccessType=ro\n" % index
                for index in range(0x2000, 0x2800)
            )
        ),
        "got more than 65536 values in the sections up to 2101, allowed: at most 65536",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", some_long(BOMBS, "size.npz", "ints.toml"))
def test_a_small_file_that_needs_much_memory_is_refused_before(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    content, says = BOMBS[name]
    Path(name).write_bytes(content())
    option = ["od", "5", *BUS, "--diff", name] if name.endswith(".eds") else ["eds", "--layout", f"./{name}"]
    tracemalloc.start()
    try:
        with pytest.raises(SystemExit) as ended, virtual_time(CHANNEL):
            main(option)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    (line,) = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2
    assert says in line
    assert most < 200 << 20


def test_a_journal_is_not_read_beyond_its_first_line_if_that_is_none(tmp_path: Path) -> None:
    file = tmp_path / "x.jsonl"
    with file.open("wb") as sparse:
        sparse.truncate(1 << 28)
    tracemalloc.start()
    try:
        with pytest.raises(ConfigError, match="the header of a recording's journal"):
            read_journal(file)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 30 << 20


@pytest.mark.parametrize(("patches", "buses"), some_long([(10_000, 1), (10_000, 64), (128, 1)], (128, 1)))
def test_more_patches_than_node_ids_are_refused_at_once(
    patches: int, buses: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "hand.toml"
    lines = [f'[[buses]]\nname = "can{i}"\ninterface = "virtual"\nchannel = "c{i}"\n' for i in range(buses)]
    lines += [
        f'[[patches]]\nname = "p{i}"\nnode_id = {i // buses % 127 + 1}\nbus = "can{i % buses}"\n'
        for i in range(patches)
    ]
    file.write_text("".join(lines))
    with pytest.raises(SystemExit) as ended:
        main(["hand", "check", str(file)])
    (line,) = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2
    assert f"patches: got {patches} patches, allowed: at most {127 * buses}: node-IDs 1 to 127 on " in line
