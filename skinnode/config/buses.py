"""``[[buses]]``, ``[sync]`` and ``[bring_up]``: the CAN buses, their roles and their timing."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator

from skinnode.config.explain import short
from skinnode.config.table import Allowed, Name, NodeId, Table, one_of
from skinnode.errors import ConfigError

MAX_BUS_LOAD: Final = 0.70
"""Default limit for the planned bus load, as a fraction. Above this limit, the response times of low-priority
frames grow steeply (Davis, Burns, Bril and Lukkien, Controller Area Network (CAN) schedulability analysis,
Real-Time Systems 35, 2007), and too little capacity is left to retransmit frames after errors."""

Role = Literal["master", "guest"]
GuestSends = Literal["nothing", "sdo"]
Missing = Literal["refuse", "wait"]

_KEYS_OF_TABLE: Final = ("interface", "channel", "bitrate", "data_bitrate", "fd", "ignore_config")


class OtherFrame(Table):
    """Frame that another device, such as a drive, sends on the bus.

    The frame adds to the bus load and delays the hand's frames.
    """

    can_id: Annotated[int, Field(ge=0, le=0x7FF), Allowed("an integer from 0 to 0x7FF")]
    """11-bit identifier; the lowest identifier has the highest priority."""
    length: Annotated[int, Field(ge=0, le=8), Allowed("an integer from 0 to 8")] = 8
    """Number of data bytes."""
    period_ms: Annotated[
        float, Field(ge=0.1, le=3_600_000, allow_inf_nan=False), Allowed("a number from 0.1 to 3600000")
    ]
    """Minimum time between two frames with this identifier, in milliseconds."""


class BusConfig(Table):
    """CAN bus, identified by the names of its interface and channel in python-can."""

    name: Name = "can0"
    """Name of the bus, used in the key ``bus`` of each patch."""
    interface: Annotated[str, Field(min_length=1), Allowed("the name of a python-can interface")] = "virtual"
    """Name of the interface in python-can, such as socketcan, pcan, kvaser or udp_multicast."""
    channel: Annotated[str, Field(min_length=1), Allowed("the name of a channel, as a string")] = "skin"
    """Name of the channel in python-can, such as ``can0`` for socketcan or a group address for
    udp_multicast."""
    bitrate_bps: Annotated[
        int,
        Field(ge=10_000, le=1_000_000),
        Allowed("an integer from 10000 to 1000000, as in classic CAN"),
    ] = 1_000_000
    """Bit rate, in bits per second; for CAN FD frames, the bit rate of the arbitration phase."""
    fd: bool = False
    """Send the PDOs of the patches on this bus in CAN FD frames with bit-rate switching."""
    data_bitrate_bps: Annotated[
        int, Field(ge=10_000, le=8_000_000), Allowed("an integer from 10000 to 8000000")
    ] = 5_000_000
    """Bit rate of the data phase of CAN FD frames, from ESI to the CRC delimiter, in bits per second."""
    options: dict[str, bool | int | float | str] = Field(default={})
    """Additional keyword arguments for the interface in python-can."""
    role: Annotated[Role, one_of(Role)] = "master"
    """Role of the host: ``master`` if it sends NMT commands and SYNC on the bus, ``guest`` if the robot's own
    master does."""
    guest_sends: Annotated[GuestSends, one_of(GuestSends)] = "nothing"
    """Frames that the host may send as a guest: ``nothing``, or ``sdo`` for requests that identify and
    configure the patches and read their data."""
    heartbeat_node_id: Annotated[NodeId | None, Allowed("an integer from 1 to 127 that no node uses")] = None
    """Node-ID in the heartbeat that the host sends as master. The patches monitor this heartbeat and enter
    pre-operational when it stops. If None, the host sends no heartbeat."""
    max_load: Annotated[
        float, Field(gt=0, le=1, allow_inf_nan=False), Allowed("a number greater than 0 and at most 1")
    ] = MAX_BUS_LOAD
    """Maximum planned bus load, as a fraction, assuming that every frame has its maximum length."""
    others: Annotated[tuple[OtherFrame, ...], Field(strict=False)] = ()
    """Frames that other devices send on this bus; the planned bus load includes these frames."""

    @field_validator("options", mode="before")
    @classmethod
    def _no_key_of_table(cls, value: Any) -> Any:
        for key, option in value.items() if isinstance(value, dict) else ():
            if key in _KEYS_OF_TABLE:
                raise ConfigError(key, short(option), "use the key of [[buses]] instead")
            if not isinstance(option, bool | int | float | str):
                raise ConfigError(key, short(option), "a string, a number, true or false")
        return value


class SyncConfig(Table):
    """SYNC, sent by the host or by the robot's own master; each SYNC starts one scan of every patch."""

    period_ms: Annotated[int, Field(ge=1, le=60_000), Allowed("an integer from 1 to 60000")] = 80
    """SYNC period, in milliseconds."""
    counter_overflow: Annotated[
        int,
        Field(ge=0, le=240),
        Allowed("an integer from 2 to 240; or 0 if the host is a guest on all buses"),
    ] = 240
    """Maximum value of the SYNC counter (0x1019), which starts at 1 and numbers the scans. The value must be
    0 if another master sends SYNC without a counter; each patch then numbers its own scans."""
    stagger_ms: Annotated[float, Field(ge=0, allow_inf_nan=False), Allowed("a non-negative delay")] = 0.0
    """Delay, in milliseconds, between the SYNCs on successive buses on which the host is the master. With a
    delay of 0, the scans on all buses end at the same time, and some must wait for a solver."""

    @property
    def stagger_s(self) -> float:
        """Delay between the SYNCs on successive buses, in s."""
        return self.stagger_ms * 1e-3

    @property
    def period_s(self) -> float:
        """SYNC period, in s."""
        return self.period_ms * 1e-3


class BringUpConfig(Table):
    """Settings for bringing up patches, both at start-up and later."""

    missing: Annotated[Missing, one_of(Missing)] = "refuse"
    """Action taken if a patch does not answer at start-up. With ``refuse``, the host does not start the hand.
    With ``wait``, the host starts the other patches and waits for the missing patch."""
    heartbeat_ms: Annotated[int, Field(ge=20, le=10_000), Allowed("an integer from 20 to 10000")] = 250
    """Heartbeat period of the nodes, in milliseconds. The host writes this period to the nodes; a guest that
    sends nothing assumes that the nodes already use it. With a period of 250 ms, a lost node is detected
    within a second, and the heartbeats of four nodes use 0.1 % of the bandwidth."""

    @property
    def heartbeat_s(self) -> float:
        """Heartbeat period of the nodes, in s."""
        return self.heartbeat_ms * 1e-3
