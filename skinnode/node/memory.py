"""What a node remembers over a power cycle, and the file it remembers it in.

A memory keeps one :class:`Kept`, whole: whoever reads it finds what was saved last, or what was saved before
that, never a mixture.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import stat
import weakref
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any, Final, Protocol, Self

from skinnode.canopen.indices import MAX_NODE_ID
from skinnode.canopen.lss import BIT_RATES_BPS, NOT_CONFIGURED
from skinnode.errors import SkinError
from skinnode.files.file_lock import lock_file
from skinnode.files.whole_file import create_beside, discard, discard_leftovers, flush_folder

_FORMAT: Final = "skinnode node memory 1"
_MOST_BYTES: Final = 1 << 24
"""Of a file worth reading: 512 PDOs and the largest baseline take less than a tenth of it."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """One group of parameters (CiA 301 v4.2, 7.5.2.13): those that are not at their defaults."""

    node_id: int = 0
    """The node-ID when they were saved: what COB-IDs that follow it were relative to."""
    values: Mapping[tuple[int, int], bytes] = field(default_factory=dict)
    """Index and sub-index to the value as it travels."""


@dataclass(frozen=True, slots=True)
class Kept:
    """All that survives a power cycle."""

    patch: str = ""
    """Whose: sizes and layout of the patch. Another patch has no use for the rest."""
    node_id: int | None = None
    """Stored by LSS: 1 to 127, or 255 for none at all; None where LSS has stored nothing."""
    bit_rate_bps: int | None = None
    """Stored by LSS."""
    communication: Parameters = Parameters()
    """Objects 0x1000 to 0x1FFF."""
    application: Parameters = Parameters()
    """Objects 0x2000 to 0x9FFF."""
    baseline_ohm: tuple[tuple[float, ...], ...] = ()
    """(U, K) R0 of the last tare, REAL32; empty before the first."""


class Fault(IntEnum):
    """Why a memory, or a part of it, is of no use. The value is told in the emergency message."""

    UNREADABLE = 1
    DAMAGED = 2
    FOREIGN = 3
    """Of another patch, or in another format."""
    REFUSED = 4
    """One parameter that the object dictionary does not allow any more."""
    NOT_SAVED = 5
    """What should have been kept by itself could not be."""


class MemoryFault(SkinError):
    """A memory without a usable content."""

    def __init__(self, fault: Fault, message: str) -> None:
        self.fault = fault
        super().__init__(message)


class Memory(Protocol):
    """Where a node keeps what it must not forget."""

    def load(self) -> Kept | None:
        """What was saved last; None for a memory that was never used. Raises MemoryFault."""

    def save(self, kept: Kept) -> None:
        """Keep ``kept`` instead of what was kept before; on return it is safe. Raises OSError, and then keeps
        what it had."""


class VolatileMemory:
    """Remembers as long as the object lives: the non-volatile memory of a simulated board."""

    def __init__(self) -> None:
        self._kept: Kept | None = None

    def load(self) -> Kept | None:
        """See :class:`Memory`."""
        return self._kept

    def save(self, kept: Kept) -> None:
        """See :class:`Memory`."""
        self._kept = kept


class FileMemory:
    """A human-readable file: JSON with a checksum. Saving waits for the medium, some milliseconds in which
    the node, and any other node driven by its thread, does nothing else.

    A memory owns the file exclusively, from :meth:`claim` or the first :meth:`save` to :meth:`close`, the end
    of a ``with`` block or the end of the object. The claim is a kernel lock on a file beside it, which is
    released when the process ends, even if it is killed.

    The file is replaced atomically (written under a temporary name, flushed to the medium, renamed), so that
    a killed process or a power failure at any moment leaves the old content or the new. It is created
    for its owner alone (mode 0600), and a symbolic link in its place is refused. A file that is
    damaged or belongs to another patch is not overwritten but put aside, under a name that ends in
    ``.unused-`` and a digest of its bytes.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        path = Path(path)
        self.path = Path(os.path.realpath(path.parent)) / path.name
        self._release: Callable[[], object] | None = None

    def claim(self) -> None:
        """Claim the file exclusively. Raises FileInUse if another memory owns it, in this or another process,
        and OSError if it cannot be locked."""
        if self._release is None:
            lock = lock_file(self.path.with_name(f".{self.path.name[:200]}.lock"))
            self._release = weakref.finalize(self, lock.release)
            discard_leftovers(self.path)

    def close(self) -> None:
        """Release the file. A closed memory can be claimed again."""
        release, self._release = self._release, None
        if release is not None:
            release()

    def __enter__(self) -> Self:
        self.claim()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def load(self) -> Kept | None:
        """See :class:`Memory`."""
        try:
            return unpack(self._read())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise MemoryFault(Fault.UNREADABLE, f"{self.path}: {error.strerror}") from error
        except MemoryFault as error:
            raise MemoryFault(error.fault, f"{self.path}: {error}") from None

    def save(self, kept: Kept) -> None:
        """See :class:`Memory`. Raises FileInUse, an OSError, if another memory owns the file."""
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
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK  # opening a pipe must not block
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
    """``kept`` as the text of a file."""
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
    """The content of a file. Raises MemoryFault for anything that :func:`pack` does not write."""
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
        raise MemoryFault(Fault.DAMAGED, "no memory of a node, or a part of one") from error


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
