r"""Makes untrusted text printable; only this module defines which characters output may contain.

Text from a device, a file, a recording or the command line is untrusted. The rules are:

* Text from a bus or an EDS is made printable when decoded (:func:`printable`), and is limited to one line.
  The original bytes are preserved in ``od --json``, in a DCF and in comparisons.
* A name in hand.toml that is not printable is rejected (``skinnode.config``).
* The output of every command passes through :class:`PrintableStream`, and output from rich passes through the
  console of ``skinnode.cli``. Both mechanisms are safety nets for echoed text, such as file names and
  arguments.
* In HTML pages, text is also HTML-escaped, so that untrusted text is never interpreted as markup.

Text is printable according to :meth:`str.isprintable` if it contains no control characters (C0, DEL, C1), no
format characters (some of which reverse the text direction or have no width) and no surrogates. Non-printable
characters are replaced by Python escapes: ``\x1b``, ``\u202e``.
"""

from __future__ import annotations

import re
from typing import Any, Final, TextIO

MOST: Final = 200
"""Maximum number of characters shown of an untrusted text; longer than any name, but short enough for one
line."""

_SUSPECT: Final = re.compile(r"[^ -~]")
_SUSPECT_IN_LINES: Final = re.compile(r"[^\n\t -~]")


def printable(text: str | bytes, most: int = MOST) -> str:
    """Return ``text`` on one line, without control sequences.

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
    """Return the whole ``text`` without control sequences, but keep its line ends and tabs.

    Use this function for messages that contain untrusted parts.
    """
    return text if text.isprintable() else _SUSPECT_IN_LINES.sub(_escaped, text)


def _escaped(found: re.Match[str]) -> str:
    character = found[0]
    return character if character.isprintable() else repr(character)[1:-1]


class PrintableStream:
    """Wrapper for a text stream, such as stdout, that escapes control characters.

    Because of the attribute ``rich_proxied_file``, output from rich bypasses the wrapper.
    """

    def __init__(self, stream: TextIO) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        """Write ``text`` with its control characters escaped, and return its length."""
        if not isinstance(text, str):
            raise TypeError(f"write() argument must be str, not {type(text).__name__}")
        self.rich_proxied_file.write(printable_lines(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write each of ``lines`` with its control characters escaped."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)
