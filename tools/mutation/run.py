"""Run the tests on each selected mutant: ``python -m tools.mutation.run --package protocol``.

Each mutant is applied to a private copy of the repository, on which the test stages of ``stages.toml`` are
run. A mutant is killed if a test fails or if a stage exceeds its time limit. The failure of a real-time test
counts only if the test also fails when it is run alone.

Each verdict is written to ``results.json`` immediately. Later runs skip mutants that have a verdict;
``--again`` tests the surviving mutants again.

Importing the libraries takes longer than most tests, so this process imports them once and forks a child for
each pytest run.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import ctypes
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tools.mutation.draw import GROUPS, ROOT, Mutant, find, read

HERE: Final = Path(__file__).parent
RESULTS: Final = HERE / "results.json"
EQUIVALENT: Final = HERE / "equivalent.toml"

_KERNELS: Final = (
    "compiled/*.py",
    "model/kernels.py",
    "solve/*.py",
    "solve/*/*.py",
    "solve/posterior/local/*.py",
    "solve/posterior/past/*.py",
    "bus_load/stuffing*.py",
)  # as in skinnode.compiled.jit
_MEMORY_BYTES: Final = 8 << 30
_FILE_BYTES: Final = 1 << 30
_TEST_S: Final = 120
"""Time limit for a single test, in s."""
_GRACE_S: Final = 60.0
"""Fixed part of a stage's time limit, in s. The other part is six times the stage's duration on unmutated
code."""
_PR_SET_CHILD_SUBREAPER: Final = 36
_PASSED, _FAILED = 0, 1


@dataclass(frozen=True)
class Outcome:
    """Result of one pytest run."""

    status: int | None
    """Exit status of pytest; None if the run exceeded its time limit."""
    failed: tuple[str, ...]
    """Node IDs of the failed tests."""
    took_s: float


class Tree:
    """Private copy of the repository, and a cache of the kernels compiled from it."""

    def __init__(self, folder: Path) -> None:
        self.source, self.cache, self.warm = folder / "tree", folder / "cache", folder / "warm"
        for each in (self.source, self.cache):
            each.mkdir(parents=True, exist_ok=True)
        self.log = folder / "log"
        self._copy()
        if self.warm.exists() and not (self.warm / "skinnode" / self._leaf()).exists():
            shutil.rmtree(self.warm)  # remove kernels compiled from different source code

    def _copy(self) -> None:
        listed = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard"],
            cwd=ROOT,
            check=True,
            capture_output=True,
            text=True,
        ).stdout.splitlines()
        wanted = {name for name in listed if (ROOT / name).is_file()}
        for path in list(self.source.rglob("*")):
            name = str(path.relative_to(self.source))
            if path.is_file() and name not in wanted and "__pycache__" not in path.parts:
                path.unlink()
        for name in wanted:
            self._restore(name)

    def _restore(self, name: str) -> None:
        here, there = ROOT / name, self.source / name
        if not there.exists() or here.read_bytes() != there.read_bytes():
            there.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(here, there)

    def put(self, mutant: Mutant) -> None:
        """Apply a mutant to the copy, and remove the compiled kernels that it affects.

        numba recompiles the kernels of a file that has changed, but not the kernels of other files that
        depend on it, so this method removes the latter.
        """
        path = self.source / mutant.file
        found = path.stat()
        self._original = path, path.read_text("utf-8"), (found.st_atime_ns, found.st_mtime_ns)
        path.write_text(find(mutant, self._original[1]), "utf-8")
        shutil.rmtree(self.cache, ignore_errors=True)
        if not self.warm.exists():
            self.cache.mkdir()
            return
        shutil.copytree(self.warm, self.cache)
        (old,) = (self.cache / "skinnode").iterdir()
        if not any(path.match(f"skinnode/{pattern}") for pattern in _KERNELS):
            return
        try:
            new = old.with_name(self._leaf())
        except subprocess.CalledProcessError:  # the mutated package cannot be imported
            return
        old.rename(new)
        for stem in self._reached(mutant.file):
            for kept in new.rglob(f"{stem}.*"):
                kept.unlink()

    def _leaf(self) -> str:
        """Return the name of the cache folder for the kernels of the current copy."""
        code = "from skinnode.compiled.jit import cache_dir; print(cache_dir().name)"
        with tempfile.TemporaryDirectory() as folder:
            environment = os.environ | {"PYTHONPATH": str(self.source), "SKINNODE_CACHE_DIR": folder}
            command = [sys.executable, "-c", code]
            return subprocess.run(
                command, cwd=self.source, env=environment, check=True, capture_output=True, text=True
            ).stdout.strip()

    def _reached(self, file: str) -> set[str]:
        """Return the names of ``file`` and of all kernel modules that import it directly or indirectly."""
        package = ROOT / "skinnode"
        imports: dict[str, set[str]] = {}
        for path in (path for pattern in _KERNELS for path in package.glob(pattern)):
            module = "skinnode." + ".".join(path.relative_to(package).with_suffix("").parts)
            imports[module] = set()
            for node in ast.walk(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module:
                    imports[module] |= {node.module} | {f"{node.module}.{name.name}" for name in node.names}
        reached = {".".join(Path(file).with_suffix("").parts)}
        while more := {module for module, needs in imports.items() if needs & reached} - reached:
            reached |= more
        return {module.rpartition(".")[2] for module in reached}

    def put_back(self) -> None:
        """Restore the file changed by :meth:`put`."""
        path, text, times_ns = self._original
        path.write_text(text, "utf-8")
        os.utime(path, ns=times_ns)  # numba recompiles files whose modification time has changed

    def keep_kernels(self) -> None:
        """Save the kernels compiled from the unmutated source code."""
        shutil.rmtree(self.warm, ignore_errors=True)
        compiled = self.cache / "skinnode" / self._leaf()
        if compiled.exists():
            shutil.copytree(compiled, self.warm / "skinnode" / compiled.name)

    def forget_kernels(self) -> None:
        shutil.rmtree(self.cache, ignore_errors=True)
        self.cache.mkdir()


class _Failures:
    """pytest plugin that records which tests fail."""

    def __init__(self) -> None:
        self.failed: list[str] = []

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self.failed.append(report.nodeid)

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            self.failed.append(report.nodeid)


def run_tests(tree: Tree, arguments: Sequence[str], limit_s: float) -> Outcome:
    """Run pytest in a new process group, then kill every process that it started."""
    answer, begin_s = tree.log.with_name("answer"), time.monotonic()
    answer.unlink(missing_ok=True)
    child = os.fork()
    if not child:
        _be_pytest(tree, arguments, answer, limit_s)
    status: int | None = None
    try:
        while time.monotonic() - begin_s < limit_s:
            found, word = os.waitpid(child, os.WNOHANG)
            if found:
                status = os.waitstatus_to_exitcode(word)
                break
            time.sleep(0.02)
    finally:
        _end_children(child)
    took_s = time.monotonic() - begin_s
    failed = tuple(json.loads(answer.read_text("utf-8"))) if answer.exists() else ()
    return Outcome(status, failed, took_s)


def _be_pytest(tree: Tree, arguments: Sequence[str], answer: Path, limit_s: float) -> None:
    status = 70
    try:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with tree.log.open("wb") as log, open(os.devnull, "rb") as nothing:
            os.dup2(nothing.fileno(), 0)
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_FSIZE, (_FILE_BYTES, _FILE_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (int(2 * limit_s) + 1, int(2 * limit_s) + 2))
        os.chdir(tree.source)
        os.environ |= {
            "PYTHONPATH": str(tree.source),
            "SKINNODE_CACHE_DIR": str(tree.cache),
            "PYTHONDONTWRITEBYTECODE": "1",  # otherwise, stale bytecode might run instead of the mutant
        }
        sys.dont_write_bytecode = True
        sys.path[:] = [str(tree.source), *(each for each in sys.path if Path(each or ".").resolve() != ROOT)]
        for name in [name for name in sys.modules if name.split(".")[0] == "tools"]:
            del sys.modules[name]
        import pytest

        failures = _Failures()
        options = ["-q", "-n", "0", "--tb=short", "-p", "no:cacheprovider", "-o", f"timeout={_TEST_S}"]
        options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
        options += ["-W", "ignore::SyntaxWarning"]  # for example, "is" with a literal
        status = int(pytest.main([*options, *arguments], plugins=[failures]))
        answer.write_text(json.dumps(failures.failed), "utf-8")
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _end_children(group: int) -> None:
    """Kill all processes in a group, then any other children, which may have left the group."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)
    for _ in range(100):
        children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
        if not children:
            return
        for child in children:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(child), signal.SIGKILL)
            with contextlib.suppress(ChildProcessError):
                os.waitpid(int(child), 0)


