"""Contacts and wrenches, including covariances, in the coordinate frame of a link or of the hand.

A contact exerts a force f on the skin at a point r. Its wrench consists of the force f and the torque r × f
about the origin of the frame. The covariance of the wrench is propagated to first order from the covariances
of f and r. The errors of f and r are assumed to be independent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from skinnode.model.frames import Contact
from skinnode.model.layout import Float
from skinnode.model.pose import Pose

HAND: Final = "hand"
"""Name of the hand's coordinate frame, and link name for patches that are mounted on the hand itself."""


@dataclass(frozen=True, slots=True)
class Mount:
    """Link on which a patch is mounted, and the patch's pose on that link."""

    link: str = HAND
    """Name of the link on which the patch is mounted."""
    pose: Pose = field(default_factory=Pose)
    """Pose of the patch's frame in the frame of its link."""


@dataclass(frozen=True, slots=True, eq=False)
class HandContact:
    """Contact on a patch, expressed in the coordinate frame of the patch's link or of the hand."""

    patch: str
    """Name of the patch."""
    link: str
    """Name of the link on which the patch is mounted; :data:`HAND` for a patch on the hand itself."""
    frame: str
    """Name of the frame in which the contact's vectors are expressed: :data:`HAND` or the link."""
    position_m: Float
    """(3,) centre of the normal load on the undeformed skin, in metres."""
    position_covariance_m2: Float
    """(3, 3) covariance of the position, in m²."""
    normal: Float
    """(3,) unit normal of the skin at the contact, pointing outwards. An object presses in the opposite
    direction.
    """
    normal_force_n: float
    """Normal force, in N; positive if the object presses on the skin."""
    normal_force_std_n: float
    force_n: Float
    """(3,) force on the skin, in N: vector sum of the normal force and the shear force."""
    force_covariance_n2: Float
    """(3, 3) covariance of the force, in N²."""
    area_m2: float
    """Contact area, in m², as in :class:`~skinnode.Contact`."""
    area_std_m2: float
    force_calibrated: bool
    """Whether the forces are based on a calibration of the patch."""
    trusted: bool
    """Whether the patch's field is trusted."""

    @classmethod
    def on_link(cls, contact: Contact, patch: str, mount: Mount, *, trusted: bool) -> HandContact:
        """Return a contact expressed in the coordinate frame of the patch's link.

        Args:
            contact: The contact, in the frame of the patch.
            patch: Name of the patch.
            mount: Link and pose of the patch.
            trusted: Whether the patch's field is trusted.
        """
        to_link = mount.pose.rotation
        axes = contact.axes @ to_link.T
        shear_n, shear_std_n = contact.shear_force_n, contact.shear_force_std_n
        force_n = np.array([shear_n[0], shear_n[1], -contact.normal_force_n])
        force_std_n = np.array([shear_std_n[0], shear_std_n[1], contact.normal_force_std_n])
        return cls(
            patch=patch,
            link=mount.link,
            frame=mount.link,
            position_m=mount.pose.points_m(contact.centroid_m),
            position_covariance_m2=(to_link * contact.centroid_std_m**2) @ to_link.T,
            normal=axes[2],
            normal_force_n=contact.normal_force_n,
            normal_force_std_n=contact.normal_force_std_n,
            force_n=force_n @ axes,
            force_covariance_n2=(axes.T * force_std_n**2) @ axes,
            area_m2=contact.area_m2,
            area_std_m2=contact.area_std_m2,
            force_calibrated=contact.force_calibrated,
            trusted=trusted,
        )

    @property
    def position_std_m(self) -> Float:
        """(3,) standard deviation of the position along each axis, in metres."""
        return np.asarray(np.sqrt(np.diag(self.position_covariance_m2)))

    @property
    def force_std_n(self) -> Float:
        """(3,) standard deviation of the force along each axis, in N."""
        return np.asarray(np.sqrt(np.diag(self.force_covariance_n2)))

    def moved(self, pose: Pose, frame: str = HAND) -> HandContact:
        """Return the contact expressed in another coordinate frame.

        Args:
            pose: Pose of this contact's frame in the other frame.
            frame: Name of the other frame.
        """
        turn = pose.rotation
        return replace(
            self,
            frame=frame,
            position_m=pose.points_m(self.position_m),
            position_covariance_m2=turn @ self.position_covariance_m2 @ turn.T,
            normal=turn @ self.normal,
            force_n=turn @ self.force_n,
            force_covariance_n2=turn @ self.force_covariance_n2 @ turn.T,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Wrench:
    """Total force and torque that the contacts on a link, or on the hand, exert on the skin.

    Forces that are too weak to be detected as contacts, and the torque of a contact about its own normal, are
    not included.
    """

    frame: str
    """Name of the frame in which all vectors are expressed; the torque is about the origin of this frame."""
    force_n: Float
    """(3,) force on the skin, in N."""
    torque_nm: Float
    """(3,) torque on the skin about the origin of the frame, in N m."""
    covariance: Float
    """(6, 6) covariance of force and torque, in N², N² m and N² m²."""
    contacts: int
    """Number of contacts."""
    force_calibrated: bool
    """Whether every force is based on a calibration of its patch; True if there are no contacts."""
    trusted: bool
    """Whether the fields of all patches on the link, or on the hand, are trusted."""

    @property
    def force_std_n(self) -> Float:
        """(3,) standard deviation of the force, in N."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def torque_std_nm(self) -> Float:
        """(3,) standard deviation of the torque, in N m."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))

    def moved(self, pose: Pose, frame: str = HAND) -> Wrench:
        """Return the wrench expressed in another coordinate frame, with the torque about that frame's origin.

        Args:
            pose: Pose of this wrench's frame in the other frame.
            frame: Name of the other frame.
        """
        turn, lever = pose.rotation, _cross(np.array(pose.position_m))
        both = np.zeros((6, 6))
        both[:3, :3] = both[3:, 3:] = turn
        both[3:, :3] = lever @ turn
        force_n = turn @ self.force_n
        return replace(
            self,
            frame=frame,
            force_n=force_n,
            torque_nm=turn @ self.torque_nm + lever @ force_n,
            covariance=both @ self.covariance @ both.T,
        )


def wrench_of(contacts: Iterable[HandContact], frame: str, *, trusted: bool) -> Wrench:
    """Return the total wrench of contacts that are expressed in the same frame.

    Errors of contacts on different patches are assumed to be independent. Errors of contacts on the same
    patch may be correlated: noise can shift load between neighbouring contacts, and an error in the assumed
    stiffness scales all forces. Since the correlation is unknown, their covariances are combined into an
    upper bound that holds for any correlation.

    Args:
        contacts: The contacts, all in ``frame``.
        frame: Name of the frame.
        trusted: Value of :attr:`Wrench.trusted`.
    """
    force_n, torque_nm, covariance = np.zeros(3), np.zeros(3), np.zeros((6, 6))
    of_patch: dict[str, list[HandContact]] = {}
    for contact in contacts:
        of_patch.setdefault(contact.patch, []).append(contact)
        force_n += contact.force_n
        torque_nm += np.cross(contact.position_m, contact.force_n)
    for group in of_patch.values():
        # For errors e and weights w with Σ w = 1, (Σ e)(Σ e)ᵀ ≤ Σ e eᵀ / w. With weights proportional to the
        # standard deviations, equality holds if the errors are fully correlated.
        stds = [math.sqrt(float(np.trace(contact.force_covariance_n2))) for contact in group]
        total = sum(stds)
        for contact, std in zip(group, stds, strict=True):
            covariance += _covariance(contact) * (total / std if std > 0 else len(group))
    found = [contact for group in of_patch.values() for contact in group]
    calibrated = all(contact.force_calibrated for contact in found)
    return Wrench(frame, force_n, torque_nm, covariance, len(found), calibrated, trusted)


def _covariance(contact: HandContact) -> Float:
    """Return the (6, 6) covariance of a contact's wrench, to first order."""
    by_force = np.vstack([np.eye(3), _cross(contact.position_m)])
    by_position = np.vstack([np.zeros((3, 3)), -_cross(contact.force_n)])
    return np.asarray(
        by_force @ contact.force_covariance_n2 @ by_force.T
        + by_position @ contact.position_covariance_m2 @ by_position.T
    )


def _cross(vector: Float) -> Float:
    """Return the (3, 3) matrix that maps w to the cross product ``vector`` × w."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
