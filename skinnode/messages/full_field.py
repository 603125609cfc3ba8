"""Converts displacement fields to ``skinnode_msgs/Field`` and back, without loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skinnode.messages.contacts import contact_message
from skinnode.messages.definitions import FIELD
from skinnode.messages.fields import field_info
from skinnode.messages.typestore import decode, encode, message_type
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.model.frames import Contact, FieldFrame, ScanStamp, SolveStats, sealed
from skinnode.model.layout import Float
from skinnode.model.status import as_statuses

_NOTHING = np.empty(0)


@dataclass(frozen=True, slots=True)
class SendStamp:
    """Sequence number, times and layout of a field that is sent to other processes."""

    started_ns: int
    """Unix time (ns) at which the publisher started; identifies the publisher's run."""
    sequence: int
    """Sequence number of the field among its patch's fields in this run, starting at 1."""
    sent_ns: int
    """Unix time (ns) at which the field was sent."""
    wall_minus_mono_ns: int
    """Unix time minus the host's monotonic clock, in ns."""
    layout_hash: int = 0
    """Hash of the layout with which the field was computed (:attr:`skinnode.PatchLayout.layout_hash`)."""


def encode_field(field: FieldFrame, sent: SendStamp) -> bytes:
    """Encode a field as ``skinnode_msgs/Field``.

    Args:
        field: The field, with a stamp.
        sent: Sequence number, times and layout of the field.
    """
    stamp = field.stamp
    assert stamp is not None
    t_ns = (stamp.t_sync_ns or stamp.t_receive_ns) + sent.wall_minus_mono_ns
    axes = [each.axes.reshape(9) for each in field.contacts]
    message = message_type(FIELD)(
        info=field_info(field, t_ns),
        started_ns=sent.started_ns,
        sequence=sent.sequence,
        sent_ns=sent.sent_ns,
        wall_minus_mono_ns=sent.wall_minus_mono_ns,
        layout_hash=sent.layout_hash,
        upper_wires=field.displacement_m.shape[0],
        electrodes=field.displacement_m.shape[1],
        displacement=_flat(field.displacement_m),
        displacement_std=_flat(field.displacement_std_m),
        core_std=_flat(field.core_std_m),
        force=_flat(field.force_n),
        data_share=_flat(field.data_share),
        contacts=[contact_message(contact, field) for contact in field.contacts],
        contact_axes=np.concatenate(axes) if axes else _NOTHING,
    )
    return encode(message, FIELD)


def decode_field(data: bytes) -> tuple[FieldFrame, SendStamp]:
    """Decode a field from ``skinnode_msgs/Field``. The times in its stamp refer to the host's clock.

    Raises:
        ValueError: The data are not a valid ``skinnode_msgs/Field``.
    """
    message = decode(data, FIELD)
    info, shape = message.info, (message.upper_wires, message.electrodes, 3)
    stamp = ScanStamp(
        info.patch,
        info.scan,
        info.counter,
        info.device_time_us,
        info.t_sync_ns,
        info.t_receive_ns,
        info.t_solved_ns,
    )
    axes = message.contact_axes.reshape(-1, 3, 3)
    if len(axes) != len(message.contacts) or len(info.status) != shape[0]:
        raise ValueError(f"{FIELD}: arrays of different lengths")
    field = FieldFrame(
        displacement_m=message.displacement.reshape(shape),
        displacement_std_m=message.displacement_std.reshape(shape),
        status=as_statuses(info.status.tolist()),
        residual=info.residual,
        stats=SolveStats(info.evaluations, info.jacobians, info.steps, info.solve_time_s),
        force_n=_shaped(message.force, shape),
        stamp=stamp,
        method=info.method,
        by_prior=_mask(info.by_prior),
        contacts=tuple(map(_contact, message.contacts, axes)),
        gain=info.gain if len(info.gain) else None,
        noise_factor=info.noise_factor,
        held=_mask(info.held),
        core_std_m=_shaped(message.core_std, shape),
        distrust=info.distrust if info.tested else None,
        wires_trusted=_mask(info.wires_trusted),
        precise=info.precise,
        data_share=_shaped(message.data_share, shape),
        touched=None if info.touched < 0 else bool(info.touched),
        touch_odds=None if np.isnan(info.touch_odds) else info.touch_odds,
        faults=tuple(map(_fault, info.faults)),
    )
    sent = SendStamp(
        message.started_ns,
        message.sequence,
        message.sent_ns,
        message.wall_minus_mono_ns,
        message.layout_hash,
    )
    return sealed(field), sent


def _flat(values: Float | None) -> Float:
    return _NOTHING if values is None else np.ascontiguousarray(values, dtype=np.float64).reshape(-1)


def _shaped(values: Float, shape: tuple[int, int, int]) -> Float | None:
    return values.reshape(shape) if len(values) else None


def _mask(values: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    return values if len(values) else None


def _contact(message: Any, axes: Float) -> Contact:
    position, std = message.position, message.position_std
    contact = Contact(
        centroid_m=np.array([position.x, position.y, position.z]),
        centroid_std_m=np.array([std.x, std.y, std.z]),
        area_m2=message.area,
        area_std_m2=message.area_std,
        normal_force_n=message.normal_force,
        normal_force_std_n=message.normal_force_std,
        shear_force_n=message.shear_force,
        shear_force_std_n=message.shear_force_std,
        force_calibrated=message.force_calibrated,
        axes=axes,
    )
    return sealed(contact)


def _fault(message: Any) -> DataFault:
    return DataFault(
        part=FaultyPart(message.part),
        kind=FaultKind(message.kind),
        upper=None if message.upper < 0 else message.upper,
        lower=None if message.lower < 0 else message.lower,
        since=message.since,
        deviations=message.deviations,
    )
