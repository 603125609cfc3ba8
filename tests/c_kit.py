"""The C99 kit as a program: compiled for a patch under sanitizers, fed with commands, read back.

``tests/c_driver.c`` says what its commands are. Programs are kept in pytest's cache folder, under a name that
contains a digest of all that a compiler reads: to compile them takes more CPU time than to run them.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray

from skinnode.model.layout import PatchLayout
from skinnode.protocol.c_kit import kit_files
from skinnode.protocol.profile import PatchProfile

REQUIRE_COMPILERS: Final = "SKINNODE_REQUIRE_COMPILERS"
COMPILERS: Final = ("gcc", "clang")
DRIVER: Final = Path(__file__).with_name("c_driver.c")
STRICT: Final = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZED: Final = (*STRICT, "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
LEVELS: Final = {"gcc": "-O1", "clang": "-O0"}
"""One program is optimised, and the other is as written; clang needs three times as long for -O1."""

PROGRAMS: Final = Path(__file__).parents[1] / ".pytest_cache" / "d" / "skinnode-c"
"""Folder of the programs; ``pytest --cache-clear`` removes it."""
KEPT_S: Final = 7 * 24 * 3600.0
"""Time after which a program that no test has used is removed."""

NO_SCAN, COMPLETE, TORN, UNCHECKED, MIXED, CORRUPT, JOINED = range(7)
PUBLISHED: Final = (COMPLETE, TORN, UNCHECKED)
_STATS: Final = 21


def require(compiler: str) -> str:
    """The compiler's path. Skips where there is none, or fails if the environment requires compilers."""
    path = shutil.which(compiler)
    if path is None:
        if os.environ.get(REQUIRE_COMPILERS):
            pytest.fail(f"{REQUIRE_COMPILERS} is set, but there is no {compiler}")
        pytest.skip(f"no {compiler} on this machine")
    return path


def available() -> list[str]:
    """Return the compilers of this machine. Skips where there is none."""
    found = [compiler for compiler in COMPILERS if shutil.which(compiler)]
    if os.environ.get(REQUIRE_COMPILERS) or not found:
        return [require(compiler) and compiler for compiler in COMPILERS]
    return found


