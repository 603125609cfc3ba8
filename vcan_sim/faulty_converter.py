"""Simulated converter with injected faults, including faults of the wires connected to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from skinnode.node.patch.source import ResistanceSource, conversions_of
from skinnode.protocol.codes import CodeScale, encode
from vcan_sim.faults import OF_WIRES, Faults
from vcan_sim.injector import Injector
from vcan_sim.skin.imperfections import EXACT

MOST_DRIFT: Final = 10.0
"""Maximum factor by which drift multiplies or divides a resistance."""
WIRE_NOISE: Final = 3e-3
"""Relative standard deviation of the noise in a resistance measured through a bad contact."""


class FaultyConverter:
    """Analogue-to-digital converter with injected faults.

    Wire faults take effect after the node has booted, so the tare at power-on is valid. Drift and temperature
    changes affect all readings, including the tare.

    Args:
        source: Source of the resistances that an intact converter would measure.
        injector: The node's faults, random generator and counts.
        booting: Function that returns whether the node is booting.
        baseline_ohm: Function that returns the baseline R0 in ohms, (U, K), to which codes refer.
        scale: Code scale of the node.
        temperature_per_k: Temperature coefficient of all resistances, 1/K.
        on_repeat: Function called with the time (ns) of each reading in which a frozen converter repeats the
            last one.
    """

    def __init__(  # noqa: PLR0913 - all parts of a node's converter
        self,
        source: ResistanceSource,
        injector: Injector,
        *,
        booting: Callable[[], bool],
        baseline_ohm: Callable[[], Float],
        scale: CodeScale,
        temperature_per_k: float = EXACT.temperature_per_k,
        on_repeat: Callable[[int], object] = lambda t_ns: None,
    ) -> None:
        self._on_repeat = on_repeat
        self._source, self._injector, self._booting = source, injector, booting
        self._baseline_ohm, self._scale = baseline_ohm, scale
        self._temperature_per_k = temperature_per_k
        self._drift, self._drifted_to_ns = 0.0, 0
        self._reading: Float | None = None
        self._conversions: int | None = None
        self._held: dict[tuple[str, object], Float] = {}  # readings from the start of each fault
        self._examined: Faults | None = None
        self._wires_intact = True

    @property
    def conversions(self) -> int | None:
        """Number of completed conversions; None if the converter does not count."""
        return None if self._injector.faults.uncounted else self._conversions

    def read(self, t_ns: int) -> Float:
        """Return the resistances (U, K) at ``t_ns`` in ohms. A frozen converter repeats its last reading."""
        self._injector.injected.uncounted += self._injector.faults.uncounted
        if self._injector.faults.frozen and self._reading is not None:
            self._injector.injected.frozen += 1
            self._on_repeat(t_ns)
        else:
            self._reading = self._flip(self._through_wires(self._shifted(self._source.read(t_ns), t_ns)))
            self._conversions = conversions_of(self._source)
        return self._reading

    def _shifted(self, read: Float, t_ns: int) -> Float:
        """Apply the drift and the temperature change to a reading."""
        faults, injected = self._injector.faults, self._injector.injected
        factor = 1.0
        if faults.drift_per_s:
            since_ns = self._drifted_to_ns or t_ns
            self._drift += faults.drift_per_s * (t_ns - since_ns) * 1e-9
            self._drifted_to_ns = t_ns
            factor *= min(max(1.0 + self._drift, 1.0 / MOST_DRIFT), MOST_DRIFT)
            injected.drifted += 1
        else:
            self._drift, self._drifted_to_ns = 0.0, 0
        if faults.warmer_k:
            factor *= 1.0 + self._temperature_per_k * faults.warmer_k
            injected.warmed += 1
        return read if factor == 1.0 else factor * read

    def _through_wires(self, read: Float) -> Float:
        faults = self._injector.faults
        if faults is not self._examined:
            self._examined = faults
            self._wires_intact = all(getattr(faults, name) is None for name in OF_WIRES)
        if self._wires_intact or self._booting():
            self._held = {}
            return read
        self._injector.injected.miswired += 1
        read = read.copy()
        for wire, ohm in ((faults.crossed_upper, read), (faults.crossed_lower, read.T)):
            if wire is not None:
                ohm[[wire, wire + 1]] = ohm[[wire + 1, wire]]
        for wire, ohm in ((faults.noisy_upper, read), (faults.noisy_lower, read.T)):
            if wire is not None:
                ohm[wire] *= 1.0 + WIRE_NOISE * self._injector.random.standard_normal(ohm.shape[1])
        self._hold(read, faults)
        for wire, ohm, value in (
            (faults.shorted_upper, read, 0.0),
            (faults.shorted_lower, read.T, 0.0),
            (faults.open_upper, read, np.inf),
            (faults.open_lower, read.T, np.inf),
        ):
            if wire is not None:
                ohm[wire] = value
        return read

    def _hold(self, read: Float, faults: Faults) -> None:
        """Hold the resistances of frozen wires and stuck crossings at their values when the fault began."""
        stuck = None if faults.stuck_upper is None else (faults.stuck_upper, faults.stuck_lower)
        held: dict[tuple[str, object], Float] = {}
        for name, place, ohm in (
            ("frozen_upper", faults.frozen_upper, read),
            ("frozen_lower", faults.frozen_lower, read.T),
            ("stuck", stuck, read),
        ):
            if place is not None:
                value = self._held.get((name, place))
                held[name, place] = np.array(ohm[place]) if value is None else value
                ohm[place] = held[name, place]
        self._held = held

    def _flip(self, read: Float) -> Float:
        """Flip one bit of one code in a reading with probability ``flipped``."""
        if not self._injector.draw(self._injector.faults.flipped) or self._booting():
            return read
        random, scale, baseline_ohm = self._injector.random, self._scale, self._baseline_ohm()
        at = tuple(int(random.integers(size)) for size in read.shape)
        code = int(encode(read[at], baseline_ohm[at], scale))
        others = [code ^ 1 << bit for bit in range(scale.bits) if code ^ 1 << bit <= scale.steps]
        if code > scale.steps or not others:
            return read
        self._injector.injected.flipped += 1
        read = read.copy()
        read[at] = (scale.lo + others[int(random.integers(len(others)))] * scale.step) * baseline_ohm[at]
        return read
