"""``[[patches]]``: node-ID, layout, pose, calibration and baseline of each patch."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from skinnode.config.explain import first_error
from skinnode.config.links import PoseConfig
from skinnode.config.table import (
    Allowed,
    Count,
    Length,
    Name,
    NodeId,
    Stiffness,
    Table,
    existing_file,
    one_of,
)
from skinnode.config.toml_text import read_toml
from skinnode.errors import ConfigError
from skinnode.model.elastic import Rubber
from skinnode.model.layout import PatchLayout, require_array
from skinnode.model.layout_file import from_electrodes, has_electrodes, impossible, read_npz
from skinnode.model.tolerances import EXACT, ORDINARY, Tolerances

Preset = Literal["aligned", "symmetric", "staggered"]
Coordinates = Literal["preset", "node"]

_Resistivity = Annotated[
    float, Field(ge=1e-3, le=1e15, allow_inf_nan=False), Allowed("a number from 1e-3 to 1e15 (ohm/m)")
]
_Noise = Annotated[
    float, Field(ge=1e-12, lt=1, allow_inf_nan=False), Allowed("a number of at least 1e-12 and below 1")
]
_RowTime = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False), Allowed("a number from 0 to 1e6 (µs)")]
_RUBBER = Rubber()
_Gain = Annotated[float, Field(ge=0.1, le=10, allow_inf_nan=False), Allowed("a number from 0.1 to 10")]
_Tolerance = Annotated[
    float, Field(ge=0, lt=0.5, allow_inf_nan=False), Allowed("a number of at least 0 and below 0.5")
]
_Position = Annotated[tuple[float, float, float], Field(strict=False)]
_Wire = Annotated[tuple[_Position, ...], Field(strict=False)]
_Wires = Annotated[
    tuple[_Wire, ...],
    Field(strict=False),
    Allowed("a list of wires, each a list of electrodes, each a list of three numbers (m)"),
]
_SHAPES: Final = {"upper_m": ("U", "N", 3), "lower_m": ("K", "M", 3)}
_NAMED_TOLERANCES: Final = {"ordinary": ORDINARY, "exact": EXACT}
_TOLERANCES: Final = '"ordinary", "exact" or a table of numbers'


class ElectrodesConfig(Table):
    """Contents of a layout file. Recordings contain layout files in this form; a hand file names the file."""

    upper_m: _Wires
    """Positions of the upper electrodes at rest, metres: x, y and z of each electrode of each wire."""
    lower_m: _Wires
    """Positions of the lower electrodes, metres: x, y and z of each electrode of each wire."""
    resistivity_ohm_per_m: _Resistivity
    """Resistance of the rubber between two electrodes, divided by their distance, ohm per metre."""
    name: str = "custom"
    """Name of the layout in messages."""

    def build(self) -> PatchLayout:
        """Return the layout. Raises ValueError if the geometry is impossible."""
        upper_m, lower_m = (
            require_array(name, getattr(self, name), shape) for name, shape in _SHAPES.items()
        )
        return PatchLayout(upper_m, lower_m, self.resistivity_ohm_per_m, self.name)

    @classmethod
    def of(cls, layout: PatchLayout) -> ElectrodesConfig:
        """Return the electrodes of ``layout``; :meth:`build` restores every number exactly."""
        return cls(
            upper_m=layout.upper_m.tolist(),
            lower_m=layout.lower_m.tolist(),
            resistivity_ohm_per_m=layout.resistivity_ohm_per_m,
            name=layout.name,
        )


class LayoutConfig(Table):
    """Geometry of a patch, from a preset (:meth:`skinnode.PatchLayout.preset`) or a file."""

    file: Annotated[Path | None, Field(strict=False), Allowed("the path of a layout file")] = None
    """NPZ or TOML file with the electrodes (``upper_m``, ``lower_m``, metres), or TOML file with the other
    keys of this table. If a file is given, the only other key allowed in the table is ``coordinates``. The
    path is relative to the hand file."""
    electrodes: ElectrodesConfig | None = None
    """Contents of the layout file, in a recording. The only other key allowed in the table is
    ``coordinates``."""
    preset: Annotated[Preset, one_of(Preset)] = "staggered"
    """Named arrangement of the electrodes."""
    pitch_m: Length = 4e-3
    """Distance between neighbouring electrodes of an upper wire, in metres."""
    height_m: Length = 2e-3
    """Height of the upper electrodes above the lower electrodes, in metres."""
    upper_wires: Count = 10
    """Number of upper wires, U; each upper wire is one row of the resistance matrix."""
    upper_electrodes: Count = 10
    """Number N of electrodes per upper wire."""
    lower_wires: Count | None = None
    """Number of lower wires, K; each lower wire is one column of the resistance matrix. If
    None, K is 3 N."""
    lower_electrodes: Count | None = None
    """Number of electrodes per lower wire, M. If None, M equals U."""
    resistivity_ohm_per_m: _Resistivity = 1e7
    """Resistance of the rubber between two electrodes, divided by their distance, ohm per metre."""
    coordinates: Annotated[Coordinates, one_of(Coordinates)] = "preset"
    """Source of the electrode positions: ``preset`` for this table, ``node`` for the patch itself (0x2300).
    Bus-load plans and simulations always use this table, so its numbers of wires and electrodes must be
    correct."""

    @field_validator("file")
    @classmethod
    def _existing(cls, value: Path | None, info: ValidationInfo) -> Path | None:
        return existing_file(value, info, "the path of a layout file")

    @model_validator(mode="after")
    def _file_or_keys(self) -> LayoutConfig:
        for source in ("file", "electrodes"):
            if getattr(self, source) is not None:
                for key in sorted(self.model_fields_set - {source, "coordinates"}):
                    raise ConfigError(key, getattr(self, key), f"only without layout.{source}")
        return self

    def build(self) -> PatchLayout:
        """Return the layout.

        Raises:
            ValueError: The geometry is impossible.
            ConfigError: The file cannot be used.
        """
        if self.file is not None:
            return load_layout(self.file)
        if self.electrodes is not None:
            return self.electrodes.build()
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

    def without_file(self) -> LayoutConfig:
        """Return a table that contains the electrodes instead of the name of a layout file.

        Raises:
            ConfigError: The file cannot be used.
        """
        if self.file is None:
            return self
        electrodes = ElectrodesConfig.of(load_layout(self.file))
        return LayoutConfig(electrodes=electrodes, coordinates=self.coordinates)


class CalibrationConfig(Table):
    """Measured properties of a patch; the baseline and the resistivity have their own keys."""

    stiffness_n_per_m: Stiffness | None = None
    """Stiffness of the rubber under one electrode, N/m; overrides ``solver.stiffness_n_per_m``."""
    young_pa: Annotated[
        float, Field(ge=1e3, le=1e10, allow_inf_nan=False), Allowed("a number from 1e3 to 1e10 (Pa)")
    ] = _RUBBER.young_pa
    """Young's modulus of the rubber, Pa, used to compute contact forces."""
    poisson: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False), Allowed("a number from 0 to 0.5")] = (
        _RUBBER.poisson
    )
    """Poisson's ratio of the rubber."""
    force_calibrated: bool = False
    """Whether ``young_pa`` has been calibrated on this patch, for instance by pressing it with typical
    objects while a load cell measures the force. If false, the standard deviations of normal forces are large
    enough to cover rubber bonded to a rigid support, where the force can be fifty times as high as for thick
    rubber. A modulus from a data sheet is not a calibration."""
    upper_gain: Annotated[tuple[_Gain, ...] | None, Field(strict=False), Allowed("a list of numbers")] = None
    """Correction factors, one per upper wire. Each factor multiplies the wire's measured resistances to
    correct drift since the baseline was measured."""

    @property
    def rubber(self) -> Rubber:
        """Rubber parameters used to compute forces."""
        return Rubber(self.young_pa, self.poisson)


