"""What runs until it is told is not stopped by Python's garbage collector."""

from __future__ import annotations

import gc

from skinnode.process.garbage_collection import without_long_collections


class Link:
    """An object that only a walk through what refers to it can find to be garbage."""

    def __init__(self) -> None:
        self.myself = self


def test_collections_pass_over_what_was_there_and_still_find_what_is_new() -> None:
    old = Link()
    with without_long_collections():
        assert not any(item is old for item in gc.get_objects())
        gc.collect()
        before = sum(isinstance(item, Link) for item in gc.get_objects())
        for _ in range(100):
            Link()
        assert gc.collect() >= 100
        assert sum(isinstance(item, Link) for item in gc.get_objects()) == before
    assert any(item is old for item in gc.get_objects())
