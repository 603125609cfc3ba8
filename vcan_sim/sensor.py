"""Simulated resistance readings of a patch, for a node's converter."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Final, Protocol

import numpy as np

from skinnode.config import SimulationConfig
from skinnode.model.layout import Float, PatchLayout
from skinnode.process import clock
from skinnode.protocol.device_time import TIME_STEP_US
from vcan_sim.default_scene import Scene
from vcan_sim.skin.imperfections import EXACT, Imperfections
from vcan_sim.skin.patch import PhysicalPatch

REMEMBERED_READINGS: Final = 4096
"""Number of recent readings whose times are stored, enough for five minutes at 12.5 scans per second."""

Fault = Callable[[Float, int], Float]
"""Function that takes a reading (U, K) in ohms and its time in ns, and returns the faulty reading. An open
pair of wires reads inf, and a shorted pair reads 0."""


class SkinMotion(Protocol):
    """Skin motion from a :class:`vcan_sim.default_scene.Scene` or :class:`vcan_sim.scenes.PatchScene`."""

    @property
    def layout(self) -> PatchLayout:
        """Layout of the patch at rest."""

    @property
    def simulation(self) -> SimulationConfig:
        """Simulation settings, such as the seed and noise of the converter."""

    @property
    def number(self) -> int:
        """Number of the patch in the hand. Patches with different numbers have different noise."""

    def upper_m(self, t_s: float) -> Float:
        """Return the positions (U, N, 3) of the upper electrodes at scene time ``t_s``, in metres.

        At rest, the result is ``layout.upper_m`` itself.
        """


class SimulatedPatch:
    """Resistances of a patch in a scene, as read by a noisy converter.

    This class implements :class:`skinnode.node.ResistanceSource`. The skin is at rest until :meth:`start`
    begins the scene, so the tare at power-on measures an untouched patch. :meth:`truth_m` returns the ground
    truth at any time, and :meth:`read_ns` returns the time of a scan.

    Args:
        scene: Motion of the skin.
        converter_noise: Standard deviation of a reading, relative to the resistance; default: the value in
            the simulation settings.
        fault: Function applied to each noisy reading.
        imperfections: Deviations of the patch from its layout. The random errors depend on the number of the
            patch.

    Raises:
        ConfigError: If the random errors make the gap between an upper and a lower electrode too small.
    """

    def __init__(
        self,
        scene: SkinMotion,
        *,
        converter_noise: float | None = None,
        fault: Fault | None = None,
        imperfections: Imperfections = EXACT,
    ) -> None:
        self.scene = scene
        self.fault = fault
        self.reads = 0
        """Number of readings so far, including readings for the tare."""
        self.last_read_ns = 0
        """Time of the last reading, in ns."""
        self._noise = scene.simulation.converter_noise if converter_noise is None else converter_noise
        self._random = np.random.default_rng([scene.simulation.seed, scene.number])
        self.skin: Final = PhysicalPatch(scene.layout, imperfections, scene.number)
        """Patch with its imperfections."""
        self._origin_ns: int | None = None
        self._read_ns: OrderedDict[int, int] = OrderedDict()

    @property
    def conversions(self) -> int:
        """Number of conversions so far. A reading is one conversion of the whole matrix."""
        return self.reads

    @property
    def started(self) -> bool:
        """Whether the scene has begun."""
        return self._origin_ns is not None

    def start(self, t_ns: int) -> None:
        """Start or restart the scene at ``t_ns``."""
        self._origin_ns = t_ns

    def read(self, t_ns: int) -> Float:
        """Return a noisy reading of the resistances (U, K) at ``t_ns`` in ohms.

        The noise depends only on the seed and the number of the reading, not on the time.
        """
        self.reads += 1
        self.last_read_ns = t_ns
        self._remember(t_ns)
        resistance = self.exact_ohm(t_ns)
        noisy = resistance * (1.0 + self._noise * self._random.standard_normal(resistance.shape))
        read = self.skin.converted_ohm(noisy, self.reads)
        return read if self.fault is None else self.fault(read, t_ns)

    def note_repeat(self, t_ns: int) -> None:
        """Store the time of a reading in which a frozen converter repeats the last one.

        The scan is sent with the time of this reading, for which there is also a ground truth.
        """
        self.last_read_ns = t_ns
        self._remember(t_ns)

    def exact_ohm(self, t_ns: int) -> Float:
        """Return the noise-free resistances (U, K) at ``t_ns`` in ohms."""
        t_s = self.scene_s(t_ns)
        return self.skin.rest_ohm if t_s is None else self.skin.analogue_ohm(t_s, self.scene.upper_m)

    def read_ns(self, device_time_us: int) -> int:
        """Return the time of a reading, in ns.

        Args:
            device_time_us: Time of the reading on the node's clock, µs, modulo 2³². The lowest 6 bits are
                ignored, because a summary with a check does not contain them.

        Raises:
            LookupError: If no stored reading has this time.
        """
        try:
            return self._read_ns[(device_time_us & 0xFFFF_FFFF) // TIME_STEP_US]
        except KeyError:
            raise LookupError(
                f"no reading at device time {device_time_us} µs among the last {len(self._read_ns)}"
            ) from None

    def read_times_ns(self) -> list[int]:
        """Return the times (ns) of the last :data:`REMEMBERED_READINGS` readings, oldest first."""
        return list(self._read_ns.values())

    def truth_m(self, t_ns: int) -> Float:
        """Return the true electrode positions during a reading at ``t_ns``.

        Returns:
            (U, N, 3) float64, m: actual positions of the upper electrodes, each at the sampling time of its
            wire. With imperfections, they differ from ``layout.upper_m`` even at rest; see
            :meth:`displacement_m`.
        """
        t_s = self.scene_s(t_ns)
        return self.skin.rest_m if t_s is None else self.skin.upper_m(t_s, self.scene.upper_m)

    def displacement_m(self, t_ns: int) -> Float:
        """Return the true displacement of the electrodes during a reading at ``t_ns``.

        Returns:
            (U, N, 3) float64, m: :meth:`truth_m` minus the actual positions at rest. Solvers estimate
            this displacement, because they compare readings with a baseline.
        """
        return np.asarray(self.truth_m(t_ns) - self.skin.rest_m)

    def scene_s(self, t_ns: int) -> float | None:
        """Return the scene time (s) at ``t_ns``; None if the scene has not begun."""
        return None if self._origin_ns is None else (t_ns - self._origin_ns) * 1e-9

    def _remember(self, t_ns: int) -> None:
        self._read_ns[(t_ns // 1000 & 0xFFFF_FFFF) // TIME_STEP_US] = t_ns
        if len(self._read_ns) > REMEMBERED_READINGS:
            self._read_ns.popitem(last=False)


def simulated(layout: PatchLayout) -> SimulatedPatch:
    """Return a simulated patch with random touches: the source ``simulated`` of ``skinnode node``.

    The scene starts immediately. The first touch occurs after 0.8 s, so the patch is untouched during the
    tare at power-on.
    """
    source = SimulatedPatch(Scene(layout))
    source.start(clock.monotonic_ns())
    return source
