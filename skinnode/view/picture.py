"""Computes a field's picture as arrays: surface, arrows and contacts. Does not require the viewer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.model.frames import Z_95_TWO_SIDED, FieldFrame
from skinnode.model.layout import Float
from skinnode.monitor.field_map import SURE
from skinnode.view.colours import depth_rgba, grey_rgba
from skinnode.view.geometry import displaced_m, force_n, normals, ring_m

FORCE_M_PER_N: Final = 0.012
"""Arrow length for a force of 1 N, in m."""
SHEAR: Final = 4.0
"""Extra magnification of shear arrows relative to the surface, as on the monitor's maps, because shear is
about a quarter of the depth."""
_SHORT: Final = 0.05
"""Minimum shear drawn as an arrow, as a fraction of the depth shown in the brightest colour."""
_LIFT: Final = 0.05
"""Height of shear arrows and contacts above the surface, in electrode pitches."""


@dataclass(frozen=True, slots=True)
class Style:
    """Scales of a picture."""

    exaggeration: float
    """Ratio of drawn to measured displacement."""
    full_m: float
    """Depth shown in the brightest colour, in m."""
    pitch_m: float
    """Distance between neighbouring electrodes of the patch, in m."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchPicture:
    """Picture of one field, in patch coordinates; all lengths are in metres.

    C is the number of contacts and S the number of shear arrows. The points form the (U, N) grid and are
    stored in row-major order.
    """

    points_m: Float
    """(U N, 3): surface with exaggerated displacement."""
    normals: Float
    """(U N, 3): unit normals of this surface."""
    rgba: NDArray[np.uint8]
    """(U N, 4): colours by depth."""
    shear_origins_m: Float
    """(S, 3): start points of the shear arrows, just above the electrodes whose shear is significant."""
    shear_m: Float
    """(S, 3): shear arrows, magnified :data:`SHEAR` times more than the surface displacement."""
    force_origins_m: Float
    """(C, 3): start point of each contact's force arrow, which ends at the contact's centre."""
    force_m: Float
    """(C, 3): arrows of the forces on the skin, with a length of :data:`FORCE_M_PER_N` per newton."""
    force_std_m: Float
    """(C, 3): half-axes of each force's 95 % ellipsoid along the contact's axes, on the same scale as the
    arrow."""
    force_axes: Float
    """(C, 3, 3): axes of each contact, as rows."""
    rings_m: tuple[Float, ...]
    """Circles with the same areas as the contacts."""
    labels: tuple[str, ...]
    """Normal force of each contact, with its standard deviation."""


def picture_of(field: FieldFrame, rest_m: Float, style: Style) -> PatchPicture:
    """Return the picture of a field.

    Args:
        field: The field.
        rest_m: (U, N, 3) positions of the electrodes at rest, in m.
        style: Scales of the picture.
    """
    unknown = ~np.isfinite(field.displacement_std_m[..., 2])
    moved_m = displaced_m(rest_m, field.displacement_m, style.exaggeration)
    out = normals(moved_m)
    lift_m = _LIFT * style.pitch_m
    shown = _certain_shear(field, style.full_m) & ~unknown
    shear_m = field.displacement_m[shown]
    shear_m[:, 2] = 0.0
    contacts = field.contacts
    centres_m = [_centre_m(contact.centroid_m, rest_m, moved_m) for contact in contacts]
    forces_m = [FORCE_M_PER_N * force_n(contact) for contact in contacts]
    stds_n = [(*contact.shear_force_std_n, contact.normal_force_std_n) for contact in contacts]
    return PatchPicture(
        points_m=moved_m.reshape(-1, 3),
        normals=out.reshape(-1, 3),
        rgba=depth_rgba(-field.displacement_m[..., 2], unknown, style.full_m),
        shear_origins_m=moved_m[shown] + lift_m * out[shown],
        shear_m=SHEAR * style.exaggeration * shear_m,
        force_origins_m=_rows(
            [centre_m - force_m for centre_m, force_m in zip(centres_m, forces_m, strict=True)]
        ),
        force_m=_rows(forces_m),
        force_std_m=Z_95_TWO_SIDED * FORCE_M_PER_N * _rows(stds_n),
        force_axes=np.array([contact.axes for contact in contacts]).reshape(-1, 3, 3),
        rings_m=tuple(ring_m(contact, lift_m) for contact in contacts),
        labels=tuple(f"{each.normal_force_n:.2f} ± {each.normal_force_std_n:.2f} N" for each in contacts),
    )


def stale_picture_of(rest_m: Float) -> PatchPicture:
    """Return the picture of a patch without an up-to-date field: its surface at rest, in grey.

    Args:
        rest_m: (U, N, 3) positions of the electrodes at rest, in m.
    """
    none = np.empty((0, 3))
    return PatchPicture(
        points_m=rest_m.reshape(-1, 3),
        normals=normals(rest_m).reshape(-1, 3),
        rgba=grey_rgba(rest_m.shape[0] * rest_m.shape[1]),
        shear_origins_m=none,
        shear_m=none,
        force_origins_m=none,
        force_m=none,
        force_std_m=none,
        force_axes=np.empty((0, 3, 3)),
        rings_m=(),
        labels=(),
    )


def _certain_shear(field: FieldFrame, full_m: float) -> NDArray[np.bool_]:
    """Return the (U, N) mask of the electrodes whose shear is significant and large enough to be visible."""
    x_m, y_m = field.displacement_m[..., 0], field.displacement_m[..., 1]
    std_m = np.maximum(field.displacement_std_m[..., 0], field.displacement_std_m[..., 1])
    least_m = np.maximum(SURE * std_m, _SHORT * full_m)
    return np.asarray(x_m * x_m + y_m * y_m > least_m * least_m)  # False where unknown


def _centre_m(centroid_m: Float, rest_m: Float, moved_m: Float) -> Float:
    """Return the drawn (3,) centre of a contact in m, displaced like the nearest electrode."""
    distances = np.linalg.norm(rest_m - centroid_m, axis=-1)
    nearest = np.unravel_index(int(distances.argmin()), distances.shape)
    return np.asarray(centroid_m + moved_m[nearest] - rest_m[nearest])


def _rows(vectors: list[Float] | list[tuple[float, ...]]) -> Float:
    return np.array(vectors, np.float64).reshape(-1, 3)
