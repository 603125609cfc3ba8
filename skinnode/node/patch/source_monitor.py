"""Count failures of a patch's source, and report them in EMCY messages (0xFF00)."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator

from skinnode.canopen.emergency import EmcyCode
from skinnode.node.emcy import EmcyProducer
from skinnode.node.patch.source import SourceFailed, SourceFault


class SourceMonitor:
    """Monitor that counts and reports failures of a source.

    Args:
        emcy: emergency producer.
        on_failure: called after each failure of the source.
    """

    def __init__(self, emcy: EmcyProducer, on_failure: Callable[[], None]) -> None:
        self._emcy, self._on_failure = emcy, on_failure
        self._fault: SourceFault | None = None
        self.failures = 0
        """Number of failed scans, tares and self-test readings."""
        self.error = ""
        """One-line description of the source's last failure; empty before the first failure."""

    def reset(self, t_ns: int) -> None:
        """Report the failure again after a reset if the source is still failing."""
        if self._fault is not None:
            self._report(self._fault, t_ns)

    @contextlib.contextmanager
    def watch(self, t_ns: int) -> Iterator[None]:
        """Monitor the source while it is read in the ``with`` block.

        A failure is reported and raised again. If an earlier failure has ended, its end is reported.

        Args:
            t_ns: current time, ns.
        """
        try:
            yield
        except SourceFailed as failure:
            self.failures += 1
            self.error = str(failure)
            if failure.fault is not self._fault:  # report a continuing failure only once
                self._report(failure.fault, t_ns)
            self._on_failure()
            raise
        if self._fault is not None:
            self._fault = None
            self._emcy.clear(EmcyCode.SOURCE, t_ns)

    def _report(self, fault: SourceFault, t_ns: int) -> None:
        self._fault = fault
        self._emcy.report(EmcyCode.SOURCE, struct.pack("<BH", fault, self.failures & 0xFFFF), t_ns)