class TolerancesConfig(Table):
    """Manufacturing tolerances of a patch, which are included in the reported standard deviations.

    `"ordinary"` selects the defaults below; `"exact"` is for a patch that matches its layout exactly, such as
    a simulated patch. The solver method `posterior` includes tolerances in its standard deviations; `exact`
    ignores them. If a patch has tolerances, `auto` selects `posterior`.
    """

    placement: _Tolerance = ORDINARY.placement
    """Standard deviation of the position of each wire along each axis, as a multiple of the pitch."""
    thickness: _Tolerance = ORDINARY.thickness
    """Standard deviation of the rubber thickness between upper and lower electrodes, as a fraction of the
    smallest distance between an upper and a lower electrode."""
    electrode_radius: _Tolerance = ORDINARY.electrode_radius
    """Radius of the electrodes, as a multiple of the pitch. The forward model assumes point electrodes."""
    gain: _Tolerance = ORDINARY.gain
    """Relative standard deviation of the front end's gain for changes in resistance."""

    @model_validator(mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value not in _NAMED_TOLERANCES:
            raise ConfigError("", value, _TOLERANCES)
        return asdict(_NAMED_TOLERANCES[value])

    def build(self) -> Tolerances:
        """Return the tolerances as a :class:`~skinnode.model.tolerances.Tolerances`."""
        return Tolerances(**self.model_dump())


def _or_named(schema: dict[str, Any]) -> None:
    """Allow the names of predefined tolerances in the JSON Schema of the key ``tolerances``."""
    named = {"type": "string", "enum": list(_NAMED_TOLERANCES)}
    schema["anyOf"] = [named, {"$ref": schema.pop("$ref")}]


class PatchConfig(Table):
    """Skin patch: identity on the bus, geometry and calibration."""

    name: Name
    """Name of the patch in programs and reports."""
    node_id: NodeId
    """CANopen node-ID, 1 to 127, unique on its bus."""
    bus: Name = "can0"
    """Name of the bus to which the patch is connected."""
    link: Name | None = None
    """Name of the robot link that carries the patch. If None, the patch is fixed to the hand itself."""
    pose: PoseConfig = PoseConfig()
    """Pose of the patch's coordinate frame in the frame of its link or, without a link, in the hand's frame.
    A link without a pose in ``[[links]]`` has the same frame as the hand."""
    eds: Annotated[Path | None, Field(strict=False), Allowed("the path of an EDS file")] = None
    """Electronic data sheet (EDS) to check against the wire format of this patch; the path is relative to the
    hand file."""
    layout: LayoutConfig = LayoutConfig()
    code_bits: Annotated[Literal[16, 24], Allowed("16 or 24")] = 16
    """Width of a resistance code on the bus, in bits."""
    serial: Annotated[int | None, Field(ge=0, le=0xFFFF_FFFF), Allowed("an integer from 0 to 2^32 - 1")] = (
        None
    )
    """Required serial number of the node (0x1018:4). If None, the host accepts any serial number. If no node
    answers at the node-ID, the host finds the node by its serial number over LSS and assigns the node-ID."""
    relative_noise: _Noise = 3e-6
    """Relative standard deviation of the analogue noise in a resistance measurement, excluding
    quantization."""
    row_time_us: _RowTime = 0.0
    """Time between the samples of successive upper wires in a scan, µs; 0 if all upper wires are sampled at
    once. If it is given, fields belong to the time at which the first upper wire was sampled."""
    baseline: Annotated[
        Path | None, Field(strict=False), Allowed("the path of a file of resistances in ohm")
    ] = None
    """File with the resistances at rest in ohms: one line per upper wire, one number per lower wire.
    If None, the host reads the resistances at rest from the node."""
    calibration: CalibrationConfig = CalibrationConfig()
    tolerances: Annotated[TolerancesConfig, Field(json_schema_extra=_or_named), Allowed(_TOLERANCES)] = (
        TolerancesConfig()
    )
    """Manufacturing tolerances: `"ordinary"` (the default) for a carefully manufactured patch, `"exact"` for
    a simulated patch, or a table of numbers. A calibration does not replace tolerances, because it does not
    cover the geometry."""

    @field_validator("eds", "baseline")
    @classmethod
    def _existing_file(cls, value: Path | None, info: ValidationInfo) -> Path | None:
        what = "an EDS file" if info.field_name == "eds" else "a file of resistances in ohm"
        return existing_file(value, info, f"the path of {what}")


def load_layout(path: Path | str) -> PatchLayout:
    """Read a layout file.

    Args:
        path: NPZ or TOML file with the arrays ``upper_m`` and ``lower_m``, or TOML file with the keys of
            ``[patches.layout]``.

    Raises:
        ConfigError: The file cannot be read or does not contain a valid layout. The message is one line.
    """
    path = Path(path)
    if path.suffix == ".npz":
        return read_npz(path)
    document = read_toml(path, "layout file")
    if has_electrodes(document.table):
        return from_electrodes(document.table, path)
    for key in ("file", "coordinates"):
        if key in document.table:
            raise ConfigError(key, document.table[key], "only in a hand file", where=document.where((key,)))
    try:
        return LayoutConfig.model_validate(document.table).build()
    except ValidationError as error:
        raise first_error(error, LayoutConfig, document.where) from None
    except ValueError as error:
        raise impossible(error, where=str(path)) from None
