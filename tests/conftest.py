"""What all tests share."""

from __future__ import annotations

import random

import pytest


@pytest.fixture
def multicast_group() -> str:
    """A multicast address that nobody else on this machine is likely to use at the same time."""
    return f"239.74.{random.randrange(256)}.{random.randrange(256)}"
