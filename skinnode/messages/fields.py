"""Converts displacement fields to ``sensor_msgs/PointCloud2`` and ``skinnode_msgs/FieldInfo``."""

from __future__ import annotations

import functools
import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.messages.definitions import DATA_FAULT, FIELD_INFO
from skinnode.messages.topics import patch_frame
from skinnode.messages.typestore import header, message_type
from skinnode.model.data_fault import DataFault
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float

POINT_CLOUD: Final = "sensor_msgs/msg/PointCloud2"
CLOUD_FIELDS: Final = (
    *("x", "y", "z", "dx", "dy", "dz", "std_x", "std_y", "std_z"),
    *("fx", "fy", "fz", "share_x", "share_y", "share_z"),
)
"""Fields of a point: displaced position (m) in the patch frame, displacement (m) and its standard deviation
(m; infinite where unknown), force on the skin (N; NaN if no forces were computed), and the fraction of the
displacement that the data determine. The points are ordered by upper wire and, within a wire, by
electrode.
"""

_FLOAT32: Final = 7
"""Value of ``PointField.FLOAT32``."""


def point_cloud(field: FieldFrame, rest_m: Float, t_ns: int) -> Any:
    """Return a field as ``sensor_msgs/PointCloud2`` of FLOAT32, one row of points per upper wire.

    Args:
        field: The field, with a stamp.
        rest_m: (U, N, 3) electrode positions at rest, in m.
        t_ns: Unix time of the measurement, in ns.
    """
    assert field.stamp is not None
    shape = field.displacement_m.shape
    points = np.empty((*shape[:2], len(CLOUD_FIELDS)), dtype="<f4")
    points[..., 0:3] = rest_m + field.displacement_m
    points[..., 3:6] = field.displacement_m
    points[..., 6:9] = field.displacement_std_m
    points[..., 9:12] = np.nan if field.force_n is None else field.force_n
    points[..., 12:15] = 1.0 if field.data_share is None else field.data_share
    step = points.itemsize * len(CLOUD_FIELDS)
    return message_type(POINT_CLOUD)(
        header=header(t_ns, patch_frame(field.stamp.patch)),
        height=shape[0],
        width=shape[1],
        fields=_point_fields(),
        is_bigendian=False,
        point_step=step,
        row_step=step * shape[1],
        data=points.reshape(-1).view(np.uint8),
        is_dense=bool(np.isfinite(points).all()),
    )


def field_info(field: FieldFrame, t_ns: int) -> Any:
    """Return the field data that a point cloud cannot contain, as ``skinnode_msgs/FieldInfo``.

    Args:
        field: The field, with a stamp.
        t_ns: Unix time of the measurement, in ns.
    """
    stamp, stats = field.stamp, field.stats
    assert stamp is not None
    return message_type(FIELD_INFO)(
        header=header(t_ns, patch_frame(stamp.patch)),
        patch=stamp.patch,
        scan=stamp.scan,
        counter=stamp.counter,
        device_time_us=stamp.device_time_us,
        t_sync_ns=stamp.t_sync_ns,
        t_receive_ns=stamp.t_receive_ns,
        t_solved_ns=stamp.t_solved_ns,
        trusted=field.trusted,
        tested=field.distrust is not None,
        touched=-1 if field.touched is None else int(field.touched),
        touch_odds=math.nan if field.touch_odds is None else float(field.touch_odds),
        precise=bool(field.precise),
        distrust=field.distrust or "",
        method=field.method,
        noise_factor=float(field.noise_factor),
        status=np.array(field.status, dtype=np.uint8),
        residual=np.ascontiguousarray(field.residual, dtype=np.float64),
        wires_trusted=_mask(field.wires_trusted),
        by_prior=_mask(field.by_prior),
        held=_mask(field.held),
        gain=np.empty(0) if field.gain is None else np.ascontiguousarray(field.gain, dtype=np.float64),
        evaluations=stats.evaluations,
        jacobians=stats.jacobians,
        steps=stats.steps,
        solve_time_s=float(stats.time_s),
        faults=[_fault(fault) for fault in field.faults],
    )


@functools.cache
def _point_fields() -> list[Any]:
    make = message_type("sensor_msgs/msg/PointField")
    return [make(name, 4 * i, _FLOAT32, 1) for i, name in enumerate(CLOUD_FIELDS)]


def _mask(mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    return np.empty(0, dtype=np.bool_) if mask is None else np.ascontiguousarray(mask, dtype=np.bool_)


def _fault(fault: DataFault) -> Any:
    return message_type(DATA_FAULT)(
        part=str(fault.part),
        kind=str(fault.kind),
        upper=-1 if fault.upper is None else fault.upper,
        lower=-1 if fault.lower is None else fault.lower,
        since=fault.since,
        deviations=float(fault.deviations),
    )
