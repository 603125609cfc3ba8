"""Processes a code stream with the host's solver and fault detection, for ``skinnode bench trust``.

As in the host, each scan is checked for frozen parts and open wires, solved without the readings that these
checks exclude, and added to the statistics that reveal slow faults.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skinnode.bench.trust_signal import SCALE, CodeStream
from skinnode.config import PatchConfig, SolverConfig
from skinnode.host.code_watch import CodeWatch
from skinnode.host.node_facts import NodeFacts
from skinnode.host.scan_solver import ScanSolver
from skinnode.model.frames import FieldFrame, ScanStamp
from skinnode.protocol.codes import Codes
from skinnode.protocol.profile import PatchProfile
from skinnode.protocol.scan import Scan
from skinnode.protocol.summary import SummaryFlag

CONVERSIONS: Final = int(SummaryFlag.CONVERSIONS)
PERIOD_NS: Final = 10_000_000
"""Time between consecutive scans, in ns."""


@dataclass
class HostPatch:
    """A patch's solver and fault detection, as in the host."""

    solver: ScanSolver
    watch: CodeWatch

    def field(self, codes: Codes, number: int, phase: int) -> FieldFrame:
        """Solve scan ``number`` with the given (U, K) codes and conversion phase."""
        scan, stamp = _scan_of(self.solver.facts.profile, codes, number, phase)
        verdict = self.watch.judge(scan, number)
        field = verdict.applied(self.solver.solve(verdict.admitted(scan), stamp)[0])
        self.watch.on_scan(scan)
        return field


def host_patch(taken: CodeStream, config: PatchConfig | None = None, **options: Any) -> HostPatch:
    """Create the solver and the fault detection for the patch that produced a stream.

    Args:
        taken: The stream.
        config: Patch entry of a hand file; default: an entry with the stream's noise and tolerances.
        **options: Options from the table ``[solver]`` of a hand file.
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
    solver = ScanSolver(facts, SolverConfig(**options), now=lambda: 0)
    return HostPatch(solver, CodeWatch(SCALE, facts.config.relative_noise))


def fields_of(taken: CodeStream, patch: HostPatch | None = None) -> list[FieldFrame]:
    """Solve every scan of a stream and return the fields."""
    patch = host_patch(taken) if patch is None else patch
    scans = enumerate(zip(taken.codes, taken.phase.tolist(), strict=True))
    return [patch.field(codes, number, phase) for number, (codes, phase) in scans]


def _scan_of(profile: PatchProfile, codes: Codes, number: int, phase: int) -> tuple[Scan, ScanStamp]:
    lost = int((~(codes <= SCALE.open)).sum())
    chunks = profile.n_chunks
    t_ns = (number + 1) * PERIOD_NS
    scan = Scan(
        codes=codes,
        valid=np.asarray(codes <= SCALE.steps),
        counter=number % 240 + 1,
        scan=number,
        complete=lost == 0,
        chunks_expected=chunks,
        chunks_received=chunks - -(-lost // profile.codes_per_chunk),
        device_time_us=t_ns // 1000,
        flags=phase * (CONVERSIONS & -CONVERSIONS),  # shift the phase into its bit field
        t_first_ns=t_ns,
        t_last_ns=t_ns,
    )
    return scan, ScanStamp("patch", number, scan.counter, t_ns // 1000, t_ns, t_ns)
