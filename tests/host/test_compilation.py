"""Once a patch has been set up, no kernel is compiled or loaded from the cache: its stream would stop."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

PROGRAM = """
import gc, json, sys
import numpy as np
from numba.core.registry import CPUDispatcher
from skinnode.bench.trust_faults import singles
from skinnode.bench.trust_loads import draw
from skinnode.bench.trust_signal import Setting, Timeline, make
from skinnode.bench.trust_solver import host_patch

def kernels():
    every = [each for each in gc.get_objects() if type(each) is CPUDispatcher]
    return {f"{each.py_func.__qualname__}{kinds}" for each in every for kinds in each.signatures}

rng, setting = np.random.default_rng(1), Setting("staggered", 0.5, float(sys.argv[1]))
faults = [fault for fault in singles() if fault.name in sys.argv[2:]]
load = draw("sphere", setting.layout(), rng)
taken = make(setting, load, faults, rng, Timeline(rest=4, press=4, hold=6, slide=4, release=3, after=3))
patch = host_patch(taken)
before = kernels()
for number, codes in enumerate(taken.codes):
    codes.setflags(write=False)  # as in the scans of a host
    patch.field(codes, number, 1 + number % 3)
print(json.dumps([len(before), sorted(kernels() - before)]))
"""


@pytest.mark.parametrize("noise", ["1e-5", "1e-3"])
@pytest.mark.parametrize(
    "fault", ["none", "crossing stuck at a constant", "lower wire open", "upper wires crossed"]
)
def test_nothing_is_compiled_once_a_patch_has_been_set_up(noise: str, fault: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, noise, fault], capture_output=True, text=True, check=True, timeout=200
    )
    before, late = json.loads(done.stdout)
    assert before > 20
    assert late == []
