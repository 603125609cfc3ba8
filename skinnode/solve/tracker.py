"""The tracker of a live stream: one frame in, one field out."""

from __future__ import annotations

from numpy.typing import ArrayLike

from skinnode.model.frames import FieldFrame
from skinnode.model.layout import PatchLayout
from skinnode.solve.exact import ExactTracker


class Tracker:
    """Follows one patch, frame by frame. One owner; the compiled part holds no GIL.

    Args:
        layout: the patch, K ≥ 3N.
        method: ``exact``, the inverse of each wire.
        operator, relative_noise, baseline_ohm, stiffness_n_per_m: see :class:`ExactTracker`.

    Compiles its kernels on construction. Raises ValueError for arguments of the wrong shape or range.
    """

    def __init__(
        self,
        layout: PatchLayout,
        *,
        method: str = "exact",
        operator: str = "levenberg_marquardt",
        relative_noise: ArrayLike = 1e-5,
        baseline_ohm: ArrayLike | None = None,
        stiffness_n_per_m: float | None = None,
    ) -> None:
        if method != "exact":
            raise ValueError(f"method: got {method!r}, must be exact")
        self.layout = layout
        self._exact = ExactTracker(
            layout,
            operator=operator,
            relative_noise=relative_noise,
            baseline_ohm=baseline_ohm,
            stiffness_n_per_m=stiffness_n_per_m,
        )

    def reset(self) -> None:
        """Forget the stream: the next frame is solved from the rest position."""
        self._exact.reset()

    def update(
        self, frame_ohm: ArrayLike, valid: ArrayLike | None = None, relative_noise: ArrayLike | None = None
    ) -> FieldFrame:
        """The displacement field of one frame, see :meth:`ExactTracker.update`."""
        return self._exact.update(frame_ohm, valid, relative_noise)
