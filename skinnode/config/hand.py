"""Model of ``hand.toml``: the configuration of a hand as immutable, validated values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field, PrivateAttr, ValidationError, model_validator

from skinnode.canopen.indices import MAX_NODE_ID
from skinnode.config.buses import BringUpConfig, BusConfig, SyncConfig
from skinnode.config.explain import first_error, key_path, short
from skinnode.config.links import LinkConfig
from skinnode.config.patches import PatchConfig
from skinnode.config.running import SolverConfig, StreamConfig
from skinnode.config.simulation import SimulationConfig
from skinnode.config.table import Allowed, Name, Table
from skinnode.config.toml_text import Document, read_toml
from skinnode.errors import NOTHING, ConfigError, Shown
from skinnode.model.layout_file import impossible
from skinnode.text.words import counted

MOST_BUSES: Final = 256
"""Maximum number of buses in a hand. No machine has that many CAN interfaces, but a simulated hand with 1000
patches has 250 buses."""


class HandConfig(Table):
    """Configuration of a hand: its buses and patches, and the host settings.

    Names, node-IDs and serial numbers must be unique, the bus of each patch must exist, each geometry must be
    possible, and no setting may conflict with the role of a bus; otherwise a ConfigError is raised. Pydantic
    wraps this error in a ValidationError, which :func:`parse_hand` unwraps. The bus load is checked
    separately, by :func:`skinnode.bus_load.plan.check_plan`.
    """

    name: Name = "hand"
    """Name of the hand in programs and reports."""
    buses: Annotated[
        tuple[BusConfig, ...], Field(min_length=1, strict=False), Allowed("at least one [[buses]]")
    ]
    """CAN buses to which the patches of the hand are connected."""
    patches: Annotated[
        tuple[PatchConfig, ...], Field(min_length=1, strict=False), Allowed("at least one [[patches]]")
    ]
    """Skin patches of the hand."""
    links: Annotated[tuple[LinkConfig, ...], Field(strict=False)] = ()
    """Robot links on which patches are mounted, with their poses in the hand's coordinate frame."""
    sync: SyncConfig = SyncConfig()
    bring_up: BringUpConfig = BringUpConfig()
    solver: SolverConfig = SolverConfig()
    stream: StreamConfig = StreamConfig()
    simulation: SimulationConfig = SimulationConfig()
    _read_of: Document = PrivateAttr(Document("", {}, {}))

    def bus(self, name: str) -> BusConfig:
        """Return the bus called ``name``.

        Raises:
            KeyError: The hand has no such bus.
        """
        return {bus.name: bus for bus in self.buses}[name]

    def patch(self, name: str) -> PatchConfig:
        """Return the patch called ``name``.

        Raises:
            KeyError: The hand has no such patch.
        """
        return {patch.name: patch for patch in self.patches}[name]

    def patches_on(self, bus: str) -> tuple[PatchConfig, ...]:
        """Return the patches on the bus called ``bus``, in file order."""
        return tuple(patch for patch in self.patches if patch.bus == bus)

    @property
    def served_buses(self) -> tuple[BusConfig, ...]:
        """Buses that carry patches, in file order."""
        return tuple(bus for bus in self.buses if self.patches_on(bus.name))

    def where(self, key: str) -> str:
        """Return ``file:line:column`` of a dotted key, for error messages; empty if there is no file."""
        return self._read_of.where(key_path(key))

    def on(self, interface: str | None = None, channel: str | None = None) -> HandConfig:
        """Return a copy of the hand that uses a different interface or channel.

        Args:
            interface: New python-can interface for all buses; None to keep the interfaces in the file.
            channel: New channel for the bus; None to keep the channel in the file.

        Raises:
            ConfigError: A channel is given for a hand with several buses, two buses would have the same
                channel, or a name is empty.
        """
        if channel is not None and len(self.buses) > 1:
            raise ConfigError(
                "--channel", channel, f"only for a hand with one bus; this one has {len(self.buses)}"
            )
        change = {"interface": interface, "channel": channel}
        kept = {key: value for key, value in change.items() if value is not None}
        for key, value in kept.items():
            if not value:
                raise ConfigError(f"--{key}", value, "a name")
        if interface is not None and len({bus.channel for bus in self.buses}) < len(self.buses):
            allowed = "only for a hand whose buses have different channels"
            raise ConfigError("--interface", interface, allowed)
        return self.model_copy(update={"buses": tuple(bus.model_copy(update=kept) for bus in self.buses)})

    def without_layout_files(self) -> HandConfig:
        """Return a copy of the hand that contains the electrodes of its layout files.

        Raises:
            ConfigError: A layout file cannot be used.
        """
        patches = [p.model_copy(update={"layout": p.layout.without_file()}) for p in self.patches]
        return self.model_copy(update={"patches": tuple(patches)})

    def table(self) -> dict[str, Any]:
        """Return a table from which :func:`parse_hand` builds an equal hand."""
        table = self.model_dump(exclude_defaults=True)
        # the period is required if the host is a guest, even if it has the default value
        table.setdefault("sync", {})["period_ms"] = self.sync.period_ms
        return table

    @model_validator(mode="before")
    @classmethod
    def _counts(cls, table: Any) -> Any:
        """Check the numbers of buses and patches before their models are built.

        Building the models of ten thousand patches would take minutes.
        """
        if isinstance(table, Mapping):
            buses, patches = table.get("buses"), table.get("patches")
            if isinstance(buses, list) and len(buses) > MOST_BUSES:
                raise ConfigError("buses", Shown(f"{len(buses)} buses"), f"at most {MOST_BUSES}")
            if isinstance(patches, list) and isinstance(buses, list):
                most = MAX_NODE_ID * len(buses)
                if len(patches) > most > 0:
                    on = counted(len(buses), "bus", "buses")
                    allowed = f"at most {most}: node-IDs 1 to {MAX_NODE_ID} on {on}"
                    raise ConfigError("patches", Shown(f"{len(patches)} patches"), allowed)
        return table

    @model_validator(mode="after")
    def _cross_checks(self) -> HandConfig:
        _require_unique("buses", "name", [bus.name for bus in self.buses])
        _require_unique("buses", "channel", [(bus.interface, bus.channel) for bus in self.buses])
        _require_unique("patches", "name", [patch.name for patch in self.patches])
        names = [bus.name for bus in self.buses]
        for i, patch in enumerate(self.patches):
            if patch.bus not in names:
                raise ConfigError(f"patches[{i}].bus", patch.bus, f"a bus of this file: {', '.join(names)}")
            _check_geometry(f"patches[{i}]", patch)
            self._check_row_time(f"patches[{i}]", patch)
        _require_unique("patches", "node_id", [(patch.bus, patch.node_id) for patch in self.patches])
        serials = [object() if patch.serial is None else patch.serial for patch in self.patches]
        _require_unique("patches", "serial", serials)
        self._check_links()
        self._check_roles()
        return self

    def _check_row_time(self, key: str, patch: PatchConfig) -> None:
        """Check that all upper wires of a patch can be sampled within a SYNC period."""
        if not patch.row_time_us:
            return
        wires, period_us = patch.layout.build().shape[0], 1e3 * self.sync.period_ms
        if wires * patch.row_time_us > period_us:
            within = f"within one SYNC period of {self.sync.period_ms} ms"
            sampled = f"{counted(wires, 'upper wire')} must be sampled {within}"
            allowed = f"at most {period_us / wires:g}, because {sampled}"
            raise ConfigError(f"{key}.row_time_us", patch.row_time_us, allowed)

    def _check_links(self) -> None:
        """Check that each link is defined once and has at least one patch."""
        _require_unique("links", "name", [link.name for link in self.links])
        used = list(dict.fromkeys(patch.link for patch in self.patches if patch.link is not None))
        for i, link in enumerate(self.links):
            if link.name not in used:
                allowed = f"the link of a patch: {', '.join(used)}" if used else "only if patches have a link"
                raise ConfigError(f"links[{i}].name", link.name, allowed)

    def _check_roles(self) -> None:
        """Check for settings that conflict with the role of a bus."""
        overflow, guest = self.sync.counter_overflow, all(bus.role == "guest" for bus in self.buses)
        if overflow == 1 or (overflow == 0 and not guest):
            allowed = "an integer from 2 to 240; or 0 if the host is a guest on all buses"
            raise ConfigError("sync.counter_overflow", overflow, allowed)
        masters = [bus for bus in self.buses if bus.role == "master"]
        if (len(masters) - 1) * self.sync.stagger_ms >= self.sync.period_ms:
            most = self.sync.period_ms / (len(masters) - 1)
            allowed = (
                f"below {most:g}, because the SYNC must be sent on all {len(masters)} buses within one period"
            )
            raise ConfigError("sync.stagger_ms", self.sync.stagger_ms, allowed)
        for i, bus in enumerate(self.buses):
            node_ids = [patch.node_id for patch in self.patches_on(bus.name)]
            if bus.role == "guest" and bus.heartbeat_node_id is not None:
                raise ConfigError(
                    f"buses[{i}].heartbeat_node_id", bus.heartbeat_node_id, 'only with role = "master"'
                )
            if bus.heartbeat_node_id in node_ids:
                allowed = "an integer from 1 to 127 that no node uses"
                raise ConfigError(f"buses[{i}].heartbeat_node_id", bus.heartbeat_node_id, allowed)
        self._check_guests()

    def _check_guests(self) -> None:
        """Check that the file contains all data that a silent guest cannot read from the nodes."""
        for i, patch in enumerate(self.patches):
            bus = self.bus(patch.bus)
            if bus.role == "master" or bus.guest_sends == "sdo":
                continue
            if patch.baseline is None:
                allowed = f"a file, because the host is a guest that sends nothing on {bus.name}"
                raise ConfigError(f"patches[{i}].baseline", NOTHING, allowed)
            if patch.layout.coordinates == "node":
                allowed = f"preset, because the host is a guest that sends nothing on {bus.name}"
                raise ConfigError(f"patches[{i}].layout.coordinates", "node", allowed)
        guests = [bus.name for bus in self.buses if bus.role == "guest"]
        if guests and "period_ms" not in self.sync.model_fields_set:
            allowed = f"the period of the SYNC on {guests[0]}, where the host is a guest"
            raise ConfigError("sync.period_ms", NOTHING, allowed)


