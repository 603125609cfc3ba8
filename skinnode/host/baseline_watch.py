"""Reread a running node's baseline or error register if it may have changed."""

from __future__ import annotations

import contextlib
import logging
from concurrent.futures import Executor, Future
from typing import Final

import numpy as np

from skinnode.errors import BusError, ConfigError
from skinnode.host.sdo_client import Abandoned
from skinnode.host.supervised import JOIN_DEADLINE_S, LEAST_NS, Joined, Supervised
from skinnode.model.baseline_change import TOUCHED, touched_crossings
from skinnode.process import clock

_log = logging.getLogger(__name__)

_DOUBT_NS: Final = 2_000_000_000
"""Minimum interval (ns) between reads of a baseline that may have changed unannounced."""

_REGISTER_NS: Final = 500_000_000
"""Minimum interval (ns) between reads of a nonzero error register. With these reads, a patch is reported as
operational within a second after its error ends, even if the EMCY message that clears the error is lost. The
reads use four SDO frames per second.
"""


class BaselineWatch:
    """Rereads the baselines and error registers of running nodes. Used only by the supervisor's thread.

    SDO transfers run as jobs on ``pool``. A node has at most one job at a time.
    """

    def __init__(self, pool: Executor) -> None:
        self._pool = pool

    def look(self, node: Supervised, now_ns: int) -> None:
        """Reread a node's baseline if the node has announced a new one or if a summary was lost.

        After an announcement, scans are withheld until the new baseline has been read.
        """
        remote, stream, job = node.remote, node.remote.stream, node.job
        if job is not None:
            if job.done():
                node.job = None
                self._take_baseline(node, job, now_ns)
            return
        changed = stream.withholding
        node.announced |= changed
        if not (changed or stream.doubtful) or now_ns < node.read_ns:
            self._watch_register(node, now_ns)
            return
        if remote.listen_only:
            if changed:
                remote.monitor.refusal = 'its baseline changed; guest_sends = "nothing" forbids reading it'
            return
        stream.doubtful = False
        abandon = node.abandon = clock.event()

        def read() -> Joined | None:
            withholdings = remote.withhold() if changed else stream.withholdings
            return Joined(remote.renew_baseline(JOIN_DEADLINE_S, abandon.is_set), withholdings)

        node.job = self._pool.submit(read)

    def _watch_register(self, node: Supervised, now_ns: int) -> None:
        """Reread a nonzero error register. The EMCY message that clears the error may have been lost."""
        remote = node.remote
        if not remote.monitor.error_register or remote.listen_only or now_ns < node.register_ns:
            return

        def read() -> Joined | None:
            with contextlib.suppress(BusError, ConfigError):  # a failed read is repeated later
                remote.renew_register()
            return None

        node.register_ns = now_ns + _REGISTER_NS
        node.job = self._pool.submit(read)

    def _take_baseline(self, node: Supervised, job: Future[Joined | None], now_ns: int) -> None:
        if job.exception() is None and job.result() is None:  # the job has read only the error register
            return
        remote, stream = node.remote, node.remote.stream
        node.read_ns = now_ns + (LEAST_NS if stream.withholding else _DOUBT_NS)
        try:
            read = job.result()
        except (BusError, ConfigError) as error:  # the heartbeat timeout detects a missing node
            stream.doubtful = True
            _log.warning("%s; reading its baseline again", error)
            return
        except Abandoned:
            return
        except Exception as error:
            remote.defects.report("reading the baseline or the error register", error)
            return
        assert read is not None  # None is handled above
        solver = read.solver
        if solver is not None:
            remote.link.call(lambda: stream.resume(solver, read.withholdings, anew=False), remote.defects)
            node.announced = True  # the announcement may have been lost
            note_baseline(node)


def note_baseline(node: Supervised) -> None:
    """Record the baseline used by the solver, and count it if it is new.

    Bring-up may also find a new baseline, if an earlier read failed or the baseline changed while the node
    was absent.
    """
    facts, before = node.remote.facts, node.baseline_ohm
    assert facts is not None  # called only after bring-up
    node.baseline_ohm = facts.baseline_ohm
    count, change = (0, 0.0) if before is None else touched_crossings(before, facts.baseline_ohm)
    if count:
        _log.warning(
            "patch %s: %d crossings of the new baseline changed by up to %.2g %%, %s",
            *(node.remote.patch.name, count, 100 * change, TOUCHED),
        )
    if node.announced or (before is not None and not np.array_equal(before, facts.baseline_ohm)):
        node.announced = False
        node.baselines += 1
        node.remote.monitor.baselines = node.baselines