def _stages(mutant: Mutant, table: dict[str, Any]) -> list[list[str]]:
    """Return the test files for a mutant, one list per stage; each file occurs only once."""
    group = table[mutant.group]
    first = group.get("first", {}).get(Path(mutant.file).stem, [])
    stages, seen = [], set[str]()
    for stage in [first, *group["stages"]]:
        files = [path for pattern in stage for path in _expand(pattern) if path not in seen]
        seen |= set(files)
        if files:
            stages.append(files)
    return stages


def _expand(pattern: str) -> list[str]:
    found = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob(pattern))
    if not found:
        raise SystemExit(f"stages.toml: got {pattern}, which does not match any file")
    return found


class Session:
    """Runs tests on a tree, using the results on unmutated source code as a reference."""

    def __init__(self, tree: Tree, table: dict[str, Any], *, quick: bool) -> None:
        self._tree, self._table, self._quick = tree, table, quick
        self._real_time = {path for pattern in table["real_time"] for path in _expand(pattern)}
        self._known: dict[str, dict[str, Any]] = {}
        self._kept = tree.log.with_name("unmutated.json")

    def measure(self, mutants: Sequence[Mutant], *, trust: bool) -> None:
        """Run the test files on unmutated code to measure their durations and find failing tests."""
        if self._kept.exists() and trust:
            self._known = json.loads(self._kept.read_text("utf-8"))
        files = {path: None for each in mutants for stage in self._stages(each) for path in stage}
        missing = [path for path in files if path not in self._known]
        if not trust:
            missing = list(files)
            self._tree.forget_kernels()
        for path in missing:
            run = run_tests(self._tree, [path], 900.0)
            if run.status not in (_PASSED, _FAILED):
                raise SystemExit(
                    f"{path}: exit status {run.status} on unmutated source code; see {self._tree.log}"
                )
            failed = [
                test for test in run.failed if run_tests(self._tree, [test], 900.0).status != _PASSED
            ]  # a test that passes when run alone probably failed because of CPU load
            for test in failed:
                print(f"test excluded because it fails on unmutated source code: {test}", flush=True)
            self._known[path] = {"took_s": run.took_s, "failed": failed}
            self._kept.write_text(json.dumps(self._known, indent=1), "utf-8")
        if missing:
            self._tree.keep_kernels()

    def _stages(self, mutant: Mutant) -> list[list[str]]:
        stages = _stages(mutant, self._table)
        return stages[:1] if self._quick else stages

    def judge(self, mutant: Mutant) -> dict[str, Any]:
        """Run the tests on a mutant; return the verdict, the reason and the duration."""
        begin_s = time.monotonic()
        try:
            self._tree.put(mutant)
            verdict, by = self._try_stages(mutant)
        finally:
            self._tree.put_back()
        return {"verdict": verdict, "by": by, "took_s": round(time.monotonic() - begin_s, 1)}

    def _try_stages(self, mutant: Mutant) -> tuple[str, str]:
        for files in self._stages(mutant):
            files = sorted(files, key=lambda path: self._known[path]["took_s"])
            left_out = [test for path in files for test in self._known[path]["failed"]]
            limit_s = _GRACE_S + 6.0 * sum(self._known[path]["took_s"] for path in files)
            for _ in range(8):  # repeat the stage without the flaky test
                deselected = [word for test in left_out for word in ("--deselect", test)]
                run = run_tests(self._tree, ["-x", *deselected, *files], limit_s)
                if run.status is None:
                    return "killed", f"exceeded the time limit of {limit_s:.0f} s"
                if run.status == _PASSED:
                    break
                if run.status != _FAILED or not run.failed:
                    return "killed", run.failed[0] if run.failed else f"exit status {run.status}"
                if run.failed[0].partition("::")[0] not in self._real_time:
                    return "killed", run.failed[0]
                if run_tests(self._tree, [run.failed[0]], limit_s).status != _PASSED:
                    return "killed", run.failed[0]
                print(f"{mutant.name}: ignored a test that failed only once: {run.failed[0]}", flush=True)
                left_out.append(run.failed[0])
        return ("open", "") if self._quick else ("survived", "")


