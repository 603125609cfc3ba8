"""Reads the text of an EDS or DCF file in any encoding.

CiA 306 requires ASCII, but tools also write other encodings. Reading is lossless: each non-ASCII byte
becomes a lone surrogate (PEP 383), from which the original bytes of a value can be recovered.
:func:`for_people` decodes text for display.
"""

from __future__ import annotations

import codecs
from typing import Final, NamedTuple

ASCII: Final = "ASCII"

MOST_EDS_BYTES: Final = 2 << 20
"""Maximum file size, bytes; twenty times the size of a patch's EDS, and larger than the EDS of any known
device."""

_UTF_16: Final = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
_CODECS: Final = {
    ASCII: "utf-8",
    "UTF-8": "utf-8",
    "UTF-8 with BOM": "utf-8",
    "UTF-16 with BOM": "utf-8",
    "Windows-1252": "cp1252",
    "Latin-1": "latin-1",
}
"""Python codec for the original bytes of an :class:`EdsText`, by encoding."""


class EdsText(NamedTuple):
    """Text of a file and its assumed encoding."""

    text: str
    """ASCII text with lone surrogates for other bytes; lines end in ``\\n``."""
    encoding: str
    """Human-readable name of the encoding."""

    @property
    def codec(self) -> str:
        """Codec for the bytes that the surrogates represent; UTF-16 has been converted to UTF-8."""
        return _CODECS[self.encoding]

    @property
    def readable(self) -> str:
        """Decoded text."""
        return for_people(self.text, self.codec)

    @property
    def note(self) -> str:
        """One-line note for the user; empty for an ASCII file."""
        return "" if self.encoding == ASCII else f"read as {self.encoding}: an EDS should be ASCII"


def read_eds_text(data: bytes) -> EdsText:
    """Return the text of a file and its encoding.

    The byte order mark determines the encoding. Without a mark, the encoding is the first of ASCII, UTF-8,
    Windows-1252 and Latin-1 that fits. Nothing but the mark is lost.

    Args:
        data: the bytes of the file.

    Raises:
        UnicodeDecodeError: if the text is malformed UTF-16.
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
    """Return bytes as text from which :func:`octets` can recover them."""
    return data.decode("ascii", "surrogateescape")


def octets(text: str) -> bytes:
    """Return the original bytes of a file's text; genuine non-ASCII characters are encoded as UTF-8."""
    return text.encode("utf-8", "surrogateescape")


def for_people(text: str, codec: str) -> str:
    """Decode the text of a file for display; bytes that the codec cannot decode become U+FFFD."""
    return octets(text).decode(codec, "replace")


def _is(data: bytes, codec: str) -> bool:
    try:
        data.decode(codec)
    except UnicodeDecodeError:
        return False
    return True
