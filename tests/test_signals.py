"""A program that runs until Ctrl-C ends at whatever instant the signal comes."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
import time

import pytest

from skinnode.process.signals import SignalEvent

PROGRAM = """
import os, random, signal, sys, threading, time
from skinnode.process.signals import stop_on_signal

sys.setswitchinterval(1e-5)  # or the loop below would keep the other thread waiting for 5 ms

def kill():
    time.sleep(random.uniform(0.0, 1e-4))
    os.kill(os.getpid(), signal.SIGTERM)

for _ in range(1000):
    with stop_on_signal() as stop:
        killer = threading.Thread(target=kill)
        killer.start()
        while not stop.wait(0.0):
            pass
        killer.join()
print("ended")
"""


@pytest.mark.long
def test_no_instant_of_a_signal_stops_the_program_for_good() -> None:
    """With the lock of threading.Event, a signal soon came while the main thread held it."""
    ran = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "ended\n", "")


def test_a_signal_event_wakes_every_thread_that_waits() -> None:
    event, woken = SignalEvent(), []
    threads = [threading.Thread(target=lambda: woken.append(event.wait(20.0))) for _ in range(3)]
    for thread in threads:
        thread.start()
    assert not event.wait(0.01)
    assert not event.is_set()
    event.set()
    for thread in threads:
        thread.join(10.0)
    assert woken == [True] * 3
    assert event.is_set()
    assert event.wait(0.0)
    assert event.wait(-1.0)


def test_a_signal_event_without_a_timeout_is_ended_by_a_signal() -> None:
    event = SignalEvent()
    kept = signal.signal(signal.SIGALRM, lambda *_: event.set())
    try:
        signal.setitimer(signal.ITIMER_REAL, random.uniform(0.01, 0.05))
        begin_s = time.monotonic()
        assert event.wait()
        assert time.monotonic() - begin_s < 10.0
    finally:
        signal.signal(signal.SIGALRM, kept)
