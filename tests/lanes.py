"""Cases of parametrized tests that are part of a plain run, and those that only the lane ``long`` has."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def some_long(cases: Iterable[Any], *plain: Any) -> list[Any]:
    """All ``cases``, marked ``long`` but for the ``plain`` ones. A tuple has a value for each parameter."""
    every = list(cases)
    unknown = [each for each in plain if each not in every]
    if unknown:
        raise ValueError(f"{unknown} are none of the cases")
    return [
        each
        if each in plain
        else pytest.param(*(each if isinstance(each, tuple) else (each,)), marks=pytest.mark.long)
        for each in every
    ]
