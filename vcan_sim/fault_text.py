"""Text form of faults, such as ``palm:lost=0.1,frozen`` or ``can0:bus_off``.

::

    text     [PLACE:]FAULT[,FAULT...]    PLACE is a patch or a bus; default: all patches or all buses
    FAULT    NAME | NAME=VALUE | none    none ends all faults of the patch or bus

The ``--fault`` option, the ``vcan-sim inject`` command and the ``[[faults]]`` tables of scene files use this
form.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeVar

from skinnode.errors import ConfigError
from vcan_sim.bus_attacker import NO_BUS_FAULTS, BusFaults
from vcan_sim.faults import NO_FAULTS, Faults

NONE: Final = "none"
"""Keyword that ends all faults of a patch or bus. As the value of a wire fault, it ends only that fault."""

Value = int | float | bool | None
AnyFaults = TypeVar("AnyFaults", Faults, BusFaults)

OF_PATCHES: Final = {each.name: each.default for each in dataclasses.fields(Faults)}
"""Default value of each patch fault, by name."""
OF_BUSES: Final = {each.name: each.default for each in dataclasses.fields(BusFaults)}
"""Default value of each bus fault, by name."""


@dataclass(frozen=True, slots=True)
class FaultChange:
    """Change to the faults of one patch or bus."""

    place: str
    """Name of the patch or bus whose faults change."""
    on_bus: bool
    values: Mapping[str, Value] = field(default_factory=dict)
    """New values of the faults, by name."""
    clears: bool = False
    """Whether all current faults end before the new values are set."""

    def of(self, faults: AnyFaults) -> AnyFaults:
        """Return ``faults`` with this change applied.

        Raises:
            ConfigError: If a value is out of range, or if two values are inconsistent.
        """
        kept = type(faults)(seed=faults.seed) if self.clears else faults  # the seed is not a fault
        return dataclasses.replace(kept, **self.values)  # type: ignore[arg-type]  # types match


def parse_changes(
    texts: Sequence[str], patches: Sequence[str], buses: Sequence[str], key: str = "--fault"
) -> list[FaultChange]:
    """Parse faults in text form. Returns one or more changes per string, in the same order.

    Args:
        texts: Strings such as ``palm:lost=0.1,frozen``, ``can0:bus_off``, ``palm:none`` or ``none``.
        patches: Names of the hand's patches. They take precedence over buses of the same name.
        buses: Names of the hand's buses.
        key: Name of the command-line option, for error messages.

    Raises:
        ConfigError: If a patch, bus or fault is unknown, or a value has the wrong type.
    """
    changes = []
    for text in texts:
        place, colon, listed = text.rpartition(":")
        if not colon:
            changes += list(_everywhere(listed, patches, buses, key))
        elif place in patches:
            changes.append(_change(place, listed, key, on_bus=False))
        elif place in buses:
            changes.append(_change(place, listed, key, on_bus=True))
        else:
            allowed = f"a patch of the hand: {', '.join(patches)}; or a bus: {', '.join(buses)}"
            raise ConfigError(key, place, allowed)
    return changes


def parse_values(text: str, *, on_bus: bool, key: str = "--fault") -> dict[str, Value]:
    """Parse faults without a patch or bus, such as ``lost=0.01,silent``. Returns values by fault name.

    Args:
        text: One or more faults, separated by commas.
        on_bus: Whether the faults are bus faults.
        key: Name of the command-line option, for error messages.

    Raises:
        ConfigError: If a fault is unknown or a value has the wrong type.
    """
    return _values(_parts(text, key), OF_BUSES if on_bus else OF_PATCHES, key)


def text_of(faults: Faults | BusFaults) -> str:
    """Return faults in text form, without the seed; ``none`` if no fault is set."""
    defaults = OF_BUSES if isinstance(faults, BusFaults) else OF_PATCHES
    shown = [
        name_and_value(name, getattr(faults, name))
        for name, default in defaults.items()
        if name != "seed" and getattr(faults, name) != default
    ]
    return ",".join(shown) or NONE


def name_and_value(name: str, value: Value) -> str:
    """Return one fault in text form: its name if the value is True, otherwise ``NAME=VALUE``."""
    return name if value is True else f"{name}={_shown(value)}"


def _shown(value: Value) -> str:
    if value is None:
        return NONE
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _parts(text: str, key: str) -> list[str]:
    parts = [part.strip() for part in text.split(",")]
    parts = [part for part in parts if part]
    if not parts:
        raise ConfigError(key, text, f"the name of a fault, or {NONE}")
    return parts


def _change(place: str, listed: str, key: str, *, on_bus: bool) -> FaultChange:
    parts = _parts(listed, key)
    values = _values([part for part in parts if part != NONE], OF_BUSES if on_bus else OF_PATCHES, key)
    return FaultChange(place, on_bus, values, NONE in parts)


def _everywhere(listed: str, patches: Sequence[str], buses: Sequence[str], key: str) -> Iterator[FaultChange]:
    """Yield a change for every patch and bus to which the named faults apply."""
    parts = _parts(listed, key)
    clears = NONE in parts
    values = _values([part for part in parts if part != NONE], OF_PATCHES | OF_BUSES, key)
    for places, known, on_bus in ((patches, OF_PATCHES, False), (buses, OF_BUSES, True)):
        own = {name: value for name, value in values.items() if name in known}
        if own or clears:
            yield from (FaultChange(place, on_bus, own, clears) for place in places)


def _values(parts: Sequence[str], known: Mapping[str, object], key: str) -> dict[str, Value]:
    values: dict[str, Value] = {}
    for part in parts:
        name, equals, value = (each.strip() for each in part.partition("="))
        if name not in known:
            raise ConfigError(key, name, ", ".join(known))
        kind = type(known[name])
        try:
            values[name] = _value(kind, value, given=bool(equals))
        except ValueError:
            raise ConfigError(f"{key} {name}", value, _allowed(kind)) from None
    return values


def _value(kind: type, text: str, *, given: bool) -> Value:
    if kind is bool:
        if text not in ("true", "false") and given:
            raise ValueError
        return text != "false"
    if kind is float:
        return float(text)
    return None if kind is not int and text == NONE else int(text)


def _allowed(kind: type) -> str:
    if kind is bool:
        return "no value, or true or false"
    if kind is float:
        return "a number"
    return "an integer" if kind is int else f"an integer, or {NONE}"


def none_of(*, on_bus: bool) -> Faults | BusFaults:
    """Return the ``Faults`` of a fault-free patch, or the ``BusFaults`` of a fault-free bus."""
    return NO_BUS_FAULTS if on_bus else NO_FAULTS
