"""The files of the C99 kit: accepted by compilers with all warnings, and true to the protocol's constants."""

from __future__ import annotations

import re
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

from skinnode.canopen import indices as od
from skinnode.cli.main import main
from skinnode.model.layout import PatchLayout
from skinnode.protocol.c_kit import CONFIG_NAME, FIXED_NAMES, config_header, kit_files
from skinnode.protocol.coordinates import pack_coordinates
from skinnode.protocol.eds_files import REFERENCE_PROFILES, eds_name
from skinnode.protocol.profile import PatchProfile
from tests.lanes import some_long

from ..c_kit import compile_c, require, write_kit

GCC = (
    "-Wall -Wextra -pedantic -Wconversion -Wsign-conversion -Warith-conversion -Wshadow -Wundef -Wvla"
    " -Wcast-align=strict -Wcast-qual -Wbad-function-cast -Wpointer-arith -Wwrite-strings -Wstrict-prototypes"
    " -Wmissing-prototypes -Wold-style-definition -Wredundant-decls -Wswitch-default -Wswitch-enum"
    " -Wfloat-equal -Wdouble-promotion -Wformat=2 -Wlogical-op -Wduplicated-cond -Wduplicated-branches"
    " -Wnull-dereference -Wjump-misses-init -Wunreachable-code"
)
CLANG = (
    "-Weverything -Wno-padded -Wno-declaration-after-statement"
    " -Wno-unknown-warning-option -Wno-unsafe-buffer-usage"
)
"""All warnings but three: padding within structures, declarations after statements, which C99 allows, and, in
newer versions, any use of a pointer as an array."""
ACCEPTED = {"gcc": f"-std=c99 -Werror {GCC}".split(), "clang": f"-std=c99 -Werror {CLANG}".split()}
SIZES = [
    *REFERENCE_PROFILES,
    PatchProfile(1, 1, 1, 1, 24),
    PatchProfile(2, 32, 1, 1, 24, bus="fd"),
    PatchProfile(3, 254, 1, 1),
    PatchProfile(254, 254, 1, 1, bus="fd"),
]


@pytest.mark.long
@pytest.mark.parametrize("compiler", ACCEPTED)
@pytest.mark.parametrize("profile", some_long(SIZES, SIZES[0]), ids=eds_name)
def test_no_warning(profile: PatchProfile, compiler: str, tmp_path: Path) -> None:
    for level in ("-O2", "-Os"):
        output = ["-c", write_kit(profile, tmp_path), "-o", tmp_path / "kit.o"]
        compile_c([require(compiler), *ACCEPTED[compiler], level, *output])


def test_a_header_for_cpp(tmp_path: Path) -> None:
    write_kit(SIZES[0], tmp_path)
    (tmp_path / "a.cpp").write_text('#include "skinnode_patch.h"\nskn_assembler_t a;\n')
    strict = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    compile_c([require("g++"), *strict, "-c", tmp_path / "a.cpp", "-o", tmp_path / "a.o"])


@pytest.mark.parametrize("compiler", ACCEPTED)
def test_two_sizes_in_one_program(compiler: str, tmp_path: Path) -> None:
    """As the header says: one source file for each size, which includes the kit with static functions."""
    for name, profile in {"palm": SIZES[0], "thumb": PatchProfile(4, 12, 4, 4, 24)}.items():
        write_kit(profile, tmp_path / name)
        (tmp_path / f"{name}.c").write_text(
            f'#define SKN_API static inline\n#include "{name}/skinnode_patch.c"\n'
            f"unsigned {name}_bytes(void);\n"
            f"unsigned {name}_bytes(void)\n{{\n    static skn_sender_t sender;\n    uint8_t data[64];\n"
            "    skn_sender_init(&sender);\n    sender.full_due = skn_sender_chunk(&sender, data);\n"
            "    return (unsigned)sizeof sender.sent;\n}\n"
        )
    (tmp_path / "main.c").write_text(
        "#include <stdio.h>\nunsigned palm_bytes(void);\nunsigned thumb_bytes(void);\n"
        'int main(void)\n{\n    printf("%u %u\\n", palm_bytes(), thumb_bytes());\n    return 0;\n}\n'
    )
    sources = [tmp_path / f"{name}.c" for name in ("main", "palm", "thumb")]
    program = tmp_path / "hand"
    compile_c([require(compiler), "-std=c99", "-Wall", "-Wextra", "-Werror", *sources, "-o", program])
    assert subprocess.run([program], capture_output=True, text=True, check=True).stdout == "600 192\n"


def macros(profile: PatchProfile) -> dict[str, int]:
    found = re.findall(r"^#define SKN_(\w+) (\w+)$", config_header(profile), flags=re.MULTILINE)
    return {name: int(value.rstrip("uUL"), 0) for name, value in found}


