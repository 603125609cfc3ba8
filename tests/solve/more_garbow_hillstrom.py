"""Problems of Moré, Garbow & Hillstrom, Testing unconstrained optimization software, ACM TOMS 7, 17-41, 1981.

Each function returns r (m,) and ∂r/∂x (m, n) for x (n,), in the precision of x. The numbers are the equation
numbers of the paper's section 3. ``test_more_garbow_hillstrom.py`` compares every Jacobian with differences
in 80-bit arithmetic, and every published minimum with a minimum found by SciPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from skinnode import PointKind

Vector = np.ndarray
Pair = tuple[Vector, Vector]


def rosenbrock(x: Vector) -> Pair:
    r, j = np.zeros_like(x), np.zeros((x.size, x.size), x.dtype)
    odd = np.arange(0, x.size, 2)
    r[odd], r[odd + 1] = 10 * (x[1::2] - x[::2] ** 2), 1 - x[::2]
    j[odd, odd], j[odd, odd + 1], j[odd + 1, odd] = -20 * x[::2], 10, -1
    return r, j


def freudenstein_roth(x: Vector) -> Pair:
    a, b = x
    r = [-13 + a + ((5 - b) * b - 2) * b, -29 + a + ((b + 1) * b - 14) * b]
    return np.array(r), np.array([[1, (10 - 3 * b) * b - 2], [1, (3 * b + 2) * b - 14]])


def powell_badly_scaled(x: Vector) -> Pair:
    a, b = x
    p, q = np.exp(-x)
    return np.array([1e4 * a * b - 1, p + q - 1.0001]), np.array([[1e4 * b, 1e4 * a], [-p, -q]])


def brown_badly_scaled(x: Vector) -> Pair:
    a, b = x
    return np.array([a - 1e6, b - 2e-6, a * b - 2]), np.array([[1, 0], [0, 1], [b, a]])


def beale(x: Vector) -> Pair:
    (a, b), i = x, np.arange(1, 4)
    power = b**i
    return np.array([1.5, 2.25, 2.625]) - a * (1 - power), np.stack([power - 1, a * i * b ** (i - 1)], 1)


def jennrich_sampson(x: Vector) -> Pair:
    i = np.arange(1.0, 11.0)
    p = np.exp(i[:, None] * x)
    return 2 + 2 * i - p.sum(1), -i[:, None] * p


def helical_valley(x: Vector) -> Pair:
    a, b, c = x
    turn = 2 * np.pi
    theta = np.copysign(0.25, b) if a == 0 else np.arctan(b / a) / turn + (0.5 if a < 0 else 0.0)
    square = a * a + b * b
    radius, slope = np.sqrt(square), 100 / turn / square
    r = [10 * (c - 10 * theta), 10 * (radius - 1), c]
    j = [[slope * b, -slope * a, 10], [10 * a / radius, 10 * b / radius, 0], [0, 0, 1]]
    return np.array(r), np.array(j)


BARD = np.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39])


def bard(x: Vector) -> Pair:
    a, b, c = x
    u = np.arange(1.0, 16.0)
    v, w = 16 - u, np.minimum(u, 16 - u)
    d = v * b + w * c
    return BARD - (a + u / d), np.stack([-np.ones_like(d), u * v / d**2, u * w / d**2], 1)


GAUSS = np.array([9, 44, 175, 540, 1295, 2420, 3521, 3989, 3521, 2420, 1295, 540, 175, 44, 9]) / 1e4


def gaussian(x: Vector) -> Pair:
    a, b, c = x
    away = (8 - np.arange(1.0, 16.0)) / 2 - c
    p = np.exp(-b * away**2 / 2)
    return a * p - GAUSS, np.stack([p, -a * p * away**2 / 2, a * b * p * away], 1)


MEYER = np.array(
    [34780, 28610, 23650, 19630, 16370, 13720, 11540, 9744, 8261, 7030, 6005, 5147, 4427, 3820, 3307, 2872]
)


def meyer(x: Vector) -> Pair:
    a, b, c = x
    t = 45 + 5 * np.arange(1.0, 17.0) + c
    p = np.exp(b / t)
    return a * p - MEYER, np.stack([p, a * p / t, -a * b * p / t**2], 1)


def gulf(x: Vector) -> Pair:
    """The paper prints |yᵢ m i x₂|, a misprint for |yᵢ − x₂|, with which its root (50, 25, 1.5) is a root."""
    a, b, c = x
    t = np.arange(1, 100) / 100
    away = 25 + (-50 * np.log(t)) ** (2 / 3) - b
    p = np.abs(away) ** c / a
    e = np.exp(-p)
    return e - t, np.stack([e * p / a, e * p * c / away, -e * p * np.log(np.abs(away))], 1)


def box(x: Vector) -> Pair:
    a, b, c = x
    t = np.arange(1, 11) / 10
    known = np.exp(-t) - np.exp(-10 * t)
    p, q = np.exp(-t * a), np.exp(-t * b)
    return p - q - c * known, np.stack([-t * p, t * q, -known + 0 * p], 1)


def powell_singular(x: Vector) -> Pair:
    r, j = np.zeros_like(x), np.zeros((x.size, x.size), x.dtype)
    for k in range(0, x.size, 4):
        a, b, c, d = x[k : k + 4]
        r[k : k + 4] = a + 10 * b, np.sqrt(5) * (c - d), (b - 2 * c) ** 2, np.sqrt(10) * (a - d) ** 2
        j[k, k : k + 2], j[k + 1, k + 2], j[k + 1, k + 3] = (1, 10), np.sqrt(5), -np.sqrt(5)
        j[k + 2, k + 1], j[k + 2, k + 2] = 2 * (b - 2 * c), -4 * (b - 2 * c)
        j[k + 3, k], j[k + 3, k + 3] = 2 * np.sqrt(10) * (a - d), -2 * np.sqrt(10) * (a - d)
    return r, j


def wood(x: Vector) -> Pair:
    a, b, c, d = x
    f, g = np.sqrt(90), np.sqrt(10)
    r = [10 * (b - a * a), 1 - a, f * (d - c * c), 1 - c, g * (b + d - 2), (b - d) / g]
    return np.array(r), np.array(
        [
            *([-20 * a, 10, 0, 0], [-1, 0, 0, 0], [0, 0, -2 * f * c, f]),
            *([0, 0, -1, 0], [0, g, 0, g], [0, 1 / g, 0, -1 / g]),
        ]
    )


KOWALIK_Y = np.array([0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246])
KOWALIK_U = np.array([4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])


def kowalik_osborne(x: Vector) -> Pair:
    (a, b, c, d), u = x, KOWALIK_U
    top, below = u**2 + u * b, u**2 + u * c + d
    return KOWALIK_Y - a * top / below, np.stack(
        [-top / below, -a * u / below, a * top * u / below**2, a * top / below**2], 1
    )


def brown_dennis(x: Vector) -> Pair:
    a, b, c, d = x
    t = np.arange(1.0, 21.0) / 5
    p, q = a + t * b - np.exp(t), c + d * np.sin(t) - np.cos(t)
    return p**2 + q**2, 2 * np.stack([p, p * t, q, q * np.sin(t)], 1)


OSBORNE_1 = np.array(
    [844, 908, 932, 936, 925, 908, 881, 850, 818, 784, 751, 718, 685, 658, 628, 603, 580, 558, 538, 522,
     506, 490, 478, 467, 457, 448, 438, 431, 424, 420, 414, 411, 406]
) / 1e3  # fmt: skip


def osborne_1(x: Vector) -> Pair:
    t = 10 * np.arange(33.0)
    p, q = np.exp(-t * x[3]), np.exp(-t * x[4])
    j = np.stack([-np.ones_like(p), -p, -q, x[1] * t * p, x[2] * t * q], 1)
    return OSBORNE_1 - (x[0] + x[1] * p + x[2] * q), j


def biggs(x: Vector) -> Pair:
    t = np.arange(1, 14) / 10
    y = np.exp(-t) - 5 * np.exp(-10 * t) + 3 * np.exp(-4 * t)
    p, q, s = np.exp(-t * x[0]), np.exp(-t * x[1]), np.exp(-t * x[4])
    j = np.stack([-t * x[2] * p, t * x[3] * q, p, -q, -t * x[5] * s, s], 1)
    return x[2] * p - x[3] * q + x[5] * s - y, j


OSBORNE_2 = np.array(
    [1366, 1191, 1112, 1013, 991, 885, 831, 847, 786, 725, 746, 679, 608, 655, 616, 606, 602, 626, 651,
     724, 649, 649, 694, 644, 624, 661, 612, 558, 533, 495, 500, 423, 395, 375, 372, 391, 396, 405, 428,
     429, 523, 562, 607, 653, 672, 708, 633, 668, 645, 632, 591, 559, 597, 625, 739, 710, 729, 720, 636,
     581, 428, 292, 162, 98, 54]
) / 1e3  # fmt: skip


def osborne_2(x: Vector) -> Pair:
    t = np.arange(65.0)[:, None] / 10
    height, width = x[:4], x[4:8]
    away = np.concatenate([np.sqrt(t), t - x[8:]], 1)
    p = np.exp(-(away**2) * width)
    j = np.concatenate([-p, height * away**2 * p, -2 * (height * width * away * p)[:, 1:]], 1)
    return OSBORNE_2 - p @ height, j


def watson(x: Vector) -> Pair:
    t, k = np.arange(1, 30)[:, None] / 29, np.arange(x.size)
    power = t**k
    lower = np.concatenate([np.zeros((29, 1)), k[1:] * power[:, :-1]], 1)
    value = power @ x
    r = np.concatenate([lower @ x - value**2 - 1, [x[0], x[1] - x[0] ** 2 - 1]])
    j = np.concatenate([lower - 2 * value[:, None] * power, np.zeros((2, x.size))])
    j[29, 0], j[30, 0], j[30, 1] = 1, -2 * x[0], 1
    return r, j


def penalty_1(x: Vector) -> Pair:
    share = np.sqrt(1e-5)
    return np.append(share * (x - 1), x @ x - 0.25), np.vstack([share * np.eye(x.size), 2 * x])


def penalty_2(x: Vector) -> Pair:
    n, share = x.size, np.sqrt(1e-5)
    i, p, weight = np.arange(2, n + 1), np.exp(x / 10), np.arange(n, 0, -1)
    y = np.exp(i / 10) + np.exp((i - 1) / 10)
    parts = [x[:1] - 0.2, share * (p[1:] + p[:-1] - y), share * (p[1:] - np.exp(-0.1)), [weight @ x**2 - 1]]
    slope = share / 10 * np.diag(p)
    j = np.vstack([np.eye(1, n), slope[1:] + slope[:-1], slope[1:], 2 * weight * x])
    return np.concatenate(parts), j


def variably_dimensioned(x: Vector) -> Pair:
    weight = np.arange(1, x.size + 1)
    total = weight @ (x - 1)
    j = np.vstack([np.eye(x.size), weight + 0 * x, 2 * total * weight])
    return np.concatenate([x - 1, [total, total**2]]), j


def trigonometric(x: Vector) -> Pair:
    i = np.arange(1, x.size + 1)
    r = x.size - np.cos(x).sum() + i * (1 - np.cos(x)) - np.sin(x)
    return r, np.tile(np.sin(x), (x.size, 1)) + np.diag(i * np.sin(x) - np.cos(x))


def brown_almost_linear(x: Vector) -> Pair:
    n = x.size
    j = np.ones((n, n), x.dtype) + np.eye(n)
    j[-1] = np.where(np.eye(n) > 0, 1, x).prod(1)
    return np.append(x[:-1] + x.sum() - (n + 1), np.prod(x) - 1), j


def discrete_boundary_value(x: Vector) -> Pair:
    n, h = x.size, 1 / (x.size + 1)
    cubed = x + h * np.arange(1, n + 1) + 1
    around = np.concatenate([[0], x, [0]])
    j = np.diag(2 + 1.5 * h**2 * cubed**2) - np.eye(n, k=1) - np.eye(n, k=-1)
    return 2 * x - around[:-2] - around[2:] + h**2 * cubed**3 / 2, j


def discrete_integral(x: Vector) -> Pair:
    n, h = x.size, 1 / (x.size + 1)
    t = h * np.arange(1, n + 1)
    kernel = h / 2 * np.minimum.outer(t, t) * (1 - np.maximum.outer(t, t))
    return x + kernel @ (x + t + 1) ** 3, np.eye(n) + 3 * kernel * (x + t + 1) ** 2


def broyden_tridiagonal(x: Vector) -> Pair:
    around = np.concatenate([[0], x, [0]])
    j = np.diag(3 - 4 * x) - np.eye(x.size, k=-1) - 2 * np.eye(x.size, k=1)
    return (3 - 2 * x) * x - around[:-2] - 2 * around[2:] + 1, j


def broyden_banded(x: Vector) -> Pair:
    near = np.tri(x.size, k=1) - np.tri(x.size, k=-6) - np.eye(x.size)
    return x * (2 + 5 * x**2) + 1 - near @ (x * (1 + x)), np.diag(2 + 15 * x**2) - near * (1 + 2 * x)


def linear_full_rank(x: Vector) -> Pair:
    m = 2 * x.size
    j = np.eye(m, x.size) - 2 / m
    return j @ x - 1, j + 0 * x


def linear_rank_1(x: Vector) -> Pair:
    j = np.outer(np.arange(1.0, 2 * x.size + 1), np.arange(1.0, x.size + 1))
    return j @ x - 1, j + 0 * x


def linear_rank_1_with_zeros(x: Vector) -> Pair:
    j = np.outer(np.arange(2.0 * x.size), np.arange(1.0, x.size + 1))
    j[-1], j[:, 0], j[:, -1] = 0, 0, 0
    return j @ x - 1, j + 0 * x


def chebyquad(x: Vector) -> Pair:
    n, y = x.size, 2 * x - 1
    values, slopes = np.empty((n, n), x.dtype), np.empty((n, n), x.dtype)
    before, slope_before, value, slope = np.ones_like(y), np.zeros_like(y), y, np.ones_like(y)
    for i in range(n):
        values[i], slopes[i] = value, slope
        before, slope_before, value, slope = (
            *(value, slope, 2 * y * value - before),
            2 * value + 2 * y * slope - slope_before,
        )
    r = values.mean(axis=1)
    r[1::2] += x.dtype.type(1) / (np.arange(2, n + 1, 2) ** 2 - 1)
    return r, 2 * slopes / n


@dataclass(frozen=True)
class Problem:
    """A problem of the paper at one size."""

    number: int
    """Equation number in section 3."""
    pair: Callable[[Vector], Pair]
    x0: tuple[float, ...]
    """Standard starting point."""
    least: float = 0.0
    """Published minimum of Σ r²; 0 for a root."""

    @property
    def name(self) -> str:
        return f"{self.number} {self.pair.__name__} {len(self.x0)}"

    def start(self, factor: float) -> Vector:
        """Standard start times 1, 10 or 100; the origin becomes (factor, …), as in MINPACK's own tests."""
        x = factor * np.array(self.x0)
        return x if x.any() or factor == 1 else np.full_like(x, factor)

    @property
    def square(self) -> bool:
        return self.residual(self.start(1)).size == len(self.x0)

    def residual(self, x: Vector) -> Vector:
        return self.pair(x)[0]

    def jacobian(self, x: Vector) -> Vector:
        return self.pair(x)[1]


