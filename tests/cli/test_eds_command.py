"""``skinnode eds`` as its user meets it; what is in the files is tested in tests/protocol."""

from __future__ import annotations

from pathlib import Path

import pytest

from skinnode.cli.main import main
from skinnode.protocol.eds_files import dcf_text, eds_text
from skinnode.protocol.profile import PatchProfile


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["eds", *arguments])
    assert isinstance(end.value.code, int)
    return end.value.code


def test_sizes_width_and_bus_are_those_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = ["--upper-wires", "3", "--lower-wires", "7", "--upper-electrodes", "5", "--lower-electrodes", "4"]
    profile = PatchProfile(3, 7, 5, 4, 24, bus="fd")
    assert run(*sizes, "--code-bits", "24", "--fd") == 0
    assert capsys.readouterr().out == eds_text(profile)
    file = tmp_path / "a.dcf"
    device = ["--dcf", "--node-id", "9", "--bitrate", "250000", "-o", str(file)]
    assert run(*sizes, "--code-bits", "24", "--fd", *device) == 0
    assert capsys.readouterr().out == ""
    assert file.read_text() == dcf_text(profile, 9, 250_000)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--dcf"], "--node-id: got nothing"),
        (["--node-id", "4"], "--node-id: got 4, allowed: only with --dcf"),
        (["--dcf", "--node-id", "4", "--bitrate", "0"], "bitrate_bps: got 0"),
        (["--dcf", "--node-id", "4", "--bitrate", "300000"], "bitrate_bps: got 300000"),
        (["--layout", "staggered", "--lower-wires", "3"], "--lower-wires: got 3"),
        (["--upper-wires", "254", "--lower-wires", "254"], "rows × columns: got 64516"),
        (["--code-bits", "12"], "code_bits: got 12"),
        (["-o", "no such folder/a.eds"], "--output: got 'no such folder/a.eds'"),
    ],
)
def test_options_that_cannot_be(options: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*options) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.strip().splitlines()
    assert line.startswith(f"error: {says}")
