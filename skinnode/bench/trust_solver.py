"""The host's solver, fed with the codes of a stream for ``skinnode bench trust``."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from skinnode.bench.trust_signal import SCALE, CodeStream
from skinnode.config import PatchConfig, SolverConfig
from skinnode.host.node_facts import NodeFacts
from skinnode.host.scan_solver import ScanSolver
from skinnode.model.frames import FieldFrame, ScanStamp
from skinnode.protocol.codes import Codes
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan import Scan

PERIOD_NS: Final = 10_000_000
"""Time between scans, ns."""


def solver_of(taken: CodeStream, config: PatchConfig | None = None, **options: Any) -> ScanSolver:
    """Return the solver that a host makes for a patch with this stream's layout, noise and tolerances.

    Args:
        taken: Stream.
        config: Patch of a hand file; default: one that states the stream's noise and tolerances.
        **options: Keys of ``[solver]`` in a hand file.
    """
    layout = taken.layout
    stated: dict[str, Any] = {
        "relative_noise": taken.stated_noise,
        "tolerances": "ordinary" if taken.ordinary else "exact",
    }
    facts = NodeFacts(
        config=PatchConfig(name="patch", node_id=5, **stated) if config is None else config,
        layout=layout,
        profile=PatchProfile.from_layout(layout),
        scale=SCALE,
        baseline_ohm=taken.baseline_ohm,
        serial=None,
        heartbeat_s=0.5,
        checked=True,
    )
    return ScanSolver(facts, SolverConfig(**options), clock=lambda: 0)


def fields_of(taken: CodeStream, solver: ScanSolver | None = None) -> list[FieldFrame]:
    """Return the field of every scan."""
    solver = solver_of(taken) if solver is None else solver
    return [solve(solver, codes, number) for number, codes in enumerate(taken.codes)]


def solve(solver: ScanSolver, codes: Codes, number: int) -> FieldFrame:
    """Return the field of a scan with ``codes`` (U, K)."""
    lost = int((~(codes <= SCALE.open)).sum())
    chunks = solver.facts.profile.n_chunks
    t_ns = (number + 1) * PERIOD_NS
    scan = Scan(
        codes=codes,
        valid=np.asarray(codes <= SCALE.steps),
        counter=number % 240 + 1,
        scan=number,
        complete=lost == 0,
        chunks_expected=chunks,
        chunks_received=chunks - -(-lost // solver.facts.profile.codes_per_chunk),
        device_time_us=t_ns // 1000,
        flags=0,
        t_first_ns=t_ns,
        t_last_ns=t_ns,
    )
    stamp = ScanStamp("patch", number, scan.counter, t_ns // 1000, t_ns, t_ns)
    return solver.solve(scan, stamp)[0]
