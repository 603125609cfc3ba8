"""Virtual time: threads that run one at a time, by a clock that jumps."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import queue
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack
from types import FrameType
from typing import Any

import can
import pytest

from skinnode.process import clock
from vcan_sim import virtual_time
from vcan_sim.event_loop import run
from vcan_sim.timed_interface import MOST_STATIONS
from vcan_sim.virtual_time import READINGS, START_NS, Deadlock, VirtualClock


def test_waiting_takes_virtual_time_and_computing_none() -> None:
    with VirtualClock():
        begin_s = clock.monotonic()
        sum(range(100_000))
        assert clock.monotonic() == begin_s
        clock.sleep(3600.0)
        assert clock.monotonic() == begin_s + 3600.0
        assert not clock.event().wait(0.25)
        with pytest.raises(queue.Empty):
            clock.simple_queue().get(timeout=0.5)
        assert clock.monotonic() == begin_s + 3600.75
        assert clock.perf_counter() == clock.monotonic()


def test_time_passes_for_a_thread_that_polls_it() -> None:
    with VirtualClock():
        end_s = clock.monotonic() + 1.0
        while clock.monotonic() < end_s:
            pass
        assert clock.monotonic() == pytest.approx(end_s, abs=1e-3)


def test_a_thread_that_waits_between_its_readings_does_not_poll() -> None:
    times = READINGS + 100
    with VirtualClock():
        for _ in range(times):
            clock.monotonic()
            clock.sleep(1e-3)
        assert clock.monotonic_ns() == START_NS + times * 1_000_000


def test_outside_and_in_other_threads_time_is_the_systems() -> None:
    seen: list[int] = []
    with VirtualClock():
        other = threading.Thread(target=lambda: seen.append(clock.monotonic_ns()))
        other.start()
        other.join()
        assert clock.monotonic_ns() == START_NS
    before, seen_ns, after = time.monotonic_ns(), clock.monotonic_ns(), time.monotonic_ns()
    assert before <= seen_ns <= after
    assert abs(seen[0] - seen_ns) < 60e9


def test_threads_run_in_the_order_of_their_times_and_then_of_their_waits() -> None:
    order: list[tuple[str, float]] = []

    def nap(name: str, seconds: float) -> None:
        for _ in range(3):
            clock.sleep(seconds)
            order.append((name, clock.monotonic() - START_NS * 1e-9))

    with VirtualClock():
        naps = [clock.thread(nap, name, (name, s)) for name, s in (("a", 0.5), ("b", 0.25), ("c", 0.5))]
        for thread in naps:
            thread.start()
        for thread in naps:
            thread.join()
    assert order == [
        ("b", 0.25), ("a", 0.5), ("c", 0.5), ("b", 0.5), ("b", 0.75), ("a", 1.0), ("c", 1.0), ("a", 1.5),
        ("c", 1.5),
    ]  # fmt: skip


def test_an_event_wakes_all_that_wait_and_a_queue_the_first() -> None:
    woken: list[str] = []
    with VirtualClock():
        event, items = clock.event(), clock.simple_queue()

        def wait_for_event(name: str) -> None:
            assert event.wait(10.0)
            woken.append(name)

        def take(name: str) -> None:
            woken.append(f"{name} {items.get()}")

        threads = [clock.thread(wait_for_event, n, (n,)) for n in "ab"]
        threads += [clock.thread(take, n, (n,)) for n in "cd"]
        for thread in threads:
            thread.start()
        clock.sleep(1.0)
        items.put(1)
        event.set()
        items.put(2)
        for thread in threads:
            thread.join()
        assert clock.monotonic_ns() == START_NS + 10**9
    assert woken == ["c 1", "a", "b", "d 2"]


def test_a_time_out_and_a_wake_at_the_same_instant_wake_once() -> None:
    got: list[object] = []
    with VirtualClock() as virtual:
        items = clock.simple_queue()

        def take() -> None:
            try:
                got.append(items.get(timeout=1.0))
            except queue.Empty:
                got.append("empty")
            clock.sleep(1.0)
            got.append("after")

        taker = clock.thread(take, "taker")
        taker.start()
        clock.sleep(0.0)
        virtual.call_at(START_NS + 10**9, lambda: items.put("item"))
        taker.join(5.0)
        assert not taker.is_alive()
        assert clock.monotonic_ns() == START_NS + 2 * 10**9
    assert got == ["empty", "after"]  # the time-out was set first


def test_a_lock_is_handed_over() -> None:
    log: list[str] = []
    with VirtualClock():
        lock = clock.lock()

        def work(name: str) -> None:
            with lock:
                log.append(f"{name} in")
                clock.sleep(1.0)
                log.append(f"{name} out")

        threads = [clock.thread(work, name, (name,)) for name in "abc"]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert log == ["a in", "a out", "b in", "b out", "c in", "c out"]


def test_pool_runs_its_jobs_and_cancels_what_waits() -> None:
    with VirtualClock():
        ended = clock.simple_queue()

        def job(number: int) -> int:
            clock.sleep(1.0)
            if number == 1:
                raise ValueError("one")
            return number

        with clock.pool(2, "pool") as pool:
            jobs: list[Future[int]] = [pool.submit(job, number) for number in range(5)]
            for each in jobs:
                each.add_done_callback(ended.put)
            assert [ended.get() is each for each in jobs[:2]] == [True, True]
            assert clock.monotonic_ns() == START_NS + 10**9
            pool.shutdown(cancel_futures=True)
        assert jobs[0].result() == 0
        assert isinstance(jobs[1].exception(), ValueError)
        assert [each.cancelled() for each in jobs] == [False, False, False, False, True]


def test_a_deadlock_is_reported_with_the_threads_that_wait() -> None:
    def wait_for_each_other() -> None:
        with VirtualClock():
            event = clock.event()
            clock.thread(event.wait, "never").start()
            event.wait()

    with pytest.raises(Deadlock, match="waiting: 'never'"):
        wait_for_each_other()


@pytest.mark.parametrize("naps", [0, 3])
def test_an_exception_of_a_timed_function_is_the_first_threads(naps: int) -> None:
    """Whichever thread happens to wait when the function is called; all threads continue."""

    def fail() -> None:
        raise ValueError("a frame that must not be")

    def nap() -> None:
        for _ in range(naps):
            clock.sleep(0.5e-3)
        event.wait()
        ended.append(clock.monotonic_ns() - START_NS)

    ended: list[int] = []
    with VirtualClock() as time_here:
        event = clock.event()
        thread = clock.thread(nap, "naps")
        thread.start()
        time_here.call_at(START_NS + 1_000_000, fail)
        with pytest.raises(ValueError, match="a frame that must not be"):
            clock.sleep(1.0)
        assert clock.monotonic_ns() == START_NS + 1_000_000
        clock.sleep(1.0)  # the wait that has failed does not end this one
        assert clock.monotonic_ns() == START_NS + 1_001_000_000
        event.set()
        thread.join()
    assert ended == [1_001_000_000]


def test_threads_left_behind_are_named() -> None:
    def leave_one() -> None:
        with VirtualClock():
            clock.thread(clock.event().wait, "left").start()

    with pytest.raises(RuntimeError, match="threads 'left' have not ended"):
        leave_one()


def test_the_interface_needs_virtual_time() -> None:
    with pytest.raises(can.CanInitializationError, match="runs in real time"):
        can.Bus(interface="timed", channel="a", ignore_config=True)


def test_frames_take_the_time_of_their_bits() -> None:
    """A base frame with 8 bytes 0x55 at 500 kbit/s has 111 bits and the intermission, and few stuff bits."""
    with VirtualClock():
        options = {"interface": "timed", "channel": "a", "bitrate": 500_000, "ignore_config": True}
        with can.Bus(**options) as one, can.Bus(**options) as other, can.Bus(**options) as third:
            clock.sleep(0.001)
            begin_s = clock.time()
            one.send(can.Message(arbitration_id=0x555, is_extended_id=False, data=b"\x55" * 8))
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b""))
            first, second = third.recv(1.0), third.recv(1.0)
            assert first is not None
            assert second is not None
            assert (first.arbitration_id, second.arbitration_id) == (0x123, 0x555)
            assert 47 - 3 + 108 <= (second.timestamp - begin_s) * 500_000 <= 55 + 135
            assert clock.time() - begin_s < 0.0015  # frames of a millisecond wake the reader together
            assert third.recv(0.1) is None


def test_what_an_endpoint_has_sent_arrives_although_it_is_closed() -> None:
    with VirtualClock():
        options = {"interface": "timed", "channel": "a", "ignore_config": True}
        with can.Bus(**options) as stays:
            with can.Bus(**options) as leaves:
                for number in range(3):
                    leaves.send(can.Message(arbitration_id=number, is_extended_id=False))
            heard = [stays.recv(0.01) for _ in range(4)]
        assert [message.arbitration_id if message else None for message in heard] == [0, 1, 2, None]
        with can.Bus(**options) as alone:
            alone.send(can.Message(arbitration_id=1, is_extended_id=False))
        clock.sleep(1.0)


def test_endpoints_can_be_opened_and_closed_without_limit() -> None:
    """A new endpoint neither sends nor receives frames of the closed endpoints."""
    with VirtualClock():
        options = {"interface": "timed", "channel": "a", "ignore_config": True}
        for _ in range(2 * MOST_STATIONS):
            with can.Bus(**options) as lonely:  # nobody acknowledges its frame
                lonely.send(can.Message(arbitration_id=1, is_extended_id=False))
        with can.Bus(**options) as stays, can.Bus(**options) as hears:
            for number in range(2 * MOST_STATIONS):
                with can.Bus(**options) as opened:
                    stays.send(can.Message(arbitration_id=2, is_extended_id=False, data=bytes((number,))))
                    clock.sleep(0.001)
                    heard = [opened.recv(0.0) for _ in range(2)]
                    assert [message and message.data[0] for message in heard] == [number, None]
                    stays.send(can.Message(arbitration_id=2, is_extended_id=False, data=b"\xff"))
                clock.sleep(0.001)
            assert stays.recv(0.01) is None
            assert sum(hears.recv(0.01) is not None for _ in range(5 * MOST_STATIONS)) == 4 * MOST_STATIONS
        with ExitStack() as all_open:
            for _ in range(MOST_STATIONS):
                all_open.enter_context(can.Bus(**options))
            with pytest.raises(can.CanInitializationError, match="more than 64 endpoints at the same time"):
                can.Bus(**options)


def test_an_event_loop_waits_in_virtual_time() -> None:
    """It sleeps, its time-outs expire, and another thread of the program wakes it at the time it says."""

    async def main() -> list[float]:
        loop, arrived, at_s = asyncio.get_running_loop(), asyncio.Event(), []

        def work() -> None:
            clock.sleep(30.0)
            loop.call_soon_threadsafe(arrived.set)

        worker = clock.thread(work, "worker")
        worker.start()
        begin_s = loop.time()
        await asyncio.sleep(10.0)
        at_s.append(loop.time() - begin_s)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(5.0):
                await arrived.wait()
        at_s.append(loop.time() - begin_s)
        await arrived.wait()
        at_s.append(loop.time() - begin_s)
        worker.join()
        return at_s

    begin_s = time.monotonic()
    with VirtualClock():
        assert run(main()) == pytest.approx([10.0, 15.0, 30.0], abs=1e-6)
    assert time.monotonic() - begin_s < 5.0


def test_without_a_virtual_clock_an_event_loop_is_that_of_asyncio() -> None:
    async def main() -> type:
        return type(asyncio.get_running_loop())

    assert run(main()) is asyncio.run(main())


class Interrupted(Exception):
    """Raised by a signal handler."""


@pytest.fixture
def raising_signal() -> Iterator[signal.Signals]:
    """Return a signal whose handler raises Interrupted."""

    def handle(_number: int, _frame: FrameType | None) -> None:
        raise Interrupted

    before = signal.signal(signal.SIGUSR1, handle)
    yield signal.SIGUSR1
    signal.signal(signal.SIGUSR1, before)


def test_an_exception_of_a_signal_handler_waits_for_its_turn(raising_signal: signal.Signals) -> None:
    """The first thread must not run beside the thread that has the turn, nor make a thread miss its time."""
    main, items, running, ended = threading.get_ident(), 200, [False], [False]
    with VirtualClock():
        queue_of_main, late_ns = clock.queue(), list[int]()

        def interrupt() -> None:
            while not ended[0]:
                clock.sleep(0.003)
                running[0] = True
                signal.pthread_kill(main, raising_signal)
                end_s = time.monotonic() + 0.001
                while time.monotonic() < end_s:  # lets the first thread run the handler
                    time.sleep(1e-4)
                running[0] = False

        def nap() -> None:
            while not ended[0]:
                due_ns = clock.monotonic_ns() + 7_000_000
                clock.sleep(0.007)
                late_ns.append(clock.monotonic_ns() - due_ns)
                queue_of_main.put(None)

        threads = [clock.thread(interrupt, "interrupt"), *(clock.thread(nap, f"nap {i}") for i in range(3))]
        for thread in threads:
            thread.start()
        interrupted = taken = 0
        while taken < items:
            try:
                queue_of_main.get()
                taken += 1
            except Interrupted:
                interrupted += 1
            assert not running[0]
            try:
                clock.sleep(0.001)
            except Interrupted:
                interrupted += 1
            assert not running[0]
        ended[0] = True
        for thread in threads:
            while thread.is_alive():
                with contextlib.suppress(Interrupted):
                    thread.join()
    assert interrupted > items // 2
    assert set(late_ns) == {0}


def interrupted_at(step: int) -> bool:
    """Raise Interrupted at a line of the clock that the first thread executes; return whether it did."""
    left, running = step, False

    def count(frame: FrameType, event: str, _argument: object) -> Any:
        nonlocal left
        if frame.f_code.co_filename != virtual_time.__file__:
            return None
        left -= event == "line"
        if event == "line" and not left:
            raise Interrupted
        return count

    def echo() -> None:
        nonlocal running
        while requests.get() is not None:
            running = True  # until it waits
            answers.put(None)
            time.sleep(0)
            running = False

    def nap() -> None:
        while not ended.is_set():
            clock.sleep(0.001)

    with VirtualClock():
        requests, answers, ended = clock.queue(), clock.queue(), clock.event()
        threads = [clock.thread(echo, "echo", ()), clock.thread(nap, "nap", ())]
        for thread in threads:
            thread.start()
        sys.settrace(count)
        try:
            for _ in range(2):
                requests.put(0)
                answers.get()
                clock.sleep(0.0005)
        except Interrupted:
            assert not running
        finally:
            sys.settrace(None)
        ended.set()
        requests.put(None)
        for thread in threads:
            thread.join()
    return left <= 0


def test_an_exception_of_a_signal_handler_may_come_at_any_step_of_a_hand_over() -> None:
    """It must neither let two threads run at once nor lose the turn of another thread."""
    for step in itertools.count(1):
        reached = Future[bool]()

        def attempt(step: int = step, reached: Future[bool] = reached) -> None:
            try:
                reached.set_result(interrupted_at(step))
            except BaseException as error:
                reached.set_exception(error)

        threading.Thread(target=attempt, daemon=True).start()
        if not reached.result(timeout=60.0):
            break
    assert step > 100
