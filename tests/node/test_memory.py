"""Non-volatile memory: what was saved is there whole, whatever happened in between."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinnode.files.file_lock import FileInUse
from skinnode.node.memory import Fault, Kept, MemoryFault, Parameters, VolatileMemory
from skinnode.node.memory_file import FileMemory, pack, unpack

KEPT = Kept(
    "2x6-u16-00c0ffee",
    9,
    250_000,
    Parameters(4, {(0x1017, 0): b"\x64\x00", (0x1800, 1): bytes.fromhex("84010000"), (0x1A00, 0): b"\x03"}),
    Parameters(4, {(0x2020, 2): b"\x4d\x00"}),
    ((1234.5, float(np.float32(0.1))), (float(np.finfo(np.float32).max), float(np.finfo(np.float32).tiny))),
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "patch.json"


def test_nothing_was_saved_yet(path: Path) -> None:
    assert FileMemory(path).load() is None
    assert VolatileMemory().load() is None


@pytest.mark.parametrize("kept", [KEPT, Kept(KEPT.patch)])
def test_what_was_saved_is_loaded(path: Path, kept: Kept) -> None:
    FileMemory(path).save(KEPT)
    FileMemory(path).save(kept)
    assert FileMemory(path).load() == kept
    assert os.listdir(path.parent) == [path.name]
    volatile = VolatileMemory()
    volatile.save(kept)
    assert volatile.load() == kept


def test_the_file_can_be_read_by_people(path: Path) -> None:
    FileMemory(path).save(KEPT)
    content = json.loads(path.read_text())["content"]
    assert content["node_id"] == 9
    assert content["communication"]["values"]["0x1800:1"] == "84 01 00 00"
    assert content["baseline_ohm"][0].startswith("1234.5 0.1")


class TestFilesOfNoUse:
    @pytest.mark.parametrize(
        "change",
        [
            lambda data: data[: len(data) // 2],
            lambda data: b"",
            lambda data: data.replace(b"4d 00", b"4e 00"),
            lambda data: data.replace(b'"node_id": 9', b'"node_id": 8'),
            lambda data: b"\xff\xfe" + data,
            lambda data: b"[]",
            lambda data: b"7",
            lambda data: b"[" * 100_000,
            lambda data: data + b"{}",
        ],
    )
    def test_damaged(self, path: Path, change) -> None:
        path.write_bytes(change(pack(KEPT)))
        with pytest.raises(MemoryFault) as caught:
            FileMemory(path).load()
        assert caught.value.fault is Fault.DAMAGED
        assert str(caught.value).startswith(str(path))

    @given(at=st.integers(0, len(pack(KEPT)) - 1), bit=st.integers(0, 7))
    def test_one_bit_is_never_believed(self, at: int, bit: int) -> None:
        data = bytearray(pack(KEPT))
        data[at] ^= 1 << bit
        try:
            kept = unpack(bytes(data))
        except MemoryFault:
            return
        assert kept == KEPT  # white space, or the case of a digit: it says the same

    @pytest.mark.parametrize(
        ("key", "value"),
        [("node_id", 0), ("node_id", "9"), ("bit_rate_bps", 1), ("application", []), ("baseline_ohm", [1])],
    )
    def test_a_right_checksum_does_not_make_it_right(self, key: str, value: object) -> None:
        from skinnode.node import memory_file

        document = json.loads(pack(KEPT))
        document["content"][key] = value
        document["checksum"] = memory_file._checksum(document["content"])
        with pytest.raises(MemoryFault, match="not a node's memory, or incomplete"):
            unpack(json.dumps(document).encode())

    def test_another_format(self, path: Path) -> None:
        path.write_bytes(pack(KEPT).replace(b"memory 1", b"memory 2"))
        with pytest.raises(MemoryFault) as caught:
            FileMemory(path).load()
        assert caught.value.fault is Fault.FOREIGN

    def test_what_is_no_file(self, tmp_path: Path) -> None:
        pipe = tmp_path / "pipe"
        os.mkfifo(pipe)
        for place in (pipe, tmp_path, tmp_path / ("x" * 300)):
            with pytest.raises(MemoryFault) as caught:
                FileMemory(place).load()
            assert caught.value.fault is Fault.UNREADABLE
            with pytest.raises(OSError, match=r".+"):
                FileMemory(place).save(KEPT)
        assert os.listdir(tmp_path) == ["pipe"]

    def test_they_are_put_aside_not_overwritten(self, path: Path) -> None:
        foreign = pack(Kept("10x30-u24-12345678"))
        for _ in range(3):  # the same file three times is one file
            path.write_bytes(foreign)
            FileMemory(path).save(KEPT)
        path.write_bytes(b"damaged")
        FileMemory(path).save(KEPT)
        assert FileMemory(path).load() == KEPT
        aside = sorted(item.read_bytes() for item in path.parent.iterdir() if item != path)
        assert aside == sorted([foreign, b"damaged"])


class TestSaving:
    def test_order_of_a_safe_replacement(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The new content is on the medium before it gets the name, and the name before save returns."""
        done: list[str] = []
        fsync, replace = os.fsync, os.replace

        def kind(descriptor: int) -> str:
            return "folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file"

        monkeypatch.setattr(os, "fsync", lambda fd: (done.append(f"fsync {kind(fd)}"), fsync(fd)))
        monkeypatch.setattr(os, "replace", lambda a, b: (done.append("rename"), replace(a, b)))
        FileMemory(path).save(KEPT)
        assert done == ["fsync file", "rename", "fsync folder"]

    @pytest.mark.parametrize("call", ["fsync", "replace"])
    def test_failure_keeps_the_old(self, path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
        FileMemory(path).save(KEPT)

        def fail(*_: object) -> None:
            raise OSError("input/output error")

        with monkeypatch.context() as patch:
            patch.setattr(os, call, fail)
            with pytest.raises(OSError, match="input/output error"):
                FileMemory(path).save(Kept(KEPT.patch))
        assert FileMemory(path).load() == KEPT
        assert os.listdir(path.parent) == [path.name]

    def test_folder_that_does_not_exist(self, path: Path) -> None:
        with pytest.raises(FileNotFoundError):
            FileMemory(path.parent / "no" / "such.json").save(KEPT)


class TestOthersInTheFolder:
    """What somebody else who can write there has put in the way."""

    def test_a_link_under_the_name_of_the_new_content(self, path: Path, tmp_path: Path) -> None:
        victim = tmp_path / "victim"
        victim.write_text("precious")
        path.with_name(f".{path.name}.new").symlink_to(victim)
        FileMemory(path).save(KEPT)
        assert victim.read_text() == "precious"
        assert FileMemory(path).load() == KEPT

    def test_a_link_in_place_of_the_file(self, path: Path, tmp_path: Path) -> None:
        victim = tmp_path / "victim"
        victim.write_bytes(pack(KEPT))
        path.symlink_to(victim)
        with pytest.raises(MemoryFault, match="a symbolic link, which is not followed"):
            FileMemory(path).load()
        with pytest.raises(OSError, match="a symbolic link, which is not followed"):
            FileMemory(path).save(Kept(KEPT.patch))
        assert path.is_symlink()
        assert victim.read_bytes() == pack(KEPT)

    def test_a_link_in_place_of_the_lock(self, path: Path, tmp_path: Path) -> None:
        victim = tmp_path / "victim"
        victim.write_text("precious")
        path.with_name(f".{path.name}.lock").symlink_to(victim)
        with pytest.raises(OSError, match="symbolic link"):
            FileMemory(path).save(KEPT)
        assert victim.read_text() == "precious"

    def test_nobody_else_may_read_it(self, path: Path) -> None:
        kept = os.umask(0)
        try:
            FileMemory(path).save(KEPT)
        finally:
            os.umask(kept)
        assert path.stat().st_mode & 0o777 == 0o600


OWNER = """
import sys
from skinnode.node.memory_file import FileMemory

memory = FileMemory(sys.argv[1])
memory.claim()
print("mine", flush=True)
sys.stdin.read()
"""


class TestOneOwner:
    def test_a_second_one_is_refused_and_damages_nothing(self, path: Path) -> None:
        with FileMemory(path) as first:
            first.save(KEPT)
            second = FileMemory(path)
            with pytest.raises(FileInUse, match=f"in use by process {os.getpid()}"):
                second.save(Kept(KEPT.patch))
            assert second.load() == KEPT
        second.save(Kept(KEPT.patch))  # the first is closed
        with pytest.raises(FileInUse):
            first.claim()

    def test_nothing_is_left_of_a_lock_that_was_released(self, path: Path) -> None:
        with FileMemory(path):
            assert os.listdir(path.parent) == [f".{path.name}.lock"]
        FileMemory(path).claim()  # its end releases it as well
        assert os.listdir(path.parent) == []

    @pytest.mark.long
    def test_an_owner_that_was_killed_is_in_nobodys_way(self, path: Path) -> None:
        with subprocess.Popen(
            [sys.executable, "-c", OWNER, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as owner:
            assert owner.stdout is not None
            assert owner.stdout.readline() == "mine\n"
            with pytest.raises(FileInUse, match=f"in use by process {owner.pid}"):
                FileMemory(path).claim()
            owner.kill()
        leftover = path.with_name(f".{path.name}.0123456789abcdef.new")  # it was saving
        leftover.touch()
        FileMemory(path).save(KEPT)
        assert os.listdir(path.parent) == [path.name]

    @pytest.mark.long
    def test_many_at_once(self, path: Path) -> None:
        """Processes that claim and release as fast as they can: never two owners."""
        script = (
            "import os, sys\nfrom skinnode.node.memory_file import FileMemory\n"
            "memory, mark, had = FileMemory(sys.argv[1]), sys.argv[1] + '.mark', 0\n"
            "for _ in range(2000):\n"
            "    try: memory.claim()\n"
            "    except BlockingIOError: continue\n"
            "    os.close(os.open(mark, os.O_CREAT | os.O_EXCL)); os.unlink(mark)\n"
            "    memory.close(); had += 1\n"
            "print(had)\n"
        )
        crowd = [
            subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True)
            for _ in range(3)
        ]
        had = [int(process.communicate(timeout=60)[0]) for process in crowd]
        assert [process.returncode for process in crowd] == [0, 0, 0]
        assert min(had) > 0


WRITER = """
import os, sys
from skinnode.node.memory import Kept, Parameters
from skinnode.node.memory_file import FileMemory

def configuration(i):
    group = Parameters(i % 127 + 1, {(0x2000 + j, i % 255): i.to_bytes(4, "little") for j in range(i % 50)})
    return Kept("p", i % 127 + 1, None, group, group, ((float(i),) * 30,) * (i % 10 + 1))

memory = FileMemory(sys.argv[1])
for line in sys.stdin:
    pid, i = os.fork(), int(line)
    if pid == 0:
        while True:
            memory.save(configuration(i))
            i += 1
    print(pid, flush=True)
    os.waitpid(pid, 0)
    print("over", flush=True)
"""


@pytest.mark.long
@pytest.mark.real_time
def test_killed_at_any_moment(path: Path) -> None:
    """Processes that do nothing but save are killed. What is left is one of their configurations."""
    names: dict[str, Any] = {}
    exec(WRITER.partition("memory =")[0], names)
    configuration = names["configuration"]
    FileMemory(path).save(configuration(0))
    wait = random.Random(1)
    seen = set()
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as nursery:
        assert nursery.stdin is not None
        assert nursery.stdout is not None
        for turn in range(1000):
            if turn >= 50 and len(seen) > 25:
                break
            print(1000 * turn, file=nursery.stdin, flush=True)
            pid = int(nursery.stdout.readline())
            time.sleep(wait.uniform(0.0, 0.05))
            os.kill(pid, signal.SIGKILL)
            assert nursery.stdout.readline() == "over\n"
            kept = FileMemory(path).load()
            assert kept is not None
            number = int(kept.baseline_ohm[0][0])
            assert kept == configuration(number)
            seen.add(number)
            left = set(os.listdir(path.parent)) - {path.name, f".{path.name}.lock"}
            assert len(left) <= 1  # the next owner removes it
        nursery.stdin.close()
    assert len(seen) > 25  # they did save
    FileMemory(path).save(KEPT)
    assert FileMemory(path).load() == KEPT
    assert not [name for name in os.listdir(path.parent) if name.startswith(".")]
