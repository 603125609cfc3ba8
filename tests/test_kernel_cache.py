"""Whatever is wrong with the files of compiled kernels, and wherever they cannot be kept: the right numbers,
exit status 0, at most one line on stderr, and the next start finds a whole cache."""

from __future__ import annotations

import os
import random
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from skinnode.compiled import kernel_cache

pytestmark = pytest.mark.long

PROGRAM = """
from skinnode.compiled.jit import njit

@njit
def mean(a, b):
    return (a + b) / 2

print(mean(1, 2), mean(1.0, 4.0), sum(mean.stats.cache_hits.values()))
"""
NUMBERS = ["1.5", "2.5"]
SKINNODE = Path(sys.executable).with_name("skinnode")
ROOT = Path(__file__).parents[1]


class Cache:
    """A program with one kernel of two signatures, and its cache folder."""

    def __init__(self, folder: Path, program: Path) -> None:
        self.folder, self.program = folder, program
        self.environment = {**os.environ, "SKINNODE_CACHE_DIR": str(folder)}

    def files(self) -> list[Path]:
        return sorted(self.folder.rglob("*.nbc"))

    def start(self, *arguments: str, **options: object) -> subprocess.Popen[str]:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": self.environment}
        return subprocess.Popen([sys.executable, str(self.program), *arguments], **{**pipes, **options})

    def run(self, **options: object) -> tuple[int, list[str]]:
        """How many signatures came from the cache, and the lines on stderr."""
        return ended(self.start(**options))


def ended(process: subprocess.Popen[str]) -> tuple[int, list[str]]:
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    *numbers, hits = out.split()
    assert numbers == NUMBERS
    return int(hits), err.splitlines()


@pytest.fixture(scope="module")
def warm(tmp_path_factory: pytest.TempPathFactory) -> Cache:
    folder = tmp_path_factory.mktemp("warm")
    program = folder / "program.py"
    program.write_text(PROGRAM)
    cache = Cache(folder / "cache", program)
    assert cache.run() == (0, [])
    assert cache.run() == (2, [])
    return cache


@pytest.fixture
def cache(warm: Cache, tmp_path: Path) -> Cache:
    shutil.copytree(warm.folder, tmp_path / "cache")
    return Cache(tmp_path / "cache", warm.program)


def flip(file: Path, where: int) -> None:
    data = bytearray(file.read_bytes())
    data[where] ^= 1 << random.Random(where).randrange(8)
    file.write_bytes(data)


