"""``skinnode conformance`` as an integrator meets it, and the reports it writes."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest

from skinnode.cli.main import main
from skinnode.conformance import CASES
from skinnode.protocol.eds_files import eds_text
from skinnode.protocol.profile import PatchProfile

from .conftest import NODE_ID, patch_on

pytestmark = pytest.mark.system_time


@pytest.fixture
def patch() -> Iterator[list[str]]:
    """Options that lead to a running patch."""
    channel = f"command-{uuid.uuid4().hex[:8]}"
    with patch_on(channel):
        yield ["--node-id", str(NODE_ID), "--interface", "virtual", "--channel", channel]


def conformance(*arguments: str) -> int:
    """Exit status of ``skinnode conformance``."""
    with pytest.raises(SystemExit) as end:
        main(["conformance", *arguments])
    return int(end.value.code or 0)


class Balance(HTMLParser):
    """Whether every tag that was opened is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_a_line_a_case_and_a_summary(patch: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert conformance(*patch, "--only", "SDO-01,sdo-04, SDO-02") == 0
    one, two, four, summary = capsys.readouterr().out.strip().splitlines()
    assert one.split()[:2] == ["SDO-01", "passed"]
    assert two.split()[:2] == ["SDO-02", "passed"]
    assert four.split()[:3] == ["SDO-04", "not", "applicable"]
    assert "no object with access wo" in four
    assert summary.startswith("3 cases, 2 applicable: 2 passed, 0 warnings, 0 failed, 1 not applicable")


def test_a_warning_is_status_0_and_in_every_report(
    patch: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet = tmp_path / "a.eds"
    sheet.write_text(eds_text(PatchProfile(2, 6, 2, 6)).replace("NrOfTXPDO=4", "NrOfTXPDO=5"))
    files = {kind: tmp_path / f"report.{kind}" for kind in ("junit", "html", "json")}
    options = [part for kind, file in files.items() for part in (f"--{kind}", str(file))]
    assert conformance(*patch, "--eds", str(sheet), "--only", "EDS,SDO-05", *options) == 0
    first, _, summary = capsys.readouterr().out.strip().splitlines()
    assert first.split()[:2] == ["EDS-01", "warning"]
    assert summary.startswith("2 cases, 2 applicable: 1 passed, 1 warning, 0 failed, 0 not applicable")
    suite, _ = ElementTree.parse(files["junit"]).getroot()
    assert (suite.get("failures"), suite.get("errors"), suite.get("skipped")) == ("0", "0", "0")
    (case,) = suite.iter("testcase")
    assert [(child.tag, child.text) for child in case] == [
        ("system-out", "warning: NrOfTXPDO=5, but the EDS describes 4")
    ]
    page = Balance()
    page.feed(files["html"].read_text())
    assert "NrOfTXPDO=5, but the EDS describes 4" in page.text
    assert 'class="verdict warned"' in files["html"].read_text()
    report = json.loads(files["json"].read_text())
    assert (report["passed"], report["warnings"], report["failed"]) == (1, 1, 0)


def test_an_eds_that_the_node_does_not_keep_is_status_1_and_in_every_report(
    patch: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet = eds_text(PatchProfile(2, 6, 2, 6))
    wrong = sheet.replace("[1000]\nParameterName=Device type", "[1000]\nParameterName=<Device & type>")
    at = wrong.index("DefaultValue=0", wrong.index("[1000]"))
    (tmp_path / "a.eds").write_text(wrong[:at] + "DefaultValue=0x191" + wrong[at + len("DefaultValue=0") :])
    files = {kind: tmp_path / f"report.{kind}" for kind in ("junit", "html", "json")}
    options = [part for kind, file in files.items() for part in (f"--{kind}", str(file))]
    status = conformance(*patch, "--eds", str(tmp_path / "a.eds"), "--only", "SDO-01,SDO-04,SDO-05", *options)
    assert status == 1
    assert "SDO-01    failed" in capsys.readouterr().out

    (suite,) = ElementTree.parse(files["junit"]).getroot()
    assert (suite.get("name"), suite.get("tests")) == ("SDO", "3")
    assert (suite.get("failures"), suite.get("errors"), suite.get("skipped")) == ("1", "0", "1")
    first, fourth, fifth = suite.iter("testcase")
    assert "91 01 00 00" in (first[0].get("message") or "")
    assert "604 [8] 40 00 10 00" in (first[0].text or "")
    assert fourth[0].tag == "skipped"
    assert len(fifth) == 0

    page = Balance()
    page.feed(files["html"].read_text())
    page.close()
    assert page.open == []
    assert "SDO-01" in page.text
    assert "91 01 00 00" in page.text
    assert "http" not in files["html"].read_text()

    report = json.loads(files["json"].read_text())
    assert [case["verdict"] for case in report["cases"]] == ["failed", "not applicable", "passed"]
    assert report["failed"] == 1


def test_the_encoding_of_the_sheet_is_told(
    patch: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet = tmp_path / "a.eds"
    text = eds_text(PatchProfile(2, 6, 2, 6)).replace("ParameterName=Device type", "ParameterName=Gerätetyp")
    sheet.write_text(text, encoding="cp1252")
    assert conformance(*patch, "--eds", str(sheet), "--only", "EDS,SDO-01") == 0
    summary = capsys.readouterr().out.strip().splitlines()[-1]
    assert summary.endswith(f"EDS: {sheet}, read as Windows-1252: an EDS should be ASCII")


def test_the_list_names_every_case_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert conformance("--list") == 0
    lines = capsys.readouterr().out.strip().splitlines()
    assert [line.split()[0] for line in lines] == [case.id for case in CASES]
    assert len({case.id for case in CASES}) == len(CASES)
    assert len({case.title for case in CASES}) == len(CASES)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((), "--node-id"),
        (("--node-id", "4", "--only", "SDO-99"), "SDO-99"),
        (("--node-id", "4", "--interface", "no-such-interface"), "no-such-interface"),
        (("--node-id", "4", "--eds", "no-such-file.eds"), "no-such-file.eds"),
        (("--node-id", "4", "--html", "no such folder/report.html"), "--html"),
        (("--node-id", "4", "--interface", "virtual", "--eds", __file__), "EDS"),
        (("--node-id", "4", "--interface", "virtual", "--bitrate", "5"), "--bitrate: got 5"),
    ],
)
def test_what_cannot_run_is_one_line_and_status_2(
    arguments: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert conformance(*arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.strip().splitlines()
    assert told in line
    assert "pydantic" not in line


def test_no_node_is_status_2(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("skinnode.conformance.dut.BOOT_S", 0.3)
    assert conformance("--node-id", "9", "--interface", "virtual", "--channel", uuid.uuid4().hex) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "node 9" in line
