"""Select random mutants of the source: ``python -m tools.mutation.draw`` writes ``mutants.json``.

The mutation operators come from cosmic-ray. Places in the source are drawn with equal probability, and
then one mutation is drawn for each place. If mutations were drawn directly, a ``+``, which has eleven
mutations, would be drawn eleven times as often as a ``not``, which has one.

A mutant is identified by its file, function and operator, and by the text before and after the change, so a
list of mutants remains valid when code moves. Places are ranked by a hash of the seed and their source text,
so an edit has little effect on which other places are drawn.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
import json
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import cosmic_ray.plugins
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code

ROOT: Final = Path(__file__).parents[2]
LIST: Final = Path(__file__).with_name("mutants.json")
GROUPS: Final = {
    "protocol": ("canopen", "protocol", "bus_load"),
    "node": ("node",),
    "solve": ("solve",),
    "host": ("host",),
}
"""Packages in each group; mutants are drawn separately for each group."""
SEED: Final = 20260
PER_PACKAGE: Final = 50

_NEED_ARGUMENTS: Final = ("core/VariableReplacer", "core/VariableInserter")
_DECORATORS_FOR_SPEED: Final = ("njit", "njit_part", "njit_body", "njit_brief", "cache", "lru_cache")


@dataclass(frozen=True)
class Mutant:
    """A single change to a single source file."""

    file: str
    """Path relative to the root of the repository."""
    function: str
    """Qualified name of the innermost function or class that contains the change, or ``<module>``."""
    operator: str
    """Operator name in cosmic-ray."""
    before: str
    """Lines removed by the change."""
    after: str
    """Lines added by the change."""
    nth: int
    """Zero-based index among the file's mutants that are equal in all other fields."""

    @property
    def name(self) -> str:
        """Name of the mutant: the first ten hexadecimal digits of a hash of all its fields."""
        return _digest(self.file, self.function, self.operator, self.before, self.after, self.nth)[:10]

    @property
    def group(self) -> str:
        package = Path(self.file).parts[1]
        return next(group for group, packages in GROUPS.items() if package in packages)


def _digest(*parts: object) -> str:
    return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()


@dataclass(frozen=True)
class _Candidate:
    operator: str
    occurrence: int
    line: int
    column: int


class _OnlyBehaviour(ast.NodeTransformer):
    """Remove parts of the syntax tree that need no tests: annotations, f-strings and speed decorators."""

    def visit_AnnAssign(self, node: ast.AnnAssign) -> Any:
        node.annotation = ast.Constant(0)
        return self.generic_visit(node)

    def visit_arg(self, node: ast.arg) -> Any:
        node.annotation = None
        return node

    def visit_arguments(self, node: ast.arguments) -> Any:
        node.args = [*node.posonlyargs, *node.args, *node.kwonlyargs]  # mypy checks keyword-only arguments
        node.defaults += [each for each in node.kw_defaults if each is not None]
        node.posonlyargs, node.kwonlyargs, node.kw_defaults = [], [], []
        return self.generic_visit(node)

    def _function(self, node: Any) -> Any:
        node.returns = None
        return self._decorated(node)

    def _decorated(self, node: Any) -> Any:
        node.decorator_list = [each for each in node.decorator_list if not _for_speed(each)]
        return self.generic_visit(node)

    visit_FunctionDef = visit_AsyncFunctionDef = _function
    visit_ClassDef = _decorated

    def visit_JoinedStr(self, node: ast.JoinedStr) -> Any:
        return ast.Constant("")

    def visit_Call(self, node: ast.Call) -> Any:
        if isinstance(node.func, ast.Name) and node.func.id == "dataclass":
            node.keywords = []  # mypy catches the mistakes that frozen and slots prevent
        return self.generic_visit(node)

    def visit_If(self, node: ast.If) -> Any:
        if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return None
        return self.generic_visit(node)


def _for_speed(decorator: ast.expr) -> bool:
    while isinstance(decorator, ast.Call):
        decorator = decorator.func
    name = decorator.attr if isinstance(decorator, ast.Attribute) else getattr(decorator, "id", "")
    return name in _DECORATORS_FOR_SPEED


def _behaviour(source: str) -> str | None:
    """Return the syntax tree without the parts that need no tests; None if ``source`` does not compile."""
    try:
        with warnings.catch_warnings(
            action="ignore"
        ):  # a mutant may cause a warning, for example by comparing a literal with "is"
            compile(source, "mutant", "exec")
    except (SyntaxError, ValueError):
        return None
    return ast.dump(_OnlyBehaviour().visit(ast.parse(source)))


