"""Fenced blocks of a page, and terminals that run them as a reader would.

The title of a block tells reader and test how it runs:

==============================  ============================================================================
none                            runs line by line; a Python block must print something
``terminal N``                  runs in that terminal, after Ctrl-C to the program that runs there
``prints``                      text: the block before printed each of these lines, apart from the numbers
``prints, to the digit``        the same with the numbers
``NAME.py``, ``NAME.toml`` …    is written into that file
``in CI on vcan0``              runs if the kernel has vcan0
``run by .ci/run``              .ci/run has the same line
``not run in CI: WHY``          does not run
==============================  ============================================================================

A line that ends in ``# exit status N`` must exit with N, any other line with 0.
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

LANGUAGES = ("python", "sh", "toml", "text", "c")
NOT_RUN = "not run in CI: "
BY_CI, ON_VCAN = "run by .ci/run", "in CI on vcan0"
PRINTS, PRINTS_EXACTLY = "prints", "prints, to the digit"

_FENCE = re.compile(r'^ *```(\w*)(?: title="([^"]*)")?\n(.*?)^ *```$', flags=re.MULTILINE | re.DOTALL)
_READY = "press Ctrl-C to stop"
"""Printed by a program that runs until Ctrl-C, once it is ready."""
_LONGEST_S = 60.0
"""Maximum time of a command. Kernels are compiled before."""


@dataclass(frozen=True)
class Block:
    """One block of a page."""

    language: str
    title: str
    code: str

    @property
    def file(self) -> str | None:
        """Name of the file to write, or None."""
        return self.title if re.fullmatch(r"[\w-]+\.\w+", self.title) else None

    def lines(self) -> Iterator[tuple[str, int]]:
        """Iterate over the commands, each with its expected exit status."""
        for line in self.code.replace("\\\n", " ").splitlines():
            command, _, comment = line.partition("  # ")
            expected = re.match(r"exit status (\d)", comment)
            if command.strip():
                yield command, int(expected[1]) if expected else 0


def blocks_of(page: Path) -> list[Block]:
    return [Block(*found) for found in _FENCE.findall(page.read_text(encoding="utf-8"))]


class Terminal:
    """Runs commands one after the other in ``folder``."""

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder, self._environment = folder, environment
        self._program: subprocess.Popen[str] | None = None
        self._reader = threading.Thread()
        self._command, self._status, self._before = "", 0, 0
        self.output: list[str] = []
        """Lines printed since the list was last cleared."""

    def run(self, command: str, status: int) -> None:
        """Run a command to its end, or until a program that runs until Ctrl-C is ready."""
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
        """Wait until the program is ready; False if it ended by itself or the time is over."""
        end_s = time.monotonic() + _LONGEST_S
        while self._reader.is_alive() and time.monotonic() < end_s:
            if any(_READY in line for line in self.output[self._before :]):
                return True
            time.sleep(0.02)
        return False

    def wait_for(self, shape: str, *, exactly: bool) -> None:
        """Wait for a line that contains ``shape``, with any numbers unless ``exactly``."""
        pattern, end_s = _pattern(shape, exactly=exactly), time.monotonic() + _LONGEST_S
        while True:
            over = not self._reader.is_alive() or time.monotonic() > end_s
            if any(pattern.search(line) for line in list(self.output)):
                return
            assert not over, f"{self._command}\nprinted no line like\n{shape}\nbut\n{''.join(self.output)}"
            time.sleep(0.02)

    def end(self) -> None:
        """Send Ctrl-C, if a program runs."""
        if self._program is not None:
            os.killpg(self._program.pid, signal.SIGINT)
            self._finish()

    def kill(self) -> None:
        """Kill the program, if one runs, after the page failed."""
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
    """Compile ``shape``: any spaces, any numbers unless ``exactly``; an ellipsis matches anything."""
    made = ""
    for part in re.split(rf"({_NUMBER}|\s+|…)", shape.strip()):
        if part == "…":
            made += ".*"
        elif part.isspace():
            made += r"\s+"
        else:
            made += _NUMBER if re.match(_NUMBER, part) and not exactly else re.escape(part)
    return re.compile(made)
