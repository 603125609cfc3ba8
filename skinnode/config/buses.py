"""``[[buses]]``, ``[sync]`` and ``[bring_up]``: the CAN buses, their roles and their timing."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator

from skinnode.config.explain import short
from skinnode.config.table import Allowed, Name, NodeId, Table, one_of
from skinnode.errors import ConfigError

MAX_BUS_LOAD: Final = 0.70
"""Above 70 % the response times of low priorities grow steeply (Davis, Burns, Bril, Lukkien: Controller Area
Network (CAN) schedulability analysis, Real-Time Systems 35, 2007), and the bus has no room to repeat a frame
after an error."""

Role = Literal["master", "guest"]
GuestSends = Literal["nothing", "sdo"]
Missing = Literal["refuse", "wait"]

_KEYS_OF_TABLE: Final = ("interface", "channel", "bitrate", "data_bitrate", "fd", "ignore_config")


class OtherFrame(Table):
    """A frame that another device, such as a drive, sends on the bus.

    It adds to the bus load and to the time that frames of the hand wait.
    """

    can_id: Annotated[int, Field(ge=0, le=0x7FF), Allowed("an integer from 0 to 0x7FF")]
    """11-bit identifier; the lowest identifier has the highest priority."""
    length: Annotated[int, Field(ge=0, le=8), Allowed("an integer from 0 to 8")] = 8
    """Bytes of data."""
    period_ms: Annotated[
        float, Field(ge=0.1, le=3_600_000, allow_inf_nan=False), Allowed("a number from 0.1 to 3600000")
    ]
    """Shortest time between two such frames, milliseconds."""


class BusConfig(Table):
    """One CAN bus, by the names that python-can has for its interface and channel."""

    name: Name = "can0"
    """Name by which patches refer to the bus in their ``bus``."""
    interface: Annotated[str, Field(min_length=1), Allowed("the name of a python-can interface")] = "virtual"
    """Name of the interface in python-can: socketcan, pcan, kvaser, udp_multicast, ..."""
    channel: Annotated[str, Field(min_length=1), Allowed("the name of a channel, as a text")] = "skin"
    """Name of the channel in python-can: ``can0`` of socketcan, a group address of udp_multicast, ..."""
    bitrate_bps: Annotated[
        int,
        Field(ge=10_000, le=1_000_000),
        Allowed("an integer from 10000 to 1000000, as classic CAN has it"),
    ] = 1_000_000
    """Bits per second; in CAN FD frames, those of the arbitration phase."""
    fd: bool = False
    """PDOs of the patches on this bus travel in CAN FD frames with bit-rate switch."""
    data_bitrate_bps: Annotated[
        int, Field(ge=10_000, le=8_000_000), Allowed("an integer from 10000 to 8000000")
    ] = 5_000_000
    """Bits per second of the data phase of CAN FD frames, from ESI to the CRC delimiter."""
    options: dict[str, bool | int | float | str] = Field(default={})
    """Further arguments of the python-can interface, by their names in python-can."""
    role: Annotated[Role, one_of(Role)] = "master"
    """``guest``: the robot's own master sends NMT and SYNC on this bus; the host sends neither."""
    guest_sends: Annotated[GuestSends, one_of(GuestSends)] = "nothing"
    """What a guest sends: ``sdo`` to identify and configure the patches and to read their data."""
    heartbeat_node_id: Annotated[NodeId | None, Allowed("an integer from 1 to 127 that no node has")] = None
    """Node-ID under which the host, as master, sends a heartbeat. The patches watch it and go pre-operational
    when it stops. None: no heartbeat."""
    max_load: Annotated[
        float, Field(gt=0, le=1, allow_inf_nan=False), Allowed("a number above 0 and up to 1")
    ] = MAX_BUS_LOAD
    """Maximum share of the bus that the plan may need, with every frame at its longest."""
    others: Annotated[tuple[OtherFrame, ...], Field(strict=False)] = ()
    """Frames that other devices send on this bus; the plan takes them into account."""

    @field_validator("options", mode="before")
    @classmethod
    def _no_key_of_table(cls, value: Any) -> Any:
        for key, option in value.items() if isinstance(value, dict) else ():
            if key in _KEYS_OF_TABLE:
                raise ConfigError(key, short(option), "no such option here: [[buses]] has a key for it")
            if not isinstance(option, bool | int | float | str):
                raise ConfigError(key, short(option), "a text, a number, true or false")
        return value


class SyncConfig(Table):
    """The SYNC that the host, or the robot's own master, produces. One SYNC is one scan of every patch."""

    period_ms: Annotated[int, Field(ge=1, le=60_000), Allowed("an integer from 1 to 60000")] = 80
    """Milliseconds between two SYNCs."""
    counter_overflow: Annotated[
        int, Field(ge=0, le=240), Allowed("an integer from 2 to 240; 0 where all buses are a guest's")
    ] = 240
    """Highest value of the SYNC counter (0x1019), which starts at 1 and numbers the scans. 0: the SYNC of
    another master has no counter, and each patch numbers its own scans."""
    stagger_ms: Annotated[
        float, Field(ge=0, allow_inf_nan=False), Allowed("a number of milliseconds from 0 on")
    ] = 0.0
    """Milliseconds from the SYNC of one bus to the SYNC of the next, if the host is the master. At 0 all
    patches scan at the same instant, their scans end together, and the last field waits until all others are
    solved."""

    @property
    def stagger_s(self) -> float:
        """Time from the SYNC of one bus to the SYNC of the next, in s."""
        return self.stagger_ms * 1e-3

    @property
    def period_s(self) -> float:
        """SYNC period in s."""
        return self.period_ms * 1e-3


class BringUpConfig(Table):
    """How the host brings patches up, at the start and later."""

    missing: Annotated[Missing, one_of(Missing)] = "refuse"
    """If a patch does not answer at the start: ``refuse`` to start, or start with the others and ``wait`` for
    it."""
    heartbeat_ms: Annotated[int, Field(ge=20, le=10_000), Allowed("an integer from 20 to 10000")] = 250
    """Heartbeat period of the nodes, milliseconds. The host configures it; as a guest that sends nothing it
    expects it. At 250 ms a lost node shows within a second, for 0.1 % of the bus with four nodes."""

    @property
    def heartbeat_s(self) -> float:
        """Heartbeat period of the nodes in s."""
        return self.heartbeat_ms * 1e-3