def _functions(source: str) -> dict[int, str]:
    """Map each line number to the qualified name of the innermost function or class that contains it."""
    names: dict[int, str] = {}

    def walk(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                first = min([child.lineno, *(each.lineno for each in child.decorator_list)])
                for line in range(first, (child.end_lineno or first) + 1):
                    names[line] = prefix + child.name
                walk(child, f"{prefix}{child.name}.")
            else:
                walk(child, prefix)

    walk(ast.parse(source), "")
    return names


@cache
def _operators() -> dict[str, Any]:
    names = [name for name in cosmic_ray.plugins.operator_names() if name not in _NEED_ARGUMENTS]
    return {name: cosmic_ray.plugins.get_operator(name)() for name in names}


def _candidates(source: str, operators: dict[str, Any]) -> Iterator[_Candidate]:
    nodes = list(ast_nodes(get_ast(source)))
    for name, operator in operators.items():
        occurrence = 0
        for node in nodes:
            for (line, column), _ in operator.mutation_positions(node):
                yield _Candidate(name, occurrence, line, column)
                occurrence += 1


def mutated(source: str, operator: str, occurrence: int) -> str:
    """Return ``source`` with one mutation applied. Raises LookupError if the occurrence does not exist."""
    code = mutate_code(source, _operators()[operator], occurrence)
    if code is None:
        raise LookupError(f"{operator}: no occurrence {occurrence}")
    return str(code)


def _changed_lines(source: str, other: str) -> tuple[str, str]:
    lines = list(difflib.unified_diff(source.splitlines(), other.splitlines(), lineterm="", n=0))[2:]
    removed = [line[1:].strip() for line in lines if line.startswith("-")]
    added = [line[1:].strip() for line in lines if line.startswith("+")]
    return "\n".join(removed), "\n".join(added)


def _name(file: str, source: str, wanted: _Candidate) -> Mutant:
    """Convert a candidate to a mutant; ``nth`` is the number of equal mutations before it in the file."""
    functions = _functions(source)
    function = functions.get(wanted.line, "<module>")
    before, after = _changed_lines(source, mutated(source, wanted.operator, wanted.occurrence))
    line = source.splitlines()[wanted.line - 1]
    nth = 0
    for each in _candidates(source, {wanted.operator: _operators()[wanted.operator]}):
        if each.occurrence >= wanted.occurrence:
            break
        if functions.get(each.line, "<module>") == function and source.splitlines()[each.line - 1] == line:
            same = _changed_lines(source, mutated(source, each.operator, each.occurrence))
            nth += same == (before, after)
    return Mutant(file, function, wanted.operator, before, after, nth)


def find(mutant: Mutant, source: str) -> str:
    """Return ``source`` with ``mutant`` applied. Raises LookupError if the code to change is missing."""
    functions = _functions(source)
    nth = 0
    for each in _candidates(source, {mutant.operator: _operators()[mutant.operator]}):
        if functions.get(each.line, "<module>") != mutant.function:
            continue
        other = mutated(source, each.operator, each.occurrence)
        if _changed_lines(source, other) == (mutant.before, mutant.after):
            if nth == mutant.nth:
                return other
            nth += 1
    raise LookupError(
        f"{mutant.name}: {mutant.function} in {mutant.file} no longer contains {mutant.before!r}"
    )


def draw(group: str, count: int, seed: int, root: Path = ROOT) -> list[Mutant]:
    """Draw ``count`` mutants at different places in a group's packages."""
    sources: dict[str, str] = {}
    places: dict[str, list[tuple[str, _Candidate]]] = defaultdict(list)
    folders = [root / "skinnode" / package for package in GROUPS[group]]
    for path in sorted(path for folder in folders for path in folder.rglob("*.py")):
        file, source = str(path.relative_to(root)), path.read_text("utf-8")
        sources[file] = source
        functions, lines = _functions(source), source.splitlines()
        seen: Counter[tuple[str, ...]] = Counter()
        names: dict[tuple[int, int], str] = {}
        for each in sorted(_candidates(source, _operators()), key=lambda found: (found.line, found.column)):
            at = each.line, each.column
            if at not in names:
                text = lines[each.line - 1]
                column = each.column - (len(text) - len(text.lstrip()))
                place = (file, functions.get(each.line, "<module>"), text.strip(), str(column))
                names[at] = _digest(seed, *place, seen[place])
                seen[place] += 1
            places[names[at]].append((file, each))
    drawn: list[Mutant] = []
    for place_name in sorted(places):
        if len(drawn) == count:
            break
        of_operator: Counter[str] = Counter()
        ranked: list[tuple[str, str, _Candidate]] = []
        for file, each in places[place_name]:
            ranked.append((_digest(place_name, each.operator, of_operator[each.operator]), file, each))
            of_operator[each.operator] += 1
        for _, file, each in sorted(ranked, key=lambda entry: entry[0]):
            behaviour = _behaviour(mutated(sources[file], each.operator, each.occurrence))
            if behaviour is not None and behaviour != _behaviour(sources[file]):
                drawn.append(_name(file, sources[file], each))
                break
    return drawn


def read() -> list[Mutant]:
    """Read the list of mutants from ``mutants.json``."""
    return [Mutant(**entry) for entry in json.loads(LIST.read_text("utf-8"))["mutants"]]


def write(mutants: list[Mutant]) -> None:
    """Write ``mutants`` to ``mutants.json``, ordered by group and file."""
    mutants = sorted(
        mutants, key=lambda each: (list(GROUPS).index(each.group), each.file, each.function, each.name)
    )
    entries = [asdict(each) for each in mutants]
    LIST.write_text(
        json.dumps({"seed": SEED, "mutants": entries}, indent=1, ensure_ascii=False) + "\n", "utf-8"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Select new mutants for the given packages and keep all other mutants."
    )
    parser.add_argument("--package", choices=GROUPS, action="append")
    packages = parser.parse_args().package or list(GROUPS)
    kept = [each for each in read() if each.group not in packages] if LIST.exists() else []
    for package in packages:
        drawn = draw(package, PER_PACKAGE, SEED)
        print(f"{package}: {len(drawn)} mutants in {len({each.file for each in drawn})} files")
        kept += drawn
    write(kept)


if __name__ == "__main__":
    main()
