"""A simulated patch at the analogue port of a node: where the real one has its converter."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Final

import numpy as np

from skinnode.model.layout import Float, PatchLayout
from skinnode.protocol.device_time import TIME_STEP_US
from vcan_sim.scene import Scene

REMEMBERED_READINGS: Final = 4096
"""Readings whose time is kept: more than five minutes of scans at 12.5 a second."""

Fault = Callable[[Float, int], Float]
"""What is wrong with a patch: resistances (U, K) in ohm and the time in ns to what the converter sees
instead; inf is an open pair of wires, 0 a short."""


class SimulatedPatch:
    """The resistances of a patch in a scene, as a converter with noise reads them.

    A :class:`skinnode.node.ResistanceSource`. The scene lies at rest until :meth:`start` sets its origin of
    time, so that readings at power-on (a tare) see a patch that nobody touches. The truth is a pure function
    of time and kept nowhere: :meth:`truth_m` gives it for any time, :meth:`read_ns` that of a scan.

    Args:
        scene: what happens on the skin.
        converter_noise: standard deviation of a reading, relative to the resistance. Default: the scene's.
        fault: applied to each reading, after the noise.
    """

    def __init__(
        self, scene: Scene, *, converter_noise: float | None = None, fault: Fault | None = None
    ) -> None:
        self.scene = scene
        self.fault = fault
        self.reads = 0
        """Readings so far, those of a tare included."""
        self.last_read_ns = 0
        """Time of the newest reading."""
        self._noise = scene.simulation.converter_noise if converter_noise is None else converter_noise
        self._random = np.random.default_rng([scene.simulation.seed, scene.number])
        self._forward = _Forward(scene.layout)
        self._rest_ohm = self._forward(scene.layout.upper_m)
        self._origin_ns: int | None = None
        self._read_ns: OrderedDict[int, int] = OrderedDict()

    @property
    def started(self) -> bool:
        return self._origin_ns is not None

    def start(self, t_ns: int) -> None:
        """Let the scene begin at ``t_ns``; again, to begin anew."""
        self._origin_ns = t_ns

    def read(self, t_ns: int) -> Float:
        """(U, K) resistances in ohm at ``t_ns`` with the converter's noise. The k-th reading of a seed has
        the same noise whenever it is taken."""
        self.reads += 1
        self.last_read_ns = t_ns
        self._remember(t_ns)
        upper = self.truth_m(t_ns)
        resting = upper is self.scene.layout.upper_m
        resistance = self._rest_ohm if resting else self._forward(upper)
        read = resistance * (1.0 + self._noise * self._random.standard_normal(resistance.shape))
        return read if self.fault is None else self.fault(read, t_ns)

    def read_ns(self, device_time_us: int) -> int:
        """When the reading was taken that a node calls ``device_time_us``: its lower 32 bits, of which a
        checked summary carries all but the lowest 6.

        Raises LookupError if there was none, or if it is too long ago.
        """
        try:
            return self._read_ns[(device_time_us & 0xFFFF_FFFF) // TIME_STEP_US]
        except KeyError:
            raise LookupError(
                f"no reading at device time {device_time_us} µs among the last {len(self._read_ns)}"
            ) from None

    def truth_m(self, t_ns: int) -> Float:
        """(U, N, 3) true electrodes at ``t_ns``, metres."""
        if self._origin_ns is None:
            return self.scene.layout.upper_m
        return self.scene.upper_m((t_ns - self._origin_ns) * 1e-9)

    def _remember(self, t_ns: int) -> None:
        self._read_ns[(t_ns // 1000 & 0xFFFF_FFFF) // TIME_STEP_US] = t_ns
        if len(self._read_ns) > REMEMBERED_READINGS:
            self._read_ns.popitem(last=False)


def simulated(layout: PatchLayout) -> SimulatedPatch:
    """A patch that a sphere presses, over which it slides and from which it lifts, from its first reading on:
    the source ``simulated`` of ``skinnode node``. The first touch comes after 0.8 s, so that a tare at
    power-on sees an untouched patch."""
    source = SimulatedPatch(Scene(layout))
    source.start(time.monotonic_ns())
    return source


class _Forward:
    """Resistances of a patch by plain sums, apart from the solver's kernels so that they cannot share a bug
    with the truth; six times as fast as the reference for want of its (…, 3) temporaries."""

    def __init__(self, layout: PatchLayout) -> None:
        self._shape = (*layout.upper_m.shape[:2], *layout.lower_m.shape[:2])
        self._lower = np.ascontiguousarray(layout.lower_m.reshape(-1, 3).T)
        self._resistivity = layout.resistivity_ohm_per_m

    def __call__(self, upper_m: Float) -> Float:
        distance = np.zeros((upper_m.size // 3, self._lower.shape[1]))
        for here, there in zip(upper_m.reshape(-1, 3).T, self._lower, strict=True):
            distance += (here[:, None] - there) ** 2
        np.sqrt(distance, out=distance)
        with np.errstate(divide="ignore"):
            potential = (1.0 / distance).reshape(self._shape).sum(axis=(1, 3))
        return np.asarray(self._resistivity / potential)
