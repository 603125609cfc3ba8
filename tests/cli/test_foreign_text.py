"""What devices, files and arguments say reaches a terminal, a log and a page as text, never as commands."""

from __future__ import annotations

import logging
import re
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
import typer

from skinnode.canopen import indices as od
from skinnode.cli.main import app, main
from skinnode.config import BusConfig
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import PatchLayout
from skinnode.node import NodeRunner, PatchNode, VolatileMemory
from skinnode.text.printable import PrintableStream, printable
from skinnode.transport import CanPort
from tests.lanes import some_long
from vcan_sim.cli import main as simulate
from vcan_sim.virtual_time import VirtualClock

EVIL = "\x1b]0;owned\x07\x1b[2J\x9b31m<script>alert(1)</script>[bold]:bomb:\r\nforged: \x7f"
"""As latin-1, which a device name is."""
WORSE = EVIL + "\u202egnp.exe\u2066\u200b\u2028\ud800"
"""As an argument, or in the name of a file."""
SHOWN = r"\x1b]0;owned\x07\x1b[2J\x9b31m<script>alert(1)</script>[bold]:bomb:\r\nforged: \x7f"
LAYOUT = {"upper_wires": 2, "upper_electrodes": 2, "lower_wires": 6, "lower_electrodes": 2}


def is_clean(text: str) -> bool:
    return all(letter.isprintable() or letter in "\n\t" for letter in text)


class TestPrintable:
    def test_escapes_what_steers_a_terminal(self) -> None:
        assert printable(EVIL) == SHOWN
        assert printable(WORSE) == SHOWN + r"\u202egnp.exe\u2066\u200b\u2028\ud800"
        assert printable(EVIL.encode("latin-1") + b"\0\0") == SHOWN

    def test_leaves_the_rest(self) -> None:
        for text in ("", "skinnode patch", "Größe 10 × 10 µm", "指先", "a\\x1b"):
            assert printable(text) == text

    def test_is_bounded(self) -> None:
        assert printable("x" * 200) == "x" * 200
        assert printable("x" * 201) == "x" * 200 + "…"
        assert printable("\x1b" * 1_000_000) == (r"\x1b" * 50) + "…"

    @pytest.mark.long
    def test_is_fit_for_a_terminal_whatever_it_is_given(self) -> None:
        everything = "".join(map(chr, range(0x11_0000)))
        assert printable(everything, 1 << 24).isprintable()


@dataclass(frozen=True)
class Place:
    """A bus with node 5, whose strings are evil, and files that are too."""

    bus: list[str]
    folder: Path

    def file(self, name: str, text: str) -> str:
        path = self.folder / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    @property
    def missing(self) -> str:
        return str(self.folder / WORSE)

    def hand(self) -> str:
        """Names of a hand are printable, or refused; ``others`` see :meth:`broken_hand`."""
        _, interface, _, channel = self.bus
        sizes = ", ".join(f"{key} = {value}" for key, value in LAYOUT.items())
        return self.file(
            "hand.toml",
            'name = "[bold]<script>alert(1)</script>"\n[[buses]]\nname = "[red]"\n'
            f'interface = "{interface}"\n'
            f'channel = "{channel}"\n[[patches]]\nname = "[blink]<script>alert(1)</script>"\nbus = "[red]"\n'
            f'node_id = 5\ntolerances = "exact"\nlayout = {{ preset = "staggered", {sizes} }}\n',
        )

    def broken_hand(self) -> str:
        return self.file("broken.toml", f'name = "{_toml(WORSE[:-1])}"\n"{_toml(WORSE[:-1])}" = 1\n')

    def eds(self) -> str:
        from skinnode.protocol.eds_files import eds_text
        from skinnode.protocol.profile import PatchProfile

        text = eds_text(PatchProfile.from_layout(PatchLayout.preset("staggered", **LAYOUT)))
        name = EVIL.replace("\r", " ").replace("\n", " ")
        evil = re.sub(r"(?m)^ParameterName=.*$", lambda _: f"ParameterName={name}", text)
        return self.file("evil.eds", evil)


