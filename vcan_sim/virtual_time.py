"""Virtual time: the threads of a program take turns, and the clock jumps from event to event.

Threads are real threads, but only one runs at a time. A thread runs until it waits for an event, a queue, a
lock, another thread or a time. The thread that became ready first runs next. If no thread is ready, the clock
jumps to the next time at which a thread wakes up. Computation takes no virtual time. A program therefore runs
in the same order and at the same virtual times on every machine, and a minute of waiting takes no real time::

    with VirtualClock():
        with Fleet(hand), skinnode.Host(hand) as host:  # host and nodes on a bus with interface "timed"
            field = host.fields(timeout_s=5.0).get()

A thread that waits without using :mod:`skinnode.process.clock`, for example on a socket, a subprocess or a
``threading`` event, blocks the whole program.
"""

from __future__ import annotations

import functools
import heapq
import itertools
import os
import queue as queues
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from types import TracebackType
from typing import Any, Final, Self, cast

from skinnode.process import clock

START_NS: Final = 1_000_000_000_000
"""Monotonic start time (ns) of a virtual clock."""
START_WALL_NS: Final = 1_600_000_000_000_000_000
"""Start of a virtual clock in Unix time (ns): 2020-09-13 12:26:40 UTC."""
READINGS: Final = 10_000
"""Number of consecutive clock readings, without a wait, after which a thread is considered to be polling."""
POLL_S: Final = 1e-4
"""Time for which each clock reading suspends a polling thread, in s."""


class Deadlock(RuntimeError):
    """Every thread is waiting for another thread, and no timer is pending."""


