"""Error frames as Linux makes them (<linux/can/error.h>; drivers/net/can/dev: can_change_state, can_bus_off,
can_restart)."""

from __future__ import annotations

import pytest

from skinnode.transport.bus_state import BusState, bus_state
from skinnode.transport.frame import Frame


@pytest.mark.parametrize(
    ("can_id", "data", "state"),
    [
        (0x040, "00 00 00 00 00 00 00 00", BusState.OFF),
        (0x100, "00 00 00 00 00 00 00 00", BusState.ACTIVE),  # restarted
        (0x204, "00 20 00 00 00 00 90 00", BusState.PASSIVE),  # transmit errors: 0x90
        (0x204, "00 10 00 00 00 00 00 90", BusState.PASSIVE),
        (0x204, "00 08 00 00 00 00 60 00", BusState.WARNING),  # warning, on the way up or down
        (0x204, "00 40 00 00 00 00 00 00", BusState.ACTIVE),
        (0x004, "00 01 00 00 00 00 00 00", None),  # receive buffer overflow
        (0x004, "", None),
        (0x02A, "00 00 08 00 80 00 00 00", None),  # no acknowledge, arbitration lost: no state
    ],
)
def test_states(can_id: int, data: str, state: BusState | None) -> None:
    assert bus_state(Frame(can_id, bytes.fromhex(data), 0, error=True)) is state
