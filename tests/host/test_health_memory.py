"""The health that is created only when its facts have changed: no change is missed, none is invented."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from skinnode.canopen.nmt import NmtState
from skinnode.host.health import Condition
from skinnode.host.health_memory import HealthMemory
from skinnode.host.node_monitor import NodeMonitor

S = 10**9
STEPS = st.lists(
    st.tuples(
        st.integers(0, 3 * S),  # time since the last step
        st.sampled_from(
            ["beat", "boot", "preoperational", "scan", "emergency", "well", "refuse", "accept", "fail"]
        ),
    ),
    max_size=40,
)


def step(monitor: NodeMonitor, what: str, now_ns: int) -> None:
    match what:
        case "beat":
            monitor.on_heartbeat(bytes([NmtState.OPERATIONAL]), now_ns)
        case "boot":
            monitor.running = True
            monitor.on_heartbeat(bytes([NmtState.INITIALISING]), now_ns)
        case "preoperational":
            monitor.on_heartbeat(bytes([NmtState.PRE_OPERATIONAL]), now_ns)
        case "scan":
            monitor.on_scan(now_ns)
        case "emergency":
            monitor.on_emergency(bytes.fromhex("0010810000000000"), now_ns)
        case "well":
            monitor.on_emergency(bytes(8), now_ns)
        case "refuse":
            monitor.refusal = "wrong layout"
        case "accept":
            monitor.refusal = monitor.defect = None
        case "fail":
            monitor.defect = "solving: ValueError"


@settings(max_examples=300, deadline=None)
@given(STEPS, st.sampled_from([None, 0, 5 * S]))
def test_an_inconspicuous_patch_is_operational(steps: list[tuple[int, str]], passed_ns: int | None) -> None:
    monitor, now_ns = NodeMonitor("palm", 4), 5 * S
    for pause_ns, what in steps:
        now_ns += pause_ns
        step(monitor, what, now_ns)
        for later_ns in (0, S // 10, S, 4 * S):
            at_ns = now_ns + later_ns
            health = monitor.health(at_ns, 0.25, 0.1, 0, passed_ns)
            well = health.condition is Condition.OPERATIONAL
            found = monitor.is_inconspicuous(at_ns, 0.25, 0.1, passed_ns)
            assert found <= (well and not health.restarts_in_a_loop and not health.duplicate_id)
            if not (health.boot_ups or health.restarts_in_a_loop or health.duplicate_id):
                assert found == well  # otherwise, every check would create the health


def test_twelve_heartbeats_in_half_the_time_are_conspicuous() -> None:
    monitor = NodeMonitor("palm", 4)
    for number in range(12):
        now_ns = S + number * S // 8  # a period of 250 ms
        monitor.on_heartbeat(bytes([NmtState.OPERATIONAL]), now_ns)
        monitor.on_scan(now_ns)
        assert monitor.is_inconspicuous(now_ns, 0.25, 0.1) == (number < 11)


def test_the_health_is_created_anew_when_its_facts_change() -> None:
    facts: dict[str, object] = {"palm": 1, "thumb": None}
    created: list[str] = []

    def health(name: str) -> object:
        created.append(name)
        return object()

    memory = HealthMemory(facts, facts.__getitem__, health)
    first, again = memory(), memory()
    assert first["palm"] is again["palm"]
    assert first["thumb"] is not again["thumb"]  # no facts: created at each check
    facts["palm"] = 2
    changed = memory()
    assert changed["palm"] is not first["palm"]
    facts["palm"] = None
    memory()
    facts["palm"] = 2
    assert memory()["palm"] is not changed["palm"]
    assert created == ["palm", "thumb", "thumb", "palm", "thumb", "palm", "thumb", "palm", "thumb"]