def cut(file: Path) -> None:
    os.truncate(file, file.stat().st_size // 2)


def empty(file: Path) -> None:
    os.truncate(file, 0)


def randomise(file: Path) -> None:
    file.write_bytes(random.Random(3).randbytes(file.stat().st_size))


def lengthen(file: Path) -> None:
    file.write_bytes(file.read_bytes() + b"\0")


def make_folder(file: Path) -> None:
    file.unlink()
    (file / "within").mkdir(parents=True)


def make_pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def make_unreadable(file: Path) -> None:
    """Root reads what nobody may read; the memory of a process at 0 is an input/output error for root too."""
    file.unlink()
    file.symlink_to("/proc/self/mem")


DAMAGE: list[Callable[[Path], None]] = [
    cut,
    empty,
    randomise,
    lengthen,
    make_folder,
    make_pipe,
    make_unreadable,
]


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_removed_and_compiled_anew(cache: Cache, damage: Callable[[Path], None]) -> None:
    damage(cache.files()[0])
    hits, lines = cache.run()
    assert hits == 1  # the other is whole
    assert [line.partition(": ")[2] for line in lines] == [
        "1 of 2 files were damaged and have been removed; recompiling"
    ]
    assert str(cache.folder) in lines[0]
    assert cache.run() == (2, [])


def test_the_damage_of_many_files_is_one_line(cache: Cache) -> None:
    for file in cache.files():
        flip(file, file.stat().st_size // 2)
    hits, lines = cache.run()
    assert hits == 0
    assert [line.partition(": ")[2] for line in lines] == [
        "2 of 2 files were damaged and have been removed; recompiling"
    ]
    assert cache.run() == (2, [])


def test_no_flipped_bit_is_loaded(warm: Cache, tmp_path: Path) -> None:
    """Each byte of the header, and a sample of the rest: most of them would be loaded by numba without an
    error, and run."""
    file = tmp_path / "kernel.nbc"
    whole = warm.files()[0].read_bytes()
    rng = random.Random(5)
    for where in [*range(64), *(rng.randrange(len(whole)) for _ in range(500)), len(whole) - 1]:
        file.write_bytes(whole)
        flip(file, where)
        with pytest.raises(ValueError, match="damaged"):
            kernel_cache._read(file)


def test_a_file_under_the_name_of_another_signature_is_not_used(cache: Cache) -> None:
    first, second = cache.files()
    kept = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(kept)
    assert cache.run() == (0, [])
    assert cache.run() == (2, [])


def test_what_is_whole_but_cannot_be_loaded_is_compiled_anew(cache: Cache) -> None:
    """As of another version of a library: it would unpickle into a class that is not there."""
    kernel_cache._write(cache.files()[0], b"cno_such_module\nno_such_class\n.")
    hits, lines = cache.run()
    assert hits == 1
    assert [line.partition(": ")[2] for line in lines] == [
        "a file could not be loaded (ModuleNotFoundError(\"No module named 'no_such_module'\")) "
        "and was removed; recompiling"
    ]
    assert cache.run() == (2, [])


def test_another_installation_of_the_same_code_shares_the_kernels(cache: Cache, tmp_path: Path) -> None:
    """As when the tests of a checkout are run after the demo of an installation."""
    (tmp_path / "elsewhere").mkdir()
    moved = Cache(cache.folder, Path(shutil.copy(cache.program, tmp_path / "elsewhere")))
    assert moved.run() == (2, [])
    edited = moved.program.read_text().replace("/ 2", "* 0.5")
    moved.program.write_text(edited)
    assert moved.run() == (0, [])


def test_two_processes_compile_into_an_empty_cache_at_once(cache: Cache) -> None:
    shutil.rmtree(cache.folder)
    both = [cache.start(), cache.start()]
    assert [ended(process)[1] for process in both] == [[], []]
    assert cache.run() == (2, [])
    assert not list(cache.folder.rglob("*.tmp"))


def test_of_two_processes_that_find_the_damage_one_reports_it(cache: Cache) -> None:
    for file in cache.files():
        empty(file)
    both = [cache.start(), cache.start()]
    assert len([line for process in both for line in ended(process)[1]]) == 1
    assert cache.run() == (2, [])


def test_on_a_full_disk_nothing_is_kept_and_one_line_says_so(cache: Cache) -> None:
    """A limit of the size of files stands for the disk: the error is another, its place is the same."""
    shutil.rmtree(cache.folder)
    hits, lines = cache.run(preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)))
    assert hits == 0
    assert [line.partition(": ")[2] for line in lines] == [
        "a compiled kernel could not be cached (File too large); it will be recompiled at the next start"
    ]
    assert not [path for path in cache.folder.rglob("*") if path.is_file()]


def test_a_home_that_cannot_be_written_is_passed_over(cache: Cache, tmp_path: Path) -> None:
    for name in ("SKINNODE_CACHE_DIR", "XDG_CACHE_HOME"):
        cache.environment.pop(name, None)
    (tmp_path / "tmp").mkdir()
    cache.environment |= {"HOME": "/proc", "TMPDIR": str(tmp_path / "tmp")}  # nobody makes a folder in /proc
    assert cache.run() == (0, [])
    assert cache.run() == (2, [])
    assert len(list((tmp_path / "tmp").rglob("*.nbc"))) == 2


def test_with_no_folder_at_all_each_start_compiles(cache: Cache, tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere.py"
    nowhere.write_text(
        "import tempfile, runpy\n"
        "def gettempdir(): raise FileNotFoundError(2, 'No usable temporary directory found')\n"
        "tempfile.gettempdir = gettempdir\n"
        f"runpy.run_path({str(cache.program)!r})\n"
    )
    cache.environment |= {"HOME": "/proc", "SKINNODE_CACHE_DIR": "/proc", "XDG_CACHE_HOME": "/proc"}
    cache.program = nowhere
    assert cache.run() == (0, [])


def test_a_command_survives_damage(tmp_path: Path) -> None:
    def check() -> tuple[str, list[str]]:
        done = subprocess.run(
            [SKINNODE, "hand", "check", ROOT / "examples" / "hand.toml"],
            capture_output=True,
            text=True,
            env={**os.environ, "SKINNODE_CACHE_DIR": str(tmp_path)},
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr.splitlines()

    whole, silence = check()
    assert silence == []
    files = list(tmp_path.rglob("*.nbc"))
    assert files
    for file in files:
        flip(file, 4000)
    said, lines = check()
    assert said == whole
    assert len(lines) == 1
    assert check() == (whole, [])
