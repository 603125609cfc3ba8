"""Current faults of a simulated hand's patches and buses, and a log of their changes.

Faults are changed by :meth:`vcan_sim.fleet.Fleet.inject`, the ``vcan-sim inject`` command and the fault
schedule of a scene. Changes made together are all checked first: if one is invalid, none takes effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from skinnode.errors import ConfigError
from skinnode.process import clock
from vcan_sim.bus_attacker import NO_BUS_FAULTS, BusFaults
from vcan_sim.fault_schedule import TimedFault
from vcan_sim.fault_text import (
    NONE,
    OF_BUSES,
    OF_PATCHES,
    FaultChange,
    Value,
    name_and_value,
    none_of,
    parse_changes,
    text_of,
)
from vcan_sim.faults import NO_FAULTS, Faults


@dataclass(frozen=True, slots=True)
class FaultEvent:
    """Log entry for the start or end of a fault."""

    time_ns: int
    """Unix time of the event, in ns."""
    place: str
    """Name of the faulty patch or bus."""
    fault: str
    value: Value
    """Value of the fault, for example 0.1 for ``lost=0.1``."""
    on: bool
    """True if the fault starts, False if it ends."""
    refused: str = ""
    """Reason for refusing a scheduled change; empty if the change took effect."""

    def __str__(self) -> str:
        what = f"{self.place}:{name_and_value(self.fault, self.value)} {'on' if self.on else 'off'}"
        return f"{what}, refused: {self.refused}" if self.refused else what


@dataclass(frozen=True, slots=True)
class Places:
    """Names of a fleet's patches and buses, and functions that check and set their faults.

    The ``check`` functions raise ConfigError if a patch or bus cannot have the given faults.
    """

    patches: Sequence[str]
    buses: Sequence[str]
    check_patch: Callable[[str, Faults], None]
    set_patch: Callable[[str, Faults], None]
    check_bus: Callable[[str, BusFaults], None]
    set_bus: Callable[[str, BusFaults], None]


class FleetFaults:
    """Faults of a fleet's patches and buses. Methods may be called from any thread.

    Args:
        places: Patches and buses of the fleet.
        initial: Initial faults of every patch.

    Raises:
        ConfigError: If a patch cannot have the initial faults.
    """

    def __init__(self, places: Places, initial: Faults = NO_FAULTS) -> None:
        self._places = places
        self._lock = clock.lock()
        self._of_patches = dict.fromkeys(places.patches, NO_FAULTS)
        self._of_buses = dict.fromkeys(places.buses, NO_BUS_FAULTS)
        self._log: list[FaultEvent] = []
        self.set_patches(dict.fromkeys(places.patches, initial))

    # --- current faults

    def patch(self, name: str) -> Faults:
        """Return the current faults of a patch."""
        return self._of_patches[name]

    def bus(self, name: str) -> BusFaults:
        """Return the current faults of a bus."""
        return self._of_buses[name]

    def texts(self) -> list[str]:
        """Return the current faults, one string such as ``palm:lost=0.1`` per faulty patch or bus."""
        found = [(name, text_of(faults)) for name, faults in (self._of_patches | self._of_buses).items()]
        return [f"{place}:{text}" for place, text in found if text != NONE]

    @property
    def log(self) -> tuple[FaultEvent, ...]:
        """Starts and ends of faults since the log was last cleared, oldest first."""
        return tuple(self._log)

    def forget_log(self) -> None:
        """Clear the log, which otherwise grows without limit."""
        self._log.clear()

    # --- changes

    def inject(self, *texts: str, key: str = "--fault") -> None:
        """Change the named faults. All other faults remain unchanged.

        Args:
            *texts: Strings such as ``palm:unplugged`` or ``palm:none``; see :mod:`vcan_sim.fault_text`.
            key: Name of the command-line option, for error messages.

        Raises:
            ConfigError: If a string is invalid; all faults then remain unchanged.
        """
        places = self._places
        self._change(parse_changes(texts, places.patches, places.buses, key))

    def set_patches(self, faults: Mapping[str, Faults]) -> None:
        """Replace the faults of one or more patches.

        Args:
            faults: New faults by patch.

        Raises:
            ConfigError: If a patch is not in the hand or cannot have the faults; all faults then remain
                unchanged.
        """
        for name in faults:
            if name not in self._places.patches:
                raise ConfigError("patch", name, f"a patch of the hand: {', '.join(self._places.patches)}")
        with self._lock:
            self._replace(faults, {})

    def set_bus(self, name: str, faults: BusFaults) -> None:
        """Replace the faults of a bus.

        Args:
            name: Name of the bus.
            faults: New faults.

        Raises:
            ConfigError: If the bus is not in the hand or cannot have the faults; all faults then remain
                unchanged.
        """
        if name not in self._places.buses:
            raise ConfigError("bus", name, f"a bus of the hand: {', '.join(self._places.buses)}")
        with self._lock:
            self._replace({}, {name: faults})

    def follow(self, ended: Iterable[TimedFault], started: Iterable[TimedFault]) -> None:
        """Apply scheduled changes. A start that contradicts other faults is refused and logged.

        If one fault ends just as another starts at the same place, the first changes into the second, unless
        the start is refused.

        Args:
            ended: Scheduled faults to end.
            started: Scheduled faults to start.
        """
        ends: dict[tuple[str, bool], dict[str, Value]] = {}
        starts: dict[tuple[str, bool], dict[str, Value]] = {}
        for each in ended:
            defaults = {name: _default(name, each.on_bus) for name in each.values}
            ends.setdefault((each.place, each.on_bus), {}).update(defaults)
        for each in started:
            starts.setdefault((each.place, each.on_bus), {}).update(each.values)
        for place, on_bus in ends | starts:
            ending, starting = ends.get((place, on_bus), {}), starts.get((place, on_bus), {})
            try:
                self._change([FaultChange(place, on_bus, ending | starting)])
            except ConfigError:
                self._try(FaultChange(place, on_bus, ending))
                self._try(FaultChange(place, on_bus, starting))

    # --- internal

    def _try(self, change: FaultChange) -> None:
        """Apply a change, or log it as refused."""
        try:
            self._change([change])
        except ConfigError as error:
            now_ns = clock.time_ns()
            self._log += [
                FaultEvent(
                    now_ns, change.place, name, value, value != _default(name, change.on_bus), str(error)
                )
                for name, value in change.values.items()
            ]

    def _change(self, changes: Iterable[FaultChange]) -> None:
        with self._lock:
            patches: dict[str, Faults] = {}
            buses: dict[str, BusFaults] = {}
            for change in changes:
                if change.on_bus:
                    buses[change.place] = change.of(buses.get(change.place, self._of_buses[change.place]))
                else:
                    before = patches.get(change.place, self._of_patches[change.place])
                    patches[change.place] = change.of(before)
            self._replace(patches, buses)

    def _replace(self, patches: Mapping[str, Faults], buses: Mapping[str, BusFaults]) -> None:
        """Check all new faults, then apply and log them. The caller must hold ``_lock``."""
        for name, faults in patches.items():
            self._places.check_patch(name, faults)
        for name, of_bus in buses.items():
            self._places.check_bus(name, of_bus)
        for name, faults in patches.items():
            self._note(name, self._of_patches[name], faults)
            self._of_patches[name] = faults
            self._places.set_patch(name, faults)
        for name, of_bus in buses.items():
            self._note(name, self._of_buses[name], of_bus)
            self._of_buses[name] = of_bus
            self._places.set_bus(name, of_bus)

    def _note(self, place: str, before: Faults | BusFaults, after: Faults | BusFaults) -> None:
        """Log the faults that start and end when ``after`` replaces ``before``."""
        now_ns = clock.time_ns()
        on_bus = isinstance(after, BusFaults)
        for name in OF_BUSES if on_bus else OF_PATCHES:
            old, new = getattr(before, name), getattr(after, name)
            if name == "seed" or old == new:
                continue
            default = _default(name, on_bus)
            if old != default:
                self._log.append(FaultEvent(now_ns, place, name, old, on=False))
            if new != default:
                self._log.append(FaultEvent(now_ns, place, name, new, on=True))


def _default(name: str, on_bus: bool) -> Value:
    value: Value = getattr(none_of(on_bus=on_bus), name)
    return value
