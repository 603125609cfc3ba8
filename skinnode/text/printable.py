r"""Escapes non-printable characters in untrusted text.

Text from a device, a file, a recording or the command line is untrusted. It is handled as follows:

* Text from a bus or an EDS is converted to one printable line when it is decoded (:func:`printable`). Only
  ``od --json``, DCF files and comparisons use the original bytes.
* ``skinnode.config`` rejects names in hand.toml that are not printable.
* All command output passes through :class:`PrintableStream` or, for output by rich, through the console of
  ``skinnode.cli``. This includes file names and arguments.
* In HTML pages, HTML special characters are also escaped.

:meth:`str.isprintable` defines which characters are printable. Control characters, surrogates and format
characters, such as those that reverse the text direction, are not printable. They are replaced with Python
escape sequences such as ``\x1b`` and ``\u202e``.
"""

from __future__ import annotations

import re
from typing import Any, Final, TextIO

MOST: Final = 200
"""Maximum length of untrusted text, in characters; longer text is truncated. All valid names are shorter."""

_SUSPECT: Final = re.compile(r"[^ -~]")
_SUSPECT_IN_LINES: Final = re.compile(r"[^\n\t -~]")


def printable(text: str | bytes, most: int = MOST) -> str:
    """Return ``text`` as one line, with non-printable characters escaped.

    Args:
        text: Text, or the bytes of a VISIBLE_STRING, one per character; trailing NULs are removed.
        most: Maximum number of characters; longer text is truncated and ends in ``…``.
    """
    if isinstance(text, bytes):
        text = text.rstrip(b"\0").decode("latin-1")
    shown = text[: most + 1]
    shown = shown if shown.isprintable() else _SUSPECT.sub(_escaped, shown)
    return shown if len(shown) <= most and len(text) <= most else shown[:most] + "…"


def printable_lines(text: str) -> str:
    """Return ``text`` with non-printable characters escaped, except newlines and tabs.

    This function is meant for messages that contain untrusted text.
    """
    return text if text.isprintable() else _SUSPECT_IN_LINES.sub(_escaped, text)


def _escaped(found: re.Match[str]) -> str:
    character = found[0]
    return character if character.isprintable() else repr(character)[1:-1]


class PrintableStream:
    """Wrapper around a text stream, such as stdout, that escapes non-printable characters.

    Rich bypasses the wrapper: it writes to the stream in the ``rich_proxied_file`` attribute.
    """

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        """Write ``text`` with non-printable characters escaped; return the length of the original text."""
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
