"""The hand as its integrator writes it down: ``hand.toml`` to frozen, validated options.

:func:`load_hand` reads a file, :func:`parse_hand` a table that is already in memory. Both raise
:class:`~skinnode.errors.ConfigError` with one line: the file, the dotted key, what was found there and what
is allowed. Types are strict, as TOML is typed: ``node_id = "3"`` is an error, not a 3.

Units are the suffixes of the keys; everything without one is a count, a ratio or a name.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from skinnode.errors import BusLoadError, ConfigError
from skinnode.model.layout import PatchLayout

MAX_BUS_LOAD: Final = 0.70
"""Share of a bus a plan may need, every frame counted at its longest. The rest is for SDO, EMCY, heartbeats
and whoever else is on the bus; above 70 % the response times of low priorities grow steeply (Davis, Burns,
Bril, Lukkien: Controller Area Network (CAN) schedulability analysis, Real-Time Systems 35, 2007)."""

Preset = Literal["aligned", "symmetric", "staggered"]
Method = Literal["auto", "exact", "posterior"]
Coordinates = Literal["preset", "node"]
Role = Literal["master", "guest"]
GuestSends = Literal["nothing", "sdo"]
Missing = Literal["refuse", "wait"]
Operator = Literal["gauss_newton", "levenberg_marquardt", "dogleg"]


@dataclass(frozen=True, slots=True)
class _Allowed:
    """Rides along in the type of a field: what a technician may write there."""

    text: str


_Stiffness = Annotated[
    float, Field(ge=1e-3, le=1e12, allow_inf_nan=False), _Allowed("a number of N/m from 1e-3 to 1e12")
]
_Speed = Annotated[
    float, Field(ge=1e-6, le=10.0, allow_inf_nan=False), _Allowed("a number of m/s from 1e-6 to 10")
]
_Cycle = Annotated[
    float, Field(ge=0.1, le=3600.0, allow_inf_nan=False), _Allowed("a number of seconds from 0.1 to 3600")
]
_Length = Annotated[
    float, Field(ge=1e-6, le=1.0, allow_inf_nan=False), _Allowed("a number of metres from 1e-6 to 1")
]
_Resistivity = Annotated[
    float, Field(ge=1e-3, le=1e15, allow_inf_nan=False), _Allowed("a number of ohm/m from 1e-3 to 1e15")
]
_Ratio = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False), _Allowed("a number from 0 to below 1")]
_Wires = Annotated[int, Field(ge=1, le=254), _Allowed("an integer from 1 to 254")]
_Name = Annotated[str, Field(min_length=1, max_length=64), _Allowed("a text of 1 to 64 characters")]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class BusConfig(_Table):
    """One CAN bus: any interface python-can knows, by its name there."""

    name: _Name = "can0"
    interface: Annotated[str, Field(min_length=1), _Allowed("the name of a python-can interface")] = "virtual"
    channel: Annotated[str, Field(min_length=1), _Allowed("the name of a channel, as a text")] = "skin"
    bitrate_bps: Annotated[
        int,
        Field(ge=10_000, le=1_000_000),
        _Allowed("an integer from 10000 to 1000000, as classic CAN has it"),
    ] = 1_000_000
    fd: bool = False
    """PDOs of the patches on this bus travel in CAN FD frames with bit-rate switch."""
    data_bitrate_bps: Annotated[
        int, Field(ge=10_000, le=8_000_000), _Allowed("an integer from 10000 to 8000000")
    ] = 5_000_000
    """Of CAN FD frames, from ESI to the CRC delimiter."""
    role: Annotated[Role, _Allowed(" or ".join(get_args(Role)))] = "master"
    """``guest``: a robot's own master has NMT and SYNC on this bus; the host sends neither."""
    guest_sends: Annotated[GuestSends, _Allowed(" or ".join(get_args(GuestSends)))] = "nothing"
    """What a guest sends: ``sdo`` to identify and configure the patches and to fetch what they know."""
    heartbeat_node_id: Annotated[
        int | None, Field(ge=1, le=127), _Allowed("an integer from 1 to 127 that no node has")
    ] = None
    """Node-ID under which a master sends a heartbeat, which its patches then watch: they go pre-operational
    when it stops. None sends none."""


