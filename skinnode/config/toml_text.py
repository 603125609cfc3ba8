"""Reads TOML files, and finds the line and column of each key.

tomllib parses a file and checks its syntax, but does not record positions. A scanner therefore reads each
file again after tomllib has accepted it, to find the positions of the keys. No maintained TOML parser that
records positions is as strict as tomllib.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from skinnode.errors import NOTHING, ConfigError, Shown
from skinnode.files.input_file import read_input

KeyPath = tuple[int | str, ...]
"""Path of a key: ``patches[1].node_id`` is represented as ``("patches", 1, "node_id")``."""

_GAP: Final = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_SPACE: Final = re.compile(r"[ \t]*")
_STRING: Final = (
    r'"""(?:\\.|[^\\])*?"""(?:"{1,2}(?!"))?'
    r"|'''(?s:.)*?'''(?:'{1,2}(?!'))?"
    r'|"(?:\\.|[^"\\\n])*"'
    r"|'[^'\n]*'"
)
_VALUE: Final = re.compile(rf"{_STRING}|[^,\[\]{{}}#\n]+", re.DOTALL)
_KEY: Final = re.compile(r'"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|[A-Za-z0-9_-]+')
_LONGEST_LINE: Final = 60
_DEEPEST: Final = 32
"""Maximum number of parts of a key path. Keys in a hand file have at most six parts."""
_PART: Final = r"(?:[\w-]++|\"[^\"\n]*+\"|'[^'\n]*+')[ \t]*+"
_LONG_KEY: Final = re.compile(rf"(?<![\w\-\"'])(?:{_PART}\.[ \t]*+){{{4 * _DEEPEST}}}")
"""Pattern for a key with at least 4 × ``_DEEPEST`` parts. It also matches any other text with that many words
joined by dots, but hand files contain no such text."""
_LEAST, _MOST = -(1 << 63), (1 << 63) - 1  # range of integers in TOML 1.0
_INTEGERS: Final = "integers from -2^63 to 2^63 - 1"
_TOO_LONG: Final = Shown("a longer integer")
_TOO_DEEP: Final = f"tables and arrays nested at most {_DEEPEST} deep"


@dataclass(frozen=True, slots=True)
class Document:
    """Content of a TOML file, with the positions of its keys."""

    path: str
    table: dict[str, Any]
    places: Mapping[KeyPath, tuple[int, int]]
    """Line and column of each key, array item and table, counted from 1."""

    def where(self, key: KeyPath) -> str:
        """Return ``file:line:column`` of a key or, if the key is missing, of the enclosing table."""
        for length in range(len(key), 0, -1):
            if key[:length] in self.places:
                line, column = self.places[key[:length]]
                return f"{self.path}:{line}:{column}"
        return self.path


def read_toml(path: Path, what: str) -> Document:
    """Read a TOML file.

    Args:
        path: The file.
        what: Kind of file, for error messages.

    Raises:
        ConfigError: The file cannot be read, is not TOML, is nested too deeply, or contains an integer
            outside the range of TOML 1.0. The message is one line.
    """
    try:
        text = read_input(what, path).decode()
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"byte {error.start}", error.object[error.start : error.end], "UTF-8", where=str(path)
        ) from None
    if _LONG_KEY.search(text):  # tomllib would take minutes
        raise ConfigError(what, Shown("deeper nesting"), _TOO_DEEP, where=str(path))
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise _syntax_error(str(path), text, str(error)) from None
    except RecursionError:
        raise ConfigError(what, Shown("deeper nesting"), _TOO_DEEP, where=str(path)) from None
    except ValueError:  # an integer with more digits than Python can convert
        raise ConfigError(what, _TOO_LONG, _INTEGERS, where=str(path)) from None
    leaves = list(_leaves(table))
    if any(len(key) > _DEEPEST for key, _ in leaves):
        raise ConfigError(what, Shown("deeper nesting"), _TOO_DEEP, where=str(path))
    document = Document(str(path), table, places(text))
    for key, value in leaves:
        if isinstance(value, int) and not _LEAST <= value <= _MOST:
            raise ConfigError(str(key[-1]), _TOO_LONG, _INTEGERS, where=document.where(key))
    return document


def _leaves(table: dict[str, Any]) -> Iterator[tuple[KeyPath, Any]]:
    """Yield the path and value of each scalar, empty table or array, and value that is nested too deeply."""
    todo: list[tuple[KeyPath, Any]] = [((), table)]
    while todo:
        key, value = todo.pop()
        inner: Iterable[tuple[int | str, Any]] = ()
        if isinstance(value, dict):
            inner = value.items()
        elif isinstance(value, list):
            inner = enumerate(value)
        if inner and len(key) <= _DEEPEST:
            todo += [((*key, part), item) for part, item in inner]
        else:
            yield key, value


def _syntax_error(where: str, text: str, message: str) -> ConfigError:
    """Convert an error message from tomllib to a ConfigError.

    The message ends with the position: ``(at line 3, column 5)`` or ``(at end of document)``.
    """
    match = re.fullmatch(r"(?P<what>.*) \(at (?P<place>.*)\)", message, flags=re.DOTALL)
    what, place = (match["what"], match["place"]) if match else (message, "somewhere")
    line = re.match(r"line (\d+)", place)
    lines = text.splitlines()
    got = lines[int(line[1]) - 1].strip() if line and int(line[1]) <= len(lines) else NOTHING
    shown = got if len(got) <= _LONGEST_LINE else Shown(repr(got)[: _LONGEST_LINE - 1] + "…")
    return ConfigError(place, shown, f"TOML ({what})", where=where)


def places(text: str) -> dict[KeyPath, tuple[int, int]]:
    """Return the line and column of each key, array item and table; tomllib must accept the document."""
    offsets = _Scanner(text.replace("\r\n", " \n")).offsets
    found, line, start = {}, 1, 0
    for path, offset in sorted(offsets.items(), key=lambda item: item[1]):
        line += text.count("\n", start, offset)
        start = offset
        found[path] = line, offset - text.rfind("\n", 0, offset)
    return found


class _Scanner:
    """Scanner that records the offset at which each path first occurs."""

    def __init__(self, text: str) -> None:
        self._text, self._at = text, 0
        self.offsets: dict[KeyPath, int] = {}
        self._newest: dict[KeyPath, int] = {}  # index of the last item of each array of tables
        table: KeyPath = ()
        self._skip(_GAP)
        while self._at < len(text):
            if self._peek("["):
                table = self._header()
            else:
                self._pair(table)
            self._skip(_GAP)

    def _peek(self, sign: str) -> bool:
        return self._text.startswith(sign, self._at)

    def _skip(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self._text, self._at)
        assert match is not None, f"tomllib accepted text that this scanner rejects, at {self._at}"
        self._at = match.end()
        return match[0]

    def _note(self, path: KeyPath, offset: int) -> None:
        self.offsets.setdefault(path, offset)

    def _names(self) -> list[str]:
        """Read the parts of a dotted key such as ``a . "b"``."""
        names = []
        while True:
            self._skip(_SPACE)
            name = self._skip(_KEY)
            names.append(next(iter(tomllib.loads(f"{name} = 0"))))
            self._skip(_SPACE)
            if not self._peek("."):
                return names
            self._at += 1

    def _header(self) -> KeyPath:
        start, brackets = self._at, 2 if self._peek("[[") else 1
        self._at += brackets
        names = self._names()
        self._at += brackets
        path: KeyPath = ()
        for depth, name in enumerate(names, 1):
            path = (*path, name)
            self._note(path, start)
            if depth == len(names) and brackets == 2:
                self._newest[path] = self._newest.get(path, -1) + 1
            if path in self._newest:
                path = (*path, self._newest[path])
                self._note(path, start)
        return path

    def _pair(self, table: KeyPath) -> None:
        start = self._at
        path = table
        for name in self._names():
            path = (*path, name)
            self._note(path, start)
        self._at += 1  # =
        self._skip(_SPACE)
        self._value(path)

    def _value(self, path: KeyPath) -> None:
        if self._peek("["):
            self._items(path, "]")
        elif self._peek("{"):
            self._items(path, "}")
        else:
            self._skip(_VALUE)

    def _items(self, path: KeyPath, end: str) -> None:
        """Scan the items of an array or an inline table."""
        self._at += 1
        index = 0
        self._skip(_GAP)
        while not self._peek(end):
            if end == "]":
                self._note((*path, index), self._at)
                self._value((*path, index))
            else:
                self._pair(path)
            index += 1
            self._skip(_GAP)
            if self._peek(","):
                self._at += 1
                self._skip(_GAP)
        self._at += 1