def load_hand(path: Path | str) -> HandConfig:
    """Read a hand file. Paths in the file are relative to its folder.

    Args:
        path: The file.

    Raises:
        ConfigError: The file cannot be read, is not TOML, has an unknown or missing key or an invalid value,
            or fails a check of :class:`HandConfig`. The message is one line and contains the position in the
            file.
    """
    path = Path(path)
    return _parse(read_toml(path, "hand file"), path.parent)


def parse_hand(table: Mapping[str, Any], *, folder: Path | None = None, where: str = "") -> HandConfig:
    """Validate a table with the keys of a hand file.

    Args:
        table: The table, as returned by tomllib.
        folder: Folder to which paths are relative; by default, the working directory.
        where: Name of the file, for error messages.

    Raises:
        ConfigError: See :func:`load_hand`.
    """
    return _parse(Document(where, dict(table), {}), folder or Path())


def _parse(document: Document, folder: Path) -> HandConfig:
    try:
        hand = HandConfig.model_validate(document.table, context={"folder": folder})
    except ValidationError as error:
        raise first_error(error, HandConfig, document.where) from None
    hand._read_of = document
    return hand


def _check_geometry(key: str, patch: PatchConfig) -> None:
    """Raise ConfigError if the geometry is impossible or the number of upper-wire gains is wrong."""
    try:
        layout = patch.layout.build()
    except ValueError as error:
        if patch.layout.file is not None:
            raise ConfigError(f"{key}.layout.file", str(patch.layout.file), f"a layout ({error})") from None
        table = "layout" if patch.layout.electrodes is None else "layout.electrodes"
        raise impossible(error, f"{key}.{table}") from None
    gains, wires = patch.calibration.upper_gain, layout.shape[0]
    if gains is not None and len(gains) != wires:
        allowed = f"{wires} numbers, one per upper wire"
        raise ConfigError(f"{key}.calibration.upper_gain", short(list(gains)), allowed)


def _require_unique(table: str, key: str, values: Iterable[object]) -> None:
    seen: dict[object, int] = {}
    for i, value in enumerate(values):
        if value in seen:
            shown = value[-1] if isinstance(value, tuple) else value
            raise ConfigError(
                f"{table}[{i}].{key}", shown, f"a value that {table}[{seen[value]}] does not use"
            )
        seen[value] = i
