"""Resistances of a patch with imperfections at a given scene time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from skinnode.model.layout import Float, PatchLayout
from vcan_sim.skin.body import Draws, made
from vcan_sim.skin.crossbar import Side, floating_ohm, grounded_ohm
from vcan_sim.skin.forward import ExactForward, Paths
from vcan_sim.skin.front_end import FrontEnd
from vcan_sim.skin.hysteresis_and_creep import History
from vcan_sim.skin.imperfections import EXACT, Imperfections

ROW_STEP_S: Final = 1e-3
"""Longest interval over which the motion of the electrodes during a scan is assumed to be linear, in s."""

Surface = Callable[[float], Float]
"""Function that maps time (s) to the positions (U, N, 3) of an exact patch's upper electrodes in metres. At
rest, it returns the array ``layout.upper_m`` itself. An example is
:meth:`vcan_sim.default_scene.Scene.upper_m`."""


class PhysicalPatch:
    """Patch with imperfections and a read-out.

    Hysteresis and creep change the displacement of an electrode; placement errors do not. Results depend
    only on time, not on earlier calls. Without imperfections, the resistances equal those of
    :class:`ExactForward` bit for bit.

    The ``grounded`` and ``floating`` read-outs are simplified: the conductances of each upper wire's paths
    are taken at the sampling time of that wire, even while another upper wire is sampled. This affects only
    sneak currents.

    Args:
        layout: Nominal layout of the patch, as in the hand file.
        imperfections: Deviations from the layout.
        number: Number of the patch in the hand. It selects the random draws.

    Raises:
        ConfigError: If the random errors make the gap between an upper and a lower electrode too small.
    """

    def __init__(self, layout: PatchLayout, imperfections: Imperfections = EXACT, number: int = 0) -> None:
        self.layout, self.imperfections = layout, imperfections
        draws = Draws(imperfections.seed, number)
        body = made(layout, imperfections, draws)
        self.rest_m: Final = body.upper_m
        """(U, N, 3) float64, m: actual positions of the upper electrodes at rest."""
        self.lower_m: Final = body.lower_m
        """(K, M, 3) float64, m: actual positions of the lower electrodes."""
        self._electrodes = (*layout.upper_m.shape[:2], *layout.lower_m.shape[:2])
        self._exact = ExactForward(self._electrodes, body.lower_m, layout.resistivity_ohm_per_m)
        self._pointlike = not (
            imperfections.electrode_radius or imperfections.strain or imperfections.readout != "ideal"
        )
        radius_m = imperfections.electrode_radius * layout.pitch_m
        self._paths = Paths(body.upper_m, body.lower_m, radius_m, imperfections.strain)
        self._sides = self._network(draws)
        remembers = any(imperfections.creep) or imperfections.hysteresis
        self._history = History(imperfections, layout.height_m) if remembers else None
        wires = self._electrodes[0]
        self._row_s = imperfections.row_time_s * np.arange(wires)
        cold = np.ones((wires, 1))
        at_rest_ohm = self._network_ohm(body.upper_m, cold)
        self._front_end = FrontEnd(imperfections, draws, at_rest_ohm)
        self.rest_ohm: Final = self._front_end.amplified_ohm(at_rest_ohm)
        """(U, K) float64, ohm: resistances at the converter input, at rest and at time 0; read-only."""
        for shared in (self.rest_m, self.lower_m, self.rest_ohm):
            shared.setflags(write=False)

    def upper_m(self, t_s: float, upper_m_at: Surface) -> Float:
        """Return the upper electrodes' true positions during a scan of the patch.

        Args:
            t_s: Scene time at which the first upper wire is sampled, in s.
            upper_m_at: Motion of the exact patch, as a pure function of time.

        Returns:
            (U, N, 3) float64, m: positions of the electrodes of upper wire u at ``t_s + u · row_time_s``,
            including placement errors. The displacement that solvers estimate is this array minus
            :attr:`rest_m`. At rest, without position errors, the result is ``layout.upper_m`` itself.
        """
        if not self._row_s[-1]:  # without a row time, or with a single upper wire
            return self._upper_m(t_s, upper_m_at)
        spans = max(1, math.ceil(self._row_s[-1] / ROW_STEP_S))
        knots = np.linspace(0.0, self._row_s[-1], spans + 1)
        at = [self._upper_m(t_s + float(knot), upper_m_at) for knot in knots]
        if all(each is self.rest_m for each in at):
            return self.rest_m
        span = np.clip(np.searchsorted(knots, self._row_s, side="right") - 1, 0, spans - 1)
        share = ((self._row_s - knots[span]) / (knots[1] - knots[0]))[:, None, None]
        wires, every = np.arange(len(self._row_s)), np.stack(at)
        return np.asarray((1.0 - share) * every[span, wires] + share * every[span + 1, wires])

    def analogue_ohm(self, t_s: float, upper_m_at: Surface) -> Float:
        """Return the resistances (U, K) in ohms at the input of the converter.

        Args:
            t_s: Scene time of the scan, in s.
            upper_m_at: Motion of the exact patch, as a pure function of time.
        """
        upper_m = self.upper_m(t_s, upper_m_at)
        if upper_m is self.rest_m and not self.imperfections.warming_k:
            return self.rest_ohm
        return self._front_end.amplified_ohm(self._network_ohm(upper_m, self._warmth(t_s)))

    def converted_ohm(self, analogue_ohm: Float, reading: int) -> Float:
        """Return the output of the converter for a given input.

        Args:
            analogue_ohm: (U, K) float64, ohm: input of the converter.
            reading: Number of the reading, at least 0. It seeds the noise.

        Returns:
            (U, K) float64, ohm; the input array itself for an exact converter.
        """
        return self._front_end.converted_ohm(analogue_ohm, reading)

    def resistance_ohm(self, t_s: float, upper_m_at: Surface) -> Float:
        """Return the resistances (U, K) in ohms at the output of the converter, for one scan.

        The scene time, in whole nanoseconds, seeds the noise.

        Args:
            t_s: Scene time of the scan, in s.
            upper_m_at: Motion of the exact patch, as a pure function of time.
        """
        return self.converted_ohm(self.analogue_ohm(t_s, upper_m_at), abs(round(t_s * 1e9)))

    def _upper_m(self, t_s: float, upper_m_at: Surface) -> Float:
        """Return the upper electrodes' true positions (U, N, 3) in metres; at rest, ``rest_m`` itself."""
        layout_m = self.layout.upper_m
        if self._history is None:
            upper = upper_m_at(t_s)
            if self.rest_m is layout_m or upper is layout_m:
                return self.rest_m if upper is layout_m else upper
            return np.asarray(self.rest_m + (upper - layout_m))
        moved = self._history.displacement_m(t_s, _Motion(upper_m_at, layout_m))
        return self.rest_m if moved is None else np.asarray(self.rest_m + moved)

    def _warmth(self, t_s: float) -> Float:
        """Return the resistivity (U, 1) at each upper wire's sampling time, relative to time 0."""
        sizes = self.imperfections
        since_s = np.maximum(t_s + self._row_s, 0.0)
        risen_k = -sizes.warming_k * np.expm1(-since_s / sizes.warming_s)
        return np.asarray(1.0 + sizes.temperature_per_k * risen_k)[:, None]

    def _network(self, draws: Draws) -> tuple[Side, Side]:
        """Return the upper and lower wires of the crossbar, with their series resistances."""
        sizes = self.imperfections
        upper, per_upper, lower, per_lower = self._electrodes
        contact_ohm = sizes.contact_ohm * draws.stream("contacts").uniform(0.5, 1.5, upper + lower)
        return (
            Side(contact_ohm[:upper] + sizes.multiplexer_ohm, sizes.upper_wire_ohm, per_upper),
            Side(contact_ohm[upper:] + sizes.virtual_ground_ohm, sizes.lower_wire_ohm, per_lower),
        )

    def _network_ohm(self, upper_m: Float, warmth: Float) -> Float:
        """Return the resistances (U, K) in ohms at the amplifier's input.

        Args:
            upper_m: (U, N, 3) float64, m: upper electrodes.
            warmth: (U, 1) float64: resistivity relative to the layout's resistivity.
        """
        if self._pointlike:
            exact_ohm = self._exact(upper_m)
            return exact_ohm * warmth if self.imperfections.warming_k else exact_ohm
        resistivity = self.layout.resistivity_ohm_per_m * warmth
        if self.imperfections.readout == "ideal":
            return np.asarray(resistivity / self._paths.sums(upper_m, self._electrodes, (1, 3))[:, 0, :, 0])
        upper, lower = self._sides
        alone = tuple(axis for axis, side in ((1, upper), (3, lower)) if side.nodes == 1)
        paths = self._paths.sums(upper_m, self._electrodes, alone) / resistivity[..., None, None]
        conductance = paths.reshape(paths.shape[0] * paths.shape[1], -1)
        solve = grounded_ohm if self.imperfections.readout == "grounded" else floating_ohm
        return solve(conductance, upper, lower)


class _Motion:
    """Function that maps time to the displacement of an exact patch; it returns None at rest.

    Motions that wrap the same function are equal, which is how :class:`History` detects a new scene.
    """

    __slots__ = ("_layout_m", "_upper_m_at")

    def __init__(self, upper_m_at: Surface, layout_m: Float) -> None:
        self._upper_m_at, self._layout_m = upper_m_at, layout_m

    def __call__(self, t_s: float) -> Float | None:
        upper = self._upper_m_at(t_s)
        return None if upper is self._layout_m else np.asarray(upper - self._layout_m)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Motion) and self._upper_m_at == other._upper_m_at

    __hash__ = None  # type: ignore[assignment]  # the wrapped function need not be hashable
