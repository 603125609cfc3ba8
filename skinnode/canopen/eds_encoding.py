"""Decodes EDS and DCF files whose character encoding is unknown.

CiA 306 requires ASCII, but some tools write other encodings. Decoding is lossless: each non-ASCII byte
becomes a lone surrogate (PEP 383). :func:`for_people` converts such text for display.
"""

from __future__ import annotations

import codecs
from typing import Final, NamedTuple

ASCII: Final = "ASCII"

MOST_EDS_BYTES: Final = 2 << 20
"""Maximum accepted size of an EDS file in bytes; twenty times the size of a patch's EDS."""

_UTF_16: Final = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
_CODECS: Final = {
    ASCII: "utf-8",
    "UTF-8": "utf-8",
    "UTF-8 with BOM": "utf-8",
    "UTF-16 with BOM": "utf-8",
    "Windows-1252": "cp1252",
    "Latin-1": "latin-1",
}
"""Python codecs for the bytes in an :class:`EdsText`, keyed by encoding name."""


class EdsText(NamedTuple):
    """Text of an EDS or DCF file, and its presumed encoding."""

    text: str
    """Text in which lone surrogates represent all non-ASCII bytes, with LF line endings."""
    encoding: str
    """Name of the encoding, for display."""

    @property
    def codec(self) -> str:
        """Python codec for the bytes that the surrogates represent. UTF-16 files are converted to UTF-8."""
        return _CODECS[self.encoding]

    @property
    def readable(self) -> str:
        """Text for display."""
        return for_people(self.text, self.codec)

    @property
    def note(self) -> str:
        """Note to display if the encoding is not ASCII; otherwise empty."""
        return "" if self.encoding == ASCII else f"read as {self.encoding}: an EDS should be ASCII"


def read_eds_text(data: bytes) -> EdsText:
    """Decode an EDS or DCF file.

    If the file has a byte order mark, the mark determines the encoding and is removed. Otherwise, the
    encoding is the first of ASCII, UTF-8, Windows-1252 and Latin-1 that can decode the file.

    Args:
        data: content of the file.

    Raises:
        UnicodeDecodeError: if a file with a UTF-16 byte order mark is not valid UTF-16.
    """
    bom = data[:2]
    if bom in _UTF_16:
        data, encoding = data[2:].decode(_UTF_16[bom]).encode("utf-8"), "UTF-16 with BOM"
    elif data.startswith(codecs.BOM_UTF8) and _is(data, "utf-8"):
        data, encoding = data.removeprefix(codecs.BOM_UTF8), "UTF-8 with BOM"
    elif data.isascii():
        encoding = ASCII
    elif _is(data, "utf-8"):
        encoding = "UTF-8"
    else:
        encoding = "Windows-1252" if _is(data, "cp1252") else "Latin-1"
    text = octets_text(data).replace("\r\n", "\n").replace("\r", "\n")
    return EdsText(text, encoding)


def octets_text(data: bytes) -> str:
    """Decode bytes to text in which each non-ASCII byte becomes a lone surrogate."""
    return data.decode("ascii", "surrogateescape")


def octets(text: str) -> bytes:
    """Encode text: surrogates become their original bytes, and other non-ASCII characters become UTF-8."""
    return text.encode("utf-8", "surrogateescape")


def for_people(text: str, codec: str) -> str:
    """Convert text with surrogates for display. Bytes that the codec cannot decode become U+FFFD."""
    return octets(text).decode(codec, "replace")


def _is(data: bytes, codec: str) -> bool:
    try:
        data.decode(codec)
    except UnicodeDecodeError:
        return False
    return True
