"""The start of the nodes of a hand, as far as it waits for them."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from skinnode.config import BringUpConfig, HandConfig, Missing
from skinnode.errors import ConfigError, NodeError, NodeTimeout
from skinnode.host import Condition, Host, lifecycle, start
from skinnode.host.remote_node import RemoteNode
from skinnode.host.scan_solver import ScanSolver
from skinnode.solve.detect import touch_test
from vcan_sim.fleet import Fleet

from .conftest import SMALL, Rack, eventually
from .test_roles import changed


class Node:
    """Says that it is operational after so many naps of the host."""

    def __init__(self, naps: int) -> None:
        self.naps = naps
        self.heartbeat_s = 0.25
        self.has_other_master, self.patch = False, SimpleNamespace(name="thumb", bus="can0", node_id=5)
        self.stream, self.monitor = SimpleNamespace(withholdings=0), self
        self.nmt_state = 127
        self.sent: list[tuple[int, bytes]] = []
        self.link = SimpleNamespace(send=lambda can_id, data: self.sent.append((can_id, data)))

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
    monkeypatch.setattr(start, "clock", clock)
    start.start_all({node: None})  # type: ignore[dict-item]
    node.naps = 10_000
    with pytest.raises(NodeTimeout, match="got NMT state 127 after the start command"):
        start.start_all({node: None})  # type: ignore[dict-item]
    assert set(node.sent) == {(0x000, bytes([1, 5]))}  # one may have been lost
    assert len(node.sent) >= 3


@pytest.mark.parametrize("missing", ["refuse", "wait"])
def test_a_defect_at_every_bring_up_of_a_node_ends_the_start_unless_nodes_may_be_missing(
    hand: HandConfig, rack: Rack, monkeypatch: pytest.MonkeyPatch, missing: Missing
) -> None:
    """Nobody is handed a hand that lacks a patch without having said that it may."""
    configure, tried = RemoteNode.configure, list[str]()

    def broken(node: RemoteNode, *args: Any, **options: Any) -> ScanSolver:
        if node.patch.name == "p0" and len(tried) < 3:
            tried.append(node.patch.name)
            raise ZeroDivisionError("of ours")
        return configure(node, *args, **options)

    monkeypatch.setattr(RemoteNode, "configure", broken)
    hand = hand.model_copy(update={"bring_up": BringUpConfig(missing=missing)})
    if missing == "refuse":
        complaint = "node 5: patch 'p0' on can0: bring-up: ZeroDivisionError: of ours"
        with pytest.raises(NodeError, match=complaint), Host.from_config(hand):
            pass
        return
    with Host.from_config(hand) as host:
        assert len(tried) == 3
        for patch in ("p1", "p0"):  # which is brought up as one that came later
            assert host.fields(timeout_s=10, patch=patch).get(10) is not None
        assert eventually(lambda: host.stats().nodes["p0"].rejoins == 1)


def test_nothing_is_computed_between_the_configuration_of_the_nodes_and_their_start(
    make_hand: Callable[..., HandConfig],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The touch tests depend on the period of the scans: those of another period would be of no use."""
    configure_all, before = lifecycle.configure_all, list[int]()

    def configure(*arguments: Any) -> Any:
        before.append(touch_test._thresholds.cache_info().misses)
        return configure_all(*arguments)

    monkeypatch.setattr(lifecycle, "configure_all", configure)
    touch_test._thresholds.cache_clear()
    hand = make_hand(sync={"period_ms": 33}, solver={"false_alarms_per_hour": 0.7})
    with Fleet(hand), Host.from_config(hand) as host:
        assert host.fields(timeout_s=5).get() is not None
    assert before == [touch_test._thresholds.cache_info().misses]


@pytest.mark.long
def test_a_patch_is_solvable_if_its_solver_options_make_it_so(make_hand: Callable[..., HandConfig]) -> None:
    """Eight lower wires are too few for the 12 unknowns of a wire, but enough for its four heights."""
    layout, solver = {**SMALL, "lower_wires": 8}, {"method": "exact", "normal_only": True}
    hand = changed(make_hand(patches=1), patch={"layout": layout}, solver=solver)
    with Fleet(hand), Host.from_config(hand) as host:
        assert host.fields(timeout_s=10).get(10) is not None


def test_solver_options_that_conflict_are_refused_before_the_nodes_are_asked(
    make_hand: Callable[..., HandConfig],
) -> None:
    hand = make_hand(solver={"method": "exact", "drift": "patch"})  # without nodes
    with pytest.raises(ConfigError) as caught, Host.from_config(hand):
        pass
    assert str(caught.value) == (
        "patch 'p0': got 'staggered', allowed: method: got 'exact' with drift, must be posterior or auto"
    )


@pytest.mark.long
def test_nodes_start_although_their_heartbeats_are_rare(make_hand: Callable[..., HandConfig]) -> None:
    """With the longest heartbeat period that a hand file can set."""
    hand = make_hand(bring_up={"heartbeat_ms": 10_000}, sync={"period_ms": 400})
    with Fleet(hand), Host.from_config(hand) as host:
        host.reset_node("p0")
        assert eventually(lambda: host.health("p0").rejoins == 1, within_s=60.0)
        assert eventually(lambda: host.health("p0").condition is Condition.OPERATIONAL)
        assert host.health("p0").complaint is None
