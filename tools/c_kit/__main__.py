"""Measures the C99 kit: code size, memory, stack use, and the cycles and instructions for one scan.

``python -m tools.c_kit`` prints a Markdown table. It requires ``gcc-arm-none-eabi`` and ``valgrind``,
and the PyPI package ``unicorn``, which emulates a Cortex-M0+.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from pathlib import Path

from skinnode.protocol.c_kit import kit_files
from skinnode.protocol.eds_files import REFERENCE_PROFILES, eds_name
from skinnode.protocol.profile import PatchProfile

from .cortex_m0 import CortexM0

SOURCE = Path(__file__).with_name("measure.c")
STEPS = ("encode", "wires", "begin", "chunks", "summary", "assemble")
FLAGS = ("-std=c99", "-Os", "-ffunction-sections", "-fdata-sections")
ARM = ("arm-none-eabi-gcc", "-mcpu=cortex-m0plus", "-mthumb", "-nostartfiles", *FLAGS)
PLACES = ("-Wl,-Ttext=0x10000", "-Wl,-Tbss=0x20000000", "-Wl,-e,measure_setup")
HALVES = {
    "board": ("encode", "wires", "begin", "chunks", "summary"),
    "master": ("receive", "close"),
}
TITLES = {
    "encode": "encode all crossings",
    "wires": "find wire faults",
    "begin": "begin a full scan",
    "chunks": "pack all chunks",
    "summary": "pack the summary",
    "receive": "receive all chunks",
    "close": "receive the summary",
}
STEPS = tuple(step for steps in HALVES.values() for step in steps)


def measure(profile: PatchProfile) -> dict[str, str]:
    """Return a profile's column of the table, keyed by row title."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in kit_files(profile).items():
            (folder / file).write_text(text)
        inputs = ("-I", name, f"{name}/skinnode_patch.c", str(SOURCE))
        firmware, program = folder / "firmware.elf", folder / "program"
        _run(*ARM, *PLACES, *inputs, "-o", str(firmware))
        _run("gcc", "-g", "-DSKN_HOSTED", *FLAGS, *inputs, "-o", str(program))
        code = {f"code of the {half}, bytes": _code(folder / half, half, inputs) for half in HALVES}
        return {**code, **_memory(firmware), **_on_cortex_m0(firmware), **_on_x86(program)}


def _run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr}")
    return done.stdout + done.stderr


def _code(program: Path, half: str, inputs: tuple[str, ...]) -> str:
    """Return the code size of the kit's board or master half, including C library and compiler functions."""
    roots = [f"measure_{step}" for step in HALVES[half]]
    keep = [f"-Wl,-u,{root}" for root in roots]
    _run(*ARM, "-Wl,--gc-sections", f"-Wl,-e,{roots[0]}", *keep, *inputs, "-o", str(program))
    text = int(_run("arm-none-eabi-size", str(program)).splitlines()[1].split()[0])
    callers = sum(size for name, size in _symbols(program).items() if name.startswith("measure_"))
    return f"{text - callers:,}"


def _memory(firmware: Path) -> dict[str, str]:
    sizes = _symbols(firmware)
    return {f"RAM: `skn_{name}_t`, bytes": f"{sizes[name]:,}" for name in ("sender", "assembler", "scan")}


def _symbols(program: Path) -> dict[str, int]:
    listed = _run("arm-none-eabi-nm", "-S", str(program))
    return {name: int(size, 16) for size, name in re.findall(r"^\w+ (\w+) \w (\w+)$", listed, re.MULTILINE)}


def _on_cortex_m0(firmware: Path) -> dict[str, str]:
    machine = CortexM0(firmware)
    machine.call("measure_setup")
    rows, deepest = {}, 0
    for step in STEPS:
        cycles, stack = machine.call(f"measure_{step}")
        rows[f"{TITLES[step]}, cycles"] = f"{cycles:,}"
        deepest = max(deepest, stack)
    assert machine.word("scan", 16) == 1, "the scan was not received correctly"
    return {**rows, "stack, bytes": str(deepest)}


def _on_x86(program: Path) -> dict[str, str]:
    rows = {}
    for step in STEPS:
        out = f"--callgrind-out-file={program}.out"
        said = _run("valgrind", "--tool=callgrind", out, f"--toggle-collect=measure_{step}", str(program))
        (collected,) = re.findall(r"Collected : (\d+)", said)
        rows[f"{TITLES[step]}, x86-64 instructions"] = f"{int(collected):,}"
    return rows


def main() -> None:
    """Print the table for the reference profiles."""
    columns = [measure(profile) for profile in REFERENCE_PROFILES]
    names = [eds_name(profile)[len("skinnode-") : -len(".eds")] for profile in REFERENCE_PROFILES]
    print("| | " + " | ".join(names) + " |\n|---|" + "---|" * len(names))
    for row in columns[0]:
        print(f"| {row} | " + " | ".join(column[row] for column in columns) + " |")


if __name__ == "__main__":
    main()
