"""Rules that inject bit errors.

A disturbance inverts one bit of a frame, for all stations or for a single station. Rules apply to every
transmission attempt, so they can also destroy retransmissions.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from skinnode.errors import ConfigError
from vcan_sim.timed_bus.frame import CanFrame


@dataclass(frozen=True, slots=True)
class NthFrame:
    """Rule that disturbs a run of consecutive attempts to send frames with a given identifier.

    Raises:
        ConfigError: If a number is out of range.
    """

    can_id: int
    first: int
    """Number of the first disturbed attempt, counted from 1."""
    attempts: int = 1
    """Number of disturbed attempts."""
    bit: int = 20
    """Position of the disturbed bit, counting stuff bits; the start of frame is bit 0. Positions beyond the
    second-to-last bit of the end of frame are clipped to that bit."""
    extended: bool = False
    station: int | None = None
    """Station that sees the disturbance; None for all stations."""

    def __post_init__(self) -> None:
        for name, least in (("first", 1), ("attempts", 1), ("bit", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"disturbances.{name}", getattr(self, name), f"at least {least}")


@dataclass(frozen=True, slots=True)
class RandomShare:
    """Rule that disturbs each transmission attempt with a given probability.

    Raises:
        ConfigError: If ``share`` is not a probability, or if ``bit`` is negative.
    """

    share: float
    """Probability that a transmission attempt is disturbed, 0 to 1."""
    seed: int
    can_id: int | None = None
    """Identifier of the disturbed frames; None for all frames."""
    bit: int | None = None
    """Position of the disturbed bit, as in :class:`NthFrame`; None for a uniformly distributed position."""
    extended: bool = False
    station: int | None = None
    """Station that sees the disturbance; None for all stations."""

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise ConfigError("disturbances.share", self.share, "0 to 1")
        if self.bit is not None and self.bit < 0:
            raise ConfigError("disturbances.bit", self.bit, "at least 0")


@dataclass(frozen=True, slots=True)
class AtTime:
    """Rule that disturbs the bit sent at a given time. It has no effect on an idle bus.

    Raises:
        ConfigError: If the time is negative.
    """

    time_ns: int
    station: int | None = None
    """Station that sees the disturbance; None for all stations."""

    def __post_init__(self) -> None:
        if self.time_ns < 0:
            raise ConfigError("disturbances.time_ns", self.time_ns, "at least 0 ns")


Disturbance = NthFrame | RandomShare | AtTime


class Attempt(NamedTuple):
    """Transmission attempt, as seen by disturbance rules."""

    frame: CanFrame
    n_bits: Callable[[], int]
    """Function that returns how many bits of the frame can be disturbed."""
    bit_at: Callable[[int], int | None]
    """Function that returns the position of the bit sent at a given time (ns); None outside the frame."""


class Hit(NamedTuple):
    """Disturbed bit of a frame. Instances sort by position."""

    bit: int
    station: int
    """Station that sees the disturbance; -1 for all stations."""


Rule = Callable[[Attempt], int | None]


class Disturbances:
    """Active disturbance rules.

    Args:
        rules: Initial disturbance rules.
    """

    def __init__(self, rules: Sequence[Disturbance] = ()) -> None:
        self._rules: list[tuple[Disturbance, int, Rule]] = []
        for rule in rules:
            self.add(rule)

    def __bool__(self) -> bool:
        return bool(self._rules)

    def add(self, rule: Disturbance) -> None:
        """Add a rule. It counts transmission attempts from now on.

        Args:
            rule: Disturbance rule to add.
        """
        station = -1 if rule.station is None else rule.station
        self._rules.append((rule, station, _compiled(rule)))

    def remove(self, rule: Disturbance) -> None:
        """Remove a rule.

        Args:
            rule: The object that was passed to :meth:`add`.

        Raises:
            ValueError: If the rule is not active.
        """
        kept = [each for each in self._rules if each[0] is not rule]
        if len(kept) == len(self._rules):
            raise ValueError(f"rule: got {rule}, must be an active rule")
        self._rules = kept

    def hit(self, attempt: Attempt) -> Hit | None:
        """Return the first disturbed bit of a transmission attempt; None if no bit is disturbed.

        Call this method exactly once per attempt, because rules count the calls.

        Args:
            attempt: Transmission attempt to check.
        """
        hits = []
        for _, station, rule in self._rules:
            bit = rule(attempt)
            if bit is not None:
                hits.append(Hit(min(bit, attempt.n_bits() - 1), station))
        return min(hits, default=None)


def _compiled(rule: Disturbance) -> Rule:
    match rule:
        case NthFrame():
            return _nth_frame(rule)
        case RandomShare():
            return _random_share(rule)
        case AtTime():
            return lambda attempt: attempt.bit_at(rule.time_ns)


def _nth_frame(rule: NthFrame) -> Rule:
    count = 0

    def bit_of(attempt: Attempt) -> int | None:
        nonlocal count
        if attempt.frame.can_id != rule.can_id or attempt.frame.extended != rule.extended:
            return None
        count += 1
        return rule.bit if rule.first <= count < rule.first + rule.attempts else None

    return bit_of


def _random_share(rule: RandomShare) -> Rule:
    rng = random.Random(rule.seed)

    def bit_of(attempt: Attempt) -> int | None:
        frame = attempt.frame
        if rule.can_id is not None and (frame.can_id, frame.extended) != (rule.can_id, rule.extended):
            return None
        if rng.random() >= rule.share:
            return None
        return rng.randrange(attempt.n_bits()) if rule.bit is None else rule.bit

    return bit_of
