"""Lock files that contain their owner's process ID and never become stale."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_TRIES: Final = 100
"""Maximum number of attempts to lock a file. An attempt fails if the previous owner removes the file during
the attempt.
"""


class FileInUse(BlockingIOError):
    """Raised if the lock is held; ``process`` is the owner's process ID, or None if unknown."""

    def __init__(self, path: Path, process: int | None) -> None:
        self.process = process
        who = "another process" if process is None else f"process {process}"
        super().__init__(errno.EWOULDBLOCK, f"in use by {who}", str(path))


class NotARegularFile(OSError):
    """Raised if a lock file's path is a symbolic link, a folder, a pipe or a device."""

    def __init__(self, path: Path, what: str) -> None:
        allowed = "allowed: a regular file, or a name that does not exist"
        super().__init__(errno.EINVAL, f"its lock file {path.name} {what}; {allowed}", str(path))


@dataclass(frozen=True, slots=True)
class FileLock:
    """Lock that this process holds.

    The kernel releases the lock when the process exits, even if the process is killed.
    """

    path: Path
    descriptor: int
    process: int

    def release(self) -> None:
        """Release the lock, and remove the file if this process created the lock. Call it only once.

        The lock persists while a forked child that inherited it is running.
        """
        if self.process == os.getpid():
            with contextlib.suppress(OSError):
                self.path.unlink()
        os.close(self.descriptor)


def lock_file(path: Path) -> FileLock:
    """Create the file ``path`` if necessary, lock it, and write this process's ID into it.

    Returns:
        The lock; the caller must release it.

    Raises:
        FileInUse: The lock is already held, by this or by another process.
        NotARegularFile: ``path`` exists and is not a regular file.
        OSError: The lock file cannot be created.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY
    for _ in range(_TRIES):
        try:
            descriptor = os.open(path, flags, 0o600)
        except OSError as error:
            if path.is_symlink():
                raise NotARegularFile(path, "is a symbolic link, which is not followed") from error
            if path.exists() and not path.is_file():
                raise NotARegularFile(path, "is not a regular file") from error
            raise
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise NotARegularFile(path, "is not a regular file")
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(path, descriptor):
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, b"%d\n" % os.getpid(), 0)
                return FileLock(path, descriptor, os.getpid())
        except BlockingIOError:
            process = _owner(descriptor)
            os.close(descriptor)
            raise FileInUse(path, process) from None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # the previous owner has removed this file: try again
    raise FileInUse(path, None)


def _is_at(path: Path, descriptor: int) -> bool:
    """Return whether ``path`` still refers to the open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False


def _owner(descriptor: int) -> int | None:
    text = os.pread(descriptor, 20, 0).strip()
    return int(text) if text.isdigit() else None
