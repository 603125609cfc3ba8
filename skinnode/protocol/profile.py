"""The object dictionary of a patch, written once.

A patch of U×K codes sends them in *chunks*: TPDO1 carries u8 chunk index, u8 scan counter and 3 codes of
16 bits (or 2 of 24), codes in row-major order, upper wire first. TPDO2, the *summary*, ends each scan and
carries a check over all codes of the matrix (:func:`skinnode.protocol.codec.scan_check`).

PDO over CAN FD: a chunk is a part of one upper wire: u8 wire, u8 scan counter, u16 first column and up to 30
codes of 16 bits (or 20 of 24). All chunks of a patch are of one length, that of the mapping padded to the
next one CAN FD has; a patch of more columns sends each wire in several, as even as they can be.

What a patch measures, counts or sends has no default: it is no setting.

``python -m skinnode.protocol.profile eds/`` writes the reference EDS files again.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from skinnode.canopen import indices as od
from skinnode.canopen.communication import PdoDefault, communication_objects, spare_pdo
from skinnode.canopen.data_length import fd_length
from skinnode.canopen.dictionary import DataType, Entry, Object, array, record, var
from skinnode.canopen.eds import Commissioning, DeviceInfo, render_eds
from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout

if TYPE_CHECKING:
    from skinnode.config import BusConfig, PatchConfig

_U8, _U16, _U32, _REAL32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32, DataType.REAL32

DEFAULT_CODE_LO: Final = 0.25
DEFAULT_CODE_HI: Final = 1.25
"""Codes span R/R0 from lo to hi: a press brings electrodes closer and R down, a slide some of them apart."""
DEFAULT_PERIOD_MS: Final = 80
"""SYNC period the defaults are made for: four 10×30 patches load 1 Mbit/s to about two thirds."""
DEFAULT_REFRESH_SCANS: Final = 10
"""What a lost scan left unknown is known again within 0.8 s, for a tenth of the full traffic."""

BusType = Literal["classic", "fd"]
"""Frames that PDOs travel in: CAN 2.0 of up to 8 bytes, or CAN FD of up to 64."""

_MOST_SUBINDICES: Final = 254  # CiA 301: sub-index 255 is reserved


@dataclass(frozen=True, slots=True)
class PatchProfile:
    """Sizes of a patch as its wire format knows them.

    Raises ConfigError for a size that does not fit an array of the object dictionary (254) or the chunk
    index (256 chunks), for a code width other than 16 and 24 bits, and for more PDOs than CANopen has.
    """

    rows: int
    """Upper wires, U."""
    columns: int
    """Lower wires, K."""
    upper_electrodes: int
    """Electrodes of an upper wire, N."""
    lower_electrodes: int
    """Electrodes of a lower wire, M."""
    code_bits: int = 16
    rpdos: int = 4
    """RPDO1 takes commands, the others are spare."""
    tpdos: int = 4
    """TPDO1 carries chunks, TPDO2 summaries, the others are spare."""
    bus: BusType = "classic"
    checked: bool = True
    """Whether summaries carry a check over the scan. False: a patch of revision 1.0, whose summaries carry 32
    bits of device time instead."""

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
        """The profile of a patch with the electrodes of ``layout``."""
        rows, upper_electrodes = layout.upper_m.shape[:2]
        columns, lower_electrodes = layout.lower_m.shape[:2]
        return cls(rows, columns, upper_electrodes, lower_electrodes, code_bits, bus=bus)

    @classmethod
    def from_config(cls, patch: PatchConfig, bus: BusConfig) -> PatchProfile:
        """The profile that the hand file says a patch on ``bus`` has."""
        return cls.from_layout(patch.layout.build(), patch.code_bits, "fd" if bus.fd else "classic")

    @property
    def n_codes(self) -> int:
        """Codes of a scan, U·K."""
        return self.rows * self.columns

    @property
    def pdo_bytes(self) -> int:
        """Most bytes of a PDO, and most objects mapped into it: the smallest is a byte."""
        return 8 if self.bus == "classic" else 64

    @property
    def chunk_head_bytes(self) -> int:
        """What comes before the codes of a chunk."""
        return 2 if self.bus == "classic" else 4

    @property
    def _most_codes(self) -> int:
        return (self.pdo_bytes - self.chunk_head_bytes) * 8 // self.code_bits

    @property
    def lines(self) -> int:
        """Runs of codes that are cut into chunks: the whole scan, or over CAN FD each upper wire."""
        return 1 if self.bus == "classic" else self.rows

    @property
    def chunks_per_line(self) -> int:
        """The unused codes of the last are sent as 0 and ignored."""
        return -(-self.n_codes // self.lines // self._most_codes)

    @property
    def codes_per_chunk(self) -> int:
        """3 of 16 bits, 2 of 24; over CAN FD up to 30 or 20, an even part of an upper wire."""
        return self._most_codes if self.bus == "classic" else -(-self.columns // self.chunks_per_line)

    @property
    def n_chunks(self) -> int:
        """Chunks of a full scan."""
        return self.lines * self.chunks_per_line

    @property
    def chunk_bytes(self) -> int:
        """Length of the frame of a chunk."""
        if self.bus == "classic":
            return 8
        return fd_length(self.chunk_head_bytes + self.codes_per_chunk * self.code_bits // 8)

    @property
    def revision_number(self) -> int:
        """Value of 0x1018:3."""
        return od.REVISION_NUMBER if self.checked else od.UNCHECKED_REVISION_NUMBER

    @property
    def code_type(self) -> DataType:
        """Type of a code in the object dictionary."""
        return DataType.UNSIGNED16 if self.code_bits == 16 else DataType.UNSIGNED24

    @property
    def default_inhibit_100us(self) -> int:
        """Pace of the chunks (0x1800:3): a full scan in nine tenths of the default period, 1 ms at most."""
        return max(1, min(10, 9 * DEFAULT_PERIOD_MS // self.n_chunks))

    def objects(self) -> tuple[Object, ...]:
        """The whole object dictionary, by ascending index."""
        communication = communication_objects(
            _rpdos(self), _tpdos(self), self.pdo_bytes, self.revision_number
        )
        return (*communication, *_manufacturer_objects(self))


def _rpdos(profile: PatchProfile) -> list[PdoDefault]:
    acquisition, policy = _acquisition_record(), _send_policy_record()
    mapped = acquisition[od.TARE], acquisition[od.SINGLE_SCAN], policy[od.SEND_MODE]
    command = PdoDefault("command", od.command_cob_id(0), kind=255, mapped=mapped)
    numbers = range(1, profile.rpdos)
    return [command, *(spare_pdo(od.rpdo_cob_id(n, 0) if n < 4 else None) for n in numbers)]


def _tpdos(profile: PatchProfile) -> list[PdoDefault]:
    chunk = PdoDefault(
        "chunk",
        od.chunk_cob_id(0),
        mapped=_chunk_record(profile).entries[1:],
        inhibit_100us=profile.default_inhibit_100us,
    )
    fields = _summary_record(profile)
    third = (od.SUMMARY_TIME_64US, od.SUMMARY_CHECK) if profile.checked else (od.SUMMARY_TIME,)
    subs = od.SUMMARY_SCAN, od.SUMMARY_FLAGS, od.SUMMARY_CHUNKS, *third
    mapped = tuple(fields[sub] for sub in subs)
    summary = PdoDefault("summary", od.summary_cob_id(0), kind=1, mapped=mapped)
    numbers = range(2, profile.tpdos)
    return [chunk, summary, *(spare_pdo(od.tpdo_cob_id(n, 0) if n < 4 else None) for n in numbers)]


def _chunk_record(profile: PatchProfile) -> Object:
    head = [("Chunk index", _U8), ("Chunk scan counter", _U8)]
    if profile.bus == "fd":
        head = [("Upper wire", _U8), ("Chunk scan counter", _U8), ("First column", _U16)]
    codes = [(f"Code {i}", profile.code_type) for i in range(1, profile.codes_per_chunk + 1)]
    return record(
        od.CHUNK,
        "Chunk of a scan",
        [
            Entry(od.CHUNK, sub, name, data_type, "ro", mappable=True)
            for sub, (name, data_type) in enumerate(head + codes, 1)
        ],
    )


def _summary_record(profile: PatchProfile) -> Object:
    fields = [
        (od.SUMMARY_SCAN, "Summary scan counter", _U8),
        (od.SUMMARY_FLAGS, "Flags", _U8),
        (od.SUMMARY_CHUNKS, "Chunks sent", _U16),
        (od.SUMMARY_TIME, "Device time us", _U32),
    ]
    if profile.checked:
        fields += [(od.SUMMARY_TIME_64US, "Device time 64us", _U16), (od.SUMMARY_CHECK, "Scan check", _U16)]
    return record(
        od.SUMMARY,
        "Scan summary",
        [Entry(od.SUMMARY, sub, name, data_type, "ro", mappable=True) for sub, name, data_type in fields],
    )


def _send_policy_record() -> Object:
    return record(
        od.SEND_POLICY,
        "Send policy",
        (
            Entry(od.SEND_POLICY, od.SEND_MODE, "Send mode", _U8, "rww", 0, mappable=True, high=1),
            Entry(od.SEND_POLICY, od.SEND_THRESHOLD, "Delta threshold in codes", _U16, "rw", 2),
            Entry(
                od.SEND_POLICY,
                od.SEND_REFRESH,
                "Full refresh every n scans",
                _U16,
                "rw",
                DEFAULT_REFRESH_SCANS,
            ),
        ),
    )


def _acquisition_record() -> Object:
    return record(
        od.ACQUISITION,
        "Acquisition",
        (
            Entry(od.ACQUISITION, od.ACQUISITION_PERIOD, "Period ms, 0 at SYNC", _U16, "rw", 0),
            Entry(od.ACQUISITION, od.ACQUISITION_AVERAGING, "Averaging", _U8, "rw", 1, low=1),
            Entry(od.ACQUISITION, od.SELF_TEST, "Self-test", _U32, "rw", 0),
            Entry(od.ACQUISITION, od.TARE, "Tare", _U32, "rww", 0, mappable=True),
            Entry(od.ACQUISITION, od.SINGLE_SCAN, "Single scan", _U8, "rww", 0, mappable=True, high=1),
        ),
    )


def _time_record() -> Object:
    return record(
        od.TIME_OF_DAY,
        "Time of day",
        (
            Entry(od.TIME_OF_DAY, od.TIME_DAYS, "Days since 1984-01-01", _U16, "ro", mappable=True),
            Entry(od.TIME_OF_DAY, od.TIME_MS, "Milliseconds after midnight", _U32, "ro", mappable=True),
            Entry(od.TIME_OF_DAY, od.TIME_MESSAGES, "TIME messages", _U32, "ro"),
            Entry(od.TIME_OF_DAY, od.TIME_DEVICE_US, "Device time us of the last TIME", _U32, "ro"),
        ),
    )


_REJECTED = ("NMT", "SYNC", "TIME", "Heartbeat", "SDO", "RPDO", "Error control of the own node-ID")


def _self_test_record() -> Object:
    fields = (
        (od.TEST_STATUS, "Self-test status", _U8),
        (od.TEST_FAULTS, "Self-test faults", _U16),
        (od.TEST_READINGS, "Self-test readings", _U8),
        (od.TEST_NOISE, "Self-test relative noise", _REAL32),
        (od.TEST_OPEN_WIRES, "Open wires", _U16),
        (od.TEST_SHORTED_WIRES, "Shorted wires", _U16),
        (od.TEST_OUT_OF_RANGE, "Crossings out of range", _U32),
        (od.TEST_UNTARED, "Crossings without a baseline", _U32),
    )
    return record(
        od.SELF_TEST_RESULT,
        "Self-test result",
        [Entry(od.SELF_TEST_RESULT, sub, name, data_type, "ro") for sub, name, data_type in fields],
    )


def _wire_faults(index: int, name: str, wires: int) -> Object:
    labels = [f"{kind} from wire {first}" for first in range(0, wires, 32) for kind in ("Open", "Shorted")]
    return array(index, name, labels, _U32, "ro", mappable=True)


def _descriptor_record(profile: PatchProfile) -> Object:
    sizes = (
        (od.ROWS, "Upper wires", profile.rows),
        (od.COLUMNS, "Lower wires", profile.columns),
        (od.UPPER_ELECTRODES, "Upper electrodes", profile.upper_electrodes),
        (od.LOWER_ELECTRODES, "Lower electrodes", profile.lower_electrodes),
        (od.CODE_BITS, "Code bits", profile.code_bits),
    )
    return record(
        od.DESCRIPTOR,
        "Patch descriptor",
        (
            *(Entry(od.DESCRIPTOR, sub, name, _U8, "const", value) for sub, name, value in sizes),
            Entry(od.DESCRIPTOR, od.CODE_LO, "Code range low, of R0", _REAL32, "ro", DEFAULT_CODE_LO),
            Entry(od.DESCRIPTOR, od.CODE_HI, "Code range high, of R0", _REAL32, "ro", DEFAULT_CODE_HI),
            Entry(od.DESCRIPTOR, od.RESISTIVITY, "Resistivity ohm per m", _REAL32, "ro"),
            Entry(od.DESCRIPTOR, od.LAYOUT_ID, "Layout", _U8, "ro"),
            Entry(od.DESCRIPTOR, od.LAYOUT_HASH, "Layout hash", _U32, "ro"),
            Entry(od.DESCRIPTOR, od.SERIAL, "Serial", _U32, "ro"),
            Entry(od.DESCRIPTOR, od.PDO_BYTES, "Bytes of a PDO", _U8, "const", profile.pdo_bytes),
        ),
    )


def _manufacturer_objects(profile: PatchProfile) -> tuple[Object, ...]:
    columns = [f"Column {k}" for k in range(profile.columns)]
    return (
        _descriptor_record(profile),
        _chunk_record(profile),
        _summary_record(profile),
        _send_policy_record(),
        _acquisition_record(),
        _time_record(),
        _self_test_record(),
        _wire_faults(od.UPPER_WIRE_FAULTS, "Faults of upper wires", profile.rows),
        _wire_faults(od.LOWER_WIRE_FAULTS, "Faults of lower wires", profile.columns),
        array(od.REJECTED_FRAMES, "Rejected frames", _REJECTED, _U32, "ro"),
        *(
            array(od.CODES + r, f"Codes of upper wire {r}", columns, profile.code_type, "ro", mappable=True)
            for r in range(profile.rows)
        ),
        *(
            array(od.BASELINE + r, f"Baseline of upper wire {r}", columns, _REAL32, "rw")
            for r in range(profile.rows)
        ),
        var(od.COORDINATES, "Electrode coordinates", DataType.DOMAIN, "ro"),
        var(od.BASELINE_DOMAIN, "Baseline of all wires", DataType.DOMAIN, "rw"),
    )


def eds_name(profile: PatchProfile) -> str:
    """File name of the reference EDS of this wire format."""
    variant = "-fd" if profile.bus == "fd" else ""
    return f"skinnode-{profile.rows}x{profile.columns}-u{profile.code_bits}{variant}.eds"


def eds_text(profile: PatchProfile) -> str:
    """The electronic data sheet (CiA 306) of a patch; the same bytes for the same profile, always."""
    return render_eds(_device_info(profile, eds_name(profile)), profile.objects())


def dcf_text(profile: PatchProfile, node_id: int, bitrate_bps: int) -> str:
    """The device configuration file (CiA 306) of a patch with this node-ID on a bus of this bit rate; the
    same bytes for the same arguments, always.

    Raises ConfigError for a node-ID that is not 1 to 127 or a bit rate that a patch does not have.
    """
    if not 1 <= node_id <= od.MAX_NODE_ID:
        raise ConfigError("node_id", node_id, "1 to 127")
    if bitrate_bps not in od.BIT_RATES_BPS:
        raise ConfigError("bitrate_bps", bitrate_bps, f"one of {', '.join(map(str, od.BIT_RATES_BPS))}")
    name = eds_name(profile)
    file_name = f"{name.removesuffix('.eds')}-node{node_id}.dcf"
    device = Commissioning(node_id, bitrate_bps // 1000, f"patch {node_id}", name)
    return render_eds(_device_info(profile, file_name), profile.objects(), device)


def _device_info(profile: PatchProfile, file_name: str) -> DeviceInfo:
    variant = ", PDO over CAN FD" if profile.bus == "fd" else ""
    return DeviceInfo(
        file_name=file_name,
        description=f"{profile.rows} x {profile.columns} wires, {profile.code_bits}-bit codes{variant}",
        vendor_name="skinnode",
        vendor_number=od.VENDOR_ID,
        product_name=od.DEVICE_NAME,
        product_number=od.PRODUCT_CODE,
        revision_number=profile.revision_number,
        bit_rates_bps=od.BIT_RATES_BPS,
        rpdos=profile.rpdos,
        tpdos=profile.tpdos,
    )


REFERENCE_PROFILES: Final = (
    PatchProfile(10, 30, 10, 10, 16),
    PatchProfile(10, 30, 10, 10, 24),
    PatchProfile(10, 30, 10, 10, 16, bus="fd"),
    PatchProfile(10, 30, 10, 10, 24, bus="fd"),
)
"""One for each wire format; their EDS are kept in ``eds/``."""


def write_reference_files(folder: Path) -> None:
    """Write the EDS of every reference profile into ``folder``."""
    for profile in REFERENCE_PROFILES:
        (folder / eds_name(profile)).write_text(eds_text(profile), encoding="ascii", newline="\n")


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        sys.exit("usage: python -m skinnode.protocol.profile FOLDER (an existing folder, normally eds/)")
    write_reference_files(Path(sys.argv[1]))
