"""Compiled part of the filter over frames: interacting multiple models (IMM) of a moving skin.

Each mode of the readings (:mod:`skinnode.solve.posterior.past.load_modes`) is the state of a scalar Kalman
filter. For each speed τ of the skin, the filters of all modes form a bank: from one frame to the next, a mode
with share λ changes by a random step of variance τ λ. The unit is the noise variance of a reading, so τ is
the mean squared change of all readings taken together. The last bank forgets all earlier frames: its state is
the current frame. Its likelihood is averaged over several high speeds and over a change in all readings that
no loads can explain.

The probabilities of the banks follow from the likelihoods of their predictions (Blom and Bar-Shalom, The
interacting multiple model algorithm for systems with Markovian switching coefficients, 1988). Before each
frame, the states of the banks are mixed, so that all banks start from the frame at which the skin jumped.
"""

from __future__ import annotations

from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from skinnode.compiled.array_table import READONLY, ArrayTable, reader
from skinnode.compiled.jit import njit, njit_part
from skinnode.model.layout import Float
from skinnode.solve.linalg.cholesky import multiply_vector

SPEEDS: Final = np.array([0.0, 0.03, 0.3])
"""Speeds τ of the banks that use earlier frames. With an additional bank for a speed of 3, the filter
followed a change of 7 standard deviations only halfway in the first frame."""
JUMPS: Final = np.array([3.0, 30.0, 300.0, 3000.0, 300.0])
"""Speeds τ of the bank that forgets all earlier frames."""
UNEXPLAINED: Final = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
"""Variance, per reading, of the change that no loads can explain, for each of :data:`JUMPS`."""
STAYS: Final = 0.9
"""Probability per frame that the skin keeps its speed."""
JUMPS_CHANCE: Final = 0.03
"""Probability per frame that the skin jumps. After a jump, the probability of another jump is ½."""


class FilterArrays(ArrayTable):
    """Arrays of a patch's filter: S banks that use earlier frames; m readings in units of their noise."""

    modes: Annotated[NDArray[np.float64], "m m", READONLY]
    """Modes, as rows."""
    share: Annotated[NDArray[np.float64], "m", READONLY]
    """Share λ of each mode."""
    weight: Annotated[NDArray[np.float64], "m", READONLY]
    """Weight of each mode in the noise of the filtered readings."""
    total: Annotated[NDArray[np.float64], "m", READONLY]
    """Σ weight mode² of each reading."""
    speeds: Annotated[NDArray[np.float64], "S", READONLY]
    jumps: Annotated[NDArray[np.float64], "D", READONLY]
    unexplained: Annotated[NDArray[np.float64], "D", READONLY]
    switch: Annotated[NDArray[np.float64], "B B", READONLY]
    """Transition probability from each bank (row) to each bank (column). B = S + 1; the last bank forgets all
    earlier frames."""
    frame: Annotated[NDArray[np.float64], "m"]
    """Changes in the readings from rest, ln(R₀/R) / σ."""
    state: Annotated[NDArray[np.float64], "B m"]
    """Mean of each mode for each bank, before the frame."""
    variance: Annotated[NDArray[np.float64], "B m"]
    """Variance of each mode for each bank, before the frame."""
    chance: Annotated[NDArray[np.float64], "B"]
    """Probability of each bank, before the frame."""
    next_state: Annotated[NDArray[np.float64], "B m"]
    """Mean of each mode for each bank, after the frame."""
    next_variance: Annotated[NDArray[np.float64], "B m"]
    next_chance: Annotated[NDArray[np.float64], "B"]
    modal: Annotated[NDArray[np.float64], "m"]
    """Work array: components of the frame along the modes."""
    expected: Annotated[NDArray[np.float64], "B"]
    """Work array: probability of each bank before the frame is considered."""
    mixture: Annotated[NDArray[np.float64], "B B"]
    """Work array: weight of each bank (row) in the initial state of each bank (column)."""
    start_of: Annotated[NDArray[np.float64], "B"]
    """Work array: weight of each bank in the initial state of one bank."""
    filtered: Annotated[NDArray[np.float64], "m"]
    """Result: filtered changes in the readings."""
    noise: Annotated[NDArray[np.float64], "m"]
    """Result: variance of the filtered changes, in units of the frame's noise variance."""


arrays_of = reader(FilterArrays)


def switching(speeds: int) -> Float:
    """Return the transition probabilities (S + 1, S + 1) from each bank (row) to each bank (column).

    Args:
        speeds: Number S of banks that use earlier frames.
    """
    switch = np.full((speeds + 1, speeds + 1), (1.0 - STAYS - JUMPS_CHANCE) / max(speeds - 1, 1))
    np.fill_diagonal(switch, STAYS)
    switch[:, -1] = JUMPS_CHANCE
    switch[-1] = 0.5 / speeds
    switch[-1, -1] = 0.5
    return np.asarray(switch / switch.sum(axis=1, keepdims=True))


