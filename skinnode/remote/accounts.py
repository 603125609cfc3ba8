"""Counts the fields that a program has received and lost, and measures their age."""

from __future__ import annotations

from dataclasses import dataclass

from skinnode.messages.full_field import SendStamp


@dataclass(frozen=True, slots=True)
class PatchCounts:
    """Counters for a patch since the program connected."""

    received: int
    """Number of fields received."""
    lost: int
    """Number of fields that the daemon sent but that did not arrive, inferred from sequence number gaps."""
    runs: int
    """Number of daemon runs from which fields have arrived."""
    sequence: int
    """Sequence number of the newest field; 0 before the first field."""
    published: int
    """Number of fields sent in the daemon's current run, as counted by the daemon in its newest report."""
    delay_s: float
    """Transit time of the newest field, in s; between machines, it is only as accurate as their clocks."""
    age_s: float | None
    """Time since the host received the newest field's scan, in s; None before the first field."""


class PatchAccount:
    """Counts a patch's received and lost fields. Only the receiver may call :meth:`add`."""

    def __init__(self) -> None:
        self._received = self._lost = self._runs = self._sequence = 0
        self._run: int | None = None
        self._delay_ns = 0
        self._t_receive_ns: int | None = None
        self.published = 0

    def add(self, sent: SendStamp, delay_ns: int, t_receive_ns: int) -> bool:
        """Count a field; return whether it is newer than all earlier fields of its run.

        A field with a different ``started_ns`` begins a new run. The order of the ``started_ns`` values is
        meaningless, because the daemon's clock may have been set back.

        Args:
            sent: Sequence number and times of the field.
            delay_ns: Transit time, in ns.
            t_receive_ns: Time at which the host received the scan, on this machine's monotonic clock, in ns.
        """
        if sent.started_ns != self._run:
            self._run, self._sequence = sent.started_ns, sent.sequence - 1
            self._runs += 1
        if sent.sequence <= self._sequence:
            return False
        self._lost += sent.sequence - self._sequence - 1
        self._received += 1
        self._sequence = sent.sequence
        self._delay_ns, self._t_receive_ns = delay_ns, t_receive_ns
        return True

    def counts(self, now_ns: int) -> PatchCounts:
        """Return the counters.

        Args:
            now_ns: Monotonic time, in ns.
        """
        age_s = None if self._t_receive_ns is None else (now_ns - self._t_receive_ns) * 1e-9
        return PatchCounts(
            self._received,
            self._lost,
            self._runs,
            self._sequence,
            self.published,
            self._delay_ns * 1e-9,
            age_s,
        )
