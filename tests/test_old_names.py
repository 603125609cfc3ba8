"""Names that the documentation of version 0.1 imported are found where they were, with a warning."""

from __future__ import annotations

from importlib import import_module

import pytest

OLD = {
    "skinnode.wire.codec": ("skinnode.protocol.codec", "unpack_chunk", "unpack_summary"),
    "skinnode.model.config": ("skinnode.config", "parse_hand"),
    "skinnode.cli.demo": ("skinnode.demo.hand", "demo_hand"),
}


@pytest.mark.parametrize("old", OLD)
def test_an_old_path_finds_the_same_object_and_warns(old: str) -> None:
    new, *names = OLD[old]
    for name in names:
        with pytest.warns(DeprecationWarning, match=f"{old}.{name} has moved to {new}.{name}"):
            found = getattr(import_module(old), name)
        assert found is getattr(import_module(new), name)


def test_a_name_that_never_was_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError):
        _ = import_module("skinnode.wire.codec").no_such_name
