"""Patch sizes that determine the wire format.

A patch sends its U×K codes in *chunks*: TPDO1 carries a u8 chunk index, a u8 scan counter and 3 codes of 16
bits (or 2 codes of 24 bits). The codes are in row-major order: all codes of upper wire 0 first, then those of
upper wire 1, and so on. TPDO2 carries the *summary*, which ends each scan and contains a checksum of all
codes (:mod:`skinnode.protocol.scan_check`).

Over CAN FD, a chunk carries codes of a single upper wire: u8 wire, u8 scan counter, u16 first column and up
to 30 codes of 16 bits (or 20 codes of 24 bits). All chunks of a patch have the same length: the total length
of the mapped objects, padded to the next valid CAN FD length. If a patch has more columns than fit into a
chunk, the codes of each upper wire are split evenly into several chunks.

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
"""SYNC period (ms) for which the default settings are chosen. With this period, four 10×30 patches cause
a load of about 2/3 on a 1 Mbit/s bus."""

BusType = Literal["classic", "fd"]
"""Type of the frames that carry PDOs: classic CAN with up to 8 bytes, or CAN FD with up to 64 bytes."""

_MOST_SUBINDICES: Final = 254  # sub-index 255 is reserved by CiA 301


@dataclass(frozen=True, slots=True)
class PatchProfile:
    """Patch sizes that determine the wire format.

    Raises:
        ConfigError: if a number of wires exceeds 254, the size of an array in the object dictionary; if a
            scan has more than 256 chunks (classic CAN); if the code width is not 16 or 24 bits; or if a
            number of electrodes or PDOs is out of range.
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
    """Width of a code, bits: 16 or 24."""
    rpdos: int = 4
    """Number of RPDOs; RPDO1 carries commands, and all others are spare."""
    tpdos: int = 4
    """Number of TPDOs; TPDO1 carries chunks, TPDO2 carries summaries, and all others are spare."""
    bus: BusType = "classic"
    """Type of the frames that carry PDOs: classic CAN or CAN FD."""
    checked: bool = True
    """Whether summaries contain a scan check; false for patches of revision 1.0, which send the 32-bit device
    time instead."""

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
        """Return the profile of a patch with the electrodes of ``layout``.

        Args:
            layout: electrodes of the patch.
            code_bits: width of a code in bits, 16 or 24.
            bus: type of the frames that carry PDOs.
        """
        rows, upper_electrodes = layout.upper_m.shape[:2]
        columns, lower_electrodes = layout.lower_m.shape[:2]
        return cls(rows, columns, upper_electrodes, lower_electrodes, code_bits, bus=bus)

    @classmethod
    def from_config(cls, patch: PatchConfig, bus: BusConfig) -> PatchProfile:
        """Return the profile of a patch from the configurations of the patch and its bus in the hand file."""
        return cls.from_layout(patch.layout.build(), patch.code_bits, "fd" if bus.fd else "classic")

    @property
    def n_codes(self) -> int:
        """Number of codes in a scan, U·K."""
        return self.rows * self.columns

    @property
    def pdo_bytes(self) -> int:
        """Maximum PDO length in bytes, which is also the maximum number of objects in a PDO mapping."""
        return 8 if self.bus == "classic" else 64

    @property
    def chunk_head_bytes(self) -> int:
        """Number of bytes before the first code in a chunk."""
        return 2 if self.bus == "classic" else 4

    @property
    def _most_codes(self) -> int:
        return (self.pdo_bytes - self.chunk_head_bytes) * 8 // self.code_bits

    @property
    def lines(self) -> int:
        """Number of code sequences per scan: 1 on classic CAN, one per upper wire on CAN FD."""
        return 1 if self.bus == "classic" else self.rows

    @property
    def chunks_per_line(self) -> int:
        """Number of chunks per code sequence. Unused codes in its last chunk are sent as 0 and ignored."""
        return -(-self.n_codes // self.lines // self._most_codes)

    @property
    def codes_per_chunk(self) -> int:
        """Number of codes per chunk.

        A chunk carries 3 codes (16-bit) or 2 codes (24-bit) on classic CAN, and up to 30 or 20 on CAN FD.
        """
        return self._most_codes if self.bus == "classic" else -(-self.columns // self.chunks_per_line)

    @property
    def n_chunks(self) -> int:
        """Number of chunks in a full scan."""
        return self.lines * self.chunks_per_line

    @property
    def chunk_bytes(self) -> int:
        """Length of a chunk's payload, bytes."""
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
        """Default inhibit time of TPDO1 (0x1800:3), in units of 100 µs.

        With this inhibit time, a full scan of up to 720 chunks takes at most nine tenths of the default
        period. The inhibit time is at most 1 ms.
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
