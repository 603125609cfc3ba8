"""Use a hand run by another process, with the same interface to fields, health and events as a host."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from skinnode.errors import SkinError
from skinnode.host.callback import Callbacks
from skinnode.host.containment import Defects
from skinnode.host.events import Events, HealthEvent
from skinnode.host.health import BusHealth, Condition, PatchHealth
from skinnode.host.publish import Publisher
from skinnode.host.running_hand import RunningHand
from skinnode.host.tare import tare_deadline_s
from skinnode.messages.full_field import SendStamp
from skinnode.messages.health_report import HealthReport
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout
from skinnode.process import clock
from skinnode.process.closing import Closing
from skinnode.remote import commands
from skinnode.remote.accounts import PatchAccount, PatchCounts
from skinnode.remote.daemon_watch import DaemonWatch
from skinnode.remote.description import Description, ask
from skinnode.remote.receiver import Receiver, Recipients

if TYPE_CHECKING:
    import zenoh

SILENT_S: Final = 1.0
"""Time without a health report after which the daemon is considered silent, in s. The daemon sends four
reports per second."""
_RESET_S: Final = 1.0
_UNKNOWN: Final = -1
"""Number of described arrivals after which the next turn requests a new description."""


@dataclass(frozen=True, slots=True)
class RemoteStats:
    """Counters of a program connected to a hand."""

    patches: Mapping[str, PatchCounts]
    dropped: int
    """Number of messages dropped because this process was too slow; ``lost`` includes their fields."""
    events_lost: int
    """Number of events that the daemon sent but that did not arrive."""
    daemon_dropped: int
    """Number of fields that the daemon did not send because its process was too slow."""
    malformed: int
    """Number of messages that could not be decoded, plus the number of other exceptions."""


class RemoteHand(RunningHand, Closing):
    """Hand that a daemon (``skinnode host --publish``) publishes; :func:`skinnode.connect` creates it.

    If the daemon ends or the connection fails, subscriptions wait, :meth:`health` reports every patch as lost
    with the reason, and :attr:`away` gives the reason. The connection is re-established in the background.
    Only data from the run whose description has arrived are passed on. If a returning daemon has a different
    hand file, or a version of skinnode with different messages, its data are never passed on: subscriptions
    raise an error, and the hand remains away.

    Threads: any thread may call any method.

    Args:
        session: Session of the program, which :meth:`close` closes.
        description: Description of the hand.
    """

    def __init__(self, session: zenoh.Session, description: Description) -> None:
        hand = description.hand
        names = tuple(patch.name for patch in hand.patches)
        self._defects = defects = Defects(f"hand {hand.name!r}")
        super().__init__(hand, Publisher(names, defects), Events(defects), Callbacks(defects))
        self._session, self._description = session, description
        self._hashes = description.hashes()
        self._accounts = {name: PatchAccount() for name in names}
        self._report: HealthReport | None = None
        self._t_report_ns = clock.monotonic_ns()
        self._was_away: bool | None = None
        self._run = 0
        self._refusal: SkinError | None = None
        self._closed = False
        self._watch = DaemonWatch(session, self.hand.name)
        self._described = self._watch.arrivals
        recipients = Recipients(self._on_field, self._on_report, self._on_event, self._on_turn)
        self._receiver = Receiver(session, description, recipients, self._defects)
        self._receiver.start()

    # --- the same interface as a host

    def layout(self, patch: str) -> PatchLayout:
        """Return the electrode layout used to compute a patch's fields.

        Raises:
            KeyError: if there is no such patch.
        """
        return self._description.layouts[patch]

    def health(self, patch: str) -> PatchHealth:
        """Return the health of a patch, from the newest report; ``lost`` while the daemon is away.

        Raises:
            KeyError: if there is no such patch.
        """
        report, away = self._report, self.away
        assert report is not None  # connect waits for the first report
        health = report.patches[patch]
        since_s = (clock.monotonic_ns() - self._t_report_ns) * 1e-9
        older = replace(
            health,
            heartbeat_age_s=None if health.heartbeat_age_s is None else health.heartbeat_age_s + since_s,
            scan_age_s=None if health.scan_age_s is None else health.scan_age_s + since_s,
        )
        return older if away is None else replace(older, condition=Condition.LOST, complaint=away)

    def bus_health(self, bus: str) -> BusHealth:
        """Return the health of a bus, from the newest report; unavailable while the daemon is away.

        Raises:
            KeyError: if there is no such bus, or the bus has no patches.
        """
        report, away = self._report, self.away
        assert report is not None
        return report.buses[bus] if away is None else replace(report.buses[bus], away=away)

    def tare(self, patch: str, *, deadline_s: float | None = None) -> None:
        """Tare a patch; see :meth:`skinnode.Host.tare`.

        Raises:
            KeyError: if there is no such patch.
            ValueError: if ``deadline_s`` is negative, above 600 s or not a number.
            NodeError: if the host raises it.
            SkinError: if the daemon does not accept commands or does not reply in time, or the hand has been
                closed.
        """
        self._command("tare", patch, tare_deadline_s(self.hand, deadline_s))

    def reset_node(self, patch: str) -> None:
        """Reset a patch's node; see :meth:`skinnode.Host.reset_node`.

        Raises:
            KeyError: if there is no such patch.
            NodeError: if the host raises it.
            SkinError: if the daemon does not accept commands or does not reply in time, or the hand has been
                closed.
        """
        self._command("reset_node", patch, _RESET_S)

    # --- the connection

    @property
    def away(self) -> str | None:
        """Reason why no data is arriving; None while the daemon is present and sending."""
        if self._closed:
            return f"hand {self.hand.name!r}: this program has closed the connection"
        if self._refusal is not None:
            return str(self._refusal)
        if not self._watch.present:
            since_s = (clock.monotonic_ns() - self._watch.t_change_ns) * 1e-9
            return f"no daemon has published hand {self.hand.name!r} for {since_s:.1f} s"
        if self._silent_s > SILENT_S:
            return f"the daemon of hand {self.hand.name!r} has sent nothing for {self._silent_s:.1f} s"
        return None

    @property
    def no_commands(self) -> str | None:
        """Reason why the daemon does not accept commands; None if it accepts them."""
        if self._description.commands:
            return None
        what = "its daemon does not accept commands; start it with skinnode host --publish --commands"
        return f"hand {self.hand.name!r}: {what}"

    @property
    def ready(self) -> bool:
        """Whether the first health report has arrived.

        Raises:
            SkinError: if the daemon has restarted and its data are not passed on.
        """
        if self._refusal is not None:
            raise self._refusal
        return self._report is not None

    def stats(self) -> RemoteStats:
        """Return the counters."""
        now_ns, report = clock.monotonic_ns(), self._report
        return RemoteStats(
            patches={name: account.counts(now_ns) for name, account in self._accounts.items()},
            dropped=self._receiver.dropped,
            events_lost=self._receiver.events_lost,
            daemon_dropped=0 if report is None else report.dropped,
            malformed=self._defects.count,
        )

    def close(self) -> None:
        """End all subscriptions, the thread and the session. Further calls have no effect."""
        self._receiver.close()
        self._closed = True
        self._session.close()
        self._publisher.end()
        self._events.end()
        self._callbacks.join()

    def _command(self, command: str, patch: str, deadline_s: float) -> None:
        if patch not in self._accounts:
            raise KeyError(patch)
        for refusal in (self.no_commands, self.away):
            if refusal is not None:
                raise SkinError(refusal)
        commands.send(self._session, self.hand.name, commands.Request(command, patch, deadline_s))

    # --- the receiver's thread

    def _on_field(self, field: FieldFrame, sent: SendStamp, delay_ns: int) -> None:
        stamp = field.stamp
        assert stamp is not None
        if not (self._is_current(sent.started_ns) and self._has_layout(stamp.patch, sent)):
            return
        if self._accounts[stamp.patch].add(sent, delay_ns, stamp.t_receive_ns):
            self._publisher.publish(field, stamp.patch)

    def _on_event(self, event: HealthEvent) -> None:
        if self._refusal is None:
            self._events.publish(event)

    def _on_report(self, report: HealthReport) -> None:
        if not self._is_current(report.started_ns):
            return
        buses = {bus.name for bus in self.hand.served_buses}
        if set(report.patches) != set(self._accounts) or set(report.buses) != buses:
            raise ValueError("a health report for another hand")
        self._report, self._t_report_ns = report, clock.monotonic_ns()
        for name, published in report.published.items():
            self._accounts[name].published = published

    def _on_turn(self) -> None:
        """Publish an event when the daemon disappears or returns; read a new daemon's description."""
        if self._refusal is not None:
            return
        arrivals = self._watch.arrivals
        if arrivals != self._described and self._ask():  # if not described, the daemon is starting: ask again
            self._described = arrivals
        away = self.away
        if self._report is None or (away is not None) == bool(self._was_away):
            return
        self._was_away = away is not None
        what, text = ("back", "its daemon is back") if away is None else ("away", away)
        self._events.publish(HealthEvent(clock.monotonic_ns(), "host", what, text))

    def _ask(self) -> bool:
        """Request a description and use it; return whether one has arrived."""
        try:
            description = ask(self._session, self.hand.name)
        except SkinError as error:
            self._refuse(error)
            return False
        if description is not None:
            self._take(description)
        return description is not None

    def _has_layout(self, patch: str, sent: SendStamp) -> bool:
        """Return whether the layout of a field is known; if it has changed, request it first.

        A node that appears while the daemon runs may supply electrodes that differ from those described
        earlier. A field is not passed on until :meth:`layout` returns its layout.
        """
        if self._hashes[patch] != sent.layout_hash:
            self._ask()
        return (self._hashes[patch], self._description.started_ns) == (sent.layout_hash, sent.started_ns)

    def _take(self, description: Description) -> None:
        if not description.agrees_with(self._description):
            text = "its daemon has restarted with another hand file; connect again"
            self._refuse(SkinError(f"hand {self.hand.name!r}: {text}"))
            return
        self._run += description.started_ns != self._description.started_ns
        self._description, self._hashes = description, description.hashes()
        self._receiver.follow(description, self._run)

    def _refuse(self, error: SkinError) -> None:
        """Stop passing on data, and report ``error`` to subscriptions, in :attr:`away` and as an event."""
        self._refusal, self._was_away = error, True
        self._publisher.fail(error)
        self._events.publish(HealthEvent(clock.monotonic_ns(), "host", "away", str(error)))

    def _is_current(self, started_ns: int) -> bool:
        """Return whether a message is from the run that has been described.

        If messages arrive from another run while the described run is silent, a new description is requested,
        because the previous request may have been answered by a daemon that was about to end.
        """
        if self._refusal is None and started_ns == self._description.started_ns:
            return True
        if self._silent_s > SILENT_S:
            self._described = _UNKNOWN
        return False

    @property
    def _silent_s(self) -> float:
        """Time since the newest report of the described run, in s."""
        return (clock.monotonic_ns() - self._t_report_ns) * 1e-9
