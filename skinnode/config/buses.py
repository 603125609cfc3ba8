"""``[[buses]]``, ``[sync]`` and ``[bring_up]``: where patches are, and how fast, and in what role."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator

from skinnode.config.explain import short
from skinnode.config.table import Allowed, Name, NodeId, Table, one_of
from skinnode.errors import ConfigError

MAX_BUS_LOAD: Final = 0.70
"""Above 70 % the response times of low priorities grow steeply (Davis, Burns, Bril, Lukkien: Controller Area
Network (CAN) schedulability analysis, Real-Time Systems 35, 2007), and a frame that is sent again after an
error finds no room."""

Role = Literal["master", "guest"]
GuestSends = Literal["nothing", "sdo"]
Missing = Literal["refuse", "wait"]

_OURS: Final = ("interface", "channel", "bitrate", "data_bitrate", "fd", "ignore_config")


class OtherFrame(Table):
    """A frame that somebody else sends on the bus, such as a drive: it takes its part of the load, and of
    the time that ours wait."""

    can_id: Annotated[int, Field(ge=0, le=0x7FF), Allowed("an integer from 0 to 0x7FF")]
    """Its 11-bit identifier, which is its priority: the lowest goes first."""
    length: Annotated[int, Field(ge=0, le=8), Allowed("an integer from 0 to 8")] = 8
    """Bytes of data."""
    period_ms: Annotated[
        float, Field(ge=0.1, le=3_600_000, allow_inf_nan=False), Allowed("a number from 0.1 to 3600000")
    ]
    """Shortest time between two of them, milliseconds."""


class BusConfig(Table):
    """One CAN bus: any interface python-can knows, by its name there."""

    name: Name = "can0"
    """What patches call it in their ``bus``."""
    interface: Annotated[str, Field(min_length=1), Allowed("the name of a python-can interface")] = "virtual"
    """Name of the interface in python-can: socketcan, pcan, kvaser, udp_multicast, ..."""
    channel: Annotated[str, Field(min_length=1), Allowed("the name of a channel, as a text")] = "skin"
    """Name of the channel there: ``can0`` of socketcan, a group address of udp_multicast, ..."""
    bitrate_bps: Annotated[
        int,
        Field(ge=10_000, le=1_000_000),
        Allowed("an integer from 10000 to 1000000, as classic CAN has it"),
    ] = 1_000_000
    """Bits per second; of CAN FD frames, of their arbitration."""
    fd: bool = False
    """PDOs of the patches on this bus travel in CAN FD frames with bit-rate switch."""
    data_bitrate_bps: Annotated[
        int, Field(ge=10_000, le=8_000_000), Allowed("an integer from 10000 to 8000000")
    ] = 5_000_000
    """Bits per second of CAN FD frames, from ESI to the CRC delimiter."""
    options: dict[str, bool | int | float | str] = Field(default={})
    """Further arguments of the python-can interface, by their names there."""
    role: Annotated[Role, one_of(Role)] = "master"
    """``guest``: a robot's own master has NMT and SYNC on this bus; the host sends neither."""
    guest_sends: Annotated[GuestSends, one_of(GuestSends)] = "nothing"
    """What a guest sends: ``sdo`` to identify and configure the patches and to fetch what they know."""
    heartbeat_node_id: Annotated[NodeId | None, Allowed("an integer from 1 to 127 that no node has")] = None
    """Node-ID under which a master sends a heartbeat, which its patches then watch: they go pre-operational
    when it stops. None sends none."""
    max_load: Annotated[
        float, Field(gt=0, le=1, allow_inf_nan=False), Allowed("a number above 0 and up to 1")
    ] = MAX_BUS_LOAD
    """Share of the bus that the plan may need, every frame counted at its longest."""
    others: Annotated[tuple[OtherFrame, ...], Field(strict=False)] = ()
    """Frames that others send on this bus; the plan counts with them."""

    @field_validator("options", mode="before")
    @classmethod
    def _none_of_ours(cls, value: Any) -> Any:
        for key, option in value.items() if isinstance(value, dict) else ():
            if key in _OURS:
                raise ConfigError(key, short(option), "no such option here: [[buses]] has a key for it")
            if not isinstance(option, bool | int | float | str):
                raise ConfigError(key, short(option), "a text, a number, true or false")
        return value


class SyncConfig(Table):
    """The SYNC the host produces, or that of the robot's master. One SYNC is one scan of every patch."""

    period_ms: Annotated[int, Field(ge=1, le=60_000), Allowed("an integer from 1 to 60000")] = 80
    """Milliseconds between two SYNCs."""
    counter_overflow: Annotated[
        int, Field(ge=0, le=240), Allowed("an integer from 2 to 240; 0 where all buses are a guest's")
    ] = 240
    """Highest value of the SYNC counter (0x1019), which starts at 1 and names the scan; 0: the SYNC of
    another master has none, and scans are numbered by each patch for itself."""
    stagger_ms: Annotated[
        float, Field(ge=0, allow_inf_nan=False), Allowed("a number of milliseconds from 0 on")
    ] = 0.0
    """From the SYNC of one bus to that of the next, where the host is the master. At 0 all patches scan at
    the same instant, their scans end together, and the last field waits for all others to be solved."""

    @property
    def stagger_s(self) -> float:
        return self.stagger_ms * 1e-3

    @property
    def period_s(self) -> float:
        return self.period_ms * 1e-3


class BringUpConfig(Table):
    """How patches are taken up, at the start and later."""

    missing: Annotated[Missing, one_of(Missing)] = "refuse"
    """A patch that does not answer at the start: refuse to start, or start with those that are there and take
    up the others when they come."""
    heartbeat_ms: Annotated[int, Field(ge=20, le=10_000), Allowed("an integer from 20 to 10000")] = 250
    """Heartbeat the nodes are told to send, or do send where a guest does not tell them: a lost node shows
    within a second, at 0.1 % of the bus for four."""

    @property
    def heartbeat_s(self) -> float:
        return self.heartbeat_ms * 1e-3
