"""Decides whether the deadline of a frame leaves time to examine the frame."""

from __future__ import annotations

from typing import Final

from skinnode.process.clock import perf_counter

PATIENCE: Final = 4
"""Number of suspicious frames after which one is examined even if the deadline leaves no time. A fault makes
every subsequent frame suspicious; a press rarely does."""
FIRST_S: Final = 3e-3
"""Assumed duration of the first examination, in s. Later examinations are timed."""


class ExaminationTime:
    """Duration of examinations, and the number of suspicious frames not examined for lack of time.

    Attributes:
        expected_s: Expected duration of an examination, in s.
        is_overdue: Whether the frame is examined regardless of its deadline.
    """

    def __init__(self) -> None:
        self.expected_s = FIRST_S
        self.reset()

    def reset(self) -> None:
        """Reset the count of unexamined frames."""
        self._waiting, self.is_overdue = 0, False

    def start_frame(self) -> None:
        """Prepare for a new frame."""
        self.is_overdue = False

    def nothing_waits(self) -> None:
        """Record a frame that need not be examined."""
        self._waiting = 0

    def insist(self) -> None:
        """Force the next suspicious frame to be examined, even if there is no time."""
        self._waiting = PATIENCE

    def allows(self, until: float, seconds: float | None = None) -> bool:
        """Return whether a step in examining a suspicious frame may start.

        The deadline is ignored for every :data:`PATIENCE`-th suspicious frame that would miss it.

        Args:
            until: Deadline, as a value of :func:`skinnode.process.clock.perf_counter`, in s.
            seconds: Duration of the step; default: :attr:`expected_s`.
        """
        if self.is_in_time(until, seconds):
            return True
        self._waiting += 1
        self.is_overdue = self._waiting >= PATIENCE
        if self.is_overdue:
            self._waiting = 0
        return self.is_overdue

    def is_in_time(self, until: float, seconds: float | None = None) -> bool:
        """Return whether a step of ``seconds`` would end by ``until``, or whether the frame is overdue."""
        seconds = self.expected_s if seconds is None else seconds
        return self.is_overdue or perf_counter() + seconds <= until

    def took(self, seconds: float) -> None:
        """Record the duration of an examination, in s."""
        self.expected_s = max(seconds, 0.8 * self.expected_s)