def _grid(n: int) -> Vector:
    return np.arange(1, n + 1) / (n + 1)


_BENT = tuple(_grid(10) * (_grid(10) - 1))

PROBLEMS = (
    Problem(1, rosenbrock, (-1.2, 1)),
    Problem(2, freudenstein_roth, (0.5, -2)),
    Problem(3, powell_badly_scaled, (0, 1)),
    Problem(4, brown_badly_scaled, (1, 1)),
    Problem(5, beale, (1, 1)),
    Problem(6, jennrich_sampson, (0.3, 0.4), 124.362),
    Problem(7, helical_valley, (-1, 0, 0)),
    Problem(8, bard, (1, 1, 1), 8.21487e-3),
    Problem(9, gaussian, (0.4, 1, 0), 1.12793e-8),
    Problem(10, meyer, (0.02, 4000, 250), 87.9458),
    Problem(11, gulf, (5, 2.5, 0.15)),
    Problem(12, box, (0, 10, 20)),
    Problem(13, powell_singular, (3, -1, 0, 1)),
    Problem(14, wood, (-3, -1, -3, -1)),
    Problem(15, kowalik_osborne, (0.25, 0.39, 0.415, 0.39), 3.07505e-4),
    Problem(16, brown_dennis, (25, 5, -5, -1), 85822.2),
    Problem(17, osborne_1, (0.5, 1.5, -1, 0.01, 0.02), 5.46489e-5),
    Problem(18, biggs, (1, 2, 1, 1, 1, 1)),  # and a local minimum, 5.65565e-3
    Problem(19, osborne_2, (1.3, 0.65, 0.65, 0.7, 0.6, 3, 5, 7, 2, 4.5, 5.5), 4.01377e-2),
    Problem(20, watson, (0,) * 6, 2.28767e-3),
    Problem(20, watson, (0,) * 9, 1.39976e-6),
    Problem(20, watson, (0,) * 12, 4.72238e-10),
    Problem(21, rosenbrock, (-1.2, 1) * 5),
    Problem(22, powell_singular, (3, -1, 0, 1) * 3),
    Problem(23, penalty_1, (1, 2, 3, 4), 2.24997e-5),
    Problem(23, penalty_1, tuple(range(1, 11)), 7.08765e-5),
    Problem(24, penalty_2, (0.5,) * 4, 9.37629e-6),
    Problem(24, penalty_2, (0.5,) * 10, 2.93660e-4),
    Problem(25, variably_dimensioned, tuple(1 - np.arange(1, 11) / 10)),
    Problem(26, trigonometric, (0.1,) * 10),
    Problem(27, brown_almost_linear, (0.5,) * 10),
    Problem(27, brown_almost_linear, (0.5,) * 30),
    Problem(27, brown_almost_linear, (0.5,) * 40),
    Problem(28, discrete_boundary_value, _BENT),
    Problem(29, discrete_integral, _BENT),
    Problem(30, broyden_tridiagonal, (-1,) * 10),
    Problem(31, broyden_banded, (-1,) * 10),
    Problem(32, linear_full_rank, (1,) * 10, 10),
    Problem(33, linear_rank_1, (1,) * 10, 20 * 19 / (2 * 41)),
    Problem(34, linear_rank_1_with_zeros, (1,) * 10, (20**2 + 3 * 20 - 6) / (2 * 37)),
    Problem(35, chebyquad, tuple(_grid(5))),
    Problem(35, chebyquad, tuple(_grid(6))),
    Problem(35, chebyquad, tuple(_grid(7))),
    Problem(35, chebyquad, tuple(_grid(8)), 3.51687e-3),
    Problem(35, chebyquad, tuple(_grid(9))),
    Problem(35, chebyquad, tuple(_grid(10)), 6.50395e-3),
)
FACTORS = (1, 10, 100)


def solved(problem: Problem, kind: PointKind, norm: float) -> bool:
    """Whether a point of this kind solves the problem: a root or, of a system without one, a minimum."""
    if kind is PointKind.MINIMUM:
        return not problem.square or problem.least > 0
    return kind is PointKind.ROOT or (kind is PointKind.FLAT and 0 < norm**2 <= problem.least * (1 + 5e-6))