@njit
def start(table: NDArray[np.int64]) -> None:
    """Initialise the filter with a frame.

    Args:
        table: Table of :class:`FilterArrays`.
    """
    its = arrays_of(table)
    banks, m = its.state.shape
    multiply_vector(its.modes, its.frame, its.modal)
    for j in range(banks):
        its.next_chance[j] = 0.0
        for i in range(m):
            its.next_state[j, i] = its.modal[i]
            its.next_variance[j, i] = 1.0
    its.next_chance[banks - 1] = 1.0
    for k in range(m):
        its.filtered[k] = its.frame[k]
        its.noise[k] = 1.0


@njit_part
def _mix(switch: Float, chance: Float, mixture: Float, expected: Float) -> None:
    """Write each bank's probability before the frame, and the weights of all banks in its initial state."""
    banks = chance.size
    for j in range(banks):
        total = 0.0
        for b in range(banks):
            mixture[b, j] = chance[b] * switch[b, j]
            total += mixture[b, j]
        expected[j] = total
        for b in range(banks):
            mixture[b, j] /= total


@njit_part
def _merge(share: Float, means: Float, variances: Float, i: int) -> tuple[float, float]:
    """Return the mean and the variance of mode ``i`` in a mixture of all banks."""
    mean, wide = 0.0, 0.0
    for b in range(share.size):
        mean += share[b] * means[b, i]
    for b in range(share.size):
        off = means[b, i] - mean
        wide += share[b] * (variances[b, i] + off * off)
    return mean, wide


@njit_part
def _update(  # noqa: PLR0913 - a kernel: arrays by name
    frame: Float, share: Float, speed: float, least: float, mean: Float, variance: Float
) -> float:
    """Update a bank that uses earlier frames; return the log likelihood of the frame."""
    square, log_det = 0.0, 0.0
    for i in range(frame.size):
        ahead = variance[i] + speed * share[i]
        innovation = frame[i] - mean[i]
        gain = ahead / (ahead + 1.0)
        square += innovation * innovation / (ahead + 1.0)
        log_det += np.log(ahead + 1.0)
        mean[i] += gain * innovation
        variance[i] = max(gain, least)
    return -0.5 * (square + log_det)


@njit_part
def _forget(  # noqa: PLR0913 - a kernel: arrays by name
    frame: Float, share: Float, jumps: Float, unexplained: Float, mean: Float, variance: Float
) -> float:
    """Replace the state of the last bank with the frame; return the log likelihood of the frame."""
    total, top = 0.0, -np.inf
    for d in range(jumps.size):
        square, log_det = 0.0, 0.0
        for i in range(frame.size):
            ahead = variance[i] + jumps[d] * share[i] + unexplained[d] + 1.0
            innovation = frame[i] - mean[i]
            square += innovation * innovation / ahead
            log_det += np.log(ahead)
        value = -0.5 * (square + log_det)
        if value > top:
            total = total * np.exp(top - value) + 1.0
            top = value
        else:
            total += np.exp(value - top)
    for i in range(frame.size):
        mean[i], variance[i] = frame[i], 1.0
    found: float = top + np.log(total / jumps.size)
    return found


@njit_part
def _to_chances(logs: Float) -> None:
    """Convert log probabilities to probabilities that sum to 1."""
    top, total = -np.inf, 0.0
    for j in range(logs.size):
        top = max(top, logs[j])
    for j in range(logs.size):
        logs[j] = np.exp(logs[j] - top)
        total += logs[j]
    for j in range(logs.size):
        logs[j] /= total


@njit_part
def _add(mean: float, variance: float, mode: Float, filtered: Float, noise: Float) -> None:
    """Add the contribution of a mode to the filtered readings and to their noise."""
    for k in range(mode.size):
        filtered[k] += mean * mode[k]
        noise[k] += variance * mode[k] * mode[k]


@njit
def filter_frame(table: NDArray[np.int64], least: float) -> float:
    """Filter a frame; return the probability that the skin jumped, in which case earlier frames are invalid.

    Args:
        table: Table of :class:`FilterArrays`.
        least: Minimum variance of a mode.
    """
    its = arrays_of(table)
    modes, share, weight, frame = its.modes, its.share, its.weight, its.modal
    state, variance = its.state, its.variance
    after, spread, chance = its.next_state, its.next_variance, its.next_chance
    filtered, noise = its.filtered, its.noise
    speeds, jumps, unexplained, total = its.speeds, its.jumps, its.unexplained, its.total
    expected, mixture, start_of = its.expected, its.mixture, its.start_of
    banks, m = state.shape
    multiply_vector(modes, its.frame, frame)
    _mix(its.switch, its.chance, mixture, expected)
    for j in range(banks):
        for b in range(banks):
            start_of[b] = mixture[b, j]
        for i in range(m):
            after[j, i], spread[j, i] = _merge(start_of, state, variance, i)
        if j < speeds.size:
            found = _update(frame, share, speeds[j], least, after[j], spread[j])
        else:
            found = _forget(frame, share, jumps, unexplained, after[j], spread[j])
        chance[j] = np.log(expected[j]) + found
    _to_chances(chance)
    for k in range(m):
        filtered[k] = noise[k] = 0.0
    for i in range(m):
        mean, wide = _merge(chance, after, spread, i)
        _add(mean, wide * weight[i], modes[i], filtered, noise)
    for k in range(m):
        noise[k] /= total[k]
    jumped: float = chance[banks - 1]
    return jumped
