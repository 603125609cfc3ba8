r"""Makes untrusted text safe to print. No other module defines which characters are printable.

Text from a device, a file, a recording or the command line is untrusted. The rules are:

* Text from a bus or an EDS is converted to one printable line when it is decoded (:func:`printable`). Only
  ``od --json``, DCF files and comparisons use the original bytes.
* A name in hand.toml that is not printable is rejected (``skinnode.config``).
* The output of every command passes through :class:`PrintableStream`, or through the console of
  ``skinnode.cli`` if the output comes from rich. File names and arguments in the output are therefore
  escaped, too.
* In HTML pages, text is also HTML-escaped, so that untrusted text is never interpreted as markup.

The method :meth:`str.isprintable` decides whether a character is printable. Control characters, surrogates
and format characters, such as those that reverse the text direction, are not printable. Non-printable
characters are replaced by Python escape sequences, such as ``\x1b`` and ``\u202e``.
"""

from __future__ import annotations

import re
from typing import Any, Final, TextIO

MOST: Final = 200
"""Maximum number of characters of an untrusted text that are printed. Names are always shorter than 200
characters."""

_SUSPECT: Final = re.compile(r"[^ -~]")
_SUSPECT_IN_LINES: Final = re.compile(r"[^\n\t -~]")


def printable(text: str | bytes, most: int = MOST) -> str:
    """Return ``text`` as one line, with non-printable characters escaped.

    Args:
        text: The text. Bytes are decoded as a VISIBLE_STRING: one character per byte, without trailing NULs.
        most: Maximum number of characters; longer text is truncated and ends in ``…``.
    """
    if isinstance(text, bytes):
        text = text.rstrip(b"\0").decode("latin-1")
    shown = text[: most + 1]
    shown = shown if shown.isprintable() else _SUSPECT.sub(_escaped, shown)
    return shown if len(shown) <= most and len(text) <= most else shown[:most] + "…"


def printable_lines(text: str) -> str:
    """Return ``text`` with non-printable characters escaped, except line ends and tabs.

    Use this function for messages that contain untrusted parts.
    """
    return text if text.isprintable() else _SUSPECT_IN_LINES.sub(_escaped, text)


def _escaped(found: re.Match[str]) -> str:
    character = found[0]
    return character if character.isprintable() else repr(character)[1:-1]


class PrintableStream:
    """Wrapper for a text stream, such as stdout, that escapes non-printable characters.

    Rich finds the original stream in the attribute ``rich_proxied_file`` and writes to that stream directly.
    """

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        """Write ``text`` with non-printable characters escaped; return the length of ``text``."""
        if not isinstance(text, str):
            raise TypeError(f"write() argument must be str, not {type(text).__name__}")
        self.rich_proxied_file.write(printable_lines(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write ``lines`` with non-printable characters escaped."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)
