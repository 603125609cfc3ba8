"""Files that commands write are whole or as they were."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from skinnode.errors import ConfigError
from skinnode.files.output_file import write_text
from skinnode.files.whole_file import discard_leftovers, replace_file

SKINNODE = Path(sys.executable).with_name("skinnode")


def eds(output: Path | str, limit_bytes: int | None = None) -> subprocess.CompletedProcess[str]:
    """``skinnode eds`` to a file, on a disk that takes ``limit_bytes`` of it."""

    def limit() -> None:
        if limit_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))

    return subprocess.run(
        [SKINNODE, "eds", "--output", output],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        preexec_fn=limit,
    )


@pytest.mark.parametrize("before", [None, "what was there before"])
def test_a_disk_that_fills_up_leaves_what_was_there(tmp_path: Path, before: str | None) -> None:
    target = tmp_path / "patch.eds"
    if before is not None:
        target.write_text(before)
    done = eds(target, limit_bytes=1000)
    assert (done.returncode, done.stdout) == (2, "")
    says = f"error: --output: got '{target}', allowed: a file that can be written (File too large)\n"
    assert done.stderr == says
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == (
        {} if before is None else {target.name: before}
    )


@pytest.mark.long
def test_an_output_may_be_a_link_or_no_file_at_all(tmp_path: Path) -> None:
    """The user has named it: unlike the memory of a node it is followed."""
    target, link = tmp_path / "patch.eds", tmp_path / "link.eds"
    target.touch(mode=0o640)
    link.symlink_to(target)
    assert eds(link).returncode == 0
    assert link.is_symlink()
    assert target.stat().st_mode & 0o777 == 0o640
    printed = eds("/dev/stdout")
    assert printed.returncode == 0
    assert target.read_text() in printed.stdout


def test_an_output_keeps_permissions_that_new_files_do_not_get(tmp_path: Path) -> None:
    """Those of a group that shares the file, although the umask refuses them to new files."""
    target = tmp_path / "patch.eds"
    target.touch()
    target.chmod(0o664)
    before = os.umask(0o022)
    try:
        write_text("--output", target, "new")
        write_text("--output", tmp_path / "other.eds", "new")
    finally:
        os.umask(before)
    modes = {file.name: file.stat().st_mode & 0o777 for file in tmp_path.iterdir()}
    assert modes == {"patch.eds": 0o664, "other.eds": 0o644}
    assert target.read_text() == "new"


def test_what_is_planted_beside_is_not_touched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even under the random name."""
    monkeypatch.setattr("secrets.token_hex", lambda count: "0" * 2 * count)
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / f".file.{'0' * 16}.new").symlink_to(victim)
    with pytest.raises(FileExistsError):
        replace_file(tmp_path / "file", b"new")
    assert victim.read_text() == "precious"
    assert not (tmp_path / "file").exists()


def test_leftovers_are_those_of_one_file(tmp_path: Path) -> None:
    names = [f".file.{'0' * 16}.new", f".file.x.{'0' * 16}.new", ".file.new", "file", ".file.notes.new"]
    for name in names:
        (tmp_path / name).touch()
    discard_leftovers(tmp_path / "file")
    assert sorted(os.listdir(tmp_path)) == sorted(names[1:])


@pytest.mark.long
def test_a_plot_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    from skinnode.files.plot_file import save_figure

    figure, file = Figure(), tmp_path / "plot.PNG"
    save_figure("--plot", file, figure, 20)
    assert file.read_bytes().startswith(b"\x89PNG")
    kept = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, kept[1]))
    try:
        with pytest.raises(ConfigError, match="--plot"):
            save_figure("--plot", tmp_path / "other.png", figure, 20)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, kept)
    assert os.listdir(tmp_path) == ["plot.PNG"]
