"""Test systems of the literature: Moré, Garbow, Hillstrom, Testing unconstrained optimization software, 1981.

Written to work on complex numbers, so that the Jacobian is had by the complex step, exact to rounding and
independent of any hand-made derivative (Squire & Trapp 1998).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Vector = np.ndarray


def complex_step(f: Callable[[Vector], Vector]) -> Callable[[Vector], Vector]:
    def jacobian(x: Vector) -> Vector:
        points = x.astype(complex) + 1e-40j * np.eye(x.size)
        return np.array([f(point).imag / 1e-40 for point in points]).T

    return jacobian


@dataclass(frozen=True)
class System:
    name: str
    f: Callable[[Vector], Vector]
    x0: tuple[float, ...]
    minimum: float = 0.0
    """Literature value of Σ f² at the solution; 0 for a root."""
    root: tuple[float, ...] | None = None


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def freudenstein_roth(x):
    return np.array(
        [-13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1], -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1]]
    )


def powell_badly_scaled(x):
    return np.array([1e4 * x[0] * x[1] - 1, np.exp(-x[0]) + np.exp(-x[1]) - 1.0001])


def brown_badly_scaled(x):
    return np.array([x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2])


def helical_valley(x):
    theta = np.arctan(x[1] / x[0]) / (2 * np.pi) + (0.5 if x[0].real < 0 else 0.0)
    return np.array([10 * (x[2] - 10 * theta), 10 * (np.sqrt(x[0] ** 2 + x[1] ** 2) - 1), x[2]])


def powell_singular(x):
    return np.array(
        [
            x[0] + 10 * x[1],
            np.sqrt(5) * (x[2] - x[3]),
            (x[1] - 2 * x[2]) ** 2,
            np.sqrt(10) * (x[0] - x[3]) ** 2,
        ]
    )


def wood(x):
    return np.array(
        [
            10 * (x[1] - x[0] ** 2),
            1 - x[0],
            np.sqrt(90) * (x[3] - x[2] ** 2),
            1 - x[2],
            np.sqrt(10) * (x[1] + x[3] - 2),
            (x[1] - x[3]) / np.sqrt(10),
        ]
    )


BARD_Y = np.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39])


def bard(x):
    u = np.arange(1.0, 16.0)
    v = 16 - u
    return BARD_Y - (x[0] + u / (v * x[1] + np.minimum(u, v) * x[2]))


KOWALIK_Y = np.array([0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246])
KOWALIK_U = np.array([4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])


def kowalik_osborne(x):
    u = KOWALIK_U
    return KOWALIK_Y - x[0] * (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3])


MEYER_Y = np.array(
    [34780, 28610, 23650, 19630, 16370, 13720, 11540, 9744, 8261, 7030, 6005, 5147, 4427, 3820, 3307, 2872]
)


def meyer(x):
    return x[0] * np.exp(x[1] / (45 + 5 * np.arange(1.0, 17.0) + x[2])) - MEYER_Y


def jennrich_sampson(x):
    i = np.arange(1.0, 11.0)
    return 2 + 2 * i - (np.exp(i * x[0]) + np.exp(i * x[1]))


def brown_dennis(x):
    t = np.arange(1.0, 21.0) / 5
    return (x[0] + t * x[1] - np.exp(t)) ** 2 + (x[2] + x[3] * np.sin(t) - np.cos(t)) ** 2


def watson(x):
    t = np.arange(1.0, 30.0)[:, None] / 29
    j = np.arange(x.size)
    value = (x * t**j).sum(axis=1)
    slope = (j[1:] * x[1:] * t ** (j[1:] - 1)).sum(axis=1)
    return np.concatenate([slope - value**2 - 1, [x[0], x[1] - x[0] ** 2 - 1]])


def chebyquad(x):
    n = x.size
    y = 2 * x - 1
    t_before, t = np.ones_like(y), y
    out = []
    for i in range(1, n + 1):
        integral = 0.0 if i % 2 else -1.0 / (i * i - 1)
        out.append(t.mean() - integral)
        t_before, t = t, 2 * y * t - t_before
    return np.array(out)


def brown_almost_linear(x):
    n = x.size
    return np.concatenate([x[:-1] + x.sum() - (n + 1), [x.prod() - 1]])


def discrete_boundary_value(x):
    n = x.size
    h = 1 / (n + 1)
    t = h * np.arange(1, n + 1)
    around = np.concatenate([[0], x, [0]])
    return 2 * x - around[:-2] - around[2:] + h**2 * (x + t + 1) ** 3 / 2


def discrete_integral(x):
    n = x.size
    h = 1 / (n + 1)
    t = h * np.arange(1, n + 1)
    cube = (x + t + 1) ** 3
    below = np.cumsum(t * cube)
    above = np.cumsum(((1 - t) * cube)[::-1])[::-1] - (1 - t) * cube
    return x + h * ((1 - t) * below + t * above) / 2


def trigonometric(x):
    n = x.size
    return n - np.cos(x).sum() + np.arange(1, n + 1) * (1 - np.cos(x)) - np.sin(x)


def broyden_tridiagonal(x):
    around = np.concatenate([[0], x, [0]])
    return (3 - 2 * x) * x - around[:-2] - 2 * around[2:] + 1


def broyden_banded(x):
    n = x.size
    near = x * (1 + x)
    total = np.array([near[max(0, i - 5) : min(n, i + 2)].sum() - near[i] for i in range(n)])
    return x * (2 + 5 * x**2) + 1 - total


def _cheby(n: int) -> System:
    return System(f"chebyquad {n}", chebyquad, tuple(np.arange(1, n + 1) / (n + 1)))


_T10 = np.arange(1, 11) / 11

SQUARE = (
    System("rosenbrock", rosenbrock, (-1.2, 1.0), root=(1.0, 1.0)),
    System("freudenstein-roth near", freudenstein_roth, (4.0, 3.5), root=(5.0, 4.0)),
    System("powell badly scaled", powell_badly_scaled, (0.0, 1.0), root=(1.0981593297e-5, 9.10614673987)),
    System("helical valley", helical_valley, (-1.0, 0.0, 0.0), root=(1.0, 0.0, 0.0)),
    System("powell singular", powell_singular, (3.0, -1.0, 0.0, 1.0), root=(0.0, 0.0, 0.0, 0.0)),
    _cheby(5),
    _cheby(6),
    _cheby(7),
    _cheby(9),
    System("brown almost linear", brown_almost_linear, (0.5,) * 10),
    System("discrete boundary value", discrete_boundary_value, tuple(_T10 * (_T10 - 1))),
    System("discrete integral", discrete_integral, tuple(_T10 * (_T10 - 1))),
    System("trigonometric", trigonometric, (0.1,) * 10),
    System("broyden tridiagonal", broyden_tridiagonal, (-1.0,) * 10),
    System("broyden banded", broyden_banded, (-1.0,) * 10),
)

TALL = (
    System("wood", wood, (-3.0, -1.0, -3.0, -1.0), root=(1.0, 1.0, 1.0, 1.0)),
    System("brown badly scaled", brown_badly_scaled, (1.0, 1.0), root=(1e6, 2e-6)),
    System("bard", bard, (1.0, 1.0, 1.0), 8.21487e-3),
    System("kowalik-osborne", kowalik_osborne, (0.25, 0.39, 0.415, 0.39), 3.07505e-4),
    System("meyer", meyer, (0.02, 4000.0, 250.0), 87.9458),
    System("jennrich-sampson", jennrich_sampson, (0.3, 0.4), 124.362),
    System("brown-dennis", brown_dennis, (25.0, 5.0, -5.0, -1.0), 85822.2),
    System("watson 6", watson, (0.0,) * 6, 2.28767e-3),
    System("watson 9", watson, (0.0,) * 9, 1.39976e-6),
)
