"""Decoding of EDS and DCF files with an unknown character encoding.

CiA 306 requires ASCII, but some tools write other encodings. No information is lost: each non-ASCII byte
becomes a lone surrogate (PEP 383), from which the original byte can be recovered. The function
:func:`for_people` decodes text with surrogates for display.
"""

from __future__ import annotations

import codecs
from typing import Final, NamedTuple

ASCII: Final = "ASCII"

MOST_EDS_BYTES: Final = 2 << 20
"""Maximum accepted size of an EDS file, in bytes. The limit is twenty times the size of a patch's EDS, and
greater than the size of any known EDS."""

_UTF_16: Final = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
_CODECS: Final = {
    ASCII: "utf-8",
    "UTF-8": "utf-8",
    "UTF-8 with BOM": "utf-8",
    "UTF-16 with BOM": "utf-8",
    "Windows-1252": "cp1252",
    "Latin-1": "latin-1",
}
"""Python codec for the original bytes of an :class:`EdsText`, by the name of its encoding."""


class EdsText(NamedTuple):
    """Text of an EDS or DCF file, and the encoding that was assumed."""

    text: str
    """ASCII text in which lone surrogates represent all non-ASCII bytes; lines end in ``\\n``."""
    encoding: str
    """Name of the encoding, for display."""

    @property
    def codec(self) -> str:
        """Python codec for the bytes that the surrogates represent; UTF-8 if the file was in UTF-16."""
        return _CODECS[self.encoding]

    @property
    def readable(self) -> str:
        """Text with its non-ASCII bytes decoded, for display."""
        return for_people(self.text, self.codec)

    @property
    def note(self) -> str:
        """One-line note about an encoding other than ASCII, for display; empty for an ASCII file."""
        return "" if self.encoding == ASCII else f"read as {self.encoding}: an EDS should be ASCII"


def read_eds_text(data: bytes) -> EdsText:
    """Return the text and the encoding of an EDS or DCF file.

    A byte order mark determines the encoding. Without a byte order mark, the encoding is the first of ASCII,
    UTF-8, Windows-1252 and Latin-1 that can decode the file. The returned text omits the byte order mark.

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
    """Decode bytes to text from which :func:`octets` can recover the bytes."""
    return data.decode("ascii", "surrogateescape")


def octets(text: str) -> bytes:
    """Encode text to its original bytes: surrogates become bytes, other non-ASCII characters become UTF-8."""
    return text.encode("utf-8", "surrogateescape")


def for_people(text: str, codec: str) -> str:
    """Decode text that contains surrogates, for display; bytes that the codec cannot decode become U+FFFD."""
    return octets(text).decode(codec, "replace")


def _is(data: bytes, codec: str) -> bool:
    try:
        data.decode(codec)
    except UnicodeDecodeError:
        return False
    return True
