"""Converts contacts to ``skinnode_msgs/Contacts`` and ``geometry_msgs/WrenchStamped``."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from skinnode.messages.definitions import CONTACT, CONTACTS
from skinnode.messages.topics import patch_frame
from skinnode.messages.typestore import header, message_type
from skinnode.model.frames import Contact, FieldFrame
from skinnode.model.hand_contact import HandContact, Mount
from skinnode.model.layout import Float

WRENCH: Final = "geometry_msgs/msg/WrenchStamped"


def contacts_message(field: FieldFrame, t_ns: int) -> Any:
    """Return a field's contacts as ``skinnode_msgs/Contacts``, in the patch frame.

    Args:
        field: The field, with a stamp.
        t_ns: Unix time of the measurement, in ns.
    """
    stamp = field.stamp
    assert stamp is not None
    return message_type(CONTACTS)(
        header=header(t_ns, patch_frame(stamp.patch)),
        patch=stamp.patch,
        scan=stamp.scan,
        trusted=field.trusted,
        contacts=[contact_message(contact, field) for contact in field.contacts],
    )


def contact_wrenches(field: FieldFrame, t_ns: int) -> list[Any]:
    """Return each contact's wrench as ``geometry_msgs/WrenchStamped``, strongest contact first.

    The force acts on the skin. The torque is taken about the origin of the patch frame: it is the cross
    product of the contact's position and force.

    Args:
        field: The field, with a stamp.
        t_ns: Unix time of the measurement, in ns.
    """
    stamp = field.stamp
    assert stamp is not None
    make, make_wrench = message_type(WRENCH), message_type("geometry_msgs/msg/Wrench")
    head = header(t_ns, patch_frame(stamp.patch))
    wrenches = []
    for contact in field.contacts:
        placed = on_patch(contact, field)
        torque_nm = np.cross(placed.position_m, placed.force_n)
        wrenches.append(make(head, make_wrench(_vector(placed.force_n), _vector(torque_nm))))
    return wrenches


def on_patch(contact: Contact, field: FieldFrame) -> HandContact:
    """Return a field's contact with its force as a vector in the patch frame."""
    assert field.stamp is not None
    return HandContact.on_link(contact, field.stamp.patch, Mount(), trusted=field.trusted)


def contact_message(contact: Contact, field: FieldFrame) -> Any:
    """Return one of a field's contacts as ``skinnode_msgs/Contact``."""
    placed = on_patch(contact, field)
    return message_type(CONTACT)(
        position=message_type("geometry_msgs/msg/Point")(*contact.centroid_m.tolist()),
        position_std=_vector(contact.centroid_std_m),
        normal=_vector(placed.normal),
        force=_vector(placed.force_n),
        force_covariance=placed.force_covariance_n2.reshape(9),
        normal_force=float(contact.normal_force_n),
        normal_force_std=float(contact.normal_force_std_n),
        shear_force=np.ascontiguousarray(contact.shear_force_n),
        shear_force_std=np.ascontiguousarray(contact.shear_force_std_n),
        area=float(contact.area_m2),
        area_std=float(contact.area_std_m2),
        force_calibrated=bool(contact.force_calibrated),
    )


def _vector(values: Float) -> Any:
    return message_type("geometry_msgs/msg/Vector3")(*values.tolist())
