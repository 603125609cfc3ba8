"""Checks EDS files for CiA 306 format errors that parsers silently ignore."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final

from skinnode.errors import ProfileError, Shown

_HEADER: Final = re.compile(r"\[(.+)\]")
_OBJECT: Final = re.compile(r"[0-9a-f]{4}(sub[0-9a-f]{1,2})?", re.IGNORECASE)
_FURTHER: Final = re.compile(r"[0-9a-f]{4}(?!sub)[g-z][a-z]*", re.IGNORECASE)
"""Pattern of titles such as 1003Value and 1003ObjectLinks. No digits may follow the index, so a misspelled
sub-object such as 1018sb1 does not match."""
_OF_OBJECT: Final = re.compile(r"[0-9]\w*|[0-9a-f]{4}sub.*", re.IGNORECASE)
"""Pattern of titles that seem to denote an object, including malformed ones."""
_NUMBER: Final = re.compile(r"0x[0-9a-f]{1,8}|[0-9]{1,10}", re.IGNORECASE)
_LISTS: Final = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")
_NUMBERS: Final = ("objecttype", "datatype", "pdomapping", "subnumber", "compactsubobj")
_LONGEST_SHOWN: Final = 60


def check_form(text: str, source: str) -> None:
    """Check the titles of object sections and the lists of objects in an EDS file.

    Args:
        text: content of the file.
        source: name of the file, for the error message.

    Raises:
        ProfileError: if there is a format error. The message contains the line of the first error.
    """
    for line, section, key, value in _lines(text):
        if not key:
            if _OF_OBJECT.fullmatch(section) and not (
                _OBJECT.fullmatch(section) or _FURTHER.fullmatch(section)
            ):
                allowed = "[1018] for an object, [1018sub1] for a sub-object, in hexadecimal"
                raise _mistake("section", f"[{section}]", allowed, source, line)
        elif section.lower() in _LISTS and (key.isdecimal() or key.lower() == "supportedobjects"):
            value = value or ("" if key.isdecimal() else "0")
            number = int(value, 0 if value[1:2] in "xX" else 10) if _NUMBER.fullmatch(value) else None
            if number is None or not (number <= 0xFFFF or not key.isdecimal()):
                allowed = "an index such as 0x1018" if key.isdecimal() else "a number"
                raise _mistake(f"[{section}] {key}", value, allowed, source, line)


def no_eds(error: Exception, source: str, text: str = "") -> ProfileError:
    """Convert an EDS parser's exception to a ProfileError, with the line or section if known."""
    numbers = [getattr(error, "lineno", None), *(line for line, _ in getattr(error, "errors", ()))]
    line = next(filter(None, numbers), None)
    if line is not None:
        shown = [*text.split("\n"), ""][min(line, text.count("\n") + 1) - 1]
        allowed = (
            "a file in CiA 306 format: each [section] once, each key once per section, ';' before comments"
        )
        return _mistake("EDS", shown, allowed, source, line)
    for line, section, key, value in _lines(text):
        if _OBJECT.fullmatch(section) and key.lower() in _NUMBERS and not _NUMBER.fullmatch(value):
            return _mistake(f"[{section}] {key}", value, "a number", source, line)
    within, missing = (getattr(error, name, None) for name in ("section", "option"))
    if within and missing:
        return _mistake(f"[{within}]", Shown(f"no {missing}"), "a file in CiA 306 format", source)
    titles = {section.lower() for _, section, key, _ in _lines(text) if not key}
    for line, section, key, _ in _lines(text):
        if (
            not key
            and "sub" in section.lower()
            and _OBJECT.fullmatch(section)
            and section[:4].lower() not in titles
        ):
            allowed = f"section [{section[:4]}] before it"
            return _mistake("section", f"[{section}]", allowed, source, line)
    what = " ".join(str(error).split()) or type(error).__name__
    return _mistake("EDS", Shown(what[:_LONGEST_SHOWN]), "a file in CiA 306 format", source)


def _mistake(key: str, got: str, allowed: str, source: str, line: int | None = None) -> ProfileError:
    where = source if line is None else f"{source}:{line}"
    cut = got if len(got) <= _LONGEST_SHOWN else got[:_LONGEST_SHOWN] + "…"
    return ProfileError(key, Shown(cut) if isinstance(got, Shown) else cut, allowed, where=where)


def _lines(text: str) -> Iterator[tuple[int, str, str, str]]:
    """Yield the line number, section, key and value of each line.

    The key and value of a section header are empty. Comments and continuation lines are skipped.
    """
    section = ""
    for number, line in enumerate(text.split("\n"), 1):
        if header := _HEADER.match(line):
            section = header[1]
            yield number, section, "", ""
        elif line[:1] not in (";", "#", " ", "\t", ""):
            key, _, value = line.partition("=")
            yield number, section, key.strip() or "=", value.strip()
