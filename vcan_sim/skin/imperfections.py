"""Sizes of a simulated patch's imperfections."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, Self, get_args

from skinnode.errors import ConfigError, Shown

Readout = Literal["ideal", "grounded", "floating"]

_LIMITS: Final[dict[str, tuple[float, float, str]]] = {
    "placement": (0.0, 0.15, "pitches"),
    "along": (0.0, 0.15, "pitches"),
    "thickness": (0.0, 0.25, "clearances"),
    "tilt": (0.0, 0.25, "clearances"),
    "electrode_radius": (0.0, 0.45, "pitches"),
    "strain": (-0.5, 0.5, ""),
    "warming_k": (-100.0, 100.0, "K"),
    "temperature_per_k": (-0.005, 0.005, "1/K"),
    "warming_s": (1e-3, 1e6, "s"),
    "gain": (0.0, 0.25, ""),
    "offset": (0.0, 0.1, ""),
    "creep": (0.0, 0.5, ""),
    "creep_s": (1e-2, 1e5, "s"),
    "hysteresis": (0.0, 0.5, ""),
    "contact_ohm": (0.0, 1e6, "ohm"),
    "upper_wire_ohm": (0.0, 1e6, "ohm"),
    "lower_wire_ohm": (0.0, 1e6, "ohm"),
    "multiplexer_ohm": (0.0, 1e6, "ohm"),
    "virtual_ground_ohm": (0.0, 1e6, "ohm"),
    "row_time_s": (0.0, 1.0, "s"),
    "noise": (0.0, 0.01, ""),
}
"""Minimum, maximum and unit of each imperfection."""
_OF_NETWORK: Final = (
    "contact_ohm",
    "upper_wire_ohm",
    "lower_wire_ohm",
    "multiplexer_ohm",
    "virtual_ground_ohm",
)
"""Resistances modelled only by the ``grounded`` and ``floating`` read-outs."""
_WITHOUT_SIZE: Final = ("seed", "temperature_per_k", "warming_s", "creep_s")
"""Fields that are not sizes. They have no effect if every size is zero."""
_BITS: Final = (8, 32)


@dataclass(frozen=True, slots=True)
class Imperfections:
    """Sizes of a simulated patch's deviations from its layout. The default is an exact patch.

    A size marked *drawn* is the standard deviation of a normal distribution that is clipped at three standard
    deviations. Each imperfection has its own random stream, so enabling one imperfection does not change the
    draws for the others.

    Raises:
        ConfigError: If a value has the wrong type or is out of range, or if the ``ideal`` read-out is
            combined with a nonzero network resistance.
    """

    seed: int = 1
    """Random seed for the imperfections. The patches of a hand share the seed but have different random
    draws."""

    # --- geometry
    placement: float = 0.0
    """Position error of each upper and lower wire along x, y and z, in pitches; drawn."""
    along: float = 0.0
    """Position error of each electrode along its wire, in pitches; drawn."""
    thickness: float = 0.0
    """Thickness error of the rubber, as a fraction of the clearance between the layers; drawn."""
    tilt: float = 0.0
    """Rise of the upper layer from the middle of the patch to its edge, along x and along y, as a fraction of
    the clearance between the layers; drawn."""
    electrode_radius: float = 0.0
    """Radius of the electrodes, in pitches; they are conducting discs parallel to the x-y plane."""

    # --- rubber
    strain: float = 0.0
    """Relative change in resistivity per unit strain of a path between two electrodes."""
    warming_k: float = 0.0
    """Final temperature rise, K. The temperature approaches it exponentially from the start of the scene."""
    temperature_per_k: float = 2e-3
    """Relative change in resistivity per kelvin. It has no effect if ``warming_k`` is 0."""
    warming_s: float = 300.0
    """Time constant of the temperature rise, in s."""
    creep: tuple[float, float] = (0.0, 0.0)
    """Delayed displacements of the fast and slow creep terms, as fractions of the immediate displacement."""
    creep_s: tuple[float, float] = (0.3, 10.0)
    """Time constants of the fast and slow creep terms, in s."""
    hysteresis: float = 0.0
    """Fraction of the displacement that is subject to hysteresis, modelled by play operators."""

    # --- read-out
    gain: float = 0.0
    """Gain error of the amplifier, as a fraction of the change in each resistance from rest; drawn. Half of
    the variance is common to the whole patch. The other half is independent for each upper wire."""
    offset: float = 0.0
    """Offset error of each upper wire's readings, as a fraction of the median resistance at rest; drawn."""
    readout: Readout = "ideal"
    """Read-out of the crossbar. ``ideal``: each pair of wires is measured as if isolated. ``grounded``: one
    upper wire is driven, the other upper wires are grounded, and each lower wire has an amplifier.
    ``floating``: one pair of wires is measured while all other wires float, so sneak paths are in parallel
    with the pair."""
    contact_ohm: float = 0.0
    """Mean contact resistance (ohms) at the connector of each wire. Each wire's resistance is drawn uniformly
    from 0.5 to 1.5 times the mean."""
    upper_wire_ohm: float = 0.0
    """Resistance of an upper wire per electrode pitch, in ohms. The section from the connector to the first
    electrode has the same resistance."""
    lower_wire_ohm: float = 0.0
    """Resistance of a lower wire per electrode pitch, in ohms. The section from the connector to the first
    electrode has the same resistance."""
    multiplexer_ohm: float = 0.0
    """On-resistance of the multiplexer at each upper wire, in ohms."""
    virtual_ground_ohm: float = 0.0
    """Input resistance of the amplifier at each lower wire, in ohms; 0 for an ideal virtual ground."""
    row_time_s: float = 0.0
    """Time between the samples of neighbouring upper wires, in s."""
    noise: float = 0.0
    """Standard deviation of the converter's noise, as a fraction of its full scale. This noise is added to
    the scene's noise, which is relative to the reading."""
    bits: int = 0
    """Resolution of the converter, 8 to 32 bits; 0 for no rounding."""

    def __post_init__(self) -> None:
        for name in ("seed", "bits"):
            value = getattr(self, name)
            if type(value) is not int or value < 0:
                raise ConfigError(name, value, "a non-negative integer")
        if self.bits and not _BITS[0] <= self.bits <= _BITS[1]:
            raise ConfigError("bits", self.bits, f"0, or an integer from {_BITS[0]} to {_BITS[1]}")
        if self.readout not in get_args(Readout):
            raise ConfigError("readout", self.readout, " or ".join(get_args(Readout)))
        for name, limits in _LIMITS.items():
            object.__setattr__(self, name, _checked(name, getattr(self, name), *limits))
        if self.readout == "ideal":
            for name in _OF_NETWORK:
                if getattr(self, name):
                    raise ConfigError(name, getattr(self, name), "0 unless readout is grounded or floating")

    @property
    def exact(self) -> bool:
        """Whether the patch matches its layout exactly."""
        unsized = {name: getattr(EXACT, name) for name in _WITHOUT_SIZE}
        return dataclasses.replace(self, **unsized) == EXACT

    @classmethod
    def ordinary(cls, seed: int = 1) -> Self:
        """Return the imperfections of a carefully manufactured patch (``tolerances = "ordinary"``).

        Gain, placement, thickness and electrode radius are taken from
        :data:`skinnode.model.tolerances.ORDINARY`. The other sizes are assumptions. The temperature is
        constant and the read-out is ideal, because the tolerances cover neither.

        Args:
            seed: Random seed.

        Raises:
            ConfigError: If the seed is not a non-negative integer.
        """
        return cls(
            seed=seed,
            placement=0.02,
            along=0.002,
            thickness=0.05,
            tilt=0.01,
            electrode_radius=0.05,
            creep=(0.02, 0.03),
            hysteresis=0.05,
            gain=0.02,
            offset=1e-3,
            row_time_s=1e-4,
            noise=1e-6,
            bits=24,
        )

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Parse imperfections in text form, such as ``ordinary,placement=0.05,seed=3``.

        Raises:
            ConfigError: If a name is unknown or a value is invalid.
        """
        values: dict[str, Any] = {}
        for part in text.split(","):
            name, equals, value = part.strip().partition("=")
            if not equals:
                if name != "ordinary":
                    raise ConfigError("imperfections", part, "ordinary, or NAME=NUMBER, separated by commas")
                values[name] = True
                continue
            values[name] = _value(value)
        return cls.from_table(values)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], key: str = "imperfections") -> Self:
        """Return the imperfections in a TOML table.

        Args:
            table: Values by field name. With ``ordinary = true``, missing fields have the values of
                :meth:`ordinary` instead of the defaults.
            key: Key of the table, for error messages.

        Raises:
            ConfigError: If a key is unknown or a value is invalid.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        values = dict(table)
        start = values.pop("ordinary", False)
        if not isinstance(start, bool):
            raise ConfigError(f"{key}.ordinary", start, "true or false")
        for name in values:
            if name not in names:
                raise ConfigError(
                    f"{key}.{name}",
                    Shown("an unknown key"),
                    f"a key of this table: ordinary, {', '.join(names)}",
                )
        try:
            return dataclasses.replace(cls.ordinary() if start else cls(), **values)
        except ConfigError as error:
            raise ConfigError(f"{key}.{error.key}", error.got, error.allowed) from None


def _value(text: str) -> int | float | str:
    """Convert a string to a number if possible; otherwise, return the string itself."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def _checked(name: str, value: object, least: float, greatest: float, unit: str) -> object:
    """Return a number as a float, or a pair as a tuple. Raises ConfigError for an invalid value."""
    allowed = f"a number from {least:g} to {greatest:g} {unit}".rstrip()
    if not name.startswith("creep"):
        return _number(name, value, least, greatest, allowed)
    if not (isinstance(value, tuple | list) and len(value) == 2):
        raise ConfigError(name, value, f"two numbers, each {allowed}")
    return tuple(_number(f"{name}[{i}]", each, least, greatest, allowed) for i, each in enumerate(value))


def _number(name: str, value: object, least: float, greatest: float, allowed: str) -> float:
    """Return a number as a float. Raises ConfigError if the number is out of range."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= greatest:
        raise ConfigError(name, value, allowed)
    return float(value)


EXACT: Final = Imperfections()
"""Imperfections of an exact patch."""
