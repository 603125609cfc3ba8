"""Worst-case response times on a CAN bus: from the moment a frame is queued until its last bit has passed.

Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis: Refuted, revisited and
revised", Real-Time Systems 35, 2007, section 3: the frame of the lowest identifier goes first, a frame on the
bus is not interrupted, and every instance in the longest busy period of its priority is looked at, since the
first is not always the slowest.

One thing is added: frames may come in bursts, ``count`` of them ``spacing_ns`` apart in each period, as the
chunks of a scan do. A window that begins with a burst holds the most of them, so that the analysis holds with
their number in it in place of the paper's ⌈(t + J) / T⌉.

Left out: frames that are sent again after an error, and controllers whose buffers let a later frame of lower
priority go before an earlier one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Message:
    """Frames of one identifier on the bus. Times are whole nanoseconds.

    Raises ValueError for a burst that is longer than its period, and for times that are not positive.
    """

    can_id: int
    """Priority: the lowest goes first. No two messages of a bus have the same."""
    time_ns: int
    """How long a frame takes, at its longest, with inter-frame space."""
    period_ns: int
    """Shortest time between two bursts."""
    count: int = 1
    """Frames of a burst."""
    spacing_ns: int = 0
    """Shortest time between two frames of a burst."""
    jitter_ns: int = 0
    """How much later than due a frame may be queued; never before an earlier one of the same message."""

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
        """When an instance is due, counted from the first, number 0."""
        burst, number = divmod(instance, self.count)
        return burst * self.period_ns + number * self.spacing_ns

    def most_in(self, window_ns: int) -> int:
        """The most instances that can be queued in a window, its end excluded."""
        bursts, rest_ns = divmod(window_ns + self.jitter_ns, self.period_ns)
        begun = (
            self.count
            if rest_ns > (self.count - 1) * self.spacing_ns
            else -(-rest_ns // max(1, self.spacing_ns))
        )
        return bursts * self.count + begun


def response_time_ns(message: Message, others: Sequence[Message], bit_ns: int) -> int | None:
    """The longest time from when ``message`` is due until it has passed; None where there is no bound: it and
    all of higher priority need the whole bus.

    ``others`` are the other messages of the bus, ``bit_ns`` the time of a bit, during which frames still
    join an arbitration.
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
        wait_ns = max(wait_ns, own_ns)  # that of the instance before was shorter
        while (longer_ns := own_ns + _work_ns(higher, wait_ns + bit_ns)) > wait_ns:
            wait_ns = longer_ns
        passed_ns = wait_ns - message.due_ns(instance) + message.time_ns
        longest_ns = max(longest_ns, message.jitter_ns + passed_ns)
    return longest_ns


def _work_ns(messages: Sequence[Message], window_ns: int) -> int:
    return sum(message.most_in(window_ns) * message.time_ns for message in messages)