@pytest.mark.parametrize("profile", SIZES, ids=eds_name)
def test_the_header_has_all_objects_of_the_manufacturer(profile: PatchProfile) -> None:
    defined = macros(profile)
    objects = {each.index: each for each in profile.objects() if each.index >= 0x2000}
    named = {value for name, value in defined.items() if name.startswith("OD_")}
    rows = {base + row for base in (od.CODES, od.BASELINE) for row in range(1, profile.rows)}
    assert named == set(objects) - rows
    subindices = [name for name in defined if name.startswith("SUB_")]
    records = (od.DESCRIPTOR, od.SUMMARY, od.SEND_POLICY, od.ACQUISITION, od.TIME_OF_DAY, od.SELF_TEST_RESULT)
    assert len(subindices) == 2 + sum(len(objects[index].entries) - 1 for index in records)


def test_sizes_and_signatures() -> None:
    defined = macros(PatchProfile(10, 30, 9, 8, 24, bus="fd"))
    assert (defined["ROWS"], defined["COLUMNS"], defined["CODE_BITS"], defined["FD"]) == (10, 30, 24, 1)
    assert (defined["CHUNKS"], defined["CODES_PER_CHUNK"], defined["CHUNK_BYTES"]) == (20, 15, 64)
    assert defined["SIGNATURE_TARE"].to_bytes(4, "little") == b"tare"
    assert (defined["CODE_SCALE_LO"], defined["CODE_SCALE_SPAN"], defined["CODE_SCALE_ONE"]) == (1, 4, 4)
    assert defined["EMCY_HARDWARE"] == 0x5000


@pytest.mark.parametrize("compiler", ACCEPTED)
def test_a_layout_comes_with_its_coordinates(compiler: str, tmp_path: Path) -> None:
    layout = PatchLayout.preset("symmetric", upper_wires=3, lower_wires=5)
    profile = PatchProfile.from_layout(layout)
    write_kit(profile, tmp_path, layout)
    (tmp_path / "print.c").write_text(
        '#define SKN_WITH_COORDINATES\n#include "skinnode_patch.h"\n#include <stdio.h>\n'
        "int main(void)\n{\n"
        "    const uint32_t head[] = {SKN_LAYOUT_ID, SKN_LAYOUT_HASH, SKN_RESISTIVITY_REAL32};\n"
        "    return fwrite(head, sizeof head, 1, stdout) == 1 &&\n"
        "           fwrite(skn_coordinates, sizeof skn_coordinates, 1, stdout) == 1 ? 0 : 1;\n}\n"
    )
    program = tmp_path / "print"
    compile_c([require(compiler), *ACCEPTED[compiler], tmp_path / "print.c", "-o", program])
    printed = subprocess.run([program], capture_output=True, check=True).stdout
    assert struct.unpack("<IIf", printed[:12]) == (
        2,
        layout.layout_hash,
        np.float32(layout.resistivity_ohm_per_m),
    )
    assert printed[12:] == pack_coordinates(layout)


# --- the command


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["eds", *arguments])
    assert isinstance(end.value.code, int)
    return end.value.code


def test_the_command_writes_the_kit_of_the_patch_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "firmware"
    sizes = ["--upper-wires", "3", "--lower-wires", "7", "--code-bits", "24"]
    assert run(*sizes, "--c", str(folder)) == 0
    assert run(*sizes, "--fd", "--c", str(folder)) == 0  # its own files may be replaced
    assert str(folder) in capsys.readouterr().out
    written = {file.name: file.read_text("ascii") for file in folder.iterdir()}
    assert written == kit_files(PatchProfile(3, 7, 10, 10, 24, bus="fd"))
    assert set(written) == {*FIXED_NAMES, CONFIG_NAME}
    assert run("--layout", "aligned", "--c", str(folder)) == 0
    layout = PatchLayout.preset("aligned")
    expected = config_header(PatchProfile.from_layout(layout), layout)
    assert (folder / CONFIG_NAME).read_text("ascii") == expected


@pytest.mark.parametrize("name", [*FIXED_NAMES, CONFIG_NAME])
@pytest.mark.parametrize("is_folder", [False, True])
def test_files_of_others_are_not_replaced(
    name: str, is_folder: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if is_folder:
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).write_text("/* mine */\n")
    assert run("--c", str(tmp_path)) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(
        f"error: --c: got '{tmp_path / name}', allowed: no such file, or a file written by"
    )
    assert [file.name for file in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--c", "/proc/nowhere/x"], "--c: got '/proc/nowhere/x', allowed: a writable folder"),
        (["--c", "/dev/null"], "--c: got '/dev/null', allowed: a writable folder"),
        (["--c", "x", "-o", "y"], "--output: got 'y', allowed: not together with --c"),
        (["--c", "x", "--dcf", "--node-id", "4"], "--dcf: got True, allowed: not together with --c"),
        (["--c", "x", "--upper-wires", "200", "--lower-wires", "200"], "rows × columns: got 40000"),
        (["--c", "x", "--code-bits", "12"], "code_bits: got 12"),
    ],
)
def test_what_cannot_be(
    options: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*options) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.strip().splitlines()
    assert line.startswith(f"error: {says}")
    assert list(tmp_path.iterdir()) == []
