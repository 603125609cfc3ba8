"""Compare the benchmark times of two commits: ``python -m tools.compare.speed OLD [NEW]``.

NEW defaults to the working tree. Each round runs the benchmark once per commit. The commits take turns
running first, so that changes in machine speed affect both equally. For each benchmark row, the report lists
the shortest time of each commit and the ratio of these times. The times of NumPy and LAPACK do not depend on
the commit, so their ratios show the machine's timing noise.

The exit status is 1 if the ratio of new to old time exceeds ``--limit`` in any row, otherwise 0.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tools.compare.__main__ import tree_of


def rows_of(report: Any) -> dict[str, float]:
    """Return all times in a benchmark's JSON report, keyed by row and kind of time."""
    found: dict[str, float] = {}

    def collect(part: Any, label: str) -> None:
        if isinstance(part, dict):
            own = " ".join(str(value) for value in part.values() if isinstance(value, str))
            for key, value in part.items():
                is_time = key.split("_")[-1] in ("us", "ms", "µs")
                if is_time and isinstance(value, (int, float)):
                    found[f"{own or label} {key}"] = float(value)
                elif is_time and isinstance(value, dict):  # a distribution: p50, p99, max
                    for name, quantile in value.items():
                        found[f"{own or label} {key} {name}"] = float(quantile)
                else:
                    collect(value, f"{label} {key}".strip())
        elif isinstance(part, list):
            for index, each in enumerate(part):
                collect(each, f"{label} {index}")

    collect({key: value for key, value in report.items() if key != "machine"}, "")
    return found


def run(tree: Path, benchmark: str, arguments: list[str], out: Path) -> dict[str, float]:
    """Run ``skinnode bench BENCHMARK`` with the packages in ``tree``, and return the times."""
    code = (
        f"import sys, skinnode; assert skinnode.__file__.startswith({str(tree)!r}), 'another tree'; "
        f"sys.argv = {['skinnode', 'bench', benchmark, '--json', str(out), *arguments]!r}; "
        "from skinnode.cli.main import main; sys.exit(main())"
    )
    environment = os.environ | {"PYTHONPATH": str(tree)}
    out.unlink(missing_ok=True)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tree, env=environment, check=False, stdout=subprocess.DEVNULL)
    if not out.exists():  # status 1 with a report means that a target was missed
        done.check_returncode()
    return rows_of(json.loads(out.read_text()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", metavar="OLD", help="commit, such as HEAD~1 or a tag")
    parser.add_argument("new", metavar="NEW", nargs="?", help="commit; default: the working tree")
    parser.add_argument("--benchmark", default="kernel", help="name of the benchmark; default: kernel")
    parser.add_argument("--rounds", type=int, default=5, help="number of runs per commit; default: 5")
    parser.add_argument(
        "--limit", type=float, default=1.05, help="maximum ratio of new to old time; default: 1.05"
    )
    options, arguments = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        trees = [tree_of(options.old, folder / "old"), tree_of(options.new, folder / "new")]
        for tree in trees:  # this run only fills the cache of compiled kernels
            run(tree, options.benchmark, arguments, folder / "out.json")
        best: list[dict[str, float]] = [{}, {}]
        for turn in range(options.rounds):
            for which in (0, 1) if turn % 2 == 0 else (1, 0):
                for name, value in run(
                    trees[which], options.benchmark, arguments, folder / "out.json"
                ).items():
                    best[which][name] = min(value, best[which].get(name, value))
    fine = True
    print(f"{'':60} {'old':>9} {'new':>9}   ratio")
    for name, old in best[0].items():
        new = best[1].get(name)
        if new is None:
            print(f"{name:60} {old:9.1f}   missing")
            fine = False
            continue
        slow = new > options.limit * old
        fine = fine and not slow
        ratio = new / old if old else 1.0
        print(f"{name:60} {old:9.1f} {new:9.1f}   {ratio:.3f}{'  slower' if slow else ''}")
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
