"""Compute a commit's results for given inputs, and save them as named arrays.

Run ``python outputs.py FOLDER OUT.npz [PART ...]`` in the source tree of the commit. The script uses only the
public API and the command line, so it runs on both of the commits being compared.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import skinnode as sk

Arrays = dict[str, NDArray[Any]]
NOISES = {"quiet": 1e-6, "noisy": 1e-3}


def field_arrays(field: sk.FieldFrame) -> Arrays:
    """Convert a field, except its timestamps, to named arrays."""
    found: Arrays = {
        "status": np.array([int(each) for each in field.status]),
        "counts": np.array([field.stats.evaluations, field.stats.jacobians, field.stats.steps]),
        "contacts": np.array(
            [
                [
                    *each.centroid_m, *each.centroid_std_m, each.area_m2, each.area_std_m2,
                    each.normal_force_n, each.normal_force_std_n,
                    *each.shear_force_n, *each.shear_force_std_n,
                ]
                for each in field.contacts
            ]
        ),
        "noise_factor": np.array(field.noise_factor),
    }  # fmt: skip
    names = (
        "displacement_m",
        "displacement_std_m",
        "residual",
        "force_n",
        "by_prior",
        "gain",
        "held",
        "core_std_m",
    )
    for name in names:
        value = getattr(field, name)
        if value is not None:
            found[name] = np.asarray(value)
    return found


def stacked(fields: list[sk.FieldFrame]) -> Arrays:
    """Stack a stream's fields into one array per quantity; concatenate arrays that differ in shape."""
    each = [field_arrays(field) for field in fields]
    found: Arrays = {}
    for name in sorted({name for one in each for name in one}):
        values = [one[name] for one in each if name in one]
        if len({value.shape for value in values}) == 1:
            found[name] = np.array(values)
        else:
            found[name] = np.concatenate([value.ravel() for value in values])
            found[f"{name} sizes"] = np.array([value.size for value in values])
    return found


def follow(tracker: sk.Tracker | sk.Posterior, ohm: NDArray[np.float64]) -> Arrays:
    valid = np.ones(ohm.shape[1:], np.bool_)
    valid[0, 1:3] = False
    return stacked([tracker.update(frame, valid if t == 5 else None) for t, frame in enumerate(ohm)])


def trackers(layout: sk.PatchLayout, noise: float, baseline: Any, square: bool) -> Iterator[tuple[str, Any]]:
    def made(**options: Any) -> sk.Tracker:
        return sk.Tracker(layout, relative_noise=noise, **options)

    if square:
        yield "exact", made(method="exact")
        yield "exact dogleg", made(method="exact", operator="dogleg")
        yield "exact gauss-newton", made(method="exact", operator="gauss_newton", hold=False)
        yield "exact stiffness", made(method="exact", stiffness_n_per_m=300.0, baseline_ohm=baseline)
        yield "exact active only", made(method="exact", active_only=True)
    yield "exact normal only", made(method="exact", normal_only=True)
    yield "auto", made()
    yield "posterior", made(method="posterior")
    yield "posterior drift", sk.Posterior(layout, relative_noise=noise, drift="wire", baseline_ohm=baseline)
    yield "posterior noise", sk.Posterior(layout, relative_noise=noise, estimate_noise=True, drift="patch")
    yield "posterior model", sk.Posterior(layout, relative_noise=noise, model_error=0.03, hold=False)
    yield "posterior normal", sk.Posterior(layout, relative_noise=noise, normal_only=True, contacts=False)


def _layouts(folder: Path) -> dict[str, sk.PatchLayout]:
    kept = json.loads((folder / "layouts.json").read_text("utf-8"))
    return {
        name: sk.PatchLayout(np.array(each["upper_m"]), np.array(each["lower_m"]), 1e7)
        for name, each in kept.items()
    }


def model(folder: Path) -> Iterator[tuple[str, Arrays]]:
    rng = np.random.default_rng(1)
    for name, layout in _layouts(folder).items():
        moved = layout.upper_m + 0.1 * layout.height_m * rng.standard_normal(layout.upper_m.shape)
        yield (
            name,
            {
                "resistance_ohm": sk.resistance_ohm(layout, moved),
                "jacobian": sk.jacobian(layout, moved),
                "hash": np.array(layout.layout_hash),
            },
        )
    for preset in ("aligned", "symmetric", "staggered"):
        layout = sk.PatchLayout.preset(preset)
        yield f"preset {preset}", {"upper_m": layout.upper_m, "lower_m": layout.lower_m}


def streams(folder: Path) -> Iterator[tuple[str, Arrays]]:
    kept = np.load(folder / "streams.npz")
    for name, layout in _layouts(folder).items():
        for noise_name, noise in NOISES.items():
            for kind in ("ohm", "faulty"):
                ohm = kept[f"{name}/{noise_name}/{kind}"]
                square = layout.shape[1] >= layout.unknowns
                for method, tracker in trackers(layout, noise, kept[f"{name}/baseline"], square):
                    yield f"{name}, {noise_name}, {kind}, {method}", follow(tracker, ohm)


