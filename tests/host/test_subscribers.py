"""Programs that listen: loops, event loops, callbacks. Who blocks or raises pays alone."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import logging
import threading
from collections.abc import Callable

import numpy as np
import pytest

from skinnode.config import HandConfig
from skinnode.errors import BusError, NodeTimeout
from skinnode.host import Host
from skinnode.host.publish import Publisher
from skinnode.model.frames import FieldFrame, SolveStats
from skinnode.process import clock
from vcan_sim.fleet import Fleet

from .conftest import eventually
from .test_stream import take


def field(residual: float) -> FieldFrame:
    zero = np.zeros((1, 1, 3))
    return FieldFrame(zero, zero, (), np.array([residual]), SolveStats(0, 0, 0, 0.0))


def numbers(fields: list[FieldFrame]) -> list[float]:
    return [float(one.residual[0]) for one in fields]


@pytest.fixture
def publisher() -> Publisher:
    return Publisher(("left", "right"))


async def collected(subscription, most: int = 1000) -> list[FieldFrame]:
    fields = []
    async for one in subscription:
        fields.append(one)
        if len(fields) == most:
            break
    return fields


def test_async_for_has_what_was_queued_and_what_comes_from_other_threads(publisher: Publisher) -> None:
    fields = publisher.subscribe(10, 10.0, None)
    publisher.publish(field(0), "left")

    def work() -> None:
        for number in range(1, 6):
            publisher.publish(field(number), "left")
        publisher.end()

    async def main() -> list[FieldFrame]:
        worker = threading.Timer(0.05, work)
        worker.start()
        gathered = await collected(fields)
        worker.join()
        return gathered

    assert numbers(asyncio.run(main())) == [0, 1, 2, 3, 4, 5]
    assert asyncio.run(collected(fields)) == []  # the end is heard again


def test_others_in_the_event_loop_have_their_turn(publisher: Publisher) -> None:
    fields = publisher.subscribe(1000, 10.0, None)
    for number in range(100):
        publisher.publish(field(number), "left")
    publisher.end()
    order: list[str] = []

    async def reader() -> None:
        order.extend(["field" async for _ in fields])

    async def other() -> None:
        for _ in range(20):
            order.append("other")
            await asyncio.sleep(0)

    async def main() -> None:
        await asyncio.gather(reader(), other())

    asyncio.run(main())
    assert order.index("other") < 2
    assert order.index("field") >= 20  # after all turns of the other


def test_async_silence_is_a_timeout_and_a_failure_is_raised(publisher: Publisher) -> None:
    fields = publisher.subscribe(10, 0.05, None)
    with pytest.raises(TimeoutError, match=r"^no field within 0\.05 s$"):
        asyncio.run(collected(fields))
    publisher.fail(NodeTimeout(5, "silent"))  # a TimeoutError as well
    with pytest.raises(NodeTimeout, match="silent"):
        asyncio.run(collected(fields))


def test_async_for_that_does_not_wait_has_what_was_queued(publisher: Publisher) -> None:
    fields = publisher.subscribe(10, 0.0, None)
    for number in (1, 2):
        publisher.publish(field(number), "left")

    async def main() -> list[FieldFrame]:
        waiting = aiter(fields)
        return [await anext(waiting) for _ in range(2)]

    assert numbers(asyncio.run(main())) == [1, 2]


def test_an_event_loop_that_was_left_costs_the_publisher_nothing(publisher: Publisher) -> None:
    fields = publisher.subscribe(10, None, None)

    async def leave() -> None:
        waiting = asyncio.create_task(collected(fields))
        await asyncio.sleep(0.01)
        waiting.cancel()

    asyncio.run(leave())
    publisher.publish(field(1), "left")
    assert numbers(take(fields, 1)) == [1]


@pytest.mark.system_time
def test_async_for_of_a_running_host(hand: HandConfig, fleet: Fleet) -> None:
    with Host.from_config(hand) as host:
        fields = asyncio.run(collected(host.fields(timeout_s=10), 20))
    assert {one.stamp.patch for one in fields if one.stamp} == {"p0", "p1"}
    for one in fields:
        assert one.stamp is not None
        assert 0 < one.stamp.t_sync_ns < one.stamp.t_receive_ns < one.stamp.t_solved_ns


def test_callbacks_are_called_until_they_are_closed(hand: HandConfig, fleet: Fleet) -> None:
    every: list[FieldFrame] = []
    of_one: list[FieldFrame] = []
    with Host.from_config(hand) as host:
        callback = host.on_field(every.append)
        host.on_field(of_one.append, patch="p1")
        assert eventually(lambda: len(every) >= 10 and len(of_one) >= 5)
        callback.close()
        assert callback.ended
        count, others = len(every), len(of_one)
        assert eventually(lambda: len(of_one) >= others + 5)
        assert len(every) == count
        assert (callback.dropped, callback.failed) == (0, 0)
    assert {one.stamp.patch for one in of_one if one.stamp} == {"p1"}


def test_a_callback_that_raises_or_blocks_loses_its_own_data_only(
    hand: HandConfig, fleet: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    go = clock.event()

    def broken(one: FieldFrame) -> None:
        raise ZeroDivisionError("of the user")

    def stuck(one: FieldFrame) -> None:
        go.wait(10)

    with caplog.at_level(logging.WARNING), Host.from_config(hand) as host:
        fields = host.fields(timeout_s=10, capacity=1000)
        bad, slow = host.on_field(broken), host.on_field(stuck, capacity=2)
        assert eventually(lambda: bad.failed >= 10 and slow.dropped >= 10)
        take(fields, 20)
        assert (fields.dropped, bad.dropped, slow.failed) == (0, 0, 0)
        assert sum(stream.skipped for stream in host.stats().patches.values()) == 0
        go.set()
    assert [record.getMessage() for record in caplog.records] == [f"callback {broken.__qualname__} raised"]
    assert caplog.records[0].exc_info is not None
    assert slow.ended


def test_a_callback_may_close_itself(hand: HandConfig, fleet: Fleet) -> None:
    seen: list[FieldFrame] = []
    with Host.from_config(hand) as host:

        def once(one: FieldFrame) -> None:
            seen.append(one)
            callback.close()

        started = clock.event()
        callback = host.on_field(lambda one: once(one) if started.wait(10) else None, capacity=1)
        started.set()
        assert eventually(lambda: callback.ended)
    assert 1 <= len(seen) <= 2  # one may have been queued


def test_a_callback_that_never_returns_does_not_keep_the_host(
    hand: HandConfig, fleet: Fleet, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skinnode.host.callback.LAST_CALL_S", 0.05)
    go, entered = clock.event(), clock.event()

    def stuck(one: FieldFrame) -> None:
        entered.set()
        go.wait(10)

    with caplog.at_level(logging.WARNING), Host.from_config(hand) as host:
        callback = host.on_field(stuck)
        assert entered.wait(10)
    assert "has not returned; no longer waiting for it" in caplog.text
    assert not callback.ended
    go.set()
    assert eventually(lambda: callback.ended)


def test_a_failure_of_the_host_ends_callbacks_with_a_warning(
    publisher: Publisher, caplog: pytest.LogCaptureFixture
) -> None:
    from skinnode.host.callback import FieldCallback

    callback = FieldCallback(lambda one: None, publisher.subscribe(10, None, None))
    publisher.fail(BusError("gone"))
    assert eventually(lambda: callback.ended)
    warnings = [entry.getMessage() for entry in caplog.records if entry.levelno == logging.WARNING]
    assert [text.endswith("is no longer called: gone") for text in warnings] == [True]


@pytest.mark.parametrize("boot_deadline_s", [float("nan"), float("inf"), -1.0])
def test_a_deadline_that_never_comes_is_refused(hand: HandConfig, boot_deadline_s: float) -> None:
    with (
        pytest.raises(ValueError, match=r"boot_deadline_s: got .*, must be finite and not negative"),
        Host.from_config(hand, boot_deadline_s=boot_deadline_s),
    ):
        pytest.fail("it runs")


def test_what_cannot_be_waited_for_counted_or_called_is_refused_at_once(
    hand: HandConfig, fleet: Fleet
) -> None:
    class Awaited:
        async def __call__(self, one: FieldFrame) -> None: ...

    async def awaited(one: FieldFrame) -> None: ...

    with Host.from_config(hand) as host:
        for timeout_s in (float("nan"), float("inf"), -1.0, 1e10):
            with pytest.raises(ValueError, match=r"timeout_s: got .*, must be from 0 to"):
                host.fields(timeout_s=timeout_s)
            with pytest.raises(ValueError, match=r"timeout_s: got .*, must be from 0 to"):
                host.hands(timeout_s=timeout_s)
            with pytest.raises(ValueError, match=r"timeout_s: got .*, must be from 0 to"):
                host.fields().get(timeout_s)
            with pytest.raises(ValueError, match=r"timeout_s: got .*, must be from 0 to"):
                asyncio.run(host.fields().take_async(timeout_s))
        for capacity in (float("nan"), 1.5, 0):
            for subscribe in (host.fields, host.hands, host.events):
                with pytest.raises(ValueError, match=r"capacity: got .*, must be an integer of at least 1"):
                    subscribe(capacity=capacity)
        for function in (3, None, awaited, Awaited(), functools.partial(awaited)):
            with pytest.raises(TypeError, match=r"function: got .*, must"):
                host.on_field(function)


def arrays_of(record: object) -> list[np.ndarray]:
    values = [getattr(record, entry.name) for entry in dataclasses.fields(record)]
    return [value for value in values if isinstance(value, np.ndarray)]


def test_no_subscriber_can_change_what_the_others_have(make_hand: Callable[..., HandConfig]) -> None:
    hand = make_hand(1, solver={"method": "posterior"})
    with Fleet(hand), Host.from_config(hand) as host:
        for _, one in zip(range(400), host.fields(timeout_s=10.0), strict=False):
            arrays = [array for record in (one, *one.contacts) for array in arrays_of(record)]
            assert len(arrays) >= 3 + 4 * len(one.contacts)
            for array in arrays:
                with pytest.raises(ValueError, match="read-only"):
                    array.fill(7)
            if one.contacts:
                return
    pytest.fail("no contact in 400 fields")
