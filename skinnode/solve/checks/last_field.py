"""Last complete field of a stream, with which the data check compares the next fields.

The exact inverse has no redundancy: if one reading of a wire changes, some displacement of the wire explains
it. Under a press, the elastic prior allows large displacements, so it does not reveal a reading that is wrong
by 20 to 100 times the noise. From one frame to the next, the load changes much less than it has changed since
rest. The change in the field therefore has a much smaller prior scale, at which the same error stands out.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float

AGE: Final = 5
"""Maximum age of the last field, in frames. A reading that is wrong in every frame is confirmed after three
frames; until then, each frame is compared with the last field before the error."""


class LastField:
    """Last complete field of a stream. Each stream needs its own instance.

    Args:
        shape: Shape (U, 3N) of the displacements.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._displacement_m = np.zeros(shape)
        self._change_m = np.empty(shape)
        self.forget()

    def forget(self) -> None:
        """Discard the field."""
        self._frame = -AGE - 1

    def remember(self, field: FieldFrame, frame: int) -> None:
        """Store the field of a frame; ``frame`` is its number."""
        np.copyto(self._displacement_m, field.displacement_m.reshape(self._displacement_m.shape))
        self._frame = frame

    def change(self, field: FieldFrame, frame: int) -> Float | None:
        """Return the change (U, 3N) in the displacements since the stored field, in metres.

        The array is overwritten by the next call. Returns None if no field is stored, or if it is older than
        :data:`AGE` frames.
        """
        if frame - self._frame > AGE:
            return None
        moved = field.displacement_m.reshape(self._displacement_m.shape)
        return np.subtract(moved, self._displacement_m, out=self._change_m)
