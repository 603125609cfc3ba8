"""The start of the nodes of a hand, as far as it waits for them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from skinnode.errors import NodeTimeout
from skinnode.host import start


class Node:
    """Says that it is operational after so many naps of the host."""

    def __init__(self, naps: int) -> None:
        self.naps = naps
        self.is_guest, self.patch = False, SimpleNamespace(name="thumb", bus="can0", node_id=5)
        self.lane, self.monitor = SimpleNamespace(withholdings=0), self
        self.nmt_state = 127

    def start(self, solver: Any, withholdings: int) -> None: ...

    def said_since(self, state: int, t_ns: int) -> bool:
        return self.naps <= 0


def test_a_node_is_not_late_while_the_machine_of_the_host_stands_still(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    node, now_s = Node(naps=2), [100.0]

    def nap(seconds: float) -> None:
        now_s[0] += 5.0  # nothing ran for that long
        node.naps -= 1

    clock = SimpleNamespace(sleep=nap, monotonic=lambda: now_s[0], monotonic_ns=lambda: round(now_s[0] * 1e9))
    monkeypatch.setattr(start, "time", clock)
    start.start_all({node: None})  # type: ignore[dict-item]
    node.naps = 10_000
    with pytest.raises(NodeTimeout, match="got NMT state 127 after the start command"):
        start.start_all({node: None})  # type: ignore[dict-item]