def _load(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text("utf-8")) if path.exists() else {}


def _equivalent() -> dict[str, str]:
    return tomllib.loads(EQUIVALENT.read_text("utf-8")) if EQUIVALENT.exists() else {}


def show(mutant: Mutant) -> str:
    """Format a mutant as text."""
    before, after = mutant.before.replace("\n", "\n  - "), mutant.after.replace("\n", "\n  + ")
    return f"{mutant.name} {mutant.file}, {mutant.function}\n  - {before}\n  + {after}"


def summary(mutants: Sequence[Mutant], results: dict[str, Any]) -> str:
    """Return one line per group with the number of mutants for each verdict, then the surviving mutants."""
    equivalent, lines = _equivalent(), []
    verdict = {each.name: results.get(each.name, {}).get("verdict", "not run") for each in mutants}
    verdict |= dict.fromkeys(equivalent, "equivalent")
    for group in GROUPS:
        verdicts = [verdict[each.name] for each in mutants if each.group == group]
        if verdicts:
            counts = {word: verdicts.count(word) for word in ("killed", "equivalent", "survived", "not run")}
            told = ", ".join(f"{count} {word}" for word, count in counts.items())
            decided = counts["killed"] + counts["survived"]
            share = f": {100 * counts['killed'] / decided:.1f} % killed" if decided else ""
            lines.append(f"{group:8} {len(verdicts)} drawn, {told}{share}")
    lines += [show(each) for each in mutants if verdict[each.name] == "survived"]
    return "\n".join(lines)


