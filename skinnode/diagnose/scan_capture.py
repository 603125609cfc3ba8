"""Assembles the patches' scans in the same way as the host, and records SYNCs. Nothing is solved."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from skinnode.canopen import indices as od
from skinnode.diagnose.facts import ScanFacts
from skinnode.process import clock
from skinnode.protocol.assembler import ScanAssembler
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan import Scan
from skinnode.transport import Frame

_MOST_SCANS: Final = 1000
_MOST_SYNCS: Final = 100_000
_LONGEST_NS: Final = 10_000_000_000
"""Maximum time from a SYNC to the first frame of its scan, in ns."""


class ScanCapture:
    """Assembles the scans of several patches and records every SYNC.

    The receiving thread of a bus link calls :meth:`on_frames`. Call :meth:`facts` only after that thread has
    stopped.
    """

    def __init__(self) -> None:
        self.syncs: deque[tuple[int, int]] = deque(maxlen=_MOST_SYNCS)
        """Time (monotonic clock, ns) and counter of each SYNC; the counter is 0 for a SYNC without data."""
        self._patches: dict[int, _Patch] = {}
        self._takers: dict[int, tuple[_Patch, bool]] = {}

    def add(self, node_id: int, profile: PatchProfile, overflow: int, period_s: float) -> None:
        """Start assembling the scans of a patch.

        Args:
            node_id: The node.
            profile: Number of wires and other dimensions of the patch.
            overflow: Overflow value of the SYNC counter; 0 if SYNC has no counter.
            period_s: SYNC period, in s.
        """
        assembler = ScanAssembler(
            profile, counter_overflow=overflow, period_ns=round(period_s * 1e9), node_id=node_id
        )
        patch = self._patches[node_id] = _Patch(assembler)
        takers = {**self._takers, od.chunk_cob_id(node_id): (patch, True)}
        self._takers = {**takers, od.summary_cob_id(node_id): (patch, False)}

    def scans(self, node_id: int) -> int:
        """Return the number of captured scans of a patch."""
        return len(self._patches[node_id].scans)

    def on_frames(self, frames: Sequence[Frame]) -> None:
        """Process a batch of received frames."""
        for frame in frames:
            if frame.error or frame.remote or frame.extended:
                continue
            if frame.can_id == od.SYNC_COB_ID:
                self.note_sync(frame.t_ns, frame.data[0] if frame.data else 0)
            elif (taker := self._takers.get(frame.can_id)) is not None:
                patch, chunk = taker
                if not patch.begun:  # wait for a summary: the current scan may have begun earlier
                    patch.begun = not chunk
                    continue
                take = patch.assembler.on_chunk if chunk else patch.assembler.on_summary
                patch.keep(take(frame.data, frame.t_ns), self._sync_ns)
        for patch in self._patches.values():
            patch.keep(patch.assembler.poll(frames[-1].t_ns), self._sync_ns)

    def note_sync(self, t_ns: int, counter: int) -> None:
        """Record a SYNC that was received or sent."""
        self.syncs.append((t_ns, counter))

    def facts(self, node_id: int, scale: CodeScale, stated_noise: float) -> ScanFacts | None:
        """Return the captured scans of a patch; None if there are none.

        Args:
            node_id: The node.
            scale: Scale of the patch's codes.
            stated_noise: Relative noise of the patch's converter, according to the hand file.
        """
        patch = self._patches[node_id]
        patch.keep(patch.assembler.poll(clock.monotonic_ns()), self._sync_ns)
        scans = list(patch.scans)
        if not scans:
            return None
        codes = np.stack([scan.codes for scan, _ in scans]).astype(np.int64)
        valid = np.stack([scan.valid for scan, _ in scans])
        last_ns = np.array([scan.t_last_ns for scan, _ in scans], dtype=np.float64)
        sync_ns = np.array([np.nan if sync is None else float(sync) for _, sync in scans])
        device = [-1 if scan.device_time_us is None else scan.device_time_us for scan, _ in scans]
        conversions, repeated = _conversions([scan for scan, _ in scans])
        return ScanFacts(
            ratio=np.where(valid, scale.lo + codes * scale.step, np.nan),
            n_open=(codes == scale.open).sum(axis=0),
            n_short=(codes == scale.short).sum(axis=0),
            n_over=(codes == scale.over_range).sum(axis=0),
            t_s=(last_ns - last_ns[0]) * 1e-9,
            latency_s=(last_ns - sync_ns) * 1e-9,
            device_us=np.array(device, dtype=np.int64),
            complete=np.array([scan.complete for scan, _ in scans]),
            step=scale.step,
            stated_noise=stated_noise,
            stats=patch.assembler.stats,
            conversions=conversions,
            repeated=repeated,
        )

    def _sync_ns(self, scan: Scan) -> int | None:
        """Return the time of the SYNC that started a scan, in ns; None if the SYNC was not received.

        Searches backwards from the scan's first frame for a SYNC that has either the scan's counter or no
        counter.
        """
        for t_ns, number in reversed(list(self.syncs)):  # copied, because another thread may append
            if scan.t_first_ns - t_ns > _LONGEST_NS:
                return None
            if t_ns <= scan.t_first_ns and number in (scan.counter, 0):
                return t_ns
        return None


def _conversions(scans: Sequence[Scan]) -> tuple[int | None, int]:
    """Return the numbers of scans with and without a new conversion since the previous scan.

    Returns None and 0 if the patch does not count its conversions.
    """
    pairs = [
        (before.phase, scan.phase)
        for before, scan in itertools.pairwise(scans)
        if scan.scan == before.scan + 1 and before.phase and scan.phase
    ]
    repeated = sum(before == now for before, now in pairs)
    return (len(pairs) - repeated if pairs else None), repeated


class _Patch:
    def __init__(self, assembler: ScanAssembler) -> None:
        self.assembler = assembler
        self.begun = False
        self.scans: deque[tuple[Scan, int | None]] = deque(maxlen=_MOST_SCANS)

    def keep(self, scan: Scan | None, sync_ns: Callable[[Scan], int | None]) -> None:
        if scan is not None:
            self.scans.append((scan, sync_ns(scan)))
