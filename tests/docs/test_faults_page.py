"""The page of faults names every condition, event, emergency and finding of the code, and no others."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest

import skinnode.diagnose
from skinnode.canopen.emergency import EmcyCode
from skinnode.diagnose.root_causes import RULES
from skinnode.host import health_watch
from skinnode.host.health import BusHealth, Condition, PatchHealth
from skinnode.host.open_and_shorted_wires import WireState

from .blocks import DOCS

PAGE = (DOCS / "faults.md").read_text(encoding="utf-8")
FINDINGS = set(re.findall(r"doctor: ([^;|]*[^;| ])", PAGE))


def _calls() -> Iterator[ast.Call]:
    """All calls by plain name in the doctor's source."""
    for file in sorted(Path(skinnode.diagnose.__path__[0]).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                yield node


def _text(what: ast.expr) -> str | None:
    """Text of a literal, with an ellipsis for each inserted value; None for other expressions."""
    if isinstance(what, ast.Constant) and isinstance(what.value, str):
        return what.value
    if isinstance(what, ast.JoinedStr):
        return "".join(
            part.value if isinstance(part, ast.Constant) else _filled(part) for part in what.values
        )
    return None


def _filled(part: ast.expr) -> str:
    """How the page shows an inserted value: an ellipsis, and the plural of a counted noun."""
    match part:
        case ast.FormattedValue(value=ast.Call(func=ast.Name(id="_crossings"))):
            return "… crossings"
        case ast.FormattedValue(
            value=ast.Call(func=ast.Name(id="counted"), args=[_, _, ast.Constant(several)])
        ):
            return f"… {several}"
    return "…"


def findings() -> set[str]:
    """Names of all findings in the doctor's source: the third argument of ``Finding``, the first argument of
    ``found``, or its second if the first is a place."""
    names = set()
    for call in _calls():
        assert isinstance(call.func, ast.Name)
        texts = [_text(argument) for argument in call.args]
        if call.func.id == "Finding":
            names.add(texts[2])
        elif call.func.id == "found":
            names.add(texts[0] or texts[1])
    return {name.removesuffix(": …") for name in names if name and re.search(r"\w", name.removesuffix(": …"))}


def _is(name: str, finding: str) -> bool:
    """Whether ``finding`` matches ``name``, whose ellipses stand for any text."""
    return re.fullmatch(re.escape(name).replace("…", ".*"), finding) is not None


def test_every_finding_of_the_doctor_is_on_the_page() -> None:
    named = findings()
    assert {
        "the interface does not work",
        "the controller is …",
        "incomplete scans",
        "… crossings …",
    } <= named
    assert len(named) > 35
    assert [name for name in named if not any(_is(name, finding) for finding in FINDINGS)] == []


def test_the_page_names_no_finding_that_there_is_not() -> None:
    named = findings()
    assert [finding for finding in FINDINGS if not any(_is(name, finding) for name in named)] == []


@pytest.mark.parametrize("condition", Condition)
def test_every_condition_is_on_the_page(condition: Condition) -> None:
    assert f"`{condition.value}`" in PAGE


@pytest.mark.parametrize("code", [code for code in EmcyCode if code])
def test_every_emergency_is_on_the_page(code: EmcyCode) -> None:
    assert f"0x{code:04X}" in PAGE


def test_every_event_is_on_the_page() -> None:
    told = {
        text
        for call in ast.walk(ast.parse(Path(health_watch.__file__).read_text(encoding="utf-8")))
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Attribute)
        and call.func.attr == "_publish"
        for text in re.findall(r"'([^']+)'", ast.unparse(call.args[1]))
    }
    assert {"away", "back", "restarts in a loop", "duplicate node-ID", "well"} <= told
    counters = {*health_watch._PATCH_COUNTERS, *health_watch._BUS_COUNTERS}
    assert counters <= {field.name for kind in (PatchHealth, BusHealth) for field in fields(kind)}
    for name in [*told, *counters, *(state.value for state in WireState)]:
        assert f"`{name}`" in PAGE, name


def test_every_rule_speaks_of_findings_that_there_are() -> None:
    known = findings()
    for rule in RULES:
        for pattern in (rule.cause, *rule.follow):
            words = ("chunk PDO (TPDO1)", "upper wires open", "out of range", "x")
            texts = [name.replace("…", word) for name in known for word in words]
            fits = any(re.match(pattern, text) for text in [*texts, *known])
            assert fits, pattern
        assert set(rule.evidence) <= set(rule.follow)
