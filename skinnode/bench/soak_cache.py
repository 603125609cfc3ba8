"""Prepares a damaged copy of the kernel cache for a soak test."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

CACHE_ENVIRONMENT: Final = "SKINNODE_CACHE_DIR"
_DAMAGED: Final = 4
"""Number of cache files to damage. The number is small, because recompiling a kernel can take a few
seconds."""
_COMPILE_S: Final = 600.0
"""Time limit for compiling all kernels on a slow machine, in s."""


def fill(folder: Path) -> None:
    """Fill a kernel cache in ``folder`` with all kernels used by a soak test.

    The kernels are copied from the user's cache or, if that cache is empty, compiled in a child process. The
    user's cache is never modified.

    Raises:
        subprocess.SubprocessError: if the child process fails.
    """
    from skinnode.compiled.jit import cache_dir, is_cold

    users = cache_dir()
    if users is not None and not is_cold():
        shutil.copytree(users, folder / "skinnode" / users.name)
        return
    code = "from skinnode.bench.soak import warm_up; warm_up()"
    command = [sys.executable, "-c", code]
    subprocess.run(command, env=environment(folder), check=True, timeout=_COMPILE_S)


def environment(folder: Path) -> dict[str, str]:
    """Return a copy of the environment variables, modified to select the kernel cache in ``folder``."""
    return {**os.environ, CACHE_ENVIRONMENT: str(folder)}


def damage(folder: Path, seed: int) -> list[str]:
    """Damage random cache files in ``folder``, alternately by truncating and overwriting them.

    The choice depends only on the seed and the contents of the folder. Returns one line of text per damaged
    file.
    """
    chance = random.Random(seed)
    files = sorted(file for file in folder.rglob("*.nb[ci]") if file.stat().st_size > 1)
    lines = []
    for i, file in enumerate(chance.sample(files, min(_DAMAGED, len(files)))):
        data = file.read_bytes()
        if i % 2:
            file.write_bytes(chance.randbytes(len(data)))
            lines.append(f"{file.name} filled with random bytes")
        else:
            file.write_bytes(data[: len(data) // 2])
            lines.append(f"{file.name} cut in half")
    return lines
