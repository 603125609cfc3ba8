"""The fenced blocks of a page, and terminals that run them as a reader would.

The title of a block says how it runs, to reader and test alike:

==============================  ============================================================================
none                            runs, a line after the other; Python of its own must print something
``terminal N``                  runs in that terminal; what still runs there is ended with Ctrl-C first
``prints``                      text: each of its lines, but for the numbers, was printed by the block before
``prints, to the digit``        the same with the numbers
``NAME.py``, ``NAME.toml`` …    is written into that file
``in CI on vcan0``              runs where the kernel has vcan0
``run by .ci/run``              .ci/run has the same line
``not run in CI: WHY``          does not run
==============================  ============================================================================

A line ending in ``# exit status N`` must end with N, any other with 0.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
DOCS = REPOSITORY / "docs"
PAGES = sorted(DOCS.glob("*.md"))

LANGUAGES = ("python", "sh", "toml", "text")
NOT_RUN = "not run in CI: "
BY_CI, ON_VCAN = "run by .ci/run", "in CI on vcan0"
PRINTS, PRINTS_EXACTLY = "prints", "prints, to the digit"

_FENCE = re.compile(r'^ *```(\w*)(?: title="([^"]*)")?\n(.*?)^ *```$', flags=re.MULTILINE | re.DOTALL)
_READY = "Ctrl-C ends"
"""What a program that runs until told to says when it is ready."""
_LONGEST_S = 60.0
"""That a command may take; compiling comes before."""


@dataclass(frozen=True)
class Block:
    """One block of a page."""

    language: str
    title: str
    code: str

    @property
    def file(self) -> str | None:
        """The file that it is, if it is one."""
        return self.title if re.fullmatch(r"[\w-]+\.\w+", self.title) else None

    def lines(self) -> Iterator[tuple[str, int]]:
        """Commands, and the exit status each must end with."""
        for line in self.code.replace("\\\n", " ").splitlines():
            command, _, comment = line.partition("  # ")
            told = re.match(r"exit status (\d)", comment)
            if command.strip():
                yield command, int(told[1]) if told else 0


def blocks_of(page: Path) -> list[Block]:
    return [Block(*found) for found in _FENCE.findall(page.read_text(encoding="utf-8"))]


class Terminal:
    """Runs one command after the other in ``folder``."""

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder, self._environment = folder, environment
        self._program: subprocess.Popen[str] | None = None
        self._reader = threading.Thread()
        self._command, self._status, self._before = "", 0, 0
        self.output: list[str] = []
        """Lines printed since it was last emptied."""

    def run(self, command: str, status: int) -> None:
        """To its end; a program that runs until told to is started, and seen to be ready."""
        self.end()
        self._command, self._status, self._before = command, status, len(self.output)
        self._program = subprocess.Popen(
            ["bash", "-c", command],
            cwd=self._folder,
            env=dict(self._environment),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, args=(self._program,))
        self._reader.start()
        if "--seconds" in command or not self._ready():
            self._finish()

    def _ready(self) -> bool:
        """False when the program has ended by itself, or does not within the longest time."""
        end_s = time.monotonic() + _LONGEST_S
        while self._reader.is_alive() and time.monotonic() < end_s:
            if any(_READY in line for line in self.output[self._before :]):
                return True
            time.sleep(0.02)
        return False

    def wait_for(self, shape: str, *, exactly: bool) -> None:
        """Until a line was printed that has ``shape`` in it, but for the numbers unless ``exactly``."""
        pattern, end_s = _pattern(shape, exactly=exactly), time.monotonic() + _LONGEST_S
        while True:
            over = not self._reader.is_alive() or time.monotonic() > end_s
            if any(pattern.search(line) for line in list(self.output)):
                return
            assert not over, f"{self._command}\nprinted no line like\n{shape}\nbut\n{''.join(self.output)}"
            time.sleep(0.02)

    def end(self) -> None:
        """Ctrl-C, if something runs."""
        if self._program is not None:
            os.killpg(self._program.pid, signal.SIGINT)
            self._finish()

    def kill(self) -> None:
        """The page failed: whatever runs must not be left behind."""
        if self._program is not None:
            os.killpg(self._program.pid, signal.SIGKILL)
            self._program.wait(_LONGEST_S)
            self._reader.join()

    def _read(self, program: subprocess.Popen[str]) -> None:
        assert program.stdout is not None
        with program.stdout as lines:
            for line in lines:
                self.output.append(line)

    def _finish(self) -> None:
        assert self._program is not None
        status = self._program.wait(_LONGEST_S)
        self._program = None
        self._reader.join()
        assert status == self._status, f"{self._command}: exit status {status}\n{''.join(self.output)}"


_NUMBER = r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?"


def _pattern(shape: str, *, exactly: bool) -> re.Pattern[str]:
    """``shape`` with any spaces, and any numbers unless ``exactly``; an ellipsis stands for anything."""
    made = ""
    for part in re.split(rf"({_NUMBER}|\s+|…)", shape.strip()):
        if part == "…":
            made += ".*"
        elif part.isspace():
            made += r"\s+"
        else:
            made += _NUMBER if re.match(_NUMBER, part) and not exactly else re.escape(part)
    return re.compile(made)
