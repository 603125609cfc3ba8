"""Publishes the fields, contacts, health and events of a running host in separate threads."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from skinnode.errors import SkinError
from skinnode.host import Host
from skinnode.host.containment import Defects, keep_on
from skinnode.messages.contacts import WRENCH, contact_wrenches, contacts_message
from skinnode.messages.definitions import CONTACTS, FIELD_INFO
from skinnode.messages.fields import POINT_CLOUD, field_info, point_cloud
from skinnode.messages.full_field import SendStamp, encode_field
from skinnode.messages.topics import HandTopics
from skinnode.messages.typestore import encode
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout
from skinnode.process import clock
from skinnode.process.closing import Closing
from skinnode.remote import keys
from skinnode.remote.claim import Claim
from skinnode.remote.command_server import CommandServer
from skinnode.remote.description import Description, boot_id
from skinnode.remote.output import Outputs
from skinnode.remote.session import SessionOptions, require_protected
from skinnode.remote.status_publication import StatusPublication

if TYPE_CHECKING:
    import zenoh

QUEUED: Final = 32
"""Capacity of the queue between the host and the thread, in fields per patch."""
_POLL_S: Final = 0.05
"""Maximum time until :meth:`Publication.close` takes effect, in s."""


@dataclass(frozen=True, slots=True)
class PublicationStats:
    """Counters of a publication."""

    published: dict[str, int]
    """Number of fields sent, by patch name; equals the sequence number of the newest field."""
    dropped: int
    """Number of fields not sent because this process was too slow."""
    failed: int
    """Number of exceptions, each of which caused the loss of a field or a report."""


class Publication(Closing):
    """Publishes a host's data from construction until :meth:`close`.

    Programs receive each field as ``skinnode_msgs/Field``. The ROS 2 standard messages are computed only for
    topics that have a subscriber.

    Args:
        host: Running host, which the publication never delays. The publication ends when the host closes.
        claim: Claim on the hand; the caller closes it.
        commands: Whether programs may tare patches and reset nodes.

    Threads: any thread may call the methods.
    """

    def __init__(self, host: Host, claim: Claim, *, commands: bool = False) -> None:
        self._host, self._session = host, claim.session
        self._started_ns = clock.time_ns()
        self._patches = [patch.name for patch in host.hand.patches]
        self._published = dict.fromkeys(self._patches, 0)
        self._defects = Defects("publication")
        self._hashed = {name: _hashed(host.layout(name)) for name in self._patches}
        self._outputs = Outputs(self._session, HandTopics.of(host.hand))
        self._fields = host.fields(capacity=QUEUED * len(self._patches))
        self._over = clock.event()
        self._description: zenoh.Queryable[None] | None = self._describe(commands=commands)
        self._commands = CommandServer(self._session, host) if commands else None
        self._status = StatusPublication(host, self._outputs, self._started_ns, self.stats, self._defects)
        self._thread = clock.thread(target=self._run, name="publish")
        self._thread.start()

    def stats(self) -> PublicationStats:
        """Return the counters."""
        return PublicationStats(dict(self._published), self._fields.dropped, self._defects.count)

    def close(self) -> None:
        """Stop publishing and wait for the threads to end. Further calls have no effect."""
        self._over.set()
        self._thread.join()
        self._status.close()
        self._fields.close()
        if self._commands is not None:
            self._commands.close()
        description, self._description = self._description, None
        if description is not None:
            description.undeclare()

    def _describe(self, *, commands: bool) -> zenoh.Queryable[None]:
        """Answer queries for the hand's description with the layouts that are in use at that time."""
        hand, boot = self._host.hand, boot_id()
        key = keys.description_key(hand.name)

        def answer(query: zenoh.Query) -> None:
            with query:
                layouts = {name: self._host.layout(name) for name in self._patches}
                description = Description(hand, layouts, boot, commands, self._started_ns)
                query.reply(key, description.encode())

        return self._session.declare_queryable(key, answer)

    # --- the field thread

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "publishing a field")

    def _turn(self) -> bool:
        """Send the next field. Return False when the host or the publication has ended."""
        if self._over.is_set():
            return False
        try:
            field = self._fields.take(_POLL_S)
        except queue.Empty:
            return True
        except SkinError:  # the error that stopped the host; the host reports it
            return False
        if field is None:
            return False
        self._send(field)
        return True

    def _send(self, field: FieldFrame) -> None:
        stamp = field.stamp
        if stamp is None:
            return
        name, now_ns, offset_ns = stamp.patch, clock.time_ns(), self._status.wall_minus_mono_ns
        self._published[name] += 1
        layout, layout_hash = self._layout(name)
        sent = SendStamp(self._started_ns, self._published[name], now_ns, offset_ns, layout_hash)
        outputs, wanted = self._outputs.patches[name], self._outputs.wanted
        if (name, "full_field") in wanted:
            outputs["full_field"].send(encode_field(field, sent), now_ns)
        t_ns = (stamp.t_sync_ns or stamp.t_receive_ns) + offset_ns
        if (name, "field") in wanted:
            cloud = point_cloud(field, layout.upper_m, t_ns)
            outputs["field"].send(encode(cloud, POINT_CLOUD), now_ns)
        if (name, "field_info") in wanted:
            outputs["field_info"].send(encode(field_info(field, t_ns), FIELD_INFO), now_ns)
        if (name, "contacts") in wanted:
            outputs["contacts"].send(encode(contacts_message(field, t_ns), CONTACTS), now_ns)
        if (name, "contact_wrenches") in wanted:
            for wrench in contact_wrenches(field, t_ns):
                outputs["contact_wrenches"].send(encode(wrench, WRENCH), now_ns)

    def _layout(self, name: str) -> tuple[PatchLayout, int]:
        """Return a patch's current layout and its hash; a node that appears may supply another layout."""
        layout = self._host.layout(name)
        if layout is not self._hashed[name][0]:
            self._hashed[name] = _hashed(layout)
        return self._hashed[name]


def _hashed(layout: PatchLayout) -> tuple[PatchLayout, int]:
    return layout, layout.layout_hash


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