class VirtualClock:
    """Virtual clock for the thread that enters the ``with`` block and all threads started from it.

    All threads started in the block must end before the block does.

    Attributes:
        shared: Objects that exist once per clock, such as simulated buses, by name.

    Raises:
        Deadlock: In the thread that entered the block, if all threads are waiting for each other.
        BaseException: In the same thread, if a function passed to :meth:`call_at` has raised it.
        RuntimeError: On leaving the block, if a thread is still running.
    """

    def __init__(self) -> None:
        self.shared: dict[str, object] = {}
        self._now_ns = START_NS
        self._readings = 0  # number of clock readings by the running thread since its last wait
        self._ready: deque[_Turn] = deque()
        # Waits of the first thread that were ended by an exception from a signal handler: the turn and its
        # ``waits``.
        self._interrupted: deque[tuple[_Turn, int]] = deque()
        self._timers: list[tuple[int, int, int, _Turn | Callable[[], None]]] = []
        self._number = itertools.count()
        self._first = self._running = _Turn("the first thread")
        self._alive: dict[_Turn, None] = {}
        self._used: Any = None
        self._cpus: set[int] = set()
        self._batch = False

    def __enter__(self) -> Self:
        self._make_turns_cheap()
        self._used = clock.use(self)
        self._used.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._used.__exit__(kind, error, trace)
        if self._cpus:
            os.sched_setaffinity(0, self._cpus)
        if self._batch:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        if self._alive and error is None:
            names = ", ".join(repr(turn.name) for turn in self._alive)
            raise RuntimeError(f"virtual time: threads {names} have not ended")

    def _make_turns_cheap(self) -> None:
        """Pin the current thread to one CPU, and set its policy to SCHED_BATCH. New threads inherit both.

        Only one thread runs at a time, and handing over to a thread on another CPU takes several times as
        long, because that CPU is usually idle and must wake up first. With SCHED_BATCH, a woken thread does
        not preempt the thread that woke it and still holds the interpreter lock. A turn then takes less than
        half as much CPU time.
        """
        if hasattr(os, "sched_setaffinity"):  # Linux
            self._cpus = os.sched_getaffinity(0)
            os.sched_setaffinity(0, {sorted(self._cpus)[os.getpid() % len(self._cpus)]})
            self._batch = os.sched_getscheduler(0) == os.SCHED_OTHER
        if self._batch:
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))

    # --- time

    @property
    def now_ns(self) -> int:
        """Monotonic virtual time (ns). Unlike :meth:`monotonic_ns`, it does not count as a clock reading."""
        return self._now_ns

    def monotonic_ns(self) -> int:
        """Return the monotonic virtual time, in ns.

        A thread that reads the clock more than :data:`READINGS` times without waiting is assumed to be
        polling. Each further reading suspends the thread for :data:`POLL_S`, so that time passes.
        """
        self._readings += 1
        if self._readings > READINGS:
            self.wait(deque(), POLL_S)
            self._readings = READINGS
        return self._now_ns

    def made_progress(self) -> None:
        """Reset the current thread's count of clock readings to zero.

        A thread that takes items from a queue is not polling: it waits when the queue is empty.
        """
        self._readings = 0

    def time_ns(self) -> int:
        """Return the virtual time of day as a Unix time, in ns."""
        return START_WALL_NS - START_NS + self._now_ns

    def sleep(self, seconds: float, /) -> None:
        """Suspend the current thread for ``seconds`` of virtual time."""
        if seconds < 0:
            raise ValueError("sleep length must be non-negative")
        self.wait(deque(), seconds)

    def call_at(self, t_ns: int, function: Callable[[], None]) -> None:
        """Call a function at a given virtual time, while no thread runs.

        Args:
            t_ns: Monotonic time of the call, in ns. A time in the past means as soon as possible.
            function: Function to call. It must not wait. If it raises an exception, the exception is raised
                in the thread that entered the ``with`` block when that thread waits.
        """
        heapq.heappush(self._timers, (t_ns, next(self._number), 0, function))

    # --- synchronisation objects

    def event(self) -> threading.Event:
        """Return an unset event in virtual time."""
        return _Event(self)

    def queue(self) -> queues.Queue[Any]:
        """Return an empty, unbounded queue in virtual time."""
        return cast("queues.Queue[Any]", _Queue(self))

    def simple_queue(self) -> queues.SimpleQueue[Any]:
        """Return an empty, unbounded queue in virtual time."""
        return cast("queues.SimpleQueue[Any]", _Queue(self))

    def lock(self) -> _Lock:
        """Return an unlocked lock in virtual time."""
        return _Lock(self)

    def thread(self, target: Callable[..., object], name: str, args: tuple[Any, ...]) -> threading.Thread:
        """Return an unstarted daemon thread that runs in virtual time."""
        return _Thread(self, target, name, args)

    def pool(self, threads: int, name: str) -> Executor:
        """Return a thread pool in virtual time."""
        return _Pool(self, threads, name)

    # --- turns

    def wait(self, waiting: deque[_Turn], seconds: float | None) -> bool:
        """Suspend the current thread until :meth:`wake` is called with ``waiting``, or until a time-out.

        Args:
            waiting: Queue of the threads that wait for the same condition, longest wait first.
            seconds: Maximum wait, in s; None for no limit.

        Returns:
            True if :meth:`wake` ended the wait, False if it timed out.

        Raises:
            BaseException: An exception raised by a signal handler, once it is this thread's turn.
        """
        turn = self._running
        turn.woken, turn.waiting = False, waiting
        begun_ns, waits = self._now_ns, turn.waits
        due_ns = None if seconds is None else begun_ns + max(0, round(seconds * 1e9))
        try:
            waiting.append(turn)
            if due_ns is not None:
                heapq.heappush(self._timers, (due_ns, next(self._number), waits, turn))
            self._pass_on(turn, waits)
            if self._now_ns > begun_ns:  # even if no other thread had a turn in the meantime
                self._readings = 0
            return turn.woken
        except BaseException:
            self._stop_waiting(turn)
            if turn.woken:  # wake another thread instead
                self.wake(waiting)
            raise

    def wake(self, waiting: deque[_Turn]) -> None:
        """Make the longest-waiting thread in ``waiting`` ready to run."""
        if waiting:
            waiting[0].woken = True
            self._make_ready(waiting[0])

    def _make_ready(self, turn: _Turn) -> None:
        """End the wait of a thread.

        If a signal handler raises an exception between two steps, the thread is ready nevertheless, and the
        next call or :meth:`_take_turn` completes the remaining steps.
        """
        if turn not in self._ready:
            self._ready.append(turn)
        turn.waits += 1
        turn.waiting.remove(turn)

    def begin(self, turn: _Turn) -> None:
        """Make a new thread ready to run."""
        self._alive[turn] = None
        self._ready.append(turn)

    def end(self, turn: _Turn) -> None:
        """Remove a thread that has ended, and let the next thread run."""
        del self._alive[turn]
        self._running = self._next()
        self._running.open_gate()

    def await_first_turn(self, turn: _Turn) -> None:
        """Block a new thread until its first turn."""
        self._block(turn, None, turn.waits)
        self._readings = 0
        self._take_turn(turn)

    def _pass_on(self, turn: _Turn, waits: int) -> None:
        """Let the next thread run, and return on the current thread's next turn.

        Args:
            turn: The current thread.
            waits: Value of ``turn.waits`` at the beginning of the wait.
        """
        following = self._next()
        if following is not turn:
            self._block(turn, following, waits)
            self._readings = 0
        self._take_turn(turn)
        if turn is self._first and turn.error is not None:
            error, turn.error = turn.error, None
            raise error

    def _take_turn(self, turn: _Turn) -> None:
        self._ready.popleft()
        if turn in turn.waiting:  # an exception interrupted _make_ready
            turn.waiting.remove(turn)
            turn.waits += 1

    def _stop_waiting(self, turn: _Turn) -> None:
        """End the wait of a thread that still has the turn, because a signal handler raised an exception."""
        if turn in turn.waiting:
            turn.waiting.remove(turn)
            turn.waits += 1
        if turn in self._ready:
            self._ready.remove(turn)

    def _block(self, turn: _Turn, following: _Turn | None, waits: int) -> None:
        """Give the turn to ``following`` unless it is None, and block the current thread until its own turn.

        Python runs signal handlers in the main thread, even while another thread has the turn, and between
        any two steps of the hand-over. If a handler raises an exception before the hand-over, the exception
        is raised immediately. After the hand-over, which is the assignment to ``_running``, the main thread
        becomes ready and raises the exception on its next turn.
        """
        raised: BaseException | None = None
        while True:
            try:
                if following is not None:
                    opening, following = following, None
                    self._running = opening
                    opening.open_gate()
                turn.gate.acquire()
                if self._running is turn:
                    break
            except BaseException as error:
                raised = error
                if self._running is turn:
                    break
                self._interrupted.append((turn, waits))
                self._running.open_gate()  # the exception may have prevented this
        if raised is not None:
            raise raised

    def _next(self) -> _Turn:
        """Return the turn of the next thread to run, advancing the clock while no thread is ready.

        The turn remains in ``_ready`` until the thread takes it.
        """
        while self._interrupted:
            turn, waits = self._interrupted.popleft()
            if turn.waits == waits:  # otherwise, the wait has already ended
                self._make_ready(turn)
        while not self._ready:
            if not self._timers:
                names = ", ".join(repr(turn.name) for turn in self._alive)
                deadlock = Deadlock(f"virtual time: every thread waits for another thread; waiting: {names}")
                self._raise_in_first(deadlock)
                if not self._ready:  # the first thread has left the ``with`` block
                    raise deadlock
                break
            due_ns, _, waits, what = self._timers[0]
            if isinstance(what, _Turn):
                if what.waits == waits:  # otherwise, the thread was woken before its time-out
                    self._now_ns = max(self._now_ns, due_ns)
                    self._make_ready(what)
                heapq.heappop(self._timers)
            else:
                self._now_ns = max(self._now_ns, due_ns)
                heapq.heappop(self._timers)
                try:
                    what()
                except BaseException as error:
                    # If raised here, the exception would end whichever thread happens to be waiting, and stop
                    # the others.
                    self._raise_in_first(error)
        return self._ready[0]

    def _raise_in_first(self, error: BaseException) -> None:
        """End the first thread's wait with an exception. If it is not waiting, its next wait ends with it."""
        first = self._first
        first.error = first.error or error
        if first in first.waiting:
            self._make_ready(first)


