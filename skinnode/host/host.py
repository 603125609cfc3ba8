"""Run a hand: the public interface to its fields, health, events, statistics and tare."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from skinnode.config import BusConfig, HandConfig, load_hand
from skinnode.errors import CodecError, NodeError
from skinnode.host import nmt_master
from skinnode.host.configurator import BOOT_DEADLINE_S
from skinnode.host.containment import DefectStats, stats_by_subject
from skinnode.host.dispatcher import BusStats
from skinnode.host.health import BusHealth, PatchHealth, faults_of
from skinnode.host.health_watch import HealthWatch
from skinnode.host.lifecycle import HostParts, StartOptions, never, running_parts
from skinnode.host.other_masters import OtherMasterStats
from skinnode.host.patch_stream import StreamStats
from skinnode.host.running_hand import RunningHand
from skinnode.host.served_bus import ServedBus
from skinnode.host.supervised import NodeStats
from skinnode.host.sync import SyncStats
from skinnode.host.tap import ContainedTap, HostTap, tap_bus
from skinnode.host.tare import tare, tare_deadline_s
from skinnode.model.layout import PatchLayout
from skinnode.process import clock
from skinnode.transport import CanPort


@dataclass(frozen=True, slots=True)
class HostStats:
    """Counters of a running host."""

    buses: Mapping[str, BusStats]
    patches: Mapping[str, StreamStats]
    nodes: Mapping[str, NodeStats]
    """Bring-up counters by patch name."""
    other_masters: Mapping[str, OtherMasterStats]
    """Counters of other masters' frames, by bus name."""
    sync: SyncStats
    malformed: tuple[CodecError, ...]
    """First malformed frame received on each bus, if any."""
    defects: Mapping[str, DefectStats]
    """Statistics of contained exceptions, by patch or bus name. The key ``host`` contains the exceptions that
    concern no particular patch or bus.
    """

    @property
    def rivals(self) -> Mapping[str, OtherMasterStats]:
        """Deprecated alias for :attr:`other_masters`, to be removed in version 0.2."""
        warnings.warn(
            "HostStats.rivals is now HostStats.other_masters; the old name will be removed in version 0.2",
            DeprecationWarning,
            stacklevel=2,
        )
        return self.other_masters


