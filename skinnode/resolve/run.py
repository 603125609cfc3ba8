"""Runs the jobs of a plan and continues where an earlier run stopped."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from skinnode.errors import ConfigError
from skinnode.files.file_lock import FileInUse, lock_file
from skinnode.resolve.part_files import PartFiles
from skinnode.resolve.plan import Job
from skinnode.resolve.units import ResultSummary, Unit
from skinnode.resolve.workers import Workers

WORK_FOLDER: Final = ".skinnode-resolve"
_LOOK_S: Final = 0.5


@contextmanager
def work_folder(output: Path) -> Iterator[Path]:
    """Create and lock the work folder in ``output``; delete it when the block ends without an error.

    Args:
        output: Folder for the results, created if needed.

    Raises:
        ConfigError: The folder cannot be created, or another command is using it.
    """
    folder = output.absolute() / WORK_FOLDER
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = lock_file(folder / "lock")
    except FileInUse as error:
        allowed = f"a folder that no other skinnode resolve is using ({error})"
        raise ConfigError("--output", str(output), allowed) from None
    except OSError as error:
        allowed = f"a writable folder ({error.strerror})"
        raise ConfigError("--output", str(output), allowed) from None
    try:
        yield folder
        shutil.rmtree(folder)
    finally:
        with suppress(OSError):
            lock.release()
        for empty in (folder, output):  # nothing has been done
            with suppress(OSError):
                empty.rmdir()


def run(
    jobs: Sequence[Job], workers: Workers, parts: PartFiles, tell: Callable[[int, int, str], None]
) -> list[ResultSummary]:
    """Run all jobs and return their summaries, in the same order.

    Args:
        jobs: The jobs.
        workers: Workers that run the units.
        parts: Part files.
        tell: Function called with the number of finished units, the total number of units and the newest
            finished unit.

    Raises:
        ConfigError: A result exists that this plan did not write.
        SkinError: A unit or all workers failed. Finished units are kept for the next run.
    """
    _require_new(jobs, parts)
    left: dict[str, Unit] = {unit.key: unit for job in jobs for unit in job.units(parts)}
    total, submitted = len(left), set[str]()
    tell(0, total, "")

    def submit_ready() -> None:
        for key, unit in left.items():
            if key not in submitted and not any(need in left for need in unit.needs):
                submitted.add(key)
                workers.submit(unit)

    submit_ready()
    of_write = {job.write.key: job for job in jobs}
    while left:
        for key in workers.finished(_LOOK_S):
            unit = left.pop(key)
            tell(total - len(left), total, str(unit))
            if key in of_write:
                for solve in of_write[key].solves:
                    parts.remove(solve.key)
        submit_ready()
    return [parts.summary(job.write.key) for job in jobs]


def _require_new(jobs: Sequence[Job], parts: PartFiles) -> None:
    for job in jobs:
        target = job.write.target
        if target.exists() and not job.write.finished(parts):
            allowed = "a new file; this one already exists and is not overwritten"
            raise ConfigError("--output", str(target), allowed)
