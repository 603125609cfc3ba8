"""Faults on a CAN bus, and the rogue device that causes some of them.

The rogue device has its own endpoint on the bus. Its frames take part in arbitration, and all nodes and hosts
receive them.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from skinnode.canopen import indices as od
from skinnode.canopen.nmt import NmtCommand
from skinnode.config import BusConfig
from skinnode.errors import BusError, ConfigError
from skinnode.process import clock
from skinnode.transport import CanPort
from vcan_sim.faults import RATE_PER_S, check_range
from vcan_sim.timed_bus import CanFrame
from vcan_sim.timed_bus.wire_frame import wire_frame

FLOOD_COB_ID: Final = 0x001
"""COB-ID of flood frames. Only NMT commands, with COB-ID 0x000, have a higher priority."""
FLOOD_DATA: Final = bytes([0x55] * 8)
_INTERMISSION_BITS: Final = 3
_TICK_NS: Final = 1_000_000
"""Minimum interval between batches of rogue frames, in ns."""
_AHEAD_NS: Final = 2 * _TICK_NS
"""How far in advance flood frames are queued, in ns. This prevents gaps on a fully starved bus."""
_MOST_AT_ONCE: Final = 256
"""Maximum number of overdue rogue frames of one kind in a batch. The rest are dropped."""
_RETRY_S: Final = 0.05
"""Time from a bus error until the rogue device reopens its endpoint, in s."""
_LONGEST_WAIT_S: Final = 3600.0
"""Longest wait for the next rogue frame, in s. A wait of centuries would raise an error."""
_SHARES: Final = ("starved", "disturbed")
_RATES: Final = ("rogue_nmt_per_s", "rogue_sync_per_s")
_COUNTERS: Final = 240
"""Maximum value of the second master's SYNC counter."""


@dataclass(frozen=True, slots=True)
class BusFaults:
    """Faults on one bus; none by default.

    Raises:
        ConfigError: If a fraction is not between 0 and 1, if a rate is out of range, or if the seed is
            negative.
    """

    seed: int = 1
    """Random seed for the faults."""
    bus_off: bool = False
    """Whether the nodes' CAN controller is bus-off, so that the nodes neither send nor receive frames."""
    starved: float = 0.0
    """Fraction of the bus capacity used by a rogue device, which sends frames with COB-ID 0x001, the highest
    priority after NMT."""
    rogue_nmt_per_s: float = 0.0
    """Rate of random NMT commands from a second master, 1/s, at most 1e5. Each is sent to one node or to all
    nodes."""
    rogue_sync_per_s: float = 0.0
    """Rate of SYNC messages from a second master, 1/s, at most 1e5."""
    disturbed: float = 0.0
    """Fraction of transmissions aborted by an error frame. The sender repeats them. Only the ``timed``
    interface supports this fault."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ConfigError("seed", self.seed, "a non-negative integer")
        for name in _SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(name, getattr(self, name), "a fraction from 0 to 1")
        for name in _RATES:
            check_range(name, getattr(self, name), *RATE_PER_S)

    @property
    def needs_attacker(self) -> bool:
        """Whether these faults require the rogue device."""
        return bool(self.starved or self.rogue_nmt_per_s or self.rogue_sync_per_s)


@dataclass(slots=True)
class InjectedOnBus:
    """Counts of the faults injected into one bus."""

    bus_off: int = 0
    """Number of times the nodes' controller went bus-off."""
    starved: int = 0
    """Number of flood frames sent."""
    rogue_nmt: int = 0
    """Number of NMT commands sent by the second master."""
    rogue_sync: int = 0
    """Number of SYNC messages sent by the second master."""
    disturbed: int = 0
    """Number of transmissions aborted by an error frame."""


NO_BUS_FAULTS: Final = BusFaults()


def check_bus(faults: BusFaults, bus: BusConfig) -> None:
    """Check that a bus supports the given faults.

    Args:
        faults: Faults to check.
        bus: Configuration of the bus.

    Raises:
        ConfigError: If the ``disturbed`` fault is set on an interface other than ``timed``.
    """
    if faults.disturbed and bus.interface != "timed":
        allowed = f"0 on interface {bus.interface!r}; only the interface timed simulates error frames"
        raise ConfigError(f"{bus.name}: disturbed", faults.disturbed, allowed)