def _toml(text: str) -> str:
    return "".join(f"\\U{ord(letter):08x}" for letter in text)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    monkeypatch.chdir(tmp_path)
    layout = PatchLayout.preset("staggered", **LAYOUT)
    ohm = resistance_ohm(layout, layout.upper_m)
    bus = BusConfig(name="can7", interface="timed", channel=uuid.uuid4().hex)

    class Rest:
        def read(self, t_ns: int) -> object:
            return ohm

    with ExitStack() as stack:
        stack.enter_context(VirtualClock())
        port = stack.enter_context(CanPort(bus))
        with monkeypatch.context() as named:
            named.setattr(od, "DEVICE_NAME", EVIL.encode("latin-1"))
            node = PatchNode(5, layout, Rest(), send=port.send, serial=5, memory=VolatileMemory())
        stack.enter_context(NodeRunner(port, [node]))
        yield Place(["--interface", bus.interface, "--channel", bus.channel], tmp_path)


COMMANDS: dict[str, Callable[[Place], list[list[str]]]] = {
    "demo": lambda place: [["--json", place.missing + "/x"]],
    "host": lambda place: [[place.missing], [place.broken_hand()], [place.hand(), "--seconds", "0.3"]],
    "hand check": lambda place: [[place.missing], [place.broken_hand()], [place.hand()]],
    "hand ros2": lambda place: [
        [place.missing, "-o", str(place.folder)],
        [place.hand(), "-o", place.missing],
        [place.hand(), "-o", str(place.folder)],
    ],
    "hand schema": lambda place: [[WORSE]],
    "hand new": lambda place: [["--patches", WORSE]],
    "node": lambda place: [
        ["--source", WORSE, "--node-id", "4"],
        ["--source", "simulated", "--node-id", "4", "--layout", WORSE],
    ],
    "eds": lambda place: [["--output", place.missing + "/x"], ["--node-id", WORSE]],
    "scan": lambda place: [place.bus, ["--hand", place.hand()], ["--hand", place.missing]],
    "info": lambda place: [["5", *place.bus], ["5", "--eds", place.eds(), *place.bus], [WORSE, *place.bus]],
    "od": lambda place: [
        ["5", *place.bus],
        ["5", "1008", *place.bus],
        ["5", "--eds", place.eds(), *place.bus],
        ["5", "--diff", place.eds(), *place.bus],
        ["5", "--dcf", place.missing + "/x", *place.bus],
        ["5", "1008", "--write", WORSE, *place.bus],
    ],
    "nmt": lambda place: [["5", "start", *place.bus], ["5", WORSE, *place.bus], [WORSE, "start", *place.bus]],
    "tare": lambda place: [["5", *place.bus], [WORSE, *place.bus], ["--hand", place.hand()]],
    "lss list": lambda place: [place.bus, ["--interface", WORSE]],
    "lss set": lambda place: [["--serial", WORSE], ["--hand", place.missing, "--yes"]],
    "monitor": lambda place: [[place.missing], [place.hand(), "--json", "--seconds", "0.3"]],
    "view": lambda place: [
        [place.missing, "--web"],
        ["--replay", place.missing, "--web"],
        ["--simulate", "--save", place.missing],
    ],
    "doctor": lambda place: [
        [place.hand(), "--html", str(place.folder / "doctor.html")],
        [place.missing],
    ],
    "record": lambda place: [
        [place.hand(), "-o", str(place.folder), "--listen", "--seconds", "0.2"],
        [place.hand(), "-o", place.missing],
    ],
    "replay": lambda place: [[place.missing], [place.file("evil.log", f"(1.0) {EVIL} 123#00\n")]],
    "resolve": lambda place: [
        [place.missing, "-o", str(place.folder / "solved")],
        [place.file("evil.log", f"(1.0) {EVIL} 123#00\n"), "-o", place.missing, "--set", WORSE],
    ],
    "convert": lambda place: [
        [place.missing, WORSE],
        [
            place.file("evil.log", f"(1.0) {EVIL} 123#00\n"),
            str(place.folder / "x.npz"),
            "--hand",
            place.hand(),
        ],
    ],
    "conformance": lambda place: [
        [
            *["--node-id", "5", *place.bus, "--eds", place.eds(), "--only", "EDS,OD,SDO-02"],
            *["--html", str(place.folder / "report.html"), "--junit", str(place.folder / "report.xml")],
        ],
        ["--node-id", "5", *place.bus, "--eds", place.missing],
        ["--only", WORSE],
    ],
    **{
        f"bench {name}": lambda place: [["--json", place.missing + "/x"], [WORSE]]
        for name in (
            "kernel",
            "solve",
            "path",
            "accuracy",
            "node",
            "pipeline",
            "recording",
            "remote",
            "scale",
            "soak",
            "stability",
            "trust",
        )
    },
    "vcan-sim": lambda place: [
        *[[place.missing], [place.broken_hand()], [place.hand(), "--fault", WORSE]],
        *[["inject", WORSE], ["inject", "--simulator", WORSE]],
        *[["replay", place.missing], ["replay", place.file("evil.log", f"(1.000000) {EVIL} 123#00\n")]],
    ],
}


