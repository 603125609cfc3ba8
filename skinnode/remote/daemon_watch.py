"""Uses liveliness tokens to track whether a daemon publishes a hand."""

from __future__ import annotations

from typing import TYPE_CHECKING

from skinnode.process import clock
from skinnode.remote import keys

if TYPE_CHECKING:
    import zenoh


class DaemonWatch:
    """Tracks a hand's daemons until the session is closed. Thread-safe.

    Args:
        session: Session of the program.
        hand: Name of the hand.
    """

    def __init__(self, session: zenoh.Session, hand: str) -> None:
        import zenoh

        self._put = zenoh.SampleKind.PUT
        self._zids: frozenset[str] = frozenset()
        self._lock = clock.lock()
        self.arrivals = 0
        """Number of daemons that have appeared so far."""
        self.t_change_ns = clock.monotonic_ns()
        """Monotonic time at which a daemon last appeared or disappeared, in ns."""
        self._subscriber = session.liveliness().declare_subscriber(
            keys.hand_tokens(hand), self._on_change, history=True
        )

    @property
    def present(self) -> bool:
        """Whether a daemon publishes the hand."""
        return bool(self._zids)

    def _on_change(self, sample: zenoh.Sample) -> None:
        """Record a change. Called by Zenoh threads."""
        zid = keys.zid_of(str(sample.key_expr))
        with self._lock:
            if sample.kind == self._put:
                self.arrivals += zid not in self._zids
                self._zids |= {zid}
            else:
                self._zids -= {zid}
            self.t_change_ns = clock.monotonic_ns()