class LayoutConfig(_Table):
    """Geometry of a patch: the arguments of :meth:`skinnode.PatchLayout.preset`."""

    preset: Annotated[Preset, _Allowed(" or ".join(get_args(Preset)))] = "staggered"
    pitch_m: _Length = 4e-3
    height_m: _Length = 2e-3
    upper_wires: _Wires = 10
    upper_electrodes: _Wires = 10
    lower_wires: _Wires | None = None
    lower_electrodes: _Wires | None = None
    resistivity_ohm_per_m: _Resistivity = 1e7
    coordinates: Annotated[Coordinates, _Allowed(" or ".join(get_args(Coordinates)))] = "preset"
    """``node``: the patch itself says where its electrodes are (0x2300); the preset stands for it in plans
    and simulations, and its numbers of wires and electrodes must be right."""

    def build(self) -> PatchLayout:
        """The layout. Raises ValueError where the geometry is impossible."""
        return PatchLayout.preset(
            self.preset,
            pitch_m=self.pitch_m,
            height_m=self.height_m,
            upper_wires=self.upper_wires,
            upper_electrodes=self.upper_electrodes,
            lower_wires=self.lower_wires,
            lower_electrodes=self.lower_electrodes,
            resistivity_ohm_per_m=self.resistivity_ohm_per_m,
        )

    @property
    def n_codes(self) -> int:
        """Wire pairs of the patch, U·K."""
        return self.upper_wires * (
            3 * self.upper_electrodes if self.lower_wires is None else self.lower_wires
        )


