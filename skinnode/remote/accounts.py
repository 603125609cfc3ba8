"""Counts the fields that a program has received and lost, and measures their age."""

from __future__ import annotations

from dataclasses import dataclass

from skinnode.messages.full_field import SendStamp


@dataclass(frozen=True, slots=True)
class PatchCounts:
    """Counters of a patch in a program, since it connected."""

    received: int
    """Number of fields received."""
    lost: int
    """Number of fields that the daemon has sent but that have not arrived: gaps in the sequence numbers."""
    runs: int
    """Number of runs of the daemon from which fields have arrived."""
    sequence: int
    """Sequence number of the newest field; 0 before the first."""
    published: int
    """Number of fields that the daemon has sent in its present run, by its own count in the newest report."""
    delay_s: float
    """Time from sending to receiving of the newest field, s; between machines, as exact as their clocks."""
    age_s: float | None
    """Time since the scan of the newest field was received by the host, s; None before the first field."""


class PatchAccount:
    """Account of a patch. Only the receiver writes to it."""

    def __init__(self) -> None:
        self._received = self._lost = self._runs = self._sequence = 0
        self._started_ns = -1
        self._delay_ns = 0
        self._t_receive_ns: int | None = None
        self.published = 0

    def add(self, sent: SendStamp, delay_ns: int, t_receive_ns: int) -> bool:
        """Count a field; return whether it is newer than all fields of its run.

        Args:
            sent: Number and time of the field.
            delay_ns: Time from sending to receiving, ns.
            t_receive_ns: Time at which the host received the scan, on this machine's monotonic clock, ns.
        """
        if sent.started_ns != self._started_ns:
            if sent.started_ns < self._started_ns:
                return False  # a late message of an earlier run
            self._started_ns, self._sequence = sent.started_ns, sent.sequence - 1
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
            now_ns: Monotonic time, ns.
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