def write_kit(profile: PatchProfile, folder: Path, layout: PatchLayout | None = None) -> Path:
    """Write the kit's files, and return the source file."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in kit_files(profile, layout).items():
        (folder / name).write_text(text, encoding="ascii")
    return folder / "skinnode_patch.c"


def compile_c(arguments: Sequence[str | Path]) -> None:
    """Run a compiler, and show what it says if it refuses."""
    done = subprocess.run(list(map(str, arguments)), capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr


@functools.cache
def _version(compiler: str) -> str:
    asked = [require(compiler), "--version"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout


@functools.cache
def _program(profile: PatchProfile, compiler: str) -> Path:
    options = (*SANITIZED, LEVELS[compiler])
    read = (_version(compiler), options, sorted(kit_files(profile, None).items()), DRIVER.read_text())
    program = PROGRAMS / f"{compiler}-{hashlib.sha256(repr(read).encode()).hexdigest()[:24]}"
    if program.exists():
        program.touch()
        return program
    PROGRAMS.mkdir(parents=True, exist_ok=True)
    for old in PROGRAMS.glob("*-*"):
        with contextlib.suppress(FileNotFoundError):  # removed by another worker
            if old.stat().st_mtime < time.time() - KEPT_S:
                old.unlink()
    with tempfile.TemporaryDirectory(prefix="new.", dir=PROGRAMS) as folder:
        source, made = write_kit(profile, Path(folder)), Path(folder) / "driver"
        compile_c([require(compiler), *options, "-I", folder, source, DRIVER, "-o", made])
        made.replace(program)
    return program


@dataclass(frozen=True)
class CScan:
    """What the assembler said after a frame: its verdict, its deadline, and the scan, if any."""

    verdict: int
    deadline_us: int | None
    fields: tuple[int, ...] = ()
    """First and last arrival, number, device time, expected, received, counter, flags, has a summary."""
    codes: NDArray[np.uint32] | None = None


class Kit:
    """Processes that run the kit for one patch, one for each compiler.

    Commands are collected, and sent by :meth:`ask`, which returns the reply to all of them. All programs must
    reply the same.
    """

    def __init__(self, profile: PatchProfile, *compilers: str) -> None:
        self.profile = profile
        self._commands = bytearray()
        programs = {compiler: _program(profile, compiler) for compiler in compilers or available()}
        self._processes = {
            compiler: subprocess.Popen(
                [program],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**os.environ, "ASAN_OPTIONS": "detect_leaks=0"},
            )
            for compiler, program in programs.items()
        }

    def close(self) -> None:
        """End the processes; none must have been stopped by a sanitizer."""
        for process in self._processes.values():
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.close()
            process.stdout.close()
        assert {process.wait(20) for process in self._processes.values()} == {0}

    def __enter__(self) -> Kit:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, command: str, form: str = "", *values: int) -> None:
        self._commands += command.encode() + struct.pack("<" + form, *values)

    def ask(self) -> Reply:
        commands, self._commands = bytes(self._commands), bytearray()
        for process in self._processes.values():
            assert process.stdin is not None
            process.stdin.write(struct.pack("<I", len(commands)) + commands)
            process.stdin.flush()
        replies: dict[str, bytes] = {}
        for compiler, process in self._processes.items():
            assert process.stdout is not None
            head = process.stdout.read(4)
            assert len(head) == 4, f"the program of {compiler} was stopped by a sanitizer"
            replies[compiler] = process.stdout.read(int.from_bytes(head, "little"))
        first = next(iter(replies.values()))
        assert all(reply == first for reply in replies.values()), replies
        return Reply(first, self.profile)

    # --- board

    def encode(
        self, resistances: Iterable[int], fraction_bits: int, baselines: Iterable[float]
    ) -> NDArray[np.uint32]:
        """Codes of resistances (ohm / 2^fraction_bits), with R0 in ohm."""
        patterns = np.asarray(list(baselines), np.float32).view(np.uint32).tolist()
        for resistance, pattern in zip(resistances, patterns, strict=True):
            self.add("e", "IBI", resistance, fraction_bits, pattern)
        return self.ask().words()

    def add_scan(
        self,
        codes: NDArray[np.uint32],
        counter: int,
        time_us: int,
        *,
        flags: int = 0,
        refused: int = 0xFFFF,
        stop: int = 0xFFFF,
    ) -> None:
        self.add("S", "BBIHH", counter, flags, time_us & 0xFFFF_FFFF, refused, stop)
        self._commands += codes.astype("<u4").tobytes()

    # --- master

    def add_frame(self, cob_id: int, data: bytes, t_us: int) -> None:
        self.add("C", "IqB", cob_id, t_us, len(data))
        self._commands += data


def kits() -> Iterator[Callable[[PatchProfile], Kit]]:
    """Yield a function that starts the kit of a profile once, and end all of them."""
    compilers = available()
    running: list[Kit] = []

    @functools.cache
    def kit_of(profile: PatchProfile) -> Kit:
        running.append(Kit(profile, *compilers))
        return running[-1]

    yield kit_of
    for kit in running:
        kit.close()


class Reply:
    """Reply of the driver, read from front to back."""

    def __init__(self, data: bytes, profile: PatchProfile) -> None:
        self._data, self._at, self._profile = data, 0, profile

    def take(self, form: str) -> tuple[int, ...]:
        values = struct.unpack_from("<" + form, self._data, self._at)
        self._at += struct.calcsize("<" + form)
        return values

    def words(self) -> NDArray[np.uint32]:
        rest = np.frombuffer(self._data, "<u4", offset=self._at)
        self._at = len(self._data)
        return rest.astype(np.uint32)

    def bytes(self, n: int) -> bytes:
        self._at += n
        return self._data[self._at - n : self._at]

    def scan_sent(self) -> tuple[list[tuple[int, bytes]], bytes]:
        """Frames of a scan (function code, payload), of which the last is the summary, and record 0x2011."""
        self.take("H")
        frames: list[tuple[int, bytes]] = []
        while not frames or frames[-1][0] != 0x280:
            cob_id, length = self.take("IB")
            frames.append((cob_id, self.bytes(length)))
        return frames, self.bytes(12)

    def scan_received(self) -> CScan:
        verdict, is_open, deadline_us = self.take("BBq")
        until = deadline_us if is_open else None
        if verdict not in PUBLISHED:
            return CScan(verdict, until)
        fields = self.take("qqIIHHBBB")
        n = self._profile.n_codes
        codes = np.frombuffer(self.bytes(4 * n), "<u4").astype(np.uint32)
        return CScan(verdict, until, fields, codes.reshape(self._profile.rows, self._profile.columns))

    def stats(self) -> tuple[int, ...]:
        return self.take(f"{_STATS}I")

    @property
    def is_over(self) -> bool:
        return self._at == len(self._data)
