"""Monitors the source of a patch and reports failures with EMCY 0xFF00."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator

from skinnode.canopen.emergency import EmcyCode
from skinnode.node.emcy import EmcyProducer
from skinnode.node.patch.source import SourceFailed, SourceFault


class SourceMonitor:
    """Counts and reports failures of a source.

    Args:
        emcy: EMCY producer of the node.
        on_failure: Callback for each failure.
    """

    def __init__(self, emcy: EmcyProducer, on_failure: Callable[[], None]) -> None:
        self._emcy, self._on_failure = emcy, on_failure
        self._fault: SourceFault | None = None
        self.failures = 0
        """Number of failed scans, tares and self-test readings."""
        self.error = ""
        """One-line description of the latest failure; empty if there has been none."""

    def reset(self, t_ns: int) -> None:
        """Report the current failure, if any, again after a reset."""
        if self._fault is not None:
            self._report(self._fault, t_ns)

    @contextlib.contextmanager
    def watch(self, t_ns: int) -> Iterator[None]:
        """Return a context manager for a block of code that reads the source.

        If the block raises SourceFailed, the failure is reported. If it succeeds, the end of an earlier
        failure is reported.

        Args:
            t_ns: Current time, in ns.
        """
        try:
            yield
        except SourceFailed as failure:
            self.failures += 1
            self.error = str(failure)
            if failure.fault is not self._fault:  # a persistent failure is reported once
                self._report(failure.fault, t_ns)
            self._on_failure()
            raise
        if self._fault is not None:
            self._fault = None
            self._emcy.clear(EmcyCode.SOURCE, t_ns)

    def _report(self, fault: SourceFault, t_ns: int) -> None:
        self._fault = fault
        self._emcy.report(EmcyCode.SOURCE, struct.pack("<BH", fault, self.failures & 0xFFFF), t_ns)