class PatchConfig(_Table):
    """One patch of skin: who it is on the bus and what it looks like."""

    name: _Name
    node_id: Annotated[int, Field(ge=1, le=127), _Allowed("an integer from 1 to 127")]
    bus: _Name = "can0"
    eds: Annotated[Path | None, Field(strict=False), _Allowed("the path of an EDS file")] = None
    layout: LayoutConfig = LayoutConfig()
    code_bits: Annotated[Literal[16, 24], _Allowed("16 or 24")] = 16
    serial: Annotated[int | None, Field(ge=0, le=0xFFFF_FFFF), _Allowed("an integer from 0 to 2^32 - 1")] = (
        None
    )
    """Serial number the node must have (0x1018:4); None takes any."""
    """With it a node that does not answer at its node-ID is searched for by LSS and given it."""
    relative_noise: _Ratio = 3e-6
    """Standard deviation of the analogue noise of a resistance, relative, without quantisation."""
    baseline: Annotated[
        Path | None, Field(strict=False), _Allowed("the path of a file of resistances in ohm")
    ] = None
    """Resistances at rest as text, a line an upper wire and a number a lower wire; None: the node says."""

    @field_validator("eds", "baseline")
    @classmethod
    def _existing_file(cls, value: Path | None, info: ValidationInfo) -> Path | None:
        """A relative path is relative to the folder of the hand file."""
        if value is None:
            return None
        folder = (info.context or {}).get("folder", Path())
        path = Path(folder, value)
        if not path.is_file():
            what = "an EDS file" if info.field_name == "eds" else "a file of resistances in ohm"
            raise ValueError(f"the path of {what}; there is no file {path}")
        return path

    def chunks_per_scan(self, *, fd: bool) -> int:
        """Frames of a full scan without the summary: 3 codes of 16 bits or 2 of 24 in one, over CAN FD up to
        30 or 20 of one upper wire."""
        if not fd:
            return -(-self.layout.n_codes // (3 if self.code_bits == 16 else 2))
        rows = self.layout.upper_wires
        return rows * -(-self.layout.n_codes // rows // (30 if self.code_bits == 16 else 20))


class SyncConfig(_Table):
    """The SYNC the host produces. One SYNC is one scan of every patch."""

    period_ms: Annotated[int, Field(ge=1, le=60_000), _Allowed("an integer from 1 to 60000")] = 80
    counter_overflow: Annotated[
        int, Field(ge=0, le=240), _Allowed("an integer from 2 to 240; 0 where all buses are a guest's")
    ] = 240
    """Highest value of the SYNC counter (0x1019), which starts at 1 and names the scan; 0: the SYNC of
    another master has none, and scans are numbered by each patch for itself."""

    @property
    def period_s(self) -> float:
        return self.period_ms * 1e-3


class BringUpConfig(_Table):
    """How patches are taken up, at the start and later."""

    missing: Annotated[Missing, _Allowed(" or ".join(get_args(Missing)))] = "refuse"
    """A patch that does not answer at the start: refuse to start, or start with those that are there and take
    up the others when they come."""
    heartbeat_ms: Annotated[int, Field(ge=20, le=10_000), _Allowed("an integer from 20 to 10000")] = 250
    """Heartbeat the nodes are told to send, or do send where a guest does not tell them: a lost node shows
    within a second, at 0.1 % of the bus for four."""

    @property
    def heartbeat_s(self) -> float:
        return self.heartbeat_ms * 1e-3


class SolverConfig(_Table):
    """How resistances become displacements."""

    method: Annotated[Method, _Allowed(" or ".join(get_args(Method)))] = "auto"
    """The exact inverse of each wire, the posterior of the patch, or what suits layout and noise."""
    operator: Annotated[Operator, _Allowed(" or ".join(get_args(Operator)))] = "dogleg"
    """Of the exact inverse."""
    stiffness_n_per_m: _Stiffness | None = None
    """Stiffness of the rubber under one electrode; with it a field carries forces."""
    workers: Annotated[int | None, Field(ge=1, le=64), _Allowed("an integer from 1 to 64")] = None
    """Threads that solve patches side by side; None is one a processor core, at most one a patch."""


class SimulationConfig(_Table):
    """The scene ``vcan-sim`` plays on simulated patches: press, slide, lift, again. The host ignores it."""

    seed: Annotated[int, Field(ge=0), _Allowed("an integer of at least 0")] = 1
    indenter_radius_m: _Length = 0.04
    depth: Annotated[float, Field(gt=0, lt=1, allow_inf_nan=False), _Allowed("a number between 0 and 1")] = (
        0.1
    )
    """Deepest indentation as a share of the height of the upper layer."""
    shear_ratio: Annotated[
        float, Field(ge=0, le=2, allow_inf_nan=False), _Allowed("a number from 0 to 2")
    ] = 0.3
    """Tangential over normal load while sliding, the coefficient of friction."""
    slide_speed_m_per_s: _Speed = 0.008
    cycle_s: _Cycle = 4.0
    """Time of one press, slide and lift."""
    converter_noise: _Ratio = 3e-6
    """Standard deviation of the noise of the simulated converter, relative to the resistance."""


class HandConfig(_Table):
    """A hand: its buses, its patches and what the host does with them.

    Raises (as part of pydantic's ValidationError; :func:`parse_hand` unwraps it) ConfigError for names or
    node-IDs used twice, a bus that is not there or an impossible geometry, BusLoadError for a plan that
    does not fit its bus.
    """

    name: _Name = "hand"
    buses: Annotated[
        tuple[BusConfig, ...], Field(min_length=1, strict=False), _Allowed("at least one [[buses]]")
    ]
    patches: Annotated[
        tuple[PatchConfig, ...], Field(min_length=1, strict=False), _Allowed("at least one [[patches]]")
    ]
    sync: SyncConfig = SyncConfig()
    bring_up: BringUpConfig = BringUpConfig()
    solver: SolverConfig = SolverConfig()
    simulation: SimulationConfig = SimulationConfig()

    def bus(self, name: str) -> BusConfig:
        """The bus of that name. Raises KeyError."""
        return {bus.name: bus for bus in self.buses}[name]

    def patch(self, name: str) -> PatchConfig:
        """The patch of that name. Raises KeyError."""
        return {patch.name: patch for patch in self.patches}[name]

    def patches_on(self, bus: str) -> tuple[PatchConfig, ...]:
        """The patches on the bus of that name, in the order of the file."""
        return tuple(patch for patch in self.patches if patch.bus == bus)

    def on(self, interface: str | None = None, channel: str | None = None) -> HandConfig:
        """The same hand on another interface or channel, as ``--interface`` and ``--channel`` ask for.

        Raises ConfigError where a channel is given for a hand of several buses.
        """
        if channel is not None and len(self.buses) > 1:
            raise ConfigError("--channel", channel, f"no channel for a hand of {len(self.buses)} buses")
        change = {"interface": interface, "channel": channel}
        kept = {key: value for key, value in change.items() if value is not None}
        for key, value in kept.items():
            if not value:
                raise ConfigError(f"--{key}", value, "a name")
        return self.model_copy(update={"buses": tuple(bus.model_copy(update=kept) for bus in self.buses)})

    def bus_load(self, name: str) -> float:
        """Load of the bus if every frame of every scan is sent and takes as long as it can, 1 is full."""
        bus, patches = self.bus(name), self.patches_on(name)
        chunk_s = _longest_fd_frame_s(bus) if bus.fd else _worst_case_bits(8) / bus.bitrate_bps
        chunks = sum(patch.chunks_per_scan(fd=bus.fd) for patch in patches)
        rest = len(patches) * _worst_case_bits(8) + _worst_case_bits(
            1
        )  # summaries, the SYNC with its counter
        return (chunks * chunk_s + rest / bus.bitrate_bps) / self.sync.period_s

    @model_validator(mode="after")
    def _cross_checks(self) -> HandConfig:
        _require_unique("buses", "name", [bus.name for bus in self.buses])
        _require_unique("buses", "channel", [(bus.interface, bus.channel) for bus in self.buses])
        _require_unique("patches", "name", [patch.name for patch in self.patches])
        names = [bus.name for bus in self.buses]
        for i, patch in enumerate(self.patches):
            if patch.bus not in names:
                raise ConfigError(f"patches[{i}].bus", patch.bus, f"a bus of this file: {', '.join(names)}")
            if not self.bus(patch.bus).fd and patch.chunks_per_scan(fd=False) > 256:  # their index is a byte
                most = 256 * (3 if patch.code_bits == 16 else 2)
                allowed = f"at most {most} wire pairs at {patch.code_bits} bits"
                raise ConfigError(f"patches[{i}].layout", patch.layout.n_codes, allowed)
            try:
                patch.layout.build()
            except ValueError as error:
                raise ConfigError(f"patches[{i}].layout", patch.layout.preset, str(error)) from None
        _require_unique("patches", "node_id", [(patch.bus, patch.node_id) for patch in self.patches])
        self._check_roles()
        for i, bus in enumerate(self.buses):
            load = self.bus_load(bus.name)
            if load > MAX_BUS_LOAD:
                needed_ms = -(-self.sync.period_ms * load // MAX_BUS_LOAD)
                raise BusLoadError(
                    f"buses[{i}] ({bus.name})",
                    _Shown(f"a plan that needs {load:.0%} of {bus.bitrate_bps} bit/s"),
                    f"at most {MAX_BUS_LOAD:.0%}; sync.period_ms = {needed_ms:.0f} or fewer patches would do",
                )
        return self

    def _check_roles(self) -> None:
        """What a bus cannot give its host, or its patches, in the role it has."""
        overflow, guest = self.sync.counter_overflow, all(bus.role == "guest" for bus in self.buses)
        if overflow == 1 or (overflow == 0 and not guest):
            allowed = "an integer from 2 to 240; 0 where all buses are a guest's"
            raise ConfigError("sync.counter_overflow", overflow, allowed)
        for i, bus in enumerate(self.buses):
            node_ids = [patch.node_id for patch in self.patches_on(bus.name)]
            if bus.role == "guest" and bus.heartbeat_node_id is not None:
                raise ConfigError(f"buses[{i}].heartbeat_node_id", bus.heartbeat_node_id, "none for a guest")
            if bus.heartbeat_node_id in node_ids:
                allowed = "an integer from 1 to 127 that no node has"
                raise ConfigError(f"buses[{i}].heartbeat_node_id", bus.heartbeat_node_id, allowed)
        for i, patch in enumerate(self.patches):
            bus = self.bus(patch.bus)
            if bus.role == "master" or bus.guest_sends == "sdo":
                continue
            if patch.baseline is None:
                allowed = f"a file: on {bus.name} the host is a guest that sends nothing"
                raise ConfigError(f"patches[{i}].baseline", _NOTHING, allowed)
            if patch.layout.coordinates == "node":
                allowed = f"preset: on {bus.name} the host is a guest that sends nothing"
                raise ConfigError(f"patches[{i}].layout.coordinates", "node", allowed)


def load_hand(path: Path | str) -> HandConfig:
    """Read a hand file. Paths in it are relative to its folder.

    Raises ConfigError, in one line: file that cannot be read, TOML syntax, unknown or missing key, wrong
    type, value out of range, and everything HandConfig checks.
    """
    path = Path(path)
    return parse_hand(_read_toml(path, "hand file"), folder=path.parent, where=str(path))


def load_layout(path: Path | str) -> PatchLayout:
    """Read a layout file: a TOML file with the keys of ``[patches.layout]``. Raises ConfigError as
    :func:`load_hand`, and for an impossible geometry."""
    path = Path(path)
    table = _read_toml(path, "layout file")
    try:
        return LayoutConfig.model_validate(table).build()
    except ValidationError as error:
        raise _first_error(error, str(path), LayoutConfig) from None
    except ValueError as error:
        raise ConfigError("layout", table.get("preset", "staggered"), str(error), where=str(path)) from None


def _read_toml(path: Path, what: str) -> dict[str, Any]:
    try:
        text = path.read_bytes().decode()
    except OSError as error:
        raise ConfigError(what, str(path), f"a file that can be read ({error.strerror})") from None
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"byte {error.start}", error.object[error.start : error.end], "UTF-8", where=str(path)
        ) from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise _syntax_error(str(path), text, str(error)) from None


def parse_hand(table: Mapping[str, Any], *, folder: Path | None = None, where: str = "") -> HandConfig:
    """Validate a table with the keys of a hand file. ``folder`` is where relative paths start (default: the
    working directory), ``where`` the file to name in errors. Raises ConfigError as :func:`load_hand`.
    """
    try:
        return HandConfig.model_validate(table, context={"folder": folder or Path()})
    except ValidationError as error:
        raise _first_error(error, where) from None


def _worst_case_bits(length: int) -> int:
    """Bits of a standard data frame of ``length`` bytes with the most stuff bits there can be, with
    inter-frame space (Davis et al. 2007, eq. 1)."""
    stuffed = 34 + 8 * length
    return stuffed + 13 + (stuffed - 1) // 4


def _longest_fd_frame_s(bus: BusConfig) -> float:
    """The same of a CAN FD frame of 64 bytes: 29 bits and 3 stuff bits at the nominal bit rate; at that of
    the data 5 + 512 bits before the CRC field, 33 in it and after, and a stuff bit in 4 of the data (ISO
    11898-1:2015)."""
    return (29 + 3) / bus.bitrate_bps + (5 + 512 + 33 + 128) / bus.data_bitrate_bps


def _require_unique(table: str, key: str, values: Iterable[object]) -> None:
    seen: dict[object, int] = {}
    for i, value in enumerate(values):
        if value in seen:
            shown = value[-1] if isinstance(value, tuple) else value
            raise ConfigError(f"{table}[{i}].{key}", shown, f"one that {table}[{seen[value]}] does not use")
        seen[value] = i


class _Shown(str):
    """A text that an error shows without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


_NOTHING: Final = _Shown("nothing")
_LONGEST_SHOWN: Final = 60


def _short(value: object) -> object:
    text = repr(value)
    return value if len(text) <= _LONGEST_SHOWN else _Shown(text[: _LONGEST_SHOWN - 1] + "…")


def _dotted(location: tuple[int | str, ...]) -> str:
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return "".join(parts).removeprefix(".")


def _first_error(error: ValidationError, where: str, table: type[BaseModel] = HandConfig) -> ConfigError:
    """The first of pydantic's errors about a ``table`` in the words of this project."""
    found = error.errors()
    # A misspelt key that is required is missing as well; its misspelling says more.
    first = next((item for item in found if item["type"] == "extra_forbidden"), found[0])
    location, kind = first["loc"], first["type"]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, ConfigError):  # from a check of ours that knows its key
        return type(cause)(cause.key, cause.got, cause.allowed, where=where)
    keys, allowed = _place(location, table)
    if kind == "extra_forbidden":
        unknown = str(location[-1])
        close = difflib.get_close_matches(unknown, keys, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        listed = f"no such key{hint}; the keys here are {', '.join(keys)}"
        return ConfigError(_dotted(location), _short(first["input"]), listed, where=where)
    if kind == "value_error" and cause is not None:
        allowed = str(cause)
    got = _NOTHING if kind == "missing" else _short(first["input"])
    if allowed is None:
        allowed = re.sub(r"^Input should be ", "", first["msg"])
    return ConfigError(_dotted(location), got, allowed, where=where)


def _place(location: tuple[int | str, ...], table: type[BaseModel]) -> tuple[list[str], str | None]:
    """The keys of the table in ``table`` that holds ``location``, and what is allowed at ``location``
    itself."""
    allowed: str | None = None
    for depth, part in enumerate(location):
        if isinstance(part, int):
            allowed = "a table"
            continue
        field = table.model_fields.get(part)
        if field is None:
            break
        marks = [mark.text for mark in field.metadata if isinstance(mark, _Allowed)]
        inner = _tables_in(field.annotation)
        allowed = next(iter([*marks, *_marks_in(field.annotation)]), "a table" if inner else None)
        if inner and depth < len(location) - 1:
            table = inner[0]
    return list(table.model_fields), allowed


def _tables_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in get_args(annotation) for table in _tables_in(part)]


def _marks_in(annotation: Any) -> list[str]:
    """Marks below a union, as in ``_Stiffness | None``."""
    own = [mark.text for mark in getattr(annotation, "__metadata__", ()) if isinstance(mark, _Allowed)]
    return own + [text for part in get_args(annotation) for text in _marks_in(part)]


def _syntax_error(where: str, text: str, message: str) -> ConfigError:
    """tomllib ends its message with the place: ``(at line 3, column 5)`` or ``(at end of document)``."""
    match = re.fullmatch(r"(?P<what>.*) \(at (?P<place>.*)\)", message, flags=re.DOTALL)
    what, place = (match["what"], match["place"]) if match else (message, "somewhere")
    line = re.match(r"line (\d+)", place)
    lines = text.splitlines()
    got: object = lines[int(line[1]) - 1].strip() if line and int(line[1]) <= len(lines) else _NOTHING
    return ConfigError(place, _short(got), f"TOML ({what})", where=where)