def _preload() -> None:
    """Import libraries that load slowly and are never mutated."""
    import can  # noqa: F401
    import canopen  # noqa: F401
    import hypothesis  # noqa: F401
    import numba  # noqa: F401
    import pydantic  # noqa: F401
    import pytest  # noqa: F401
    import scipy.linalg
    import scipy.optimize  # noqa: F401


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--package", choices=GROUPS, action="append", help="default: all")
    parser.add_argument(
        "--only", action="append", metavar="NAME", help="run this mutant even if it already has a verdict"
    )
    parser.add_argument("--again", action="store_true", help="run surviving mutants again")
    parser.add_argument(
        "--trust", action="store_true", help="reuse earlier results of tests on unmutated source code"
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="run only the first stage; give no verdict for mutants that survive it",
    )
    parser.add_argument("--show", action="store_true", help="print the verdicts without running tests")
    parser.add_argument(
        "--folder", type=Path, default=Path(tempfile.gettempdir()) / f"skinnode-mutation-{os.getuid()}"
    )
    options = parser.parse_args()
    mutants, results = read(), _load(RESULTS)
    if not options.show:
        packages = options.package or list(GROUPS)
        todo = [each for each in mutants if each.group in packages and each.name not in _equivalent()]
        if options.only:
            todo = [each for each in mutants if each.name in options.only]
        else:
            done = {n for n, r in results.items() if r["verdict"] == "killed" or not options.again}
            todo = [each for each in todo if each.name not in done]
        libc = ctypes.CDLL(None, use_errno=True)
        libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        _preload()
        tree = Tree(options.folder)
        session = Session(tree, tomllib.loads((HERE / "stages.toml").read_text("utf-8")), quick=options.quick)
        session.measure(todo, trust=options.trust)
        for number, each in enumerate(todo, 1):
            try:
                result = session.judge(each)
            except LookupError as error:
                print(f"{error}; select the mutants again with tools.mutation.draw", flush=True)
                continue
            if result["verdict"] != "open":
                results = _load(RESULTS) | {each.name: result}
                RESULTS.write_text(json.dumps(dict(sorted(results.items())), indent=1) + "\n", "utf-8")
            print(
                f"{number}/{len(todo)} {each.name} {result['verdict']} {result['took_s']} s {result['by']}",
                flush=True,
            )
            if result["verdict"] == "survived":
                print(show(each), flush=True)
    print(summary(mutants, results))


if __name__ == "__main__":
    main()
