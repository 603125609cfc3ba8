"""Stores a node's non-volatile memory in a JSON file that has a checksum and is replaced atomically."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import stat
import weakref
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Final, Self

from skinnode.canopen.indices import MAX_NODE_ID
from skinnode.canopen.lss import BIT_RATES_BPS, NOT_CONFIGURED
from skinnode.files.file_lock import lock_file
from skinnode.files.whole_file import create_beside, discard, discard_leftovers, flush_folder
from skinnode.node.memory import Fault, Kept, MemoryFault, Parameters

_FORMAT: Final = "skinnode node memory 1"
_MOST_BYTES: Final = 1 << 24
"""Maximum accepted size of a memory file in bytes; more than ten times the size of the largest valid file."""


class FileMemory:
    """Non-volatile memory of a node in a JSON file.

    **Locking.** :meth:`claim` or the first :meth:`save` locks the file for exclusive access until
    :meth:`close` is called, a ``with`` block ends or the object is deleted. The lock is a kernel lock on a
    separate file in the same folder, which the kernel releases even if the process is killed.

    **Saving** writes a temporary file, flushes it to disk and renames it to the memory file. If the power
    fails or the process is killed, the memory file has either its old or its new contents. Saving takes a few
    milliseconds, during which all nodes on the same thread are blocked.

    Only the owner can read the file (mode 0600). A symbolic link is rejected. A file that is damaged or
    belongs to another patch is not overwritten but renamed: ``.unused-`` and a digest of its contents are
    appended to its name.

    Args:
        path: Path of the file; its folder must exist.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        path = Path(path)
        self.path = Path(os.path.realpath(path.parent)) / path.name
        self._release: Callable[[], object] | None = None

    def claim(self) -> None:
        """Lock the file for exclusive access.

        Raises:
            FileInUse: If this process or another process has locked the file.
            OSError: If the file cannot be locked.
        """
        if self._release is None:
            lock = lock_file(self.path.with_name(f".{self.path.name[:200]}.lock"))
            self._release = weakref.finalize(self, lock.release)
            discard_leftovers(self.path)

    def close(self) -> None:
        """Unlock the file. :meth:`claim` can lock it again."""
        release, self._release = self._release, None
        if release is not None:
            release()

    def __enter__(self) -> Self:
        self.claim()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def load(self) -> Kept | None:
        """Return the contents, or None if the file does not exist.

        Raises:
            MemoryFault: If the file cannot be read, or its contents are not usable.
        """
        try:
            return unpack(self._read())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise MemoryFault(Fault.UNREADABLE, f"{self.path}: {error.strerror}") from error
        except MemoryFault as error:
            raise MemoryFault(error.fault, f"{self.path}: {error}") from None

    def save(self, kept: Kept) -> None:
        """Replace the contents, and return once the new contents are on disk.

        Args:
            kept: New contents.

        Raises:
            FileInUse: If this process or another process has locked the file.
            OSError: If the file cannot be written. The file keeps its old contents.
        """
        self.claim()
        beside = create_beside(self.path, pack(kept), durable=True)
        try:
            self._put_aside(kept.patch)
            os.replace(beside, self.path)
        except BaseException:
            discard(beside)
            raise
        flush_folder(self.path.parent)

    def _read(self) -> bytes:
        # O_NONBLOCK: otherwise, opening a named pipe would block.
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        try:
            descriptor = os.open(self.path, flags)
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise MemoryFault(Fault.UNREADABLE, "a symbolic link, which is not followed") from error
            raise
        with open(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise MemoryFault(Fault.UNREADABLE, "not a file")
            return file.read(_MOST_BYTES)

    def _put_aside(self, patch: str) -> None:
        try:
            data = self._read()
        except FileNotFoundError:
            return
        except MemoryFault as error:
            raise OSError(str(error)) from error
        with contextlib.suppress(MemoryFault):
            if unpack(data).patch == patch:
                return
        digest = hashlib.sha256(data).hexdigest()[:8]
        os.replace(self.path, self.path.with_name(f"{self.path.name}.unused-{digest}"))


def pack(kept: Kept) -> bytes:
    """Return the bytes of a memory file with the given contents."""
    content = {
        "patch": kept.patch,
        "node_id": kept.node_id,
        "bit_rate_bps": kept.bit_rate_bps,
        "communication": _parameters_to_json(kept.communication),
        "application": _parameters_to_json(kept.application),
        "baseline_ohm": [" ".join(map(repr, row)) for row in kept.baseline_ohm],
    }
    document = {"format": _FORMAT, "checksum": _checksum(content), "content": content}
    return (json.dumps(document, indent=1) + "\n").encode("ascii")


def unpack(data: bytes) -> Kept:
    """Return the contents of a memory file.

    Args:
        data: Bytes of the file.

    Raises:
        MemoryFault: If the file is damaged or has a different format.
    """
    try:
        document = json.loads(data)
        if document["format"] != _FORMAT:
            raise MemoryFault(Fault.FOREIGN, f"format: got {document['format']!r}, must be {_FORMAT!r}")
        content = document["content"]
        if document["checksum"] != _checksum(content):
            raise MemoryFault(Fault.DAMAGED, "the checksum is wrong")
        return Kept(
            str(content["patch"]),
            _one_of(content["node_id"], (None, *range(1, MAX_NODE_ID + 1), NOT_CONFIGURED)),
            _one_of(content["bit_rate_bps"], (None, *BIT_RATES_BPS.values())),
            _parameters_from_json(content["communication"]),
            _parameters_from_json(content["application"]),
            tuple(tuple(float(value) for value in row.split()) for row in content["baseline_ohm"]),
        )
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise MemoryFault(Fault.DAMAGED, "not a node's memory, or incomplete") from error


def _checksum(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def _parameters_to_json(group: Parameters) -> dict[str, Any]:
    values = {f"0x{index:04X}:{sub}": value.hex(" ") for (index, sub), value in sorted(group.values.items())}
    return {"node_id": group.node_id, "values": values}


def _parameters_from_json(group: dict[str, Any]) -> Parameters:
    values: dict[tuple[int, int], bytes] = {}
    for name, text in group["values"].items():
        index, subindex = name.split(":")
        values[int(index, 16), int(subindex)] = bytes.fromhex(text)
    return Parameters(_one_of(group["node_id"], range(MAX_NODE_ID + 1)), values)


def _one_of(value: Any, allowed: Collection[int | None]) -> Any:
    if value not in allowed:
        raise ValueError(value)
    return value
