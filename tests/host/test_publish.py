"""Publishing never blocks the worker: whoever is slow loses its own oldest fields, counted."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from skinnode.errors import BusError
from skinnode.host.publish import Publisher
from skinnode.model.frames import FieldFrame, SolveStats


def field(residual: float) -> FieldFrame:
    zero = np.zeros((1, 1, 3))
    return FieldFrame(zero, zero, (), np.array([residual]), SolveStats(0, 0, 0, 0.0))


def numbers(fields: list[FieldFrame]) -> list[float]:
    return [float(one.residual[0]) for one in fields]


@pytest.fixture
def publisher() -> Publisher:
    return Publisher(("left", "right"))


def test_slow_subscriber_loses_its_own_oldest(publisher: Publisher) -> None:
    slow, fast = publisher.subscribe(2, None, None), publisher.subscribe(10, None, None)
    for number in range(5):
        publisher.publish(field(number), "left")
    publisher.end()
    assert numbers(list(fast)) == [0, 1, 2, 3, 4]
    assert fast.dropped == 0
    assert numbers(list(slow)) == [4]  # the end took the place of the other
    assert slow.dropped == 4


def test_one_patch_only(publisher: Publisher) -> None:
    right = publisher.subscribe(10, None, "right")
    publisher.publish(field(1), "left")
    publisher.publish(field(2), "right")
    publisher.end()
    assert numbers(list(right)) == [2]
    assert right.dropped == 0


def test_latest_is_the_newest_of_its_patch(publisher: Publisher) -> None:
    assert publisher.latest("left") is None
    publisher.publish(field(1), "left")
    publisher.publish(field(2), "left")
    publisher.publish(field(3), "right")
    newest = publisher.latest("left")
    assert newest is not None
    assert numbers([newest]) == [2]


def test_a_failure_reaches_everyone_after_what_was_queued(publisher: Publisher) -> None:
    early = publisher.subscribe(10, None, None)
    publisher.publish(field(1), "left")
    publisher.fail(BusError("can0: gone"))
    publisher.end()
    assert early.get(0) is not None
    for _ in range(2):  # and it stays said
        with pytest.raises(BusError, match="can0: gone"):
            early.get(0)
    with pytest.raises(BusError, match="can0: gone"):
        list(publisher.subscribe(10, None, None))


def test_a_subscription_to_a_host_that_has_closed_ends_at_once(publisher: Publisher) -> None:
    publisher.end()
    assert list(publisher.subscribe(10, None, None)) == []


def test_loop_with_nothing_to_read_times_out(publisher: Publisher) -> None:
    with pytest.raises(TimeoutError, match=r"^no field within 0\.01 s$"):
        next(iter(publisher.subscribe(10, 0.01, None)))


def test_closed_and_forgotten_subscriptions_get_nothing(publisher: Publisher) -> None:
    with publisher.subscribe(10, None, None) as closed:
        pass
    publisher.publish(field(1), "left")
    assert closed.get(0) is None
    forgotten = publisher.subscribe(10, None, None)
    del forgotten, closed
    gc.collect()
    assert len(publisher._subscriptions) == 0  # that memory does not grow cannot be seen from outside


def test_closing_a_subscription_ends_its_loop_after_the_queued_fields(publisher: Publisher) -> None:
    fields = publisher.subscribe(10, None, None)
    publisher.publish(field(1), "left")
    fields.close()
    publisher.publish(field(2), "left")
    fields.close()
    assert numbers(list(fields)) == [1]
    assert fields.get() is None


@pytest.mark.parametrize(
    ("capacity", "patch", "message"),
    [
        (0, None, "capacity: got 0, must be an integer of at least 1"),
        (1, "middle", "patch: got 'middle', must be one of left, right"),
    ],
)
def test_bad_arguments(publisher: Publisher, capacity: int, patch: str | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        publisher.subscribe(capacity, None, patch)
