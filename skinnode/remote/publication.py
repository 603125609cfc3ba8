"""Publishes the fields, contacts, health and events of a running host in a separate thread."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from skinnode.errors import SkinError
from skinnode.host import Host
from skinnode.host.containment import Defects, keep_on
from skinnode.host.events import HealthEvent
from skinnode.host.skeleton import Skeleton
from skinnode.messages.contacts import WRENCH, contact_wrenches, contacts_message
from skinnode.messages.definitions import CONTACTS, FIELD, FIELD_INFO, HEALTH_REPORT
from skinnode.messages.fields import POINT_CLOUD, field_info, point_cloud
from skinnode.messages.full_field import SendStamp, encode_field
from skinnode.messages.health import DIAGNOSTIC_ARRAY, LOG, diagnostics, log_message
from skinnode.messages.health_report import HealthReport, encode_report
from skinnode.messages.poses import TRANSFORMS, transforms
from skinnode.messages.topics import DIAGNOSTICS, TF_STATIC, HandTopics
from skinnode.messages.typestore import encode
from skinnode.model.frames import FieldFrame
from skinnode.process import clock
from skinnode.remote import keys
from skinnode.remote.claim import Claim
from skinnode.remote.command_server import CommandServer
from skinnode.remote.description import Description, boot_id
from skinnode.remote.output import Output
from skinnode.remote.session import SessionOptions, require_protected

if TYPE_CHECKING:
    import zenoh

HEALTH_S: Final = 0.25
"""Interval between reports of the health, s."""
QUEUED: Final = 32
"""Capacity of the queue between the host and the thread, in fields per patch."""
_POLL_S: Final = 0.05
"""Maximum delay of an event while no field arrives, s."""
_PATCH_TOPICS: Final = {
    "full_field": FIELD,
    "field": POINT_CLOUD,
    "field_info": FIELD_INFO,
    "contacts": CONTACTS,
    "contact_wrenches": WRENCH,
}
"""Message of each topic of a patch."""


@dataclass(frozen=True, slots=True)
class PublicationStats:
    """Counters of a publication."""

    published: dict[str, int]
    """Number of fields sent, by patch name; the sequence number of the newest field."""
    dropped: int
    """Number of fields not sent because this process was too slow."""
    failed: int
    """Number of exceptions, each of which cost a field or a report."""


class Publication:
    """Publishes a host from construction until :meth:`close`.

    Programs receive each field as ``skinnode_msgs/Field``. The ROS 2 standard messages are computed only for
    the topics to which a program subscribes.

    Args:
        host: Running host, which is never delayed. The publication ends when the host closes.
        claim: Claim on the hand; the caller closes it.
        commands: Whether programs may tare patches and reset nodes.

    Threads: any thread may call the methods.
    """

    def __init__(self, host: Host, claim: Claim, *, commands: bool = False) -> None:
        self._host, self._session = host, claim.session
        self._started_ns = clock.time_ns()
        self._patches = [patch.name for patch in host.hand.patches]
        self._published = dict.fromkeys(self._patches, 0)
        self._dropped = 0
        self._defects = Defects("publication")
        self._skeleton = Skeleton.of(host.hand)
        self._rest_m = {name: host.layout(name).upper_m for name in self._patches}
        self._wall_minus_mono_ns = 0
        self._declare()
        self._fields = host.fields(capacity=QUEUED * len(self._patches))
        self._events = host.events()
        self._report_due_s = 0.0
        self._over = clock.event()
        self._description = self._describe(commands=commands)
        self._commands = CommandServer(self._session, host) if commands else None
        self._thread = clock.thread(target=self._run, name="publish")
        self._thread.start()

    def stats(self) -> PublicationStats:
        """Return the counters."""
        return PublicationStats(
            dict(self._published), self._dropped + self._fields.dropped, self._defects.count
        )

    def close(self) -> None:
        """Stop publishing, and wait for the thread."""
        self._over.set()
        self._thread.join()
        self._fields.close()
        if self._commands is not None:
            self._commands.close()
        self._description.undeclare()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- start

    def _declare(self) -> None:
        """Declare the node, and the publishers of all topics."""
        topics = HandTopics.of(self._host.hand)
        self._node = self._session.liveliness().declare_token(keys.node_token(str(self._session.zid())))
        self._outputs: dict[tuple[str, str], Output] = {}
        wanted = [
            (name, part, getattr(of_patch, part), message)
            for name, of_patch in topics.patches.items()
            for part, message in _PATCH_TOPICS.items()
        ]
        wanted += [
            ("", "events", topics.events, LOG),
            ("", "health", topics.health, HEALTH_REPORT),
            ("", "diagnostics", DIAGNOSTICS, DIAGNOSTIC_ARRAY),
            ("", "tf_static", TF_STATIC, TRANSFORMS),
        ]
        for entity, (name, part, topic, message) in enumerate(wanted, 1):
            output = Output(self._session, topic, message, entity, express=part == "full_field")
            self._outputs[name, part] = output
        self._subscribed: set[tuple[str, str]] = set()

    def _describe(self, *, commands: bool) -> zenoh.Queryable[None]:
        """Answer queries for the description of the hand."""
        hand = self._host.hand
        layouts = {name: self._host.layout(name) for name in self._patches}
        key, data = keys.description_key(hand.name), Description(hand, layouts, boot_id(), commands).encode()

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(key, data)

        return self._session.declare_queryable(key, answer)

    # --- the thread

    def _run(self) -> None:
        try:
            keep_on(self._turn, self._defects, "publishing")
        finally:
            self._dropped += self._fields.dropped

    def _turn(self) -> bool:
        """Send the next field, and what else is due. Return False when the host or the publication ends."""
        if self._over.is_set():
            return False
        try:
            field = self._fields.take(_POLL_S)
            if field is None:
                return False
        except queue.Empty:
            field = None
        except SkinError:  # the error that stopped the host, which the host reports
            return False
        if clock.monotonic() >= self._report_due_s:
            self._report_due_s = clock.monotonic() + HEALTH_S
            self._report()
        if field is not None:
            self._send_field(field)
        while (event := self._events.get(0.0)) is not None:
            self._send_event(event)
        return True

    def _send_field(self, field: FieldFrame) -> None:
        stamp = field.stamp
        if stamp is None:
            return
        name, now_ns = stamp.patch, clock.time_ns()
        self._published[name] += 1
        sent = SendStamp(self._started_ns, self._published[name], now_ns, self._wall_minus_mono_ns)
        if (name, "full_field") in self._subscribed:
            self._outputs[name, "full_field"].send(encode_field(field, sent), now_ns)
        t_ns = (stamp.t_sync_ns or stamp.t_receive_ns) + self._wall_minus_mono_ns
        if (name, "field") in self._subscribed:
            cloud = point_cloud(field, self._rest_m[name], t_ns)
            self._outputs[name, "field"].send(encode(cloud, POINT_CLOUD), now_ns)
        if (name, "field_info") in self._subscribed:
            info = field_info(field, t_ns)
            self._outputs[name, "field_info"].send(encode(info, FIELD_INFO), now_ns)
        if (name, "contacts") in self._subscribed:
            contacts = contacts_message(field, t_ns)
            self._outputs[name, "contacts"].send(encode(contacts, CONTACTS), now_ns)
        if (name, "contact_wrenches") in self._subscribed:
            for wrench in contact_wrenches(field, t_ns):
                self._outputs[name, "contact_wrenches"].send(encode(wrench, WRENCH), now_ns)

    def _report(self) -> None:
        """Send the health and the poses, and look up to which topics programs subscribe."""
        now_ns = clock.time_ns()
        self._wall_minus_mono_ns = now_ns - clock.monotonic_ns()
        self._subscribed = {name for name, output in self._outputs.items() if output.wanted}
        hand = self._host.hand
        patches = {name: self._host.health(name) for name in self._patches}
        buses = {bus.name: self._host.bus_health(bus.name) for bus in hand.buses if hand.patches_on(bus.name)}
        report = HealthReport(
            self._started_ns, patches, buses, dict(self._published), self._dropped + self._fields.dropped
        )
        self._outputs["", "health"].send(encode_report(report, now_ns), now_ns)
        if ("", "diagnostics") in self._subscribed:
            health = diagnostics(hand.name, patches, buses, now_ns)
            self._outputs["", "diagnostics"].send(encode(health, DIAGNOSTIC_ARRAY), now_ns)
        if ("", "tf_static") in self._subscribed:
            poses = transforms(self._skeleton, now_ns)
            self._outputs["", "tf_static"].send(encode(poses, TRANSFORMS), now_ns)

    def _send_event(self, event: HealthEvent) -> None:
        message = log_message(event, event.t_ns + self._wall_minus_mono_ns)
        self._outputs["", "events"].send(encode(message, LOG), clock.time_ns())


@contextlib.contextmanager
def publish(
    host: Host, options: SessionOptions | None = None, *, commands: bool = False
) -> Iterator[Publication]:
    """Publish a running host while the ``with`` block is active.

    Example::

        with sk.Host.from_toml("hand.toml") as host, sk.publish(host):
            ...

    Args:
        host: Running host.
        options: Connections; by default, only programs on this machine can connect.
        commands: Whether programs may tare patches and reset nodes.

    Raises:
        ConfigError: if another daemon publishes the hand, a package is missing, the connections cannot be
            opened, or commands could be sent from other machines without TLS.
    """
    options = options or SessionOptions()
    require_protected(options, commands=commands)
    with Claim(host.hand, options) as claim, Publication(host, claim, commands=commands) as publication:
        yield publication
