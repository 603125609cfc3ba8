"""What runs until it is told is not stopped by Python's garbage collector."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from skinnode.process.garbage_collection import without_long_collections


class Link:
    """An object that only a walk through what refers to it can find to be garbage."""

    def __init__(self) -> None:
        self.myself = self


@pytest.fixture(autouse=True)
def _nothing_frozen() -> Iterator[None]:
    """Start as a program does: the process of the tests has frozen its own objects."""
    gc.unfreeze()
    yield
    gc.freeze()


def is_collected(item: object) -> bool:
    """Whether collections look at an object."""
    return any(each is item for each in gc.get_objects())


@pytest.mark.long
def test_collections_pass_over_what_was_there_and_still_find_what_is_new() -> None:
    old = Link()
    with without_long_collections():
        assert not is_collected(old)
        gc.collect()
        before = sum(isinstance(item, Link) for item in gc.get_objects())
        for _ in range(100):
            Link()
        assert gc.collect() >= 100
        assert sum(isinstance(item, Link) for item in gc.get_objects()) == before
    assert is_collected(old)


@pytest.mark.long
def test_the_end_of_an_inner_block_does_not_end_the_outer_one() -> None:
    """As where a host and simulated nodes run in one program."""
    old = Link()
    with without_long_collections():
        with without_long_collections():
            new = Link()
        assert not is_collected(old)
        assert is_collected(new)
    assert is_collected(old)


def test_what_the_program_itself_has_frozen_stays_frozen() -> None:
    old = Link()
    gc.freeze()
    with without_long_collections():
        pass
    assert not is_collected(old)
