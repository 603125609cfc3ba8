"""Measure the errors due to a wrong model, for the section "Limits" of docs/solver.md.

    .venv/bin/python docs/wrong_models.py [SEEDS]

The script prints three tables. The first contains the wrong models of ``skinnode bench stability`` (case 13),
without and with ``model_error``. The second contains presses on a rubber layer bonded to a rigid base, which
the posterior assumes to be a half-space. The third contains untouched patches whose resistances all have the
same gain error.
"""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
from numpy.typing import NDArray
from scipy.special import j0, j1

import skinnode as sk
from skinnode.bench import stability
from skinnode.bench.case import MODEL_ERROR
from skinnode.bench.cases import all_cases
from skinnode.model.elastic import Rubber

Float = NDArray[np.float64]

WAVES = 6000
"""Number of wave numbers in the integrals; a layer of 1 m then matches a half-space within 0.3 %."""
SHARPEST = 40.0
"""Maximum wave number, multiplied by contact radius or thickness, whichever is smaller."""
DEEP = 20.0
"""Wave number times thickness above which the base has no effect; the effect is of order e⁻²⁰."""
NOISE = 1e-5
SHARES = (1 / 3, 2 / 3, 1.0)


def layer_response(k: Float, thickness_m: float, shear_modulus_pa: float) -> tuple[Float, Float]:
    """Return the surface displacement of an incompressible bonded layer under a pressure of wave number k.

    A pressure cos(k x) displaces the surface by U sin(k x) tangentially and by W cos(k x) normally, m/Pa.
    With Z = k z, the displacement (−f′ sin, f cos) preserves the volume. The function f = C Z sinh Z + D
    (sinh Z − Z cosh Z) solves G ∇²u = ∇p, and vanishes with its slope at the base. The condition of zero
    shear stress at the surface is f″ + f = 0, and the surface pressure is −G k (3 f′ − f‴). In the
    axisymmetric case, the same U and W are the factors of J₁ and J₀.
    """
    z = np.minimum(k * thickness_m, DEEP)
    s, c = np.sinh(z), np.cosh(z)
    first = (z * s, s + z * c, 2 * c + z * s, 3 * s + z * c)  # f, f′, f″, f‴
    second = (s - z * c, -z * s, -s - z * c, -2 * c - z * s)
    a, b = -(second[2] + second[0]), first[2] + first[0]
    f, slope, _, third = (a * one + b * other for one, other in zip(first, second, strict=True))
    pressure = -shear_modulus_pa * k * (3 * slope - third)
    deep = k * thickness_m >= DEEP
    along = np.where(deep, 0.0, -slope / pressure)
    return along, np.where(deep, -0.5 / (shear_modulus_pa * k), f / pressure)


def hertz_displacement(
    points_m: Float, center_m: Float, radius_m: float, thickness_m: float, rubber: Rubber
) -> Float:
    """Return the (P, 3) surface displacement of a bonded layer under the pressure √(1 − r²/a²), peak 1 Pa."""
    k = (np.arange(WAVES) + 0.5) * SHARPEST / min(radius_m, thickness_m) / WAVES
    # Hankel transform of the pressure, multiplied by k dk
    load = (np.sin(k * radius_m) - k * radius_m * np.cos(k * radius_m)) / (k**2 * radius_m) * (k[1] - k[0])
    along, normal = layer_response(k, thickness_m, rubber.shear_modulus_pa)
    gap = points_m - center_m
    r = np.hypot(*gap.T)
    outward = j1(np.outer(r, k)) @ (along * load) / np.maximum(r, 1e-12)
    return np.column_stack([outward[:, None] * gap, j0(np.outer(r, k)) @ (normal * load)])


