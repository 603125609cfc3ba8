"""Describes the software of a process. Only processes with the same software compute bit-identical results.

This module imports nothing from skinnode at module level, because the Dask client sends it to workers by
value.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import importlib.util
from pathlib import Path

PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "pydantic", "python-can")
"""Packages, besides skinnode, on which the results depend."""


def identity() -> dict[str, str]:
    """Return the versions of skinnode and its packages and the hash of skinnode's source code.

    Returns:
        Versions and hash by name; ``none`` for a missing package.
    """
    found = {"skinnode": _version("skinnode"), "source code": _hash_of_source()}
    return found | {name: _version(name) for name in PACKAGES}


def difference(ours: dict[str, str], theirs: dict[str, str]) -> str | None:
    """Return the first difference between two identities as text, or None if they are equal."""
    for name, version in ours.items():
        if theirs.get(name) != version:
            return f"{name} {theirs.get(name, 'none')} instead of {version}"
    return None


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def _hash_of_source() -> str:
    found = importlib.util.find_spec("skinnode")
    if found is None or found.origin is None:
        return "none"
    folder, digest = Path(found.origin).parent, hashlib.sha256()
    for file in sorted(folder.rglob("*.py")):
        digest.update(f"{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return digest.hexdigest()[:12]
