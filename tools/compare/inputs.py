"""Generates the inputs for the comparison of two commits: streams of resistances, and recordings of hands.

The displacements are sums of Gaussian bumps rather than solutions of the elastic model, so that they do not
depend on the code under comparison. The noise has a fixed seed.

Run ``python inputs.py FOLDER`` in the old commit's tree. The script uses only the public API.
"""

from __future__ import annotations

import contextlib
import json
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import skinnode as sk

Float = NDArray[np.float64]

FRAMES = 28
NOISES = {"quiet": 1e-6, "noisy": 1e-3}
RECORDED_S = 3.0

HAND = """
[[buses]]
name = "can0"
interface = "udp_multicast"
channel = "{group}"
[sync]
period_ms = 40

[solver]
method = "{method}"

[[patches]]
name = "palm"
node_id = 5
{tolerances}
layout = {{ preset = "staggered", {sizes} }}

[[patches]]
name = "thumb"
node_id = 6
{tolerances}
layout = {{ preset = "aligned", {sizes} }}
"""
TOLERANCES = 'tolerances = "exact"' if hasattr(sk, "Tolerances") else ""  # older commits do not have this key
SIZES = "upper_wires = 6, upper_electrodes = 4, lower_wires = 12, lower_electrodes = 6"
RECORDINGS = {
    "plain": ("auto", []),
    "posterior": ("posterior", []),
    "lossy": ("auto", ["--fault", "lost=0.01,corrupted=0.002", "--fault", "palm:open_upper=3"]),
    "restarts": ("auto", ["--fault", "thumb:restart_every_s=1"]),
}


def layouts() -> dict[str, sk.PatchLayout]:
    """Return two preset layouts, one bent around a cylinder, and two with different numbers of wires."""
    flat = sk.PatchLayout.preset("staggered")
    middle, radius_m = flat.upper_m[..., 0].mean(), 25e-3

    def bent(points_m: Float) -> Float:
        angle, r = (points_m[..., 0] - middle) / radius_m, radius_m + points_m[..., 2]
        return np.stack([r * np.sin(angle), points_m[..., 1], r * np.cos(angle) - radius_m], axis=-1)

    return {
        "staggered": flat,
        "aligned": sk.PatchLayout.preset("aligned"),
        "curved": sk.PatchLayout(bent(flat.upper_m), bent(flat.lower_m), 1e7),
        "other counts": sk.PatchLayout.preset(
            "staggered", upper_wires=7, upper_electrodes=5, lower_wires=21, lower_electrodes=4
        ),
        "few lower wires": sk.PatchLayout.preset(
            "staggered", upper_wires=6, upper_electrodes=4, lower_wires=9, lower_electrodes=6
        ),
    }


def displacements(layout: sk.PatchLayout) -> Float:
    """Return the displacements (T, U, N, 3) in metres for two sliding presses that overlap in time."""
    pitch, height = layout.pitch_m, layout.height_m
    x, y = layout.upper_m[..., 0], layout.upper_m[..., 1]
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    truth = np.zeros((FRAMES, *layout.upper_m.shape))
    for t in range(3, FRAMES - 4):
        share = min(1.0, (t - 2) / 8.0)
        for turn, (where, depth) in enumerate((((0.35, 0.4), 0.18), ((0.75, 0.7), 0.07))):
            if turn and t < 12:
                continue
            cx, cy = low + (high - low) * np.array([where[0] + 0.012 * t, where[1]])
            bump = np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2.0 * (1.3 * pitch) ** 2))
            truth[t, ..., 2] -= share * depth * height * bump
            truth[t, ..., 0] += 0.2 * share * depth * height * bump * (x - cx) / pitch
            truth[t, ..., 1] += 0.05 * share * depth * height * bump
    return truth


def streams() -> dict[str, Float]:
    """Return streams (T, U, K) of resistances, without faults (``…/ohm``) and with faults (``…/faulty``)."""
    made: dict[str, Float] = {}
    for number, (name, layout) in enumerate(layouts().items()):
        exact = np.array([sk.resistance_ohm(layout, layout.upper_m + d) for d in displacements(layout)])
        made[f"{name}/baseline"] = sk.resistance_ohm(layout, layout.upper_m) * 1.01
        for turn, (noise_name, noise) in enumerate(NOISES.items()):
            rng = np.random.default_rng([number, turn])
            ohm = exact * (1.0 + noise * rng.standard_normal(exact.shape))
            made[f"{name}/{noise_name}/ohm"] = ohm
            faulty = ohm.copy()
            faulty[6:9, 2] = np.nan  # readings of an upper wire are missing
            faulty[10:14, :, 4] = np.inf  # a lower wire is open
            faulty[15] = np.nan  # all readings are missing
            faulty[17, 1, :5] = 0.0
            faulty[19, 3, 7] *= 1.1  # one reading is wrong
            faulty[20:, 4] = faulty[19, 4]  # an upper wire is frozen
            made[f"{name}/{noise_name}/faulty"] = faulty
    return made


def record(folder: Path, name: str) -> None:
    """Record a simulated hand by running ``vcan-sim`` and ``skinnode record``."""
    method, faults = RECORDINGS[name]
    group = f"239.74.{random.randrange(256)}.{random.randrange(1, 255)}"
    hand = folder / f"{name}.toml"
    hand.write_text(HAND.format(group=group, method=method, sizes=SIZES, tolerances=TOLERANCES), "utf-8")
    run = [sys.executable, "-c", "import sys; from {0} import main; sys.exit(main())"]
    simulator = [*run[:2], run[2].format("vcan_sim.cli"), str(hand), *faults]
    recorder = [
        *run[:2],
        run[2].format("skinnode.cli.main"),
        "record",
        str(hand),
        "--seconds",
        str(RECORDED_S),
    ]
    with subprocess.Popen(simulator, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            file = folder / f"{name}.log"
            done = subprocess.run([*recorder, "-o", str(file)], capture_output=True, text=True, timeout=900)
            if not file.exists() or file.stat().st_size < 10_000:
                raise SystemExit(f"{name}: no recording: {done.stdout[-300:]}{done.stderr[-300:]}")
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=20)


def main() -> None:
    folder = Path(sys.argv[1])
    np.savez(folder / "streams.npz", **streams())
    shapes = {
        name: {"upper_m": layout.upper_m.tolist(), "lower_m": layout.lower_m.tolist()}
        for name, layout in layouts().items()
    }
    (folder / "layouts.json").write_text(json.dumps(shapes), "utf-8")
    for name in RECORDINGS:
        record(folder, name)


if __name__ == "__main__":
    main()
