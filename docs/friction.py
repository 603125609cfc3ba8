"""Measure the fields of healthy skin on which a sphere slides with friction, for docs/limits.md.

Run with ``python docs/friction.py [SCENES]``.

In each scene, a rigid sphere presses on a bonded layer of 2 mm and slides 4 to 12 mm. Its radius (3 to 15
mm), force (0.3 to 5 N), friction (0.2 to 1), place and direction are random. The displacements come from the
simulator's contact mechanics, which the solver's prior does not share. The readings have noise, but no fault.
"""

from __future__ import annotations

import sys
from typing import Any, Final

import numpy as np

import skinnode as sk
from skinnode.config import parse_hand
from skinnode.errors import ConfigError
from skinnode.model.layout import Float
from vcan_sim.scenes import bind_scene, load_scene, parse_scene
from vcan_sim.scenes.library import shipped_scenes

ROWS: Final = (
    (3e-6, "cells"),
    (1e-5, "cells"),
    (1e-4, "cells"),
    (1e-4, "discs"),
    (1e-3, "cells"),
    (1e-3, "discs"),
)
"""Relative noise of the readings, and prior."""
SCENES: Final = 60
TIMES_S: Final = np.arange(0.6, 3.0, 0.12)
LIMIT: Final = 5.0
"""Maximum error of a coordinate of a trusted field, in reported standard deviations."""
LAYOUT: Final = sk.PatchLayout.preset("staggered")
HAND: Final = parse_hand(
    {
        "buses": [{"name": "can0", "interface": "virtual", "channel": "friction"}],
        "patches": [{"name": "palm", "node_id": 1, "bus": "can0"}],
    }
)


def slide(rng: np.random.Generator) -> list[Float] | None:
    """Return the true displacements (U, N, 3), in m, of a random slide; None if it leaves the patch."""
    angle, length_m = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(4e-3, 12e-3)
    radius_m, friction = rng.uniform(3e-3, 15e-3), rng.uniform(0.2, 1.0)
    body = {"name": "ball", "shape": "sphere", "radius_m": radius_m, "friction": friction}
    touch = {
        "body": "ball",
        "patch": "palm",
        "at_m": rng.uniform(8e-3, 28e-3, 2).tolist(),
        "force_n": float(10.0 ** rng.uniform(-0.5, 0.7)),
        "from_s": 0.5,
        "to_s": 3.0,
        "motions": [
            {
                "kind": "slide",
                "by_m": [length_m * float(np.cos(angle)), length_m * float(np.sin(angle))],
                "from_s": 1.0,
                "to_s": 2.5,
            }
        ],
    }
    try:
        scene = bind_scene(parse_scene({"bodies": [body], "touches": [touch]}), HAND)["palm"]
    except ConfigError:
        return None
    return [scene.truth(float(t_s)).displacement_m for t_s in TIMES_S]


def measure(scenes: list[list[Float]], noise: float, prior: str) -> dict[str, Any]:
    """Solve all frames of the scenes, and count the fields that are wrong about healthy skin."""
    rest_ohm = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m)
    rng = np.random.default_rng(0)
    frames = untrusted = named = beyond = 0
    for moved in scenes:
        tracker = sk.Tracker(
            LAYOUT, method="posterior", relative_noise=noise, baseline_ohm=rest_ohm, prior=prior
        )
        for truth in moved:
            noisy = rng.normal(1.0, noise, LAYOUT.shape)
            field = tracker.update(sk.resistance_ohm(LAYOUT, LAYOUT.upper_m + truth) * noisy)
            off = np.abs(field.displacement_m - truth) / field.displacement_std_m
            frames += 1
            untrusted += not field.trusted
            named += bool(field.faults)
            beyond += bool(field.trusted and np.nanmax(off) > LIMIT)
    return {"frames": frames, "untrusted": untrusted, "named": named, "beyond": beyond}


def shipped(noise: float, seeds: int = 8) -> tuple[int, int]:
    """Return the number of frames of the shipped scene ``press``, and of those with a reported fault."""
    scene = bind_scene(load_scene(shipped_scenes()["press"], HAND), HAND)["palm"]
    moved = [scene.truth(float(t_s)).displacement_m for t_s in np.arange(1.6, 3.6, 0.08)]
    rest_ohm = sk.resistance_ohm(LAYOUT, LAYOUT.upper_m)
    named = 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        tracker = sk.Tracker(LAYOUT, method="posterior", relative_noise=noise, baseline_ohm=rest_ohm)
        for truth in moved:
            noisy = rng.normal(1.0, noise, LAYOUT.shape)
            named += bool(tracker.update(sk.resistance_ohm(LAYOUT, LAYOUT.upper_m + truth) * noisy).faults)
    return seeds * len(moved), named


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else SCENES
    found = [slide(np.random.default_rng(seed)) for seed in range(count)]
    scenes = [moved for moved in found if moved is not None]
    print("| noise | prior | frames | not trusted | a fault reported | trusted, with a coordinate beyond 5 |")
    print("|---|---|---|---|---|---|")
    for noise, prior in ROWS:
        row = measure(scenes, noise, prior)
        shares = " | ".join(f"{row[key] / row['frames']:.1%}" for key in ("untrusted", "named", "beyond"))
        print(f"| {noise:.0e} | {prior} | {row['frames']} | {shares} |", flush=True)
    for noise in (3e-6, 1e-5):
        frames, named = shipped(noise)
        print(f"scene press, noise {noise:.0e}: a fault reported in {named} of {frames} frames", flush=True)


if __name__ == "__main__":
    main()