class _Turn:
    """Scheduling state of one thread: the gate that blocks it and the condition that it waits for."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.gate = threading.Lock()
        self.gate.acquire()
        self.woken = False
        """Whether :meth:`VirtualClock.wake` ended the last wait."""
        self.waiting: deque[_Turn] = deque()
        """Threads that wait for the same condition, including this one."""
        self.waits = 0
        """Number of completed waits. Timers set for earlier waits have a smaller number and are ignored."""
        self.error: BaseException | None = None

    def open_gate(self) -> None:
        """Let the thread check whether it has the turn."""
        try:  # noqa: SIM105 - contextlib.suppress would make each turn slower
            self.gate.release()
        except RuntimeError:  # already open
            pass


class _Event(threading.Event):
    def __init__(self, of: VirtualClock) -> None:
        super().__init__()
        self._of, self._set = of, False
        self._waiting: deque[_Turn] = deque()

    def is_set(self) -> bool:
        return self._set

    def set(self) -> None:
        self._set = True
        while self._waiting:
            self._of.wake(self._waiting)

    def clear(self) -> None:
        self._set = False

    def wait(self, timeout: float | None = None) -> bool:
        if not self._set:
            self._of.wait(self._waiting, timeout)
        return self._set


class _Queue:
    """Queue in virtual time, with the methods of ``queue.Queue`` and ``queue.SimpleQueue``."""

    def __init__(self, of: VirtualClock) -> None:
        self._of = of
        self.queue: deque[Any] = deque()
        self._waiting: deque[_Turn] = deque()

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        self.queue.append(item)
        self._of.wake(self._waiting)

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        if not block:
            timeout = 0.0
        elif timeout is not None and timeout < 0:
            raise ValueError("'timeout' must be a non-negative number")
        if not self.queue:
            until_ns = None if timeout is None else self._of.monotonic_ns() + round(timeout * 1e9)
            while not self.queue:
                if until_ns is None:
                    self._of.wait(self._waiting, None)
                else:
                    left_ns = until_ns - self._of.now_ns
                    if left_ns <= 0 or not (self._of.wait(self._waiting, left_ns * 1e-9) or self.queue):
                        raise queues.Empty
        self._of.made_progress()
        return self.queue.popleft()

    def put_nowait(self, item: Any) -> None:
        self.put(item)

    def get_nowait(self) -> Any:
        return self.get(block=False)

    def qsize(self) -> int:
        return len(self.queue)

    def empty(self) -> bool:
        return not self.queue


class Mailbox(_Queue):
    """Queue whose reader can be woken separately, after several items have been stored."""

    def store(self, item: Any) -> None:
        """Append an item without waking the reader. Call :meth:`wake` later."""
        self.queue.append(item)

    def wake(self) -> None:
        """If the queue has items, wake the thread that has been waiting longest."""
        if self.queue:
            self._of.wake(self._waiting)


class _Lock:
    def __init__(self, of: VirtualClock) -> None:
        self._of, self._held = of, False
        self._waiting: deque[_Turn] = deque()

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        while self._held:
            if not blocking or not (self._of.wait(self._waiting, None if timeout < 0 else timeout)):
                return False
        self._held = True
        return True

    def release(self) -> None:
        if not self._held:
            raise RuntimeError("release unlocked lock")
        self._held = False
        self._of.wake(self._waiting)

    def locked(self) -> bool:
        return self._held

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


class _Pool(Executor):
    """Thread pool in virtual time. All threads start immediately."""

    def __init__(self, of: VirtualClock, threads: int, name: str) -> None:
        self._jobs: queues.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = of.simple_queue()
        self._closed = False
        self._threads = [of.thread(self._run, f"{name} {i}", ()) for i in range(threads)]
        for thread in self._threads:
            thread.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if self._closed:
            raise RuntimeError("cannot schedule new futures after shutdown")
        future: Future[Any] = Future()
        self._jobs.put((future, functools.partial(fn, *args, **kwargs)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        if not self._closed:
            self._closed = True
            waiting = []
            while not self._jobs.empty():
                waiting.append(self._jobs.get())
            for job in waiting:
                if cancel_futures and job is not None:
                    job[0].cancel()
                else:
                    self._jobs.put(job)
            for _ in self._threads:
                self._jobs.put(None)
        if wait:
            for thread in self._threads:
                thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, call = job
            if future.set_running_or_notify_cancel():
                try:
                    result = call()
                except BaseException as error:
                    future.set_exception(error)
                else:
                    future.set_result(result)


class _Thread(threading.Thread):
    def __init__(
        self, of: VirtualClock, target: Callable[..., object], name: str, args: tuple[Any, ...]
    ) -> None:
        super().__init__(target=target, name=name, args=args, daemon=True)
        self._of, self._turn = of, _Turn(name)
        self._over = False
        self._joining: deque[_Turn] = deque()

    def start(self) -> None:
        super().start()
        self._of.begin(self._turn)
        self._of.sleep(0.0)  # lets the new thread run first, as a real thread usually does

    def run(self) -> None:
        self._of.await_first_turn(self._turn)
        try:
            with clock.use(self._of):
                super().run()
        finally:
            self._over = True
            while self._joining:
                self._of.wake(self._joining)
            self._of.end(self._turn)

    def is_alive(self) -> bool:
        return super().is_alive() and not self._over

    def join(self, timeout: float | None = None) -> None:
        if self.ident is None:
            raise RuntimeError("cannot join thread before it is started")
        if not self._over:
            self._of.wait(self._joining, timeout)
        if self._over:
            super().join()
