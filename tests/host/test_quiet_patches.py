"""Hours of live patches whose converters are quiet: none is called frozen, nor any of its parts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from skinnode.host.code_watch import CodeWatch
from skinnode.model.forward import resistance_ohm
from skinnode.model.layout import Float, PatchLayout
from skinnode.protocol.codes import CodeScale
from skinnode.protocol.scan import Scan

SCANS_PER_S = 100
PRESETS = ("staggered", "aligned")


def dents(random: np.random.Generator, count: int) -> list[Float]:
    """Logarithms of R/R0 under presses with shear, each in the order of a press of a tenth of the layer."""
    found = []
    for _ in range(count):
        layout = PatchLayout.preset(
            str(random.choice(PRESETS)), height_m=float(random.choice([1.2e-3, 2e-3]))
        )
        upper, pitch = layout.upper_m, layout.pitch_m
        centre = random.uniform(upper.min(axis=(0, 1))[:2], upper.max(axis=(0, 1))[:2])
        away = (upper[..., :2] - centre) / (pitch * random.uniform(0.7, 3.0))
        bell = np.exp(-(away**2).sum(axis=-1))
        shear = random.normal(size=2) * 0.03
        moved = np.stack([shear[0] * bell, shear[1] * bell, -0.1 * bell], axis=-1) * layout.height_m
        found.append(np.log(resistance_ohm(layout, upper + moved) / resistance_ohm(layout, upper)))
    return found


def depths(random: np.random.Generator) -> Iterator[Float]:
    """Depth of each scan, in presses: ramps, held presses, light touches, creep back, rest."""
    while True:
        deep = float(random.choice([0.02, 0.2, 1.0, 3.0]) * random.uniform(0.5, 1.5))
        ramp, held = int(random.integers(10, 300)), int(random.integers(0, 3000))
        creep, rest = int(random.integers(20, 2000)), int(random.integers(0, 20_000))
        down = deep * 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, ramp)))
        stays = deep * (1.0 + 0.02 * np.log1p(np.arange(held) / 100.0))
        back = deep * 0.05 * np.exp(-np.arange(creep + rest) / (0.2 * creep))
        yield np.concatenate([down, stays, down[::-1], back])


def alarms(noise: float, stated: float, hours: float, seed: int) -> list[str]:
    """Faults that the watch finds in a live patch in so many hours at 100 scans/s."""
    random = np.random.default_rng(seed)
    scale, scans = CodeScale(16), round(hours * 3600 * SCANS_PER_S)
    watch, presses, found = CodeWatch(scale, stated), dents(random, 40), []
    number, warmth = 0, 0.0
    for path in depths(random):
        dent = presses[int(random.integers(len(presses)))]
        for start in range(0, len(path), 256):
            depth = path[start : start + 256]
            warmth += 1e-6 * float(random.normal())  # the hand warms up and cools down
            ratio = np.exp(depth[:, None, None] * dent + warmth)
            ratio *= 1.0 + noise * random.standard_normal(ratio.shape)
            codes = np.clip(np.rint((ratio - scale.lo) / scale.step), 0, scale.steps).astype(np.uint32)
            for each in codes:
                number += 1
                t_ns = number * 1_000_000_000 // SCANS_PER_S
                valid = np.ones(each.shape, np.bool_)
                scan = Scan(each, valid, 1, number, True, 1, 1, 0, 0, t_ns, t_ns)
                found += [str(fault) for fault in watch.judge(scan).faults]
                watch.on_scan(scan)
                if number == scans:
                    return found
    return found


@pytest.mark.release
@pytest.mark.parametrize(("noise", "stated"), [(2e-6, 3e-6), (3e-6, 3e-6), (1e-6, 1e-5), (0.0, 3e-6)])
def test_no_live_patch_is_called_frozen(noise: float, stated: float) -> None:
    assert alarms(noise, stated, 0.25, seed=4) == []