def paths(folder: Path) -> Iterator[tuple[str, Arrays]]:
    kept = np.load(folder / "streams.npz")
    schedules = {
        "uniform": sk.Uniform(),
        "plain": sk.Uniform(steps=5, plain=True),
        "periodic": sk.Periodic(),
        "adaptive": sk.Adaptive(),
    }
    for name, layout in _layouts(folder).items():
        if layout.shape[1] < layout.unknowns:
            continue
        ohm = kept[f"{name}/quiet/ohm"][3:22]
        for operator in ("dogleg", "levenberg_marquardt", "gauss_newton"):
            for schedule_name, schedule in schedules.items():
                path = sk.solve_path(layout, ohm, operator=operator, schedule=schedule)
                yield (
                    f"{name}, {operator}, {schedule_name}",
                    {
                        "status": np.array([int(each) for each in path.status]),
                        "counts": np.array([path.stats.evaluations, path.stats.jacobians, path.stats.steps]),
                        "cycle": np.array([path.cycle or 0, path.searched]),
                        **{
                            each: getattr(path, each)
                            for each in (
                                *("upper_m", "displacement_m", "error_estimate_m", "residual", "position"),
                                *("steps", "evaluations", "optimality"),
                            )
                        },
                    },
                )


def systems(_folder: Path) -> Iterator[tuple[str, Arrays]]:
    def rosenbrock(x: Any) -> Any:
        return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    def rosenbrock_jacobian(x: Any) -> Any:
        return np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])

    def powell(x: Any) -> Any:
        return np.array(
            [x[0] + 10 * x[1], 5**0.5 * (x[2] - x[3]), (x[1] - 2 * x[2]) ** 2, 10**0.5 * (x[0] - x[3]) ** 2]
        )

    def powell_jacobian(x: Any) -> Any:
        a, b = 2 * (x[1] - 2 * x[2]), 2 * 10**0.5 * (x[0] - x[3])
        return np.array(
            [[1, 10, 0, 0], [0, 0, 5**0.5, -(5**0.5)], [0, a, -2 * a, 0], [b, 0, 0, -b]], dtype=float
        )

    def tall(x: Any) -> Any:
        return np.array([x[0] - 1.0, x[1] - 2.0, x[0] * x[1] - 3.0])

    def tall_jacobian(x: Any) -> Any:
        return np.array([[1.0, 0.0], [0.0, 1.0], [x[1], x[0]]])

    cases: list[tuple[str, Callable[..., Any], Callable[..., Any], list[float]]] = [
        ("rosenbrock", rosenbrock, rosenbrock_jacobian, [-1.2, 1.0]),
        ("powell", powell, powell_jacobian, [3.0, -1.0, 0.0, 1.0]),
        ("tall", tall, tall_jacobian, [0.5, 0.5]),
    ]
    for name, residual, jacobian, x0 in cases:
        for operator in ("dogleg", "levenberg_marquardt", "gauss_newton"):
            found = sk.solve_system(residual, jacobian, x0, operator)
            yield (
                f"{name}, {operator}",
                {
                    "x": np.asarray(found.x),
                    "status": np.array(int(found.status)),
                    "counts": np.array([found.stats.evaluations, found.stats.jacobians, found.stats.steps]),
                },
            )


def recordings(folder: Path) -> Iterator[tuple[str, Arrays]]:
    for recording in sorted(folder.glob("*.log")):
        by_patch: dict[str, list[sk.FieldFrame]] = {}
        for field in sk.replay(recording):
            assert field.stamp is not None
            by_patch.setdefault(field.stamp.patch, []).append(field)
        for patch, fields in sorted(by_patch.items()):
            stamps = [field.stamp for field in fields if field.stamp is not None]
            scans = [(each.scan, each.counter, each.device_time_us) for each in stamps]
            yield f"{recording.stem}, {patch}", {**stacked(fields), "scans": np.array(scans)}


def commands(_folder: Path) -> Iterator[tuple[str, Arrays]]:
    """Yield the output of commands that generate EDS, DCF and hand files or list conformance cases."""
    code = "import sys; from skinnode.cli.main import main; sys.exit(main())"
    for text in (
        *("eds", "eds --code-bits 24 --fd", "eds --upper-wires 7 --lower-wires 21 --lower-electrodes 4"),
        *("eds --dcf --node-id 5", "hand new --buses 2 --patches 4", "conformance --list"),
    ):
        done = subprocess.run([sys.executable, "-c", code, *text.split()], capture_output=True, check=True)
        yield text, {"bytes": np.frombuffer(done.stdout, np.uint8)}


PARTS = {
    "model": model,
    "systems": systems,
    "streams": streams,
    "paths": paths,
    "recordings": recordings,
    "commands": commands,
}


def main() -> None:
    folder, out, *parts = sys.argv[1:]
    made: Arrays = {}
    for part in parts or PARTS:
        for case, arrays in PARTS[part](Path(folder)):
            made |= {f"{part}: {case}: {name}": array for name, array in arrays.items()}
    buffer = io.BytesIO()
    np.savez(buffer, **made)
    Path(out).write_bytes(buffer.getvalue())


if __name__ == "__main__":
    main()