class Host(RunningHand):
    """Host of a running hand, created by the context manager :meth:`from_toml` or :meth:`from_config`.

    Example::

        with Host.from_toml("hand.toml") as host:
            for field in host.fields():
                ...

    Inside the ``with`` block, the nodes are operational and the host sends SYNC. A node that restarts or
    reappears is brought up again. When the block exits or bring-up fails, the host sets the nodes to
    pre-operational, ends its threads and closes its interfaces. On a bus that another master runs
    (``role = "guest"``), the host sends no NMT commands and no SYNC.

    Threads: any thread may call any method.
    """

    def __init__(self, parts: HostParts) -> None:
        super().__init__(parts.hand, parts.publisher, parts.events, parts.callbacks)
        self._defects, self._sync, self._supervisor = parts.defects, parts.sync, parts.supervisor
        self._buses, self._nodes = parts.buses, parts.nodes
        self._t_up_ns = clock.monotonic_ns()

    @classmethod
    @contextlib.contextmanager
    def from_toml(  # noqa: PLR0913 - public keyword arguments
        cls,
        path: Path | str,
        *,
        interface: str | None = None,
        channel: str | None = None,
        boot_deadline_s: float = BOOT_DEADLINE_S,
        cancelled: Callable[[], bool] = never,
        tap: HostTap | None = None,
    ) -> Iterator[Host]:
        """Bring up the hand described by a hand file. Shut it down when the ``with`` block exits.

        Args:
            path: Path of the hand file.
            interface: See :meth:`from_config`.
            channel: See :meth:`from_config`.
            boot_deadline_s: See :meth:`from_config`.
            cancelled: See :meth:`from_config`.
            tap: See :meth:`from_config`.

        Raises:
            ConfigError: if the hand file is missing or invalid.
            SkinError: for the reasons listed under :meth:`from_config`.
        """
        hand = load_hand(path)
        running = cls.from_config(
            hand,
            interface=interface,
            channel=channel,
            boot_deadline_s=boot_deadline_s,
            cancelled=cancelled,
            tap=tap,
        )
        with running as host:
            yield host

    @classmethod
    @contextlib.contextmanager
    def from_config(  # noqa: PLR0913 - public keyword arguments
        cls,
        hand: HandConfig,
        *,
        interface: str | None = None,
        channel: str | None = None,
        boot_deadline_s: float = BOOT_DEADLINE_S,
        cancelled: Callable[[], bool] = never,
        tap: HostTap | None = None,
        open_port: Callable[[BusConfig], CanPort] = CanPort,
    ) -> Iterator[Host]:
        """Bring up a hand. Shut it down when the ``with`` block exits.

        Once bring-up has succeeded, errors no longer stop the host. :meth:`health` and :meth:`stats` report
        them.

        Args:
            hand: Configuration of the hand.
            interface: python-can interface; overrides the interfaces in the hand file.
            channel: Channel; overrides the channel in the hand file. Only for a hand with one bus.
            boot_deadline_s: Time limit (s) for a node's first response.
            cancelled: Function polled during bring-up. If it returns True, bring-up raises BringUpCancelled.
            tap: Recorder of the traffic, including bring-up; see :class:`skinnode.record.Recorder`.
            open_port: Function that opens a bus. Needed only for an interface that python-can does not
                support.

        Raises:
            ConfigError: if an option, EDS file or baseline file does not match the hand, or the solver does
                not support a layout.
            BusLoadError: if the planned traffic exceeds the load limit of a bus.
            BusError: if an interface cannot be opened, or no node on a bus responds and ``bring_up.missing``
                is not ``wait``.
            NodeTimeout: if a node does not respond and ``bring_up.missing`` is not ``wait``.
            NodeError: if a node does not match ``hand`` or does not keep a parameter.
            BringUpCancelled: if ``cancelled`` returned True.
            ValueError: if ``boot_deadline_s`` is negative, infinite or not a number.
        """
        hand = hand.on(interface, channel)
        options = StartOptions(boot_deadline_s, cancelled, tap, open_port)
        with running_parts(hand, options) as parts:
            host = cls(parts)
            with HealthWatch(
                host._all_health,
                host._all_bus_health,
                parts.events,
                parts.defects,
                host._all_defects,
                parts.publisher.touches.take,
            ):
                yield host

    def layout(self, patch: str) -> PatchLayout:
        """Return the electrode layout used to compute a patch's fields.

        Raises:
            KeyError: if there is no such patch.
        """
        facts = self._nodes[patch].facts
        return self.hand.patch(patch).layout.build() if facts is None else facts.layout

    def health(self, patch: str) -> PatchHealth:
        """Return the health of a patch.

        Raises:
            KeyError: if there is no such patch.
        """
        node = self._nodes[patch]
        health = node.monitor.health(
            clock.monotonic_ns(),
            node.heartbeat_s,
            self.hand.sync.period_s,
            node.stream.conflicts,
            node.stream.t_passed_ns,
        )
        faults = faults_of(self._publisher.latest(patch))
        return replace(health, faults=faults) if faults else health

    def bus_health(self, bus: str) -> BusHealth:
        """Return the health of a bus.

        Raises:
            KeyError: if there is no such bus, or the bus has no patches.
        """
        served = self._buses[bus]
        return served.health(no_sync=self._lacks_sync(served))

    def _lacks_sync(self, bus: ServedBus) -> bool:
        """Return whether a bus has no SYNC although its patches need it."""
        if not bus.sync_is_late(self._t_up_ns, self.hand.sync.period_ms * 1_000_000):
            return False
        streams = [node.stream for node in self._nodes.values() if node.link is bus.link]
        return bool(self.hand.sync.counter_overflow) or not any(each.stats().offered for each in streams)

    def _all_health(self) -> dict[str, PatchHealth]:
        return {patch: self.health(patch) for patch in self._nodes}

    def _all_bus_health(self) -> dict[str, BusHealth]:
        return {bus: self.bus_health(bus) for bus in self._buses}

    def _all_defects(self) -> dict[str, DefectStats]:
        of_buses = [bus.link.defects for bus in self._buses.values()]
        of_patches = [node.defects for node in self._nodes.values()]
        return stats_by_subject((self._defects, *of_buses, *of_patches))

    def tap(self, tap: HostTap) -> Callable[[], None]:
        """Record all traffic from now on with ``tap``. Only one tap may be active at a time.

        Returns:
            Function that ends the recording.
        """
        ends, tap = [], ContainedTap(tap, self._defects)
        for bus in self._buses.values():
            streams = [node.stream for node in self._nodes.values() if node.link is bus.link]
            ends.append(tap_bus(tap, bus.link, bus.ticks, streams))

        def untap() -> None:
            for end in ends:
                end()

        return untap

    def tare(
        self, patch: str, *, deadline_s: float | None = None, cancelled: Callable[[], bool] = never
    ) -> None:
        """Tare a patch: make its current resistances the baseline.

        The host commands the tare with RPDO1. The call returns once the host has read the new baseline and is
        using it to solve scans. Every event subscriber receives a ``baselines`` event. The node loses the new
        baseline at power-off unless it is stored (0x1010).

        Args:
            patch: Name of the patch.
            deadline_s: Time limit (s) for the new baseline; 5 s plus three SYNC periods by default.
            cancelled: Function that returns True to end the wait for the new baseline.

        Raises:
            KeyError: if there is no such patch.
            ValueError: if ``deadline_s`` is negative, above 600 s or not a number.
            NodeError: if another master runs the bus, the baseline is kept in a file, or the node is not
                operational.
            NodeTimeout: if no new baseline arrives before the deadline.
            SkinError: if ``cancelled`` returned True.
            BusError: if the command cannot be sent.
        """
        node = self._nodes[patch]
        tare(
            node,
            lambda: self._supervisor.stats()[patch].baselines,
            lambda: self.health(patch),
            tare_deadline_s(self.hand, deadline_s),
            cancelled,
        )

    def reset_node(self, patch: str) -> None:
        """Reset a patch's node (NMT *reset node*). Once the node has booted, the host brings it up again.

        Args:
            patch: Name of the patch.

        Raises:
            KeyError: if there is no such patch.
            NodeError: if another master runs the bus.
            BusError: if the command cannot be sent.
        """
        node = self._nodes[patch]
        if node.has_other_master:
            raise NodeError(
                node.patch.node_id, f"another master runs {node.patch.bus}; it must reset the node"
            )
        node.monitor.expect_boot_up(clock.monotonic_ns())
        nmt_master.reset(node.link.send, node.patch.node_id)

    def stats(self) -> HostStats:
        """Return all counters of the host."""
        buses = self._buses
        sync = SyncStats(0, 0, 0, 0) if self._sync is None else self._sync.stats()
        followers = [bus.follower for bus in buses.values()]
        rejected = (bus.link.first_malformed for bus in buses.values())
        return HostStats(
            buses={name: bus.link.stats() for name, bus in buses.items()},
            patches={name: node.stream.stats() for name, node in self._nodes.items()},
            nodes=self._supervisor.stats(),
            other_masters={name: bus.other_masters.stats() for name, bus in buses.items()},
            sync=replace(
                sync,
                received=sum(follower.received for follower in followers),
                irregular=sum(follower.irregular for follower in followers),
            ),
            malformed=tuple(error for error in rejected if error is not None),
            defects=self._all_defects(),
        )
