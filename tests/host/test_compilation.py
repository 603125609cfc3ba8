"""Once a patch has been set up, no kernel is compiled or loaded from the cache: its stream would stop."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

PROGRAM = """
import gc, json, os, sys
import numpy as np
import scipy.special  # or each copy would import it
from numba.core.registry import CPUDispatcher
from skinnode.bench.trust_faults import singles
from skinnode.bench.trust_loads import draw
from skinnode.bench.trust_signal import Setting, Timeline, make
from skinnode.bench.trust_solver import host_patch

def kernels():
    every = [each for each in gc.get_objects() if type(each) is CPUDispatcher]
    return {f"{each.py_func.__qualname__}{kinds}" for each in every for kinds in each.signatures}

def late(noise, name):
    rng, setting = np.random.default_rng(1), Setting("staggered", 0.5, noise)
    faults = [fault for fault in singles() if fault.name == name]
    assert len(faults) == (name != "none")
    load = draw("sphere", setting.layout(), rng)
    taken = make(setting, load, faults, rng, Timeline(rest=4, press=4, hold=6, slide=4, release=3, after=3))
    patch = host_patch(taken)
    before = kernels()
    for number, codes in enumerate(taken.codes):
        codes.setflags(write=False)  # as in the scans of a host
        patch.field(codes, number, 1 + number % 3)
    return len(before), sorted(kernels() - before)

assert not kernels()
for noise, name in json.loads(sys.argv[1]):  # each in a process that has loaded none
    child = os.fork()
    if child == 0:
        print(json.dumps([noise, name, *late(noise, name)]), flush=True)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
"""
FAULTS = "none", "crossing stuck at a constant", "lower wire open", "upper wires crossed"
CASES = [[noise, fault] for noise in (1e-5, 1e-3) for fault in FAULTS]


@pytest.mark.long
def test_nothing_is_compiled_once_a_patch_has_been_set_up() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(CASES)],
        capture_output=True,
        text=True,
        check=True,
        timeout=100,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # no threads, which a fork would lose
    )
    said = [json.loads(line) for line in done.stdout.splitlines()]
    assert [[noise, fault] for noise, fault, *_ in said] == CASES
    for noise, fault, before, late in said:
        assert before > 20, (noise, fault)
        assert late == [], (noise, fault)
