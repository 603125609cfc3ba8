"""Compare the results of two commits bit by bit: ``python -m tools.compare OLD [NEW]``.

NEW defaults to the working tree. The old commit generates the inputs: recordings of simulated hands, and
streams of resistances for five layouts and two noise levels, with and without faults. Both commits process
these inputs. The results are the forward model, the fields of every tracker method and path operator, the
replayed recordings, and generated files such as EDS files.

The results are divided into parts. For each part, the report lists the hash of each commit's results, and the
largest relative difference in each array that differs.

The exit status is 0 if float arrays agree to within ``--rtol`` (by default, exactly) and all other arrays are
equal; otherwise, it is 1.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

ROOT: Final = Path(__file__).resolve().parents[2]
HERE: Final = Path(__file__).parent


def tree_of(commit: str | None, folder: Path) -> Path:
    """Return ``folder`` with ``commit`` extracted to it, or the working tree if ``commit`` is None."""
    if commit is None:
        return ROOT
    folder.mkdir()
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True).stdout
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive, check=True)
    return folder


def run_in(tree: Path, script: str, *arguments: str) -> None:
    """Run a script from this folder with the packages in ``tree``."""
    code = (
        f"import runpy, sys, skinnode; assert skinnode.__file__.startswith({str(tree)!r}), 'another tree'; "
        f"sys.argv = {[script, *arguments]!r}; runpy.run_path({str(HERE / script)!r}, run_name='__main__')"
    )
    environment = os.environ | {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", code], cwd=tree, env=environment, check=True)


def relative_difference(old: Any, new: Any) -> float:
    """Return the largest difference between two arrays, relative to the largest finite value of ``old``.

    The result is inf if the arrays do not contain floats or differ in shape, type or non-finite values.
    """
    if old.shape != new.shape or old.dtype != new.dtype or old.dtype.kind != "f":
        return np.inf
    finite = np.isfinite(old)
    if not np.array_equal(old[~finite], new[~finite], equal_nan=True) or not np.isfinite(new[finite]).all():
        return np.inf
    scale = float(np.abs(old[finite]).max(initial=0.0))
    difference = float(np.abs(old[finite] - new[finite]).max(initial=0.0))
    return difference / scale if scale else np.inf


def report(old: Any, new: Any, rtol: float) -> Iterable[tuple[str, bool]]:
    """Yield each line of the report, and whether the difference in that line is within ``rtol``."""
    names = dict.fromkeys([*old.files, *new.files])
    for part in dict.fromkeys(name.partition(":")[0] for name in names):
        mine = [name for name in names if name.startswith(f"{part}:")]
        hashes, differ = [], []
        for which in (old, new):
            digest = hashlib.sha256()
            for name in mine:
                if name in which.files:
                    array = which[name]
                    digest.update(f"{name}{array.shape}{array.dtype}".encode())
                    digest.update(np.ascontiguousarray(array).tobytes())
            hashes.append(digest.hexdigest()[:16])
        for name in mine:
            if name not in old.files or name not in new.files:
                differ.append((name, np.inf))
            elif old[name].tobytes() != new[name].tobytes() or old[name].dtype != new[name].dtype:
                differ.append((name, relative_difference(old[name], new[name])))
        verdict = "equal" if not differ else f"{len(differ)} differ"
        yield f"{part:12} {len(mine):5} arrays  {hashes[0]}  {hashes[1]}  {verdict}", not differ or rtol > 0
        for name, size in sorted(differ, key=lambda pair: -pair[1]):
            yield f"  {size:9.2e}  {name}", size <= rtol


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", metavar="OLD", help="commit, such as HEAD~1 or a tag")
    parser.add_argument("new", metavar="NEW", nargs="?", help="commit; default: the working tree")
    parser.add_argument(
        "--rtol", type=float, default=0.0, help="maximum relative difference between floats; default: 0"
    )
    parser.add_argument(
        "--part", action="append", default=[], help="part of the results to compare; default: all"
    )
    parser.add_argument(
        "--folder",
        type=Path,
        help="folder in which source trees, inputs and outputs are stored for reuse",
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder: Path = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        kept = {path.name for path in folder.iterdir()}
        old = folder / "old" if "old" in kept else tree_of(options.old, folder / "old")
        new = tree_of(options.new, Path(temporary) / "new")
        inputs = folder / "inputs"
        if "inputs" not in kept:
            inputs.mkdir()
            run_in(old, "inputs.py", str(inputs))
        found = []
        for name, tree in (("old", old), ("new", new)):
            out = folder / f"{name}.npz"
            if name == "new" or out.name not in kept:
                run_in(tree, "outputs.py", str(inputs), str(out), *options.part)
            found.append(np.load(out))
        fine = True
        for line, allowed in report(*found, options.rtol):
            print(line)
            fine = fine and allowed
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