class BusAttacker:
    """Rogue device on a bus. Its thread starts when a fault first requires the device.

    Args:
        bus: Configuration of the bus.
        node_ids: Node-IDs on the bus.
        counts: Counts of injected faults, which the thread updates.
    """

    def __init__(self, bus: BusConfig, node_ids: Sequence[int], counts: InjectedOnBus) -> None:
        self._bus, self._node_ids, self._counts = bus, tuple(node_ids), counts
        self._faults = NO_BUS_FAULTS
        self._changed = clock.event()
        self._stopping = False
        self._thread = clock.thread(self._run, f"attacker {bus.name}")
        bits = len(wire_frame(CanFrame(FLOOD_COB_ID, FLOOD_DATA)).bits) + _INTERMISSION_BITS
        self._flood_ns = bits * 1e9 / bus.bitrate_bps
        self._syncs = 0

    def set(self, faults: BusFaults) -> None:
        """Replace the faults, and start the thread if it is needed for the first time."""
        self._faults = faults
        self._changed.set()
        if faults.needs_attacker and self._thread.ident is None:
            self._thread.start()

    def stop(self) -> None:
        """Stop the thread. Call this method only once."""
        self._stopping = True
        self._changed.set()
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._stopping:
            if not self._faults.needs_attacker:
                self._changed.wait()
                self._changed.clear()
                continue
            try:
                with CanPort(self._bus) as port:
                    self._attack(port)
            except BusError:  # for example, another fault has made the bus unavailable
                clock.sleep(_RETRY_S)

    def _attack(self, port: CanPort) -> None:
        """Send rogue frames for as long as a fault requires them."""
        chance = random.Random(self._faults.seed)
        due_ns: dict[str, float] = {}
        while not self._stopping and self._faults.needs_attacker:
            now_ns = clock.monotonic_ns()
            periods_ns = self._periods_ns()
            due_ns = {name: due_ns.get(name, now_ns + period) for name, period in periods_ns.items()}
            for name, period_ns in periods_ns.items():
                ahead_ns = _AHEAD_NS if name == "starved" else 0
                due_ns[name] = self._send_due(port, name, chance, due_ns[name], period_ns, now_ns + ahead_ns)
            while port.recv(0.0) is not None:  # keeps the receive queue from filling up
                pass
            first_ns = min(due_ns[name] - (_AHEAD_NS if name == "starved" else 0) for name in due_ns)
            wait_ns = max(first_ns - clock.monotonic_ns(), _TICK_NS if "starved" in due_ns else 0)
            self._changed.wait(min(max(wait_ns, 0) * 1e-9, _LONGEST_WAIT_S))
            self._changed.clear()

    def _periods_ns(self) -> dict[str, float]:
        """Return the period (ns) of each kind of rogue frame."""
        faults, found = self._faults, {}
        if faults.starved:
            found["starved"] = self._flood_ns / faults.starved
        if faults.rogue_nmt_per_s:
            found["rogue_nmt"] = 1e9 / faults.rogue_nmt_per_s
        if faults.rogue_sync_per_s:
            found["rogue_sync"] = 1e9 / faults.rogue_sync_per_s
        return found

    def _send_due(  # noqa: PLR0913 - all inputs of a frame
        self,
        port: CanPort,
        name: str,
        chance: random.Random,
        due_ns: float,
        period_ns: float,
        until_ns: float,
    ) -> float:
        """Send the rogue frames of one kind that are due, and return the time (ns) when the next is due."""
        make: Callable[[random.Random], tuple[int, bytes]] = getattr(self, f"_{name}")
        for _ in range(_MOST_AT_ONCE):
            if due_ns > until_ns:
                return due_ns
            port.send(*make(chance))
            setattr(self._counts, name, getattr(self._counts, name) + 1)
            due_ns += period_ns
        return max(due_ns, until_ns)

    def _starved(self, _: random.Random) -> tuple[int, bytes]:
        return FLOOD_COB_ID, FLOOD_DATA

    def _rogue_nmt(self, chance: random.Random) -> tuple[int, bytes]:
        command, node_id = chance.choice(list(NmtCommand)), chance.choice((0, *self._node_ids))
        return od.NMT_COB_ID, bytes((command, node_id))

    def _rogue_sync(self, _: random.Random) -> tuple[int, bytes]:
        self._syncs += 1
        return od.SYNC_COB_ID, bytes(((self._syncs - 1) % _COUNTERS + 1,))
