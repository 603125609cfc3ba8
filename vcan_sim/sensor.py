"""Simulated resistances at a node's analogue inputs."""

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
"""Number of readings whose times are kept: more than five minutes of scans at 12.5 per second."""

Fault = Callable[[Float, int], Float]
"""Function that takes the resistances (U, K) in ohm and the time in ns, and returns the resistances that the
converter sees instead; inf means an open pair of wires, 0 a shorted pair."""


class SimulatedPatch:
    """Resistances of a patch in a scene, as read by a noisy converter.

    Implements :class:`skinnode.node.ResistanceSource`. The skin stays at rest until :meth:`start` sets the
    scene's time origin, so that readings at power-on (a tare) see an untouched patch. The truth is a pure
    function of time and is not stored: :meth:`truth_m` returns it for any time, and :meth:`read_ns` returns
    the time of a scan.

    Args:
        scene: Motion of the indenter and the skin.
        converter_noise: Standard deviation of a reading, relative to the resistance. Default: the scene's.
        fault: Function applied to each reading, after the noise.
    """

    def __init__(
        self, scene: Scene, *, converter_noise: float | None = None, fault: Fault | None = None
    ) -> None:
        self.scene = scene
        self.fault = fault
        self.reads = 0
        """Number of readings so far, including readings for a tare."""
        self.last_read_ns = 0
        """Time of the newest reading, ns."""
        self._noise = scene.simulation.converter_noise if converter_noise is None else converter_noise
        self._random = np.random.default_rng([scene.simulation.seed, scene.number])
        self._forward = _Forward(scene.layout)
        self._rest_ohm = self._forward(scene.layout.upper_m)
        self._origin_ns: int | None = None
        self._read_ns: OrderedDict[int, int] = OrderedDict()

    @property
    def conversions(self) -> int:
        """Number of conversions of the whole matrix so far: one per reading."""
        return self.reads

    @property
    def started(self) -> bool:
        """Whether the scene has begun."""
        return self._origin_ns is not None

    def start(self, t_ns: int) -> None:
        """Start or restart the scene at ``t_ns``."""
        self._origin_ns = t_ns

    def read(self, t_ns: int) -> Float:
        """Return the resistances (U, K) in ohm at ``t_ns``, with converter noise.

        For a given seed the k-th reading always has the same noise, whenever it is taken.
        """
        self.reads += 1
        self.last_read_ns = t_ns
        self._remember(t_ns)
        upper = self.truth_m(t_ns)
        resting = upper is self.scene.layout.upper_m
        resistance = self._rest_ohm if resting else self._forward(upper)
        read = resistance * (1.0 + self._noise * self._random.standard_normal(resistance.shape))
        return read if self.fault is None else self.fault(read, t_ns)

    def read_ns(self, device_time_us: int) -> int:
        """Return the time of a reading, ns.

        Args:
            device_time_us: Lower 32 bits of the time of the reading on the node's clock, µs; the lowest 6
                bits are ignored, because a checked summary does not carry them.

        Raises:
            LookupError: There was no such reading, or it is too old.
        """
        try:
            return self._read_ns[(device_time_us & 0xFFFF_FFFF) // TIME_STEP_US]
        except KeyError:
            raise LookupError(
                f"no reading at device time {device_time_us} µs among the last {len(self._read_ns)}"
            ) from None

    def truth_m(self, t_ns: int) -> Float:
        """Return the true electrode positions (U, N, 3) at ``t_ns``, metres."""
        if self._origin_ns is None:
            return self.scene.layout.upper_m
        return self.scene.upper_m((t_ns - self._origin_ns) * 1e-9)

    def _remember(self, t_ns: int) -> None:
        self._read_ns[(t_ns // 1000 & 0xFFFF_FFFF) // TIME_STEP_US] = t_ns
        if len(self._read_ns) > REMEMBERED_READINGS:
            self._read_ns.popitem(last=False)


def simulated(layout: PatchLayout) -> SimulatedPatch:
    """Return a patch that a sphere presses: the source named ``simulated`` in ``skinnode node``.

    The scene starts immediately. The first touch occurs after 0.8 s, so that a tare at power-on sees an
    untouched patch.
    """
    source = SimulatedPatch(Scene(layout))
    source.start(time.monotonic_ns())
    return source


class _Forward:
    """Computes the resistances of a patch by direct summation.

    It shares no code with the solver's kernels, so truth and solver cannot have a bug in common. It is six
    times as fast as the reference model because it allocates no (…, 3) temporaries.
    """

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
