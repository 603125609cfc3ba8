"""The tracker of a live stream: one frame in, one field out, by the method that suits the patch.

``exact`` inverts each wire on its own, as the paper does; ``posterior`` estimates the whole patch with its
elastic prior. ``auto`` takes the exact inverse if the converter's noise leaves it accurate. Wires on which
the exact inverse is doubtful are put to the posterior (:mod:`skinnode.solve.root_gate`).
"""

from __future__ import annotations

from time import perf_counter
from typing import Final, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout
from skinnode.solve.cramer_rao import patch_std
from skinnode.solve.exact.tracker import ExactTracker
from skinnode.solve.options import TrackerArguments, TrackerOptions, merged
from skinnode.solve.posterior.posterior import Posterior
from skinnode.solve.root_gate import RootGate

EXACT_STD: Final = 0.0025
"""Standard deviation of the exact inverse at rest, clearances, up to which ``auto`` takes it: 2.5 % of a
press of a tenth of the layer. 16-bit codes leave 0.0005 on staggered, h = 0.5, and 0.05 on aligned."""


class Tracker:
    """Follows one patch, frame by frame.

    One owner; the compiled part holds no GIL. Compiles its kernels on construction.

    Args:
        layout: The patch.
        options: Options of the tracker; default :class:`skinnode.solve.options.TrackerOptions()`.
        **arguments: Options by name, in place of those in ``options``.

    Attributes:
        layout: The patch.
        options: The options in force.
        method: ``exact`` or ``posterior``, whichever answers.
        reason: Why, in a few words.

    Raises:
        ValueError: If an option has the wrong shape or is out of its range.
    """

    def __init__(
        self,
        layout: PatchLayout,
        options: TrackerOptions | None = None,
        **arguments: Unpack[TrackerArguments],
    ) -> None:
        self.options = options = merged(TrackerOptions, options, arguments)
        self.layout = layout
        self._posterior = Posterior(layout, options.of_posterior())
        self.method, self.reason = _choose(layout, options)
        self._exact: ExactTracker | None = None
        if self.method == "posterior":
            return
        self._exact = ExactTracker(
            layout,
            operator=options.operator,
            relative_noise=options.relative_noise,
            baseline_ohm=options.baseline_ohm,
            stiffness_n_per_m=options.stiffness_n_per_m,
            hold=options.hold,
            deadline_us=options.deadline_us,
            normal_only=options.normal_only,
            active_only=options.active_only,
            codes=options.codes,
        )
        self._gate = RootGate(self._exact, self._posterior, options)
        self.reset()

    def reset(self) -> None:
        """Forget the stream: the next frame is solved from the rest position."""
        self._posterior.reset()
        if self._exact is not None:
            self._exact.reset()
            self._gate.reset()

    def update(
        self, frame_ohm: ArrayLike, valid: ArrayLike | None = None, relative_noise: ArrayLike | None = None
    ) -> FieldFrame:
        """Solve the displacement field of one frame.

        No value raises. A wire that could not be solved holds its last trusted position, with an infinite
        standard deviation and a status.

        Args:
            frame_ohm: (U, K) resistances, ohm; a value that is not positive and finite is not used.
            valid: (U, K) bool, False if a chunk or wire is missing; default all True.
            relative_noise: A number or (U, K), noise of this frame only. A resistance whose noise is not
                positive and finite is not used.

        Returns:
            The field, with one status a wire.

        Raises:
            ValueError: If a shape is wrong.
        """
        if self._exact is None:
            return self._posterior.update(frame_ohm, valid, relative_noise)
        start = perf_counter()
        return self._gate.check(self._exact.update(frame_ohm, valid, relative_noise), start)

    def update_codes(self, codes: NDArray[np.uint32]) -> tuple[FieldFrame, int]:
        """Solve the field of a scan of codes, in a fraction of the time of decoding and :meth:`update`.

        Args:
            codes: (U, K) uint32, with the meaning given as ``codes`` on construction.

        Returns:
            The field of the resistances and the noise that the codes stand for, and the number of codes that
            were no measurement.

        Raises:
            ValueError: If the shape or type is wrong, the tracker has no meaning of codes, or its
                :attr:`method` is ``posterior``.
        """
        if self._exact is None:
            raise ValueError("method: got 'posterior', must be exact to take codes")
        if self.options.codes is None:
            raise ValueError("codes: got none, must be given on construction to take codes")
        start = perf_counter()
        field = self._gate.check(self._exact.update_codes(codes), start)
        return field, self._exact.invalid_codes


def _choose(layout: PatchLayout, options: TrackerOptions) -> tuple[str, str]:
    """The method and why."""
    nuisances, normal_only = options.nuisances, options.normal_only
    if options.method != "auto":
        if options.method == "exact" and nuisances:
            raise ValueError(f"method: got 'exact' with {nuisances[0]}, must be posterior or auto")
        return options.method, "asked for"
    if nuisances:
        return "posterior", f"{' and '.join(nuisances)} asked for"
    unknowns = layout.unknowns // 3 if normal_only else layout.unknowns
    if layout.shape[1] < unknowns:
        return "posterior", f"{layout.shape[1]} lower wires for {unknowns} unknowns an upper wire"
    share = patch_std(layout, options.relative_noise, normal_only)
    chosen = "exact" if share <= EXACT_STD else "posterior"
    return chosen, (
        f"the noise leaves the exact inverse a deviation of {100 * share:.2g} % of the clearance between the "
        f"layers at rest, where {100 * EXACT_STD:g} % is the limit"
    )