def start(arguments: list[str]) -> None:
    if arguments[0] == "vcan-sim":
        simulate(arguments[1:])
    else:
        main(arguments)


def leaves(command: object, name: str = "") -> list[str]:
    """The names of all commands below a group."""
    found = getattr(command, "commands", None)
    if found is None:
        return [name]
    return [leaf for key, below in found.items() for leaf in leaves(below, f"{name} {key}".strip())]


def test_no_command_is_left_out() -> None:
    assert sorted(COMMANDS) == sorted([*leaves(typer.main.get_command(app)), "vcan-sim"])


@pytest.mark.parametrize(
    "command", some_long(COMMANDS, "hand check", "host", "scan", "od", "replay", "vcan-sim")
)
def test_no_command_passes_it_on(
    command: str, place: Place, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    for arguments in COMMANDS[command](place):
        with pytest.raises(SystemExit):
            start([*command.split(), *arguments])
        told = capsys.readouterr()
        assert told.out + told.err
        assert is_clean(told.out)
        assert is_clean(told.err)
        assert "Traceback" not in told.err
        assert "\nforged" not in told.out + told.err
    for page in place.folder.glob("*.html"):
        assert is_clean(page.read_text())
        assert "<script>" not in page.read_text()
    for page in place.folder.glob("*.xml"):
        assert is_clean(page.read_text())
        assert "<script>" not in page.read_text()
    assert all(is_clean(record.getMessage()) for record in caplog.records)


@pytest.mark.parametrize("command", ["scan", "info", "od"])
def test_a_device_name_is_shown_as_it_is(
    command: str, place: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not as markup, nor as an emoji, nor on two lines."""
    argument = {"scan": [], "info": ["5"], "od": ["5", "1008"]}[command]
    with pytest.raises(SystemExit):
        main([command, *argument, *place.bus])
    assert SHOWN in capsys.readouterr().out


def test_a_log_line_is_clean_too(capsys: pytest.CaptureFixture[str]) -> None:
    """Warnings of the library go to stderr by logging's last resort."""
    with pytest.raises(SystemExit):
        main(["--version"])
    logging.lastResort.handle(logging.makeLogRecord({"msg": EVIL, "levelno": logging.WARNING}))  # type: ignore[union-attr]
    assert "\x1b" not in capsys.readouterr().err


def test_the_streams_still_are_streams(capsys: pytest.CaptureFixture[str]) -> None:
    import sys

    stream = PrintableStream(sys.stdout)
    stream.writelines(["a\x1b\n", "b\n"])
    assert not stream.isatty()
    assert stream.encoding
    with pytest.raises(TypeError):
        stream.write(b"")  # type: ignore[arg-type]
    assert capsys.readouterr().out == "a\\x1b\nb\n"
