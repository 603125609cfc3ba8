"""Computes worst-case response times on a CAN bus, from queueing a frame to the end of its last bit.

The method follows section 3 of Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability
analysis: Refuted, revisited and revised", Real-Time Systems 35, 2007. The frame with the lowest identifier
wins arbitration, and a transmission is never preempted. The first instance of a message is not always the
slowest, so the analysis examines every instance in the longest busy period of the message's priority level.

This module extends the analysis to messages sent in bursts, such as the chunks of a scan: each period begins
with ``count`` frames at intervals of ``spacing_ns``. A time window contains the most frames if it begins with
a burst; this number replaces the paper's ⌈(t + J) / T⌉.

Two assumptions apply: no frame is retransmitted after an error, and every controller sends its
highest-priority frame first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Message:
    """A message: all frames with the same identifier. Times are integers in nanoseconds.

    Raises:
        ValueError: if a burst is longer than its period, or a time is not positive.
    """

    can_id: int
    """Identifier, unique on the bus; a lower identifier has a higher priority."""
    time_ns: int
    """Maximum duration of a frame, including the inter-frame space, in ns."""
    period_ns: int
    """Minimum time between the starts of consecutive bursts, in ns."""
    count: int = 1
    """Number of frames per burst."""
    spacing_ns: int = 0
    """Minimum time between consecutive frames of a burst, in ns."""
    jitter_ns: int = 0
    """Maximum queueing jitter of a frame, in ns. Jitter does not change the order of the frames."""

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
        """Return the due time of an instance relative to instance 0, in ns."""
        burst, number = divmod(instance, self.count)
        return burst * self.period_ns + number * self.spacing_ns

    def most_in(self, window_ns: int) -> int:
        """Return the maximum number of instances queued within a half-open window of ``window_ns``."""
        bursts, rest_ns = divmod(window_ns + self.jitter_ns, self.period_ns)
        begun = (
            self.count
            if rest_ns > (self.count - 1) * self.spacing_ns
            else -(-rest_ns // max(1, self.spacing_ns))
        )
        return bursts * self.count + begun


def response_time_ns(message: Message, others: Sequence[Message], bit_ns: int) -> int | None:
    """Return the maximum time in ns from a frame's due time to the end of its last bit.

    Args:
        message: the message.
        others: the other messages on the bus.
        bit_ns: bit time, in ns; a frame queued up to one bit time after the start of arbitration can still
            win.

    Returns:
        The response time; None if it is unbounded, because this message and higher-priority messages need the
        entire bandwidth.
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
        wait_ns = max(wait_ns, own_ns)  # the waiting time of the previous instance is a lower bound
        while (longer_ns := own_ns + _work_ns(higher, wait_ns + bit_ns)) > wait_ns:
            wait_ns = longer_ns
        passed_ns = wait_ns - message.due_ns(instance) + message.time_ns
        longest_ns = max(longest_ns, message.jitter_ns + passed_ns)
    return longest_ns


def _work_ns(messages: Sequence[Message], window_ns: int) -> int:
    return sum(message.most_in(window_ns) * message.time_ns for message in messages)
