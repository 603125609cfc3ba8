"""Formats the results of a run as text, JSON and JUnit XML; ``html_report`` formats them as HTML."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any
from xml.etree import ElementTree

from skinnode.conformance.case import Case, Result, Verdict
from skinnode.conformance.run import Report
from skinnode.text.printable import printable_lines
from skinnode.text.words import counted

_ID_WIDTH = 9
_VERDICT_WIDTH = 15


def result_line(result: Result) -> str:
    """Return one line with the ID, verdict and title of a case, and the reason for the verdict, if any."""
    head = f"{result.case.id:{_ID_WIDTH}} {result.verdict:{_VERDICT_WIDTH}}{result.case.title}"
    return _one_line(f"{head}: {result.why}" if result.why else head)


def list_lines(cases: Iterable[Case]) -> list[str]:
    """Return one line with the ID, title and clause of each case."""
    listed = list(cases)
    width = max((len(case.title) for case in listed), default=0)
    return [f"{case.id:{_ID_WIDTH}} {case.title:{width}}  {case.clause}" for case in listed]


def summary_line(report: Report) -> str:
    """Return one line with the number of cases with each verdict, the duration and the EDS."""
    not_applicable = report.count(Verdict.NOT_APPLICABLE)
    applicable = len(report.results) - not_applicable
    seconds = sum(result.seconds for result in report.results)
    return (
        f"{len(report.results)} cases, {applicable} applicable: {report.count(Verdict.PASSED)} passed, "
        f"{counted(report.count(Verdict.WARNING), 'warning')}, {report.failed} failed, "
        f"{not_applicable} not applicable; {seconds:.1f} s; EDS: {report.eds}"
    )


def as_json(report: Report) -> dict[str, Any]:
    """Return the results as JSON-compatible data.

    Each frame is a string with the time since the start of the case (s), Tx or Rx as seen by the tester,
    COB-ID, length and data.
    """
    return {
        "eds": report.eds,
        "passed": report.count(Verdict.PASSED),
        "warnings": report.count(Verdict.WARNING),
        "failed": report.failed,
        "not_applicable": report.count(Verdict.NOT_APPLICABLE),
        "problems": list(report.problems),
        "cases": [
            {
                "id": result.case.id,
                "title": result.case.title,
                "clause": result.case.clause,
                "verdict": result.verdict.value,
                "why": result.why,
                "seconds": round(result.seconds, 4),
                "frames": [str(line).strip() for line in result.trace],
            }
            for result in report.results
        ],
    }


def as_junit(report: Report) -> str:
    """Return the results as JUnit XML with one test suite per area.

    A failed test contains the recorded frames. A case that is not applicable is reported as a skipped test. A
    warning is reported as a passed test with output.
    """
    root = ElementTree.Element("testsuites", name="CANopen conformance")
    areas: dict[str, list[Result]] = {}
    for result in report.results:
        areas.setdefault(result.case.area, []).append(result)
    for area, results in areas.items():
        suite = ElementTree.SubElement(
            root,
            "testsuite",
            name=area,
            tests=str(len(results)),
            failures=str(sum(result.verdict is Verdict.FAILED for result in results)),
            errors="0",
            skipped=str(sum(result.verdict is Verdict.NOT_APPLICABLE for result in results)),
            time=f"{sum(result.seconds for result in results):.3f}",
        )
        for result in results:
            _add_case(suite, result)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_case(suite: ElementTree.Element, result: Result) -> None:
    case = ElementTree.SubElement(
        suite,
        "testcase",
        classname=f"conformance.{result.case.area}",
        name=f"{result.case.id} {result.case.title}",
        time=f"{result.seconds:.3f}",
    )
    why = printable_lines(result.why)
    if result.verdict is Verdict.FAILED:
        failure = ElementTree.SubElement(case, "failure", message=_one_line(why), type="Failed")
        failure.text = "\n".join([why, f"CiA 301 v4.2.0, {result.case.clause}", *map(str, result.trace)])
    elif result.verdict is Verdict.NOT_APPLICABLE:
        ElementTree.SubElement(case, "skipped", message=_one_line(why))
    elif result.verdict is Verdict.WARNING:
        ElementTree.SubElement(case, "system-out").text = f"warning: {why}"


def _one_line(text: str) -> str:
    return " ".join(text.split()) if "\n" in text else text
