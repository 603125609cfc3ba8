"""Units of work. A unit can run in any process that has access to the recordings and the work folder."""

from __future__ import annotations

import hashlib
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from skinnode.config import HandConfig
from skinnode.errors import SkinError
from skinnode.resolve.identity import difference, identity
from skinnode.resolve.part_files import PartFiles
from skinnode.resolve.patch_solver import PatchFields, SolveSummary
from skinnode.resolve.recording import Recording
from skinnode.resolve.result_file import new_result
from skinnode.resolve.scan_capture import Capture, CaptureSummary


@dataclass(frozen=True)
class Unit:
    """Piece of work that results in one part file.

    Attributes:
        recording: The recording.
        hand: The hand with all settings that affect the result.
    """

    recording: Recording
    hand: HandConfig

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys of the units whose results this unit reads."""
        return ()

    @cached_property
    def key(self) -> str:
        """Hash of everything that determines the result, including the software and the hand's files.

        After a software update or a file change, an interrupted run therefore does not reuse outdated parts.
        """
        content = [type(self).__name__, repr(self.recording), self.hand.model_dump_json()]
        content += [repr(sorted(_own_identity().items())), *_hashes_of_files(self.hand)]
        return hashlib.sha256("\n".join([*content, *self.details]).encode()).hexdigest()[:24]

    @property
    def details(self) -> tuple[str, ...]:
        """Additional strings that distinguish this unit from others of its kind."""
        return ()

    def __str__(self) -> str:
        return self.recording.path.name

    def finished(self, parts: PartFiles) -> bool:
        """Return whether the result exists."""
        return self.key in parts

    def run(self, parts: PartFiles) -> None:
        """Compute the result and write its part file. Raises SkinError if the result cannot be computed."""
        raise NotImplementedError


@dataclass(frozen=True)
class CaptureScans(Unit):
    """Unit that assembles the scans of some buses.

    Its part contains the summary; the scans of each patch have a part of their own.

    Attributes:
        buses: Names of the buses.
    """

    buses: tuple[str, ...]

    @property
    def details(self) -> tuple[str, ...]:
        """Names of the buses."""
        return self.buses

    def run(self, parts: PartFiles) -> None:
        """Capture the scans."""
        capture = Capture(self.recording, self.hand, self.buses)
        with ExitStack() as stack:
            writers = {
                patch.name: stack.enter_context(parts.new(self.key_of_patch(patch.name)))
                for patch in self.hand.patches
                if patch.bus in self.buses
            }
            for item in capture:
                writers[item.patch].add(item)
        with parts.new(self.key) as part:
            part.summary = capture.summary()

    def key_of_patch(self, patch: str) -> str:
        """Return the key of the part that contains a patch's scans."""
        return f"{self.key}-{[each.name for each in self.hand.patches].index(patch)}"


@dataclass(frozen=True)
class SolvePatch(Unit):
    """Unit that solves the scans of a patch.

    Attributes:
        patch: Name of the patch.
        capture: Unit that captures the scans.
    """

    patch: str
    capture: CaptureScans

    @property
    def needs(self) -> tuple[str, ...]:
        """Key of the unit that captures the scans."""
        return (self.capture.key,)

    @property
    def details(self) -> tuple[str, ...]:
        """Name of the patch."""
        return (self.patch,)

    def __str__(self) -> str:
        return f"{self.recording.path.name}, patch {self.patch}"

    def run(self, parts: PartFiles) -> None:
        """Solve the scans."""
        captured = parts.items(self.capture.key_of_patch(self.patch))
        fields = PatchFields(self.hand, self.patch, captured)
        with parts.new(self.key) as part:
            for item in fields:
                part.add(item)
            part.summary = fields.summary()


@dataclass(frozen=True, slots=True)
class ResultSummary:
    """Result of a job, apart from its file."""

    sums: SolveSummary
    """Sums over the fields of all patches."""
    faults: tuple[str, ...]
    """Messages about missing or unreadable parts of the recording, and about lost frames and scans."""
    notes: tuple[str, ...]
    """Assumptions made because there is no journal."""


@dataclass(frozen=True)
class WriteResult(Unit):
    """Unit that writes the fields of all patches to a file; its part contains only a :class:`ResultSummary`.

    Attributes:
        target: The file.
        captured: Keys of the units that capture the scans.
        solved: Keys of the units that solve the patches.
    """

    target: Path
    captured: tuple[str, ...]
    solved: tuple[str, ...]

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys of the units that capture and solve the scans."""
        return (*self.captured, *self.solved)

    @property
    def details(self) -> tuple[str, ...]:
        """The file, and the keys of the solved patches."""
        return (str(self.target), *self.solved)

    def finished(self, parts: PartFiles) -> bool:
        """Return whether both the part and the file exist."""
        return super().finished(parts) and self.target.exists()

    def run(self, parts: PartFiles) -> None:
        """Write the part, then the file.

        This order ensures that a file without a part was not written by this unit, even if the process was
        killed.
        """
        with (
            new_result(self.recording, self.hand, self.solved, self.target, parts),
            parts.new(self.key) as part,
        ):
            part.summary = self._summary(parts)

    def _summary(self, parts: PartFiles) -> ResultSummary:
        sums: SolveSummary = sum((parts.summary(key) for key in self.solved), SolveSummary())
        captures: list[CaptureSummary] = [parts.summary(key) for key in self.captured]
        flaws = dict.fromkeys(text for each in captures for text in each.flaws)  # each reads all frames
        losses = [text for each in captures for text in each.losses]
        notes = dict.fromkeys(text for each in captures for text in each.notes)
        return ResultSummary(sums, (*flaws, *losses), tuple(notes))


def run_unit(unit: Unit, folder: str, expected: dict[str, str], worker: str) -> str:
    """Run a unit, unless its result exists; return its key.

    Args:
        unit: The unit.
        folder: The work folder.
        expected: Identity of the process that made the plan.
        worker: Name of this worker, for error messages.

    Raises:
        SkinError: This process has different software, cannot access the work folder or finds different
            files, or the unit fails.
    """
    found = difference(expected, _own_identity())
    if found is not None:
        raise refused(worker, found)
    if not Path(folder).is_dir():
        raise SkinError(
            f"worker {worker}: cannot see the folder {folder}; use a folder that all workers share"
        )
    parts = PartFiles(Path(folder))
    fresh = replace(unit)  # computes its key in this process, from the files available here
    if fresh.key != unit.key:
        raise SkinError(
            "a file that the hand names is not the file that the command started with; run the command "
            "again, or make the file available to all workers under this path"
        )
    if not unit.finished(parts):
        unit.run(parts)
    return unit.key


def refused(worker: str, found: str) -> SkinError:
    """Return the error for a worker with different software."""
    return SkinError(
        f"worker {worker}: refused, because it has {found}, and its results could differ; "
        "install the same version there, or end that worker"
    )


def _hashes_of_files(hand: HandConfig) -> list[str]:
    """Return the hash of each file that is named in the hand and affects the result.

    Raises:
        SkinError: A file cannot be read.
    """
    named = [
        path for patch in hand.patches for path in (patch.layout.file, patch.baseline) if path is not None
    ]
    try:
        return [hashlib.sha256(path.read_bytes()).hexdigest() for path in named]
    except OSError as error:
        raise SkinError(f"{error.filename}: cannot be read ({error.strerror})") from None


_identity: dict[str, Any] = {}


def _own_identity() -> dict[str, str]:
    """Return this process's identity as it was when the first unit ran."""
    if not _identity:
        _identity.update(identity())
    return _identity
