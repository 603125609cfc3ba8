"""Converts the contacts of a field to JSON-compatible data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from skinnode.text.json_values import plain

if TYPE_CHECKING:
    from skinnode.model.frames import FieldFrame


def contact_tables(field: FieldFrame | None) -> list[dict[str, Any]] | None:
    """Return a field's contacts, strongest first, with the standard deviation of each quantity.

    Returns:
        The contacts (lengths in m, areas in m², forces in N); None if no field has been solved yet.
    """
    if field is None:
        return None
    return [
        plain(
            {
                "centroid_m": contact.centroid_m.tolist(),
                "centroid_std_m": contact.centroid_std_m.tolist(),
                "area_m2": float(contact.area_m2),
                "area_std_m2": float(contact.area_std_m2),
                "normal_force_n": float(contact.normal_force_n),
                "normal_force_std_n": float(contact.normal_force_std_n),
                "shear_force_n": contact.shear_force_n.tolist(),
                "shear_force_std_n": contact.shear_force_std_n.tolist(),
                "force_calibrated": contact.force_calibrated,
            }
        )
        for contact in field.contacts
    ]
