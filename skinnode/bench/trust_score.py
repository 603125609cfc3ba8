"""Compares trusted fields with the true displacement, for ``skinnode bench trust``.

A score consists of counts, so scores of several streams and processes can be added.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skinnode.bench.trust_signal import CodeStream
from skinnode.model.data_fault import DataFault, FaultyPart
from skinnode.model.frames import FieldFrame
from skinnode.model.layout import Float
from skinnode.model.status import Status

LIMIT: Final = 5.0
"""Maximum error of a trusted coordinate, in reported standard deviations."""

BEYOND: Final = 1e-3
"""Maximum fraction of trusted coordinates with an error above :data:`LIMIT`."""

Mask = NDArray[np.bool_]


@dataclass
class Score:
    """Counts of fields, coordinates and detected faults in one or more streams."""

    streams: int = 0
    frames: int = 0
    trusted: int = 0
    """Number of trusted fields."""
    coordinates: int = 0
    """Number of trusted coordinates: the coordinates of trusted wires in trusted fields."""
    beyond: int = 0
    """Number of trusted coordinates whose error exceeds :data:`LIMIT`."""
    worst: float = 0.0
    """Maximum error of a trusted coordinate, in reported standard deviations."""
    named: int = 0
    """Number of streams in which a field correctly reported the fault."""
    nameable: int = 0
    """Number of streams in which a fault changed at least one reading."""
    scans_to_name: list[int] = dataclasses.field(default_factory=list)
    """Number of scans from the first changed reading to the first correct fault report, for each stream."""
    after: int = 0
    """Number of fields from the first correct fault report onwards."""
    after_trusted: int = 0
    """Number of trusted fields among those counted in ``after``."""
    false_names: int = 0
    """Number of false alarms: faults reported for parts whose readings were correct."""
    touches: int = 0
    """Number of trusted fields from scans in which the load is at full depth or the patch is at rest."""
    touches_right: int = 0
    """Number of fields counted in ``touches`` with the right number of contacts: one under load, none at
    rest."""
    forces: int = 0
    """Number of trusted fields with exactly one contact and a known true force."""
    forces_right: int = 0
    """Number of fields counted in ``forces`` with a normal-force error of at most :data:`LIMIT` standard
    deviations."""

    def add(self, other: Score) -> None:
        """Add the counts of ``other`` to this score."""
        for entry in dataclasses.fields(self):
            own, its = getattr(self, entry.name), getattr(other, entry.name)
            setattr(self, entry.name, max(own, its) if entry.name == "worst" else own + its)

    @property
    def share_beyond(self) -> float:
        """Fraction of trusted coordinates with an error above the limit; 0 if no coordinate is trusted."""
        return self.beyond / max(self.coordinates, 1)

    @property
    def share_trusted(self) -> float:
        """Fraction of trusted fields."""
        return self.trusted / self.frames if self.frames else math.nan

    @property
    def share_after(self) -> float:
        """Fraction of trusted fields after the first correct fault report."""
        return self.after_trusted / self.after if self.after else math.nan

    @property
    def share_named(self) -> float:
        """Fraction of the faulty streams in which the fault was reported correctly."""
        return self.named / self.nameable if self.nameable else math.nan

    @property
    def share_contacts(self) -> float:
        """Fraction of the scored fields with the right number of contacts."""
        return self.touches_right / self.touches if self.touches else math.nan

    @property
    def share_forces(self) -> float:
        """Fraction of the contact forces with an error of at most :data:`LIMIT` standard deviations."""
        return self.forces_right / self.forces if self.forces else math.nan

    @property
    def median_scans(self) -> float:
        """Median number of scans until a fault is reported correctly."""
        return float(np.median(self.scans_to_name)) if self.scans_to_name else math.nan


def trusted_wires(field: FieldFrame) -> Mask:
    """Return a (U,) mask of trusted wires; all entries are False if the field is not trusted."""
    if not field.trusted:
        return np.zeros(len(field.status), bool)
    if field.wires_trusted is not None:
        return field.wires_trusted
    return np.array([status is Status.CONVERGED for status in field.status])


def deviations(field: FieldFrame, truth_m: Float) -> Float:
    """Return the (U, N, 3) errors divided by their reported standard deviations; undefined ratios are inf."""
    with np.errstate(all="ignore"):
        error = np.abs(field.displacement_m - truth_m)
        ratio = np.where(error == 0.0, 0.0, error / field.displacement_std_m)
    return np.where(np.isnan(ratio), np.inf, ratio)


def covered(fault: DataFault, shape: tuple[int, int]) -> Mask:
    """Return a (U, K) mask of the readings covered by a reported fault."""
    mask = np.zeros(shape, bool)
    upper = slice(None) if fault.upper is None else fault.upper
    lower = slice(None) if fault.lower is None else fault.lower
    mask[upper, lower] = True
    return mask


def is_right(fault: DataFault, bad: Mask) -> bool:
    """Return whether the (U, K) mask ``bad`` marks at least half of the readings covered by ``fault``."""
    return bool(bad[covered(fault, bad.shape)].mean() >= 0.5)


Naming = tuple[FaultyPart, int | None, int | None, int]
"""Reported fault: part, upper wire, lower wire, and first affected scan."""


def judge(taken: CodeStream, fields: Sequence[FieldFrame], known: set[Naming] | None = None) -> Score:
    """Score the fields of a stream, and count false alarms.

    Args:
        taken: The stream.
        fields: Fields, one per scan.
        known: False alarms that have already been counted; the stream's false alarms are added to this set.
    """
    score = Score(streams=1)
    bad_so_far = np.zeros(taken.bad.shape[1:], bool)
    first_bad = first_named = -1
    wrongly: set[Naming] = set() if known is None else known
    before = len(wrongly)
    score.nameable = int(bool(taken.bad[taken.scored_from :].any()))
    for t, field in enumerate(fields):
        bad_so_far |= taken.bad[t]
        if first_bad < 0 and bad_so_far.any():
            first_bad = t
        for fault in field.faults:
            if is_right(fault, bad_so_far):
                first_named = t if first_named < 0 else first_named
            else:
                wrongly.add((fault.part, fault.upper, fault.lower, fault.since))
        if t >= taken.scored_from:
            _judge_field(score, taken, t, field)
            score.after += first_named >= 0
            score.after_trusted += first_named >= 0 and field.trusted
    score.false_names = len(wrongly) - before
    if first_named >= 0:
        score.named = score.nameable
        score.scans_to_name.append(first_named - first_bad)
    return score


def _judge_field(score: Score, taken: CodeStream, t: int, field: FieldFrame) -> None:
    score.frames += 1
    wires = trusted_wires(field)
    if not field.trusted:
        return
    score.trusted += 1
    found = deviations(field, taken.truth_m[t])[wires]
    score.coordinates += found.size
    score.beyond += int((found > LIMIT).sum())
    score.worst = max(score.worst, float(found.max(initial=0.0)))
    if taken.touched[t] or taken.untouched[t]:
        score.touches += 1
        score.touches_right += len(field.contacts) == int(taken.touched[t])
    if taken.touched[t] and len(field.contacts) == 1 and np.isfinite(taken.force_n[t, 2]):
        contact = field.contacts[0]
        off = abs(contact.normal_force_n + taken.force_n[t, 2])
        score.forces += 1
        score.forces_right += bool(off <= LIMIT * contact.normal_force_std_n)


def rate_bounds(events: int, hours: float) -> tuple[float, float]:
    """Return the lower and upper one-sided 95 % confidence bounds of a Poisson rate, per hour."""
    from scipy.stats import chi2

    low = 0.0 if events == 0 else 0.5 * float(chi2.ppf(0.05, 2 * events)) / hours
    return low, 0.5 * float(chi2.ppf(0.95, 2 * events + 2)) / hours
