"""Worst-case response times on a CAN bus, from queueing a frame to its last bit.

The analysis follows Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis:
Refuted, revisited and revised", Real-Time Systems 35, 2007, section 3. The lowest identifier wins
arbitration, and a frame being sent is not interrupted. Every instance in the longest busy period of a
priority level is examined, because the first instance does not always have the longest response time.

Extension: frames may come in bursts of ``count`` frames ``spacing_ns`` apart in each period, as the chunks of
a scan do. A window that starts with a burst contains the maximum number of frames, so the analysis holds with
that number instead of the paper's ⌈(t + J) / T⌉.

Retransmission after an error, and controllers that may send a lower-priority frame first, are not covered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Message:
    """Frames with the same identifier on a bus. Times are whole nanoseconds.

    Raises:
        ValueError: if a burst is longer than its period, or a time is not positive.
    """

    can_id: int
    """Identifier, which is also the priority (the lowest wins) and unique on the bus."""
    time_ns: int
    """Maximum duration of a frame including the inter-frame space, ns."""
    period_ns: int
    """Minimum time from the start of one burst to the start of the next, ns."""
    count: int = 1
    """Number of frames per burst."""
    spacing_ns: int = 0
    """Minimum time between consecutive frames of a burst, ns."""
    jitter_ns: int = 0
    """Maximum queueing jitter of a frame, ns; frames of the same message keep their order."""

    def __post_init__(self) -> None:
        for name, least in (
            ("time_ns", 1),
            ("period_ns", 1),
            ("count", 1),
            ("spacing_ns", 0),
            ("jitter_ns", 0),
        ):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: got {getattr(self, name)}, must be at least {least}")
        if self.count * self.spacing_ns > self.period_ns:
            burst = f"{self.count} frames {self.spacing_ns} ns apart"
            raise ValueError(f"spacing_ns: got {burst}, must fit {self.period_ns} ns")

    def due_ns(self, instance: int) -> int:
        """Return the time from instance 0 to the time at which an instance is due, ns."""
        burst, number = divmod(instance, self.count)
        return burst * self.period_ns + number * self.spacing_ns

    def most_in(self, window_ns: int) -> int:
        """Return the maximum number of instances queued in a half-open window of length ``window_ns``."""
        bursts, rest_ns = divmod(window_ns + self.jitter_ns, self.period_ns)
        begun = (
            self.count
            if rest_ns > (self.count - 1) * self.spacing_ns
            else -(-rest_ns // max(1, self.spacing_ns))
        )
        return bursts * self.count + begun


def response_time_ns(message: Message, others: Sequence[Message], bit_ns: int) -> int | None:
    """Return the maximum time from when a message is due until its last bit has been sent, ns.

    Args:
        message: the message.
        others: the other messages on the bus.
        bit_ns: bit time, ns; a frame queued up to one bit time after arbitration starts still takes part in
            it.

    Returns:
        The time, or None if it is unbounded because the message and all higher-priority messages together
        need the whole bandwidth.
    """
    higher = [other for other in others if other.can_id < message.can_id]
    blocking_ns = max((other.time_ns for other in others if other.can_id > message.can_id), default=0)
    if sum(each.count * each.time_ns / each.period_ns for each in (*higher, message)) >= 1:
        return None

    busy_ns = blocking_ns + message.time_ns
    while (longer_ns := blocking_ns + _work_ns((*higher, message), busy_ns)) > busy_ns:
        busy_ns = longer_ns

    longest_ns, wait_ns = 0, blocking_ns
    for instance in range(message.most_in(busy_ns)):
        own_ns = blocking_ns + instance * message.time_ns
        wait_ns = max(wait_ns, own_ns)  # the previous instance's wait is a lower bound to start from
        while (longer_ns := own_ns + _work_ns(higher, wait_ns + bit_ns)) > wait_ns:
            wait_ns = longer_ns
        passed_ns = wait_ns - message.due_ns(instance) + message.time_ns
        longest_ns = max(longest_ns, message.jitter_ns + passed_ns)
    return longest_ns


def _work_ns(messages: Sequence[Message], window_ns: int) -> int:
    return sum(message.most_in(window_ns) * message.time_ns for message in messages)