def press_layers(seeds: int) -> None:
    """Print one line per depth and thickness, with means over ``seeds`` presses by fingertip-sized bodies."""
    layout = sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
    rubber = Rubber()
    points = layout.upper_m[..., :2].reshape(-1, 2)
    rest = sk.resistance_ohm(layout, layout.upper_m)
    posterior = sk.Posterior(layout, relative_noise=NOISE, baseline_ohm=rest, rubber=rubber)
    exact = sk.Tracker(layout, method="exact", relative_noise=NOISE, baseline_ohm=rest)
    print(
        "\nBonded layer, staggered, h = 0.5 (2 mm), noise 1e-5; errors over the wires CONVERGED\n"
        f"{'press':>6}{'layer':>9}{'exact':>8}{'conv.':>7}{'wrong':>7}{'posterior':>11}{'reported':>10}"
        f"{'conv.':>7}{'in 95 %':>9}{'wrong':>7}{'force / true':>14}{'reported':>10}"
    )
    for depth in (0.1, 0.3):
        for thickness_m in (2e-3, 4e-3, 8e-3, 16e-3, 1.0):
            rows = []
            for seed in range(seeds):
                rng = np.random.default_rng(seed)
                center, radius = rng.uniform(8e-3, 28e-3, 2), float(rng.uniform(6e-3, 10e-3))
                moved = hertz_displacement(points, center, radius, thickness_m, rubber)
                pascal = depth * layout.height_m / np.abs(moved[:, 2]).max()
                truth = pascal * moved.reshape(layout.upper_m.shape)
                posterior.reset()
                exact.reset()
                for share in SHARES:
                    clean = sk.resistance_ohm(layout, layout.upper_m + share * truth)
                    frame = clean * (1.0 + NOISE * rng.standard_normal(clean.shape))
                    found, inverted = posterior.update(frame), exact.update(frame)
                force = pascal * 2 / 3 * np.pi * radius**2
                errors = [*_error(inverted, truth), *_error(found, truth)]
                rows.append([*errors, *_force(found, force)])
            table = np.array(rows)
            mean, total = np.nanmean(table, axis=0), np.nansum(table, axis=0)
            print(
                f"{depth:6.0%}{1e3 * thickness_m:6g} mm{mean[0]:8.1%}{mean[1]:7.0%}{total[4]:7.0f}"
                f"{mean[5]:11.1%}{mean[7]:10.1%}{mean[6]:7.0%}{mean[8]:9.1%}{total[9]:7.0f}"
                f"{mean[10]:14.2f}{mean[11]:10.2f}"
            )
    print(f"wrong: of {10 * seeds} wires, those CONVERGED with a coordinate beyond 5 deviations")


def _error(field: sk.FieldFrame, truth: Float) -> tuple[float, float, float, float, float]:
    """Return error, fraction of CONVERGED wires, standard deviation, coverage, and number of wrong wires."""
    used = np.array([status is sk.Status.CONVERGED for status in field.status])
    if not used.any():
        return np.nan, 0.0, np.nan, np.nan, np.nan
    error, std, size = (field.displacement_m - truth)[used], field.displacement_std_m[used], truth[used]
    inside = float((np.abs(error) <= field.half_width_95_m[used]).mean())
    shares = (float(np.linalg.norm(each) / np.linalg.norm(size)) for each in (error, std))
    wrong = float((np.abs(error) > 5.0 * std).any(axis=(1, 2)).sum())
    return next(shares), float(used.mean()), next(shares), inside, wrong


def _force(field: sk.FieldFrame, true_n: float) -> tuple[float, float]:
    """Return normal force and its standard deviation, divided by the true force; NaN without contacts."""
    if not field.contacts:
        return np.nan, np.nan
    std = np.sqrt(sum(contact.normal_force_std_n**2 for contact in field.contacts))
    return sum(contact.normal_force_n for contact in field.contacts) / true_n, float(std) / true_n


def drift_gains() -> None:
    """Print one line per gain and solver, with the apparent displacement of an untouched patch."""
    layout = sk.PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
    rest = sk.resistance_ohm(layout, layout.upper_m)
    solvers: dict[str, sk.Tracker | sk.Posterior] = {
        "exact": sk.Tracker(layout, method="exact", relative_noise=NOISE, baseline_ohm=rest),
        "posterior": sk.Posterior(layout, relative_noise=NOISE, baseline_ohm=rest),
        'posterior, drift="patch"': sk.Posterior(
            layout, relative_noise=NOISE, baseline_ohm=rest, drift="patch"
        ),
    }
    print(
        "\nUntouched patch, all R times one gain, staggered, h = 0.5 (2 mm), noise 1e-5\n"
        f"{'gain':>8}  {'solver':26}{'mean z':>10}{'largest':>10}{'reported':>10}{'conv.':>7}{'contacts':>10}"
    )
    for gain in (0.999, 1.001, 0.99, 1.01):
        for name, solver in solvers.items():
            solver.reset()
            noise = 1.0 + NOISE * np.random.default_rng(1).standard_normal(rest.shape)
            field = solver.update(gain * rest * noise)
            moved, std = 1e6 * field.displacement_m, 1e6 * field.displacement_std_m
            used = np.array([status is sk.Status.CONVERGED for status in field.status])
            found = "         -         -         -"
            if used.any():
                found = f"{moved[used, :, 2].mean():7.1f} µm{np.abs(moved[used]).max():7.1f} µm"
                found += f"{np.sqrt(np.mean(std[used] ** 2)):7.1f} µm"
            print(f"{gain:8g}  {name:26}{found}{used.mean():7.0%}{len(field.contacts):10}")


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    print(stability.HEAD)
    for share in (0.0, MODEL_ERROR):
        print(f"model_error={share:g}")
        cases = [dataclasses.replace(case, model_error=share) for case in all_cases() if case.number == 13]
        stability.run(
            seeds,
            cases=cases,
            only=("exact", "posterior"),
            report=lambda row: print(stability.line(row), flush=True),
        )
    press_layers(seeds)
    drift_gains()


if __name__ == "__main__":
    main()
