"""Finds the contacts on a patch from its displacement field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float

TOUCH: Final = 0.35
"""Minimum depth at which an electrode belongs to a touch, as a fraction of the maximum depth. In a Hertzian
contact, the rim is half as deep as the centre."""
SURE: Final = 6.0
"""Minimum depth at which an electrode belongs to a touch, as a multiple of its standard deviation. With 100
electrodes, noise alone exceeds this limit in one field in 10 million."""
LEAST_TOUCH_M: Final = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """One contact on a patch; unknown values are None.

    A touch derived from a region of pressed skin has forces only if a stiffness was specified.
    """

    x_m: float
    y_m: float
    place_std_m: float | None
    depth_m: float
    area_m2: float
    area_std_m2: float | None
    force_n: float | None
    force_std_n: float | None
    shear_n: tuple[float, float] | None


def touches_of(field: FieldFrame, rest_m: Float) -> tuple[Touch, ...]:
    """Return the contacts on a patch, strongest first.

    The contacts are taken from the field. A field from the exact inverse may contain none, for example in an
    old recording. Each connected region of pressed skin then counts as a contact, whose force is known only
    if a stiffness was specified.

    Args:
        field: Newest field of the patch.
        rest_m: (U, N, 3) positions of the electrodes at rest, in m.
    """
    if field.contacts or field.method == "posterior":
        return tuple(
            Touch(
                x_m=float(contact.centroid_m[0]),
                y_m=float(contact.centroid_m[1]),
                place_std_m=float(np.max(contact.centroid_std_m[:2])),
                depth_m=_depth_at(field, rest_m, contact.centroid_m),
                area_m2=contact.area_m2,
                area_std_m2=contact.area_std_m2,
                force_n=contact.normal_force_n,
                force_std_n=contact.normal_force_std_n,
                shear_n=(float(contact.shear_force_n[0]), float(contact.shear_force_n[1])),
            )
            for contact in field.contacts
        )
    return _touches_by_depth(field, rest_m)


def _depth_at(field: FieldFrame, rest_m: Float, place_m: Float) -> float:
    """Return the depth in m at the electrode closest to a position."""
    away = np.hypot(rest_m[..., 0] - place_m[0], rest_m[..., 1] - place_m[1])
    return float(-field.displacement_m[..., 2].flat[int(away.argmin())])


def _touches_by_depth(field: FieldFrame, rest_m: Float) -> tuple[Touch, ...]:
    depth_m, std_m = -field.displacement_m[..., 2], field.displacement_std_m[..., 2]
    known = np.isfinite(std_m)
    least_m = max(LEAST_TOUCH_M, TOUCH * float(np.max(depth_m, initial=0.0, where=known)))
    touched = known & (depth_m > least_m) & (depth_m > SURE * std_m)
    if not touched.any():
        return ()
    from scipy import ndimage

    regions, count = ndimage.label(touched)
    wires, electrodes = depth_m.shape
    width, height = np.ptp(rest_m[..., :2].reshape(-1, 2), axis=0)
    cell_m2 = float(width * height) / (max(electrodes - 1, 1) * max(wires - 1, 1))
    found = []
    for number in range(1, count + 1):
        here = regions == number
        weight = depth_m[here]
        x, y = (rest_m[here][:, :2] * weight[:, None]).sum(axis=0) / weight.sum()
        force = None if field.force_n is None else field.force_n[here].sum(axis=0)
        found.append(
            Touch(
                x_m=float(x),
                y_m=float(y),
                place_std_m=None,
                depth_m=float(weight.max()),
                area_m2=cell_m2 * int(here.sum()),
                area_std_m2=None,
                force_n=None if force is None else float(-force[2]),
                force_std_n=None,
                shear_n=None if force is None else (float(force[0]), float(force[1])),
            )
        )
    return tuple(sorted(found, key=lambda touch: -touch.depth_m))
