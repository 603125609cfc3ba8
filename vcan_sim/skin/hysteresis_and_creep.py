"""Hysteresis and creep of the rubber, which make the displacement depend on earlier loads.

Hysteresis, and then creep, acts on each coordinate of each electrode's displacement:

hysteresis   The fraction w of the displacement passes through parallel play operators. Each operator follows
             its input s only outside a band of ±r: p ← max(s − r, min(s + r, p)), with p = 0 initially. The
             hysteresis loop does not depend on the rate of loading (Prandtl-Ishlinskii operator; Brokate and
             Sprekels, Hysteresis and Phase Transitions, 1996, section 2.3).
creep        d = s + c₁ q₁ + c₂ q₂, where τᵢ dqᵢ/dt = s − qᵢ. This is the Prony series of two Kelvin-Voigt
             elements (Findley, Lai and Onaran, Creep and Relaxation of Nonlinear Viscoelastic Materials,
             1976, section 5.5). The response to a step s is s (1 + Σ cᵢ (1 − exp(−t/τᵢ))).

The result is the true displacement of the electrodes. The state advances from time 0 in steps of
:data:`STEP_S`. Within a step, the output of the hysteresis model is assumed to vary linearly. A time between
two steps is reached by a partial step that is not stored, so results do not depend on earlier requests.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinnode.model.layout import Float
from vcan_sim.skin.imperfections import Imperfections

STEP_S: Final = 1.0 / 32.0
"""Time step, in s. It is a power of two, so the times of all steps are exact."""
THRESHOLDS: Final = (0.0025, 0.005, 0.01, 0.02)
"""Thresholds r of the play operators, as fractions of the clearance; the operators have equal weights."""
_RECENT: Final = 128
"""Number of recent time steps whose states are stored."""
_KEPT_EVERY: Final = 64
"""Number of time steps (2 s) between states that are stored for longer."""
_KEPT: Final = 300
"""Number of states stored at intervals of ``_KEPT_EVERY`` steps (ten minutes). Only every ``_THINNED``-th
older state is kept."""
_THINNED: Final = 64

Load = Callable[[float], "Float | None"]
"""Function that maps time (s) to the displacement (U, N, 3) in metres, without hysteresis and creep. It
returns None at rest."""


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """State of the rubber at one instant, in metres, for each coordinate (U, N, 3) of the displacement."""

    play: Float
    """(P, U, N, 3): outputs of the play operators."""
    followed: Float
    """(U, N, 3): displacement with hysteresis."""
    delayed: Float
    """(2, U, N, 3): delayed displacements q₁ and q₂ of the two creep terms."""


class History:
    """Displacement of the rubber surface under a varying load, with hysteresis and creep.

    Args:
        imperfections: Sizes of hysteresis and creep.
        clearance_m: Clearance between the electrode layers, in m. It scales the hysteresis thresholds.
    """

    def __init__(self, imperfections: Imperfections, clearance_m: float) -> None:
        self._share = imperfections.hysteresis
        self._thresholds_m = np.reshape(THRESHOLDS if self._share else (), (-1, 1, 1, 1)) * clearance_m
        self._creep = np.array(imperfections.creep)
        self._creep_s = np.reshape(imperfections.creep_s, (2, 1, 1, 1))
        self._load: Load | None = None
        self._kept: dict[int, State | None] = {}
        self._recent: OrderedDict[int, State | None] = OrderedDict()
        self._lock = threading.Lock()  # one thread reads for the node; another requests the ground truth

    def displacement_m(self, t_s: float, load: Load) -> Float | None:
        """Return the displacement (U, N, 3) in metres at ``t_s``; None before the first load.

        Args:
            t_s: Time since the start of the history, in s.
            load: Displacement without hysteresis and creep, as a pure function of time. A different function
                restarts the history.
        """
        if t_s < 0.0:
            return load(t_s)
        with self._lock:
            if load != self._load:
                self._load = load
                self._kept, self._recent = {}, OrderedDict()
            step = int(t_s // STEP_S)
            state, since_s = self._at(step, load), t_s - step * STEP_S
            if since_s > 0.0:
                state = self._advanced(state, load(t_s), since_s)
        if state is None:
            return None
        return np.asarray(state.followed + np.tensordot(self._creep, state.delayed, axes=1))

    def _at(self, step: int, load: Load) -> State | None:
        """Return the state at a time step, starting from the latest stored state."""
        known = step
        while known >= 0 and known not in self._recent and known not in self._kept:
            known -= 1
        if known < 0:
            state, known = self._advanced(None, load(0.0), 0.0), 0
            self._store(0, state)
        else:
            state = self._recent[known] if known in self._recent else self._kept[known]
        for number in range(known + 1, step + 1):
            state = self._advanced(state, load(number * STEP_S), STEP_S)
            self._store(number, state)
        return state

    def _store(self, step: int, state: State | None) -> None:
        if step % _KEPT_EVERY == 0:
            self._kept[step] = state
            old = step - _KEPT * _KEPT_EVERY
            if old % (_THINNED * _KEPT_EVERY):
                self._kept.pop(old, None)
        self._recent[step] = state
        if len(self._recent) > _RECENT:
            self._recent.popitem(last=False)

    def _advanced(self, state: State | None, load_m: Float | None, dt_s: float) -> State | None:
        """Return the state after a step of ``dt_s``, given the load ``load_m`` at the end of the step."""
        if state is None:
            if load_m is None:
                return None
            state = State(
                np.zeros((len(self._thresholds_m), *load_m.shape)),
                np.zeros_like(load_m),
                np.zeros((2, *load_m.shape)),
            )
        s = np.zeros_like(state.followed) if load_m is None else load_m
        play = np.maximum(s - self._thresholds_m, np.minimum(s + self._thresholds_m, state.play))
        followed = s + self._share * (play.mean(axis=0) - s) if self._share else s
        if dt_s == 0.0 or not self._creep.any():
            return State(play, followed, state.delayed)
        risen = -np.expm1(-dt_s / self._creep_s)
        lag = (followed - state.followed) * (self._creep_s / dt_s)
        # exact if ``followed`` varies linearly within the step
        delayed = followed - lag * risen + (state.delayed - state.followed) * (1.0 - risen)
        return State(play, followed, delayed)
