"""Moves the contacts of a field to the time at which the first upper wire was sampled.

A contact is assigned the time at which the upper wire nearest to its centre was sampled. Its values at the
time of the first wire are interpolated between the contact and the same contact in the previous scan, like
those of a wire (:mod:`skinnode.solve.skew.scan_skew`). Contacts in two scans are considered the same if their
centres are close to each other. A contact that is new in a scan had no load in the previous scan.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.frames import Contact
from skinnode.model.layout import Float, PatchLayout
from skinnode.solve.skew.interpolation import timing_variance

SAME_CONTACT: Final = 2.0
"""Maximum distance, in pitches, between the centres of a contact in two successive scans. A body that slides
faster (100 mm/s at 12.5 scans per second and a pitch of 4 mm) is considered a new contact."""


@dataclass(frozen=True, slots=True, eq=False)
class ContactScan:
    """Contacts of a field, before interpolation."""

    t_ns: int
    """Time of the scan, in ns."""
    contacts: tuple[Contact, ...]


def interpolated_contacts(
    layout: PatchLayout, late_ns: Float, new: ContactScan, earlier: tuple[ContactScan, ...]
) -> tuple[Contact, ...]:
    """Return the contacts of a field, interpolated to the time of the first upper wire.

    Args:
        layout: The patch.
        late_ns: (U, 1, 1) time between the samples of the first wire and of each wire, in ns.
        new: Contacts of the field.
        earlier: Contacts of the last field and of the field before it, as far as they are known.
    """
    if not earlier or new.t_ns <= earlier[0].t_ns:
        return new.contacts
    apart_m = SAME_CONTACT * layout.pitch_m
    found = [_interpolated(contact, _late_ns(layout, late_ns, contact), new.t_ns, earlier, apart_m)
             for contact in new.contacts]  # fmt: skip
    found.sort(key=lambda contact: -contact.normal_force_n)
    return tuple(found)


def _late_ns(layout: PatchLayout, late_ns: Float, contact: Contact) -> float:
    """Return the sampling time after the first wire, ns, of the upper wire nearest to a contact."""
    distance2 = ((layout.upper_m - contact.centroid_m) ** 2).sum(axis=2)
    return float(late_ns[int(np.argmin(distance2.min(axis=1))), 0, 0])


def _interpolated(
    contact: Contact, late_ns: float, t_ns: int, earlier: tuple[ContactScan, ...], apart_m: float
) -> Contact:
    last = earlier[0]
    f = min(late_ns / (t_ns - last.t_ns), 1.0)
    if f == 0.0:
        return contact
    values, std = _values(contact)
    partner = _same(contact, last.contacts, apart_m)
    last_values, last_std = (_without_load(values), std) if partner is None else _values(partner)
    expected, noise2 = last_values, std**2 + last_std**2
    if partner is not None and len(earlier) > 1 and last.t_ns > earlier[1].t_ns:
        before = _same(partner, earlier[1].contacts, apart_m)
        if before is not None:
            ratio = (t_ns - last.t_ns) / (last.t_ns - earlier[1].t_ns)
            before_values, before_std = _values(before)
            expected = last_values + ratio * (last_values - before_values)
            noise2 = std**2 + ((1.0 + ratio) * last_std) ** 2 + (ratio * before_std) ** 2
    timing2 = timing_variance(f) * np.maximum((values - expected) ** 2 - noise2, 0.0)
    return _contact(
        contact,
        (1.0 - f) * values + f * last_values,
        np.hypot((1.0 - f) * std + f * last_std, np.sqrt(timing2)),
    )


def _same(contact: Contact, others: tuple[Contact, ...], apart_m: float) -> Contact | None:
    """Return the contact among ``others`` that is nearest to ``contact``; None if none is near."""
    nearest, least_m = None, apart_m
    for other in others:
        gap_m = math.dist(contact.centroid_m, other.centroid_m)
        if gap_m <= least_m:
            nearest, least_m = other, gap_m
    return nearest


def _values(contact: Contact) -> tuple[Float, Float]:
    """Return centre, area, normal force and shear force of a contact, (7,), and their deviations (7,)."""
    return (
        np.array([*contact.centroid_m, contact.area_m2, contact.normal_force_n, *contact.shear_force_n]),
        np.array(
            [
                *contact.centroid_std_m,
                contact.area_std_m2,
                contact.normal_force_std_n,
                *contact.shear_force_std_n,
            ]
        ),
    )


def _without_load(values: Float) -> Float:
    """Return the values of a contact with the same centre and no load."""
    unloaded = values.copy()
    unloaded[3:] = 0.0
    return unloaded


def _contact(contact: Contact, values: Float, std: Float) -> Contact:
    """Return a copy of the contact with the given values."""
    return dataclasses.replace(
        contact,
        centroid_m=values[:3],
        centroid_std_m=std[:3],
        area_m2=float(values[3]),
        area_std_m2=float(std[3]),
        normal_force_n=float(values[4]),
        normal_force_std_n=float(std[4]),
        shear_force_n=values[5:],
        shear_force_std_n=std[5:],
    )
