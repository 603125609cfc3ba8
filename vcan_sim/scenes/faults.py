"""Creates a scene's fault schedule from its ``[[faults]]`` tables and checks the faults against the hand."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any, Final

from skinnode.config import HandConfig
from skinnode.errors import ConfigError
from skinnode.protocol.profile import PatchProfile
from vcan_sim.bus_attacker import NO_BUS_FAULTS, check_bus
from vcan_sim.fault_schedule import FaultSchedule, TimedFault
from vcan_sim.fault_text import parse_values
from vcan_sim.faults import NO_FAULTS, OF_WIRES, check_places
from vcan_sim.scenes.tables import FaultConfig, SceneConfig

PatchSize = tuple[tuple[int, int], int]
"""Numbers of upper and lower wires of a patch, and number of chunks in its scans."""
_WIRE: Final = re.compile(r"(?P<patch>.+) (?P<side>upper|lower) (?P<number>\d{1,4})")
"""Format of a wire name in the ``where`` key, such as ``palm upper 3``."""


def schedule_of(scene: SceneConfig, hand: HandConfig) -> FaultSchedule:
    """Return the fault schedule of a scene.

    Args:
        scene: Scene with faults.
        hand: Hand that contains the patches and buses named by the faults.

    Raises:
        ConfigError: If a fault is unknown or out of range, names a patch, a wire or a bus that the hand does
            not have, or contradicts a simultaneous fault. The message gives the file, line and column of the
            error.
    """
    found = []
    for i, fault in enumerate(scene.faults):
        try:
            found.append(_timed(i, fault, hand, scene.repeat_s))
        except ConfigError as error:
            raise _with_place(scene, i, error) from None
    schedule = FaultSchedule(tuple(found), scene.repeat_s)
    sizes: dict[str, PatchSize] = {}
    for late in found:
        _check_alone(scene, late, found[: late.number])
        try:
            _check_together(schedule, late, late.from_s, hand, sizes)
        except ConfigError as error:
            raise _with_place(scene, late.number, error) from None
    for early in found:
        _check_end(scene, schedule, early, hand, sizes)
    return schedule


def _timed(number: int, fault: FaultConfig, hand: HandConfig, repeat_s: float | None) -> TimedFault:
    place, on_bus, text = _place_and_text(fault, hand)
    values = parse_values(text, on_bus=on_bus, key="fault")
    if "seed" in values:
        raise ConfigError("fault", "seed", "a fault; the seed is not a fault")
    to_s = repeat_s if fault.to_s is None else fault.to_s
    to_s = math.inf if to_s is None else to_s
    return TimedFault(number, place, on_bus, fault.from_s, to_s, values)


def _place_and_text(fault: FaultConfig, hand: HandConfig) -> tuple[str, bool, str]:
    """Return the name of the faulty patch or bus, whether it is a bus, and the fault in text form."""
    patches, buses = [patch.name for patch in hand.patches], [bus.name for bus in hand.buses]
    if fault.where in patches:
        return fault.where, False, fault.fault
    if fault.where in buses:
        return fault.where, True, fault.fault
    wire = _WIRE.fullmatch(fault.where)
    if wire is None or wire["patch"] not in patches:
        allowed = f"a patch of the hand: {', '.join(patches)}; a wire, such as '{patches[0]} upper 3'; "
        raise ConfigError("where", fault.where, f"{allowed}or a bus: {', '.join(buses)}")
    name = f"{fault.fault}_{wire['side']}"
    if name not in OF_WIRES or fault.fault == "stuck":
        kinds = dict.fromkeys(each.partition("_")[0] for each in OF_WIRES if not each.startswith("stuck"))
        raise ConfigError("fault", fault.fault, f"a fault that a wire can have: {', '.join(kinds)}")
    return wire["patch"], False, f"{name}={wire['number']}"


def _check_alone(scene: SceneConfig, late: TimedFault, earlier: list[TimedFault]) -> None:
    """Raise ConfigError if an earlier ``[[faults]]`` table sets the same fault at the same time."""
    for early in earlier:
        same = early.place == late.place and early.on_bus == late.on_bus and early.values.keys() & late.values
        if same and early.from_s < late.to_s and late.from_s < early.to_s:
            name = next(name for name in late.values if name in early.values)
            allowed = f"a time at which faults[{early.number}] does not inject {name} at {late.place!r}"
            key = f"faults[{late.number}].from_s"
            raise ConfigError(key, late.from_s, allowed, where=scene.where(key))


def _check_together(
    schedule: FaultSchedule,
    fault: TimedFault,
    t_s: float,
    hand: HandConfig,
    sizes: dict[str, PatchSize],
) -> None:
    """Raise ConfigError if the faults active at ``t_s`` at the place of ``fault`` contradict each other."""
    values: dict[str, Any] = {}
    for each in schedule.active(t_s):
        if (each.place, each.on_bus) == (fault.place, fault.on_bus):
            values |= each.values
    if fault.on_bus:
        check_bus(dataclasses.replace(NO_BUS_FAULTS, **values), hand.bus(fault.place))
        return
    faults = dataclasses.replace(NO_FAULTS, **values)
    if fault.place not in sizes:
        patch = next(p for p in hand.patches if p.name == fault.place)
        profile = PatchProfile.from_config(patch, hand.bus(patch.bus))
        sizes[fault.place] = ((profile.rows, profile.columns), profile.n_chunks)
    check_places(faults, fault.place, *sizes[fault.place])


def _check_end(
    scene: SceneConfig,
    schedule: FaultSchedule,
    early: TimedFault,
    hand: HandConfig,
    sizes: dict[str, PatchSize],
) -> None:
    """Raise ConfigError if the faults that remain when ``early`` ends are invalid without it."""
    if early.to_s == math.inf:
        return
    try:
        _check_together(schedule, early, early.to_s, hand, sizes)
    except ConfigError as error:
        key = f"faults[{early.number}].to_s"
        allowed = f"a time at which the remaining faults are valid; {error.key} needs {error.allowed}"
        raise ConfigError(key, early.to_s, allowed, where=scene.where(key)) from None


def _with_place(scene: SceneConfig, number: int, error: ConfigError) -> ConfigError:
    """Return a copy of an error that also gives the position of the fault in the scene file."""
    where = scene.faults[number].where
    wire = _WIRE.fullmatch(where)
    if wire is not None and str(error.got) == wire["number"]:  # the patch has no such wire
        key = f"faults[{number}].where"
        bounds = error.allowed.rpartition("integer ")[2]
        allowed = f"{wire['patch']} {wire['side']} with a number {bounds}"
        return ConfigError(key, where, allowed, where=scene.where(key))
    key = f"faults[{number}].{'where' if error.key == 'where' else 'fault'}"
    shown = error.key.removeprefix("fault").strip()
    allowed = f"{shown}: {error.allowed}" if shown and error.key != "where" else error.allowed
    return ConfigError(key, error.got, allowed, where=scene.where(key))
