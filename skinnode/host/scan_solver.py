"""Decode a patch's scans into resistances, and compute fields from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from skinnode.config import PatchConfig, SolverConfig
from skinnode.errors import ConfigError
from skinnode.host.code_watch import FAULTLESS, Verdict
from skinnode.host.node_facts import NodeFacts
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import FieldFrame, ResistanceFrame, ScanStamp, sealed
from skinnode.model.layout import Float
from skinnode.process import clock
from skinnode.protocol.codes import Decoder, as_baseline
from skinnode.protocol.scan import Scan
from skinnode.solve.inputs import CodeMap
from skinnode.solve.options import TrackerOptions
from skinnode.solve.tracker import Tracker


class ScanSolver:
    """Decoder and solver for the scans of one patch. Not thread-safe.

    Args:
        facts: Layout, code scale and baseline of the patch.
        config: Settings of the solver.
        now: Function that returns the monotonic time (ns).
        period_s: SYNC period (s) of the hand.
    """

    def __init__(
        self,
        facts: NodeFacts,
        config: SolverConfig,
        now: Callable[[], int] = clock.monotonic_ns,
        *,
        period_s: float = 0.08,
    ) -> None:
        self.facts = facts
        self._now = now
        calibration = facts.config.calibration
        gain = None if calibration.upper_gain is None else np.array(calibration.upper_gain)[:, None]
        scale = facts.scale
        self._codes = CodeMap(
            baseline_ohm=as_baseline(facts.baseline_ohm),
            lo=scale.lo,
            step=scale.step,
            steps=scale.steps,
            rounding_ohm=scale.relative_std * facts.baseline_ohm,
            relative_noise=facts.config.relative_noise,
            gain=gain,
        )
        options = tracker_options(
            facts.config,
            config,
            relative_noise=facts.config.relative_noise,
            baseline_ohm=facts.baseline_ohm,
            period_s=period_s,
        )
        self._tracker = Tracker(facts.layout, options, codes=self._codes)
        self._tracker.prepare()
        self._decoder = Decoder(facts.baseline_ohm, scale)

    def decode(self, scan: Scan, stamp: ScanStamp) -> ResistanceFrame:
        """Return the resistances of a scan. A code that is not a measurement becomes NaN."""
        resistance_ohm, valid = self._decoder.decode(scan.codes)
        if self._codes.gain is not None:
            resistance_ohm *= self._codes.gain
        return ResistanceFrame(resistance_ohm, valid, stamp)

    def solve(self, scan: Scan, stamp: ScanStamp, verdict: Verdict = FAULTLESS) -> tuple[FieldFrame, int]:
        """Solve a scan, accounting for converter noise and for the quantization error of the codes.

        Args:
            scan: The scan.
            stamp: Number and times of the scan.
            verdict: Result of checking the codes of the scan.

        Returns:
            Stamped field with read-only arrays, and the number of codes that are not measurements.
        """
        self._tracker.scan, self._tracker.t_ns = stamp.scan, stamp.t_sync_ns or stamp.t_receive_ns
        field, invalid = self._tracker.update_codes(verdict.admitted(scan).codes)
        contacts = tuple(sealed(contact) for contact in field.contacts)
        field = sealed(field, contacts=contacts, stamp=stamp.solved_at(self._now()))
        return verdict.applied(field), invalid


def tracker_options(
    patch: PatchConfig,
    config: SolverConfig,
    *,
    relative_noise: float,
    baseline_ohm: Float | None = None,
    period_s: float = 0.08,
) -> TrackerOptions:
    """Return the :class:`Tracker` options for a patch's scans.

    Args:
        patch: Configuration of the patch.
        config: Settings of the solver.
        relative_noise: Standard deviation of a resistance, relative to the resistance.
        baseline_ohm: (U, K) resistances at rest, in ohms; None if not known yet.
        period_s: SYNC period (s) of the hand.
    """
    calibration = patch.calibration
    return TrackerOptions(
        method=config.method,
        operator=config.operator,
        relative_noise=relative_noise,
        baseline_ohm=baseline_ohm,
        stiffness_n_per_m=calibration.stiffness_n_per_m or config.stiffness_n_per_m,
        rubber=calibration.rubber,
        force_calibrated=calibration.force_calibrated,
        # the exact inverse cannot account for tolerances
        tolerances=None if config.method == "exact" else patch.tolerances.build(),
        deadline_us=config.deadline_us,
        estimate_noise=config.estimate_noise,
        drift=config.drift,
        prior=config.prior,
        past=config.past,
        normal_only=config.normal_only,
        max_std_m=config.max_std_m,
        max_force_std_n=config.max_force_std_n,
        detect=config.detect,
        false_alarms_per_hour=config.false_alarms_per_hour,
        scan_period_s=period_s,
        row_time_s=1e-6 * patch.row_time_us,
    )


def check_solvable(patch: PatchConfig, config: SolverConfig, period_s: float) -> None:
    """Check that the solver supports a patch's layout, and prepare its kernels and tables.

    The preparation is slow, so it must be done before any node is started.

    Args:
        patch: Configuration of the patch.
        config: Settings of the solver.
        period_s: SYNC period (s) of the hand. The thresholds of the touch tests depend on it.

    Raises:
        ConfigError: if the solver cannot compute displacements for the layout, or its options conflict.
    """
    layout = patch.layout.build()
    try:
        options = tracker_options(patch, config, relative_noise=patch.relative_noise, period_s=period_s)
        tracker = Tracker(layout, dataclasses.replace(options, deadline_us=None))  # not while compiling
        tracker.update(resistance_ohm(layout, layout.upper_m))
        tracker.prepare()
    except ValueError as error:
        raise ConfigError(f"patch {patch.name!r}", layout.name, str(error)) from None
