"""Touch onsets and releases, recorded by the workers and published as events by the health watch."""

from __future__ import annotations

import contextlib
from collections import deque
from dataclasses import dataclass
from typing import Final

from skinnode.model.frames import FieldFrame

KEPT: Final = 4096
"""Maximum number of changes queued for publication; if the queue is full, the oldest changes are dropped."""


@dataclass(frozen=True, slots=True)
class TouchChange:
    """Onset or release of a touch."""

    patch: str
    t_ns: int
    """Monotonic time (ns) of the scan that showed the change: the SYNC time or, if unknown, the time of the
    last frame.
    """
    scan: int
    """Number of the scan that showed the change."""
    touched: bool
    seconds: float | None
    """Duration (s) of the touch that ended; None for an onset."""

    @property
    def what(self) -> str:
        """Event type: ``touched`` or ``released``."""
        return "touched" if self.touched else "released"

    @property
    def text(self) -> str:
        """Description of the change, without the patch name."""
        if self.seconds is None:
            return f"touched since scan {self.scan}"
        return f"released in scan {self.scan}, after {self.seconds:.2f} s"


class TouchChanges:
    """Changes in ``touched`` in the fields of all patches.

    Threads: only the worker that processes a patch may pass in its fields. Any thread may take the changes.
    """

    def __init__(self) -> None:
        self._since_ns: dict[str, int] = {}  # onset of each touched patch's current touch
        self._waiting: deque[TouchChange] = deque(maxlen=KEPT)

    def on_field(self, field: FieldFrame, patch: str) -> None:
        """Compare a field with the previous field. A field without a touch decision has no effect."""
        stamp, touched = field.stamp, field.touched
        if stamp is None or touched is None or touched == (patch in self._since_ns):
            return
        t_ns = stamp.t_sync_ns or stamp.t_receive_ns
        seconds = None
        if touched:
            self._since_ns[patch] = t_ns
        else:
            seconds = (t_ns - self._since_ns.pop(patch)) * 1e-9
        self._waiting.append(TouchChange(patch, t_ns, stamp.scan, touched, seconds))

    def take(self) -> list[TouchChange]:
        """Return the changes since the last call, oldest first."""
        found = []
        with contextlib.suppress(IndexError):
            while True:
                found.append(self._waiting.popleft())
        return found
