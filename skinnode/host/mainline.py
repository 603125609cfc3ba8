"""Run the mainline, the thread that dispatches the frames of all buses."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from types import TracebackType
from typing import Final, Self

from skinnode.host.containment import Defects, keep_on
from skinnode.host.link import BusLink
from skinnode.process import clock
from skinnode.transport import Receiver

_WAIT_S: Final = 0.02
"""Maximum wait (s) for a frame before the pollers are called."""
_ROUND_NS: Final = 10_000_000
"""Maximum interval (ns) between iterations that serve all buses, including those without new frames."""


class Mainline:
    """Thread that dispatches the frames of ``links`` until :meth:`stop` or the end of a ``with`` block.

    A failure on one bus does not affect the others.

    Threads: one thread serves all buses. Their frames arrive at about the same time, and waking another
    thread would take as long as handling twenty frames.

    Args:
        links: Connections to the buses.
        defects: Collector of exceptions that concern no particular bus; by default, the first bus's
            collector.
    """

    def __init__(self, links: Sequence[BusLink], defects: Defects | None = None) -> None:
        self._links = tuple(links)
        self._defects = links[0].defects if defects is None else defects
        self._by_intake = {link.intake: link for link in links}
        self._round_ns = 0  # time from which the next iteration serves all buses
        self._measured = itertools.cycle(self._links)
        self._stop = clock.event()
        self._receiver = Receiver(
            [link.intake for link in links], lambda error: self._defects.report("receiving", error)
        )
        for link in links:
            link.begin(functools.partial(self._receiver.resume, link.intake))
        self._thread = clock.thread(target=self._run, name="mainline")
        self._thread.start()

    def stop(self) -> None:
        """Stop and join the mainline threads.

        Frames can still be sent afterwards.
        """
        self._stop.set()
        self._thread.join()
        for link in self._links:
            link.end()
        self._receiver.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _run(self) -> None:
        keep_on(self._turn, self._defects, "the mainline")

    def _turn(self) -> bool:
        if self._stop.is_set():
            return False
        heard = self._receiver.wait(_WAIT_S)
        now_ns = clock.monotonic_ns()
        links: Sequence[BusLink] = self._links
        if now_ns < self._round_ns:  # if there are many buses, most have received nothing
            links = [self._by_intake[intake] for intake in heard]
        else:
            self._round_ns = now_ns + _ROUND_NS
        for link in links:
            try:
                link.turn()
            except Exception as error:
                link.defects.report("an iteration of the mainline", error)
        next(self._measured).measure_load()
        return True
