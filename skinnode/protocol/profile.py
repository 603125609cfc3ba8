"""Dimensions and wire format of a patch.

**Classic CAN.** A patch sends the U×K codes of a scan in *chunks* (TPDO1). A chunk consists of a u8 chunk
index, a u8 scan counter, and 3 codes of 16 bits or 2 codes of 24 bits. Codes are sent in row-major order,
starting with all codes of upper wire 0. The *summary* (TPDO2) ends the scan and contains a CRC over all codes
(:mod:`skinnode.protocol.scan_check`).

**CAN FD.** A chunk carries codes of one upper wire. It consists of a u8 wire number, a u8 scan counter, the
u16 number of the first column, and up to 30 codes of 16 bits or 20 codes of 24 bits. If an upper wire has
more codes than fit in a chunk, they are split evenly among several chunks. All chunks of a patch have the
same length, padded to a valid CAN FD length.

The command ``python -m skinnode.protocol.profile eds/`` regenerates the reference EDS files
(:mod:`skinnode.protocol.eds_files`).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from skinnode.canopen import indices as od
from skinnode.canopen.data_length import fd_length
from skinnode.canopen.dictionary import DataType, Object
from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from skinnode.protocol.objects import patch_objects

if TYPE_CHECKING:
    from skinnode.config import BusConfig, PatchConfig

DEFAULT_PERIOD_MS: Final = 80
"""SYNC period in ms for which the default settings were chosen. With this period, four 10×30 patches use
about two thirds of the capacity of a 1 Mbit/s bus."""

BusType = Literal["classic", "fd"]
"""Frame format of PDOs: classic CAN (up to 8 bytes) or CAN FD (up to 64 bytes)."""

_MOST_SUBINDICES: Final = 254  # sub-index 255 is reserved by CiA 301


@dataclass(frozen=True, slots=True)
class PatchProfile:
    """Dimensions and wire format of a patch.

    Raises:
        ConfigError: If a number of wires, electrodes or PDOs is out of range; if the code width is neither 16
            nor 24 bits; or if a scan on classic CAN would have more than 256 chunks.
    """

    rows: int
    """Number of upper wires, U."""
    columns: int
    """Number of lower wires, K."""
    upper_electrodes: int
    """Number of electrodes per upper wire, N."""
    lower_electrodes: int
    """Number of electrodes per lower wire, M."""
    code_bits: int = 16
    """Width of a code in bits: 16 or 24."""
    rpdos: int = 4
    """Number of RPDOs. RPDO1 carries commands; the others are spare."""
    tpdos: int = 4
    """Number of TPDOs. TPDO1 carries chunks and TPDO2 carries summaries; the others are spare."""
    bus: BusType = "classic"
    """Frame format of PDOs."""
    checked: bool = True
    """Whether summaries contain a 16-bit device time and a scan check. If false, as in revision 1.0 patches,
    they contain a 32-bit device time instead."""

    def __post_init__(self) -> None:
        for name, least, most in (
            ("rows", 1, _MOST_SUBINDICES),
            ("columns", 1, _MOST_SUBINDICES),
            ("upper_electrodes", 1, 255),
            ("lower_electrodes", 1, 255),
            ("rpdos", 1, od.MAX_PDOS),
            ("tpdos", 2, od.MAX_PDOS),
        ):
            value = getattr(self, name)
            if not least <= value <= most:
                raise ConfigError(name, value, f"{least} to {most}")
        if self.code_bits not in (16, 24):
            raise ConfigError("code_bits", self.code_bits, "16 or 24")
        if self.bus not in ("classic", "fd"):
            raise ConfigError("bus", self.bus, "classic or fd")
        if self.bus == "classic" and self.n_chunks > 256:
            raise ConfigError(
                "rows × columns",
                self.n_codes,
                f"at most {256 * self.codes_per_chunk} codes of {self.code_bits} bits",
            )

    @classmethod
    def from_layout(cls, layout: PatchLayout, code_bits: int = 16, bus: BusType = "classic") -> PatchProfile:
        """Return the profile of a patch that has the electrodes in ``layout``.

        Args:
            layout: Electrodes of the patch.
            code_bits: Width of a code in bits, 16 or 24.
            bus: Frame format of PDOs.
        """
        rows, upper_electrodes = layout.upper_m.shape[:2]
        columns, lower_electrodes = layout.lower_m.shape[:2]
        return cls(rows, columns, upper_electrodes, lower_electrodes, code_bits, bus=bus)

    @classmethod
    def from_config(cls, patch: PatchConfig, bus: BusConfig) -> PatchProfile:
        """Return the profile of a patch, given its entry and its bus's entry in hand.toml."""
        return cls.from_layout(patch.layout.build(), patch.code_bits, "fd" if bus.fd else "classic")

    @property
    def n_codes(self) -> int:
        """Number of codes in a scan, U·K."""
        return self.rows * self.columns

    @property
    def pdo_bytes(self) -> int:
        """Maximum length of a PDO in bytes; also the maximum number of objects mapped into a PDO."""
        return 8 if self.bus == "classic" else 64

    @property
    def chunk_head_bytes(self) -> int:
        """Length in bytes of a chunk's header, which precedes the codes."""
        return 2 if self.bus == "classic" else 4

    @property
    def _most_codes(self) -> int:
        return (self.pdo_bytes - self.chunk_head_bytes) * 8 // self.code_bits

    @property
    def lines(self) -> int:
        """Number of sequences into which a scan's codes are divided before being split into chunks.

        A scan is one sequence on classic CAN, and one sequence per upper wire on CAN FD.
        """
        return 1 if self.bus == "classic" else self.rows

    @property
    def chunks_per_line(self) -> int:
        """Number of chunks per sequence of codes. Unused codes in the last chunk are 0."""
        return -(-self.n_codes // self.lines // self._most_codes)

    @property
    def codes_per_chunk(self) -> int:
        """Number of codes per chunk."""
        return self._most_codes if self.bus == "classic" else -(-self.columns // self.chunks_per_line)

    @property
    def n_chunks(self) -> int:
        """Number of chunks in a scan if all chunks are sent."""
        return self.lines * self.chunks_per_line

    @property
    def chunk_bytes(self) -> int:
        """Length of a chunk's payload in bytes."""
        if self.bus == "classic":
            return 8
        return fd_length(self.chunk_head_bytes + self.codes_per_chunk * self.code_bits // 8)

    @property
    def revision_number(self) -> int:
        """Revision number of the patch (0x1018:3)."""
        return od.REVISION_NUMBER if self.checked else od.UNCHECKED_REVISION_NUMBER

    @property
    def code_type(self) -> DataType:
        """Data type of a code in the object dictionary."""
        return DataType.UNSIGNED16 if self.code_bits == 16 else DataType.UNSIGNED24

    @property
    def default_inhibit_100us(self) -> int:
        """Default inhibit time of TPDO1 (0x1800:3) in units of 100 µs; at most 1 ms.

        With this inhibit time, sending all chunks of a scan (up to 720) takes at most nine tenths of the
        default period.
        """
        return max(1, min(10, 9 * DEFAULT_PERIOD_MS // self.n_chunks))

    def objects(self) -> tuple[Object, ...]:
        """Return all objects in the patch's object dictionary, in ascending order of index."""
        return patch_objects(self)


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        sys.exit("usage: python -m skinnode.protocol.profile FOLDER (an existing folder, normally eds/)")
    from skinnode.protocol.eds_files import write_reference_files

    write_reference_files(Path(sys.argv[1]))
