"""Taring a patch of a running hand, and listening in for a while."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinnode.config import HandConfig
from skinnode.errors import NodeError, NodeTimeout, SkinError
from skinnode.host import Host
from skinnode.host.configurator import Configurator
from skinnode.record import Recorder
from skinnode.transport import CanPort

from .conftest import Rack, eventually, heard


def depth_m(host: Host, patch: str) -> float:
    field = host.latest(patch)
    return 0.0 if field is None else float(np.abs(field.displacement_m).max())


def test_a_pressed_patch_reads_zero_after_a_tare(hand: HandConfig, rack: Rack) -> None:
    with Host.from_config(hand) as host:
        rest_ohm = rack.sources["p0"].ohm
        rack.sources["p0"].ohm = 0.98 * rest_ohm  # all crossings, as a warmer rubber would
        assert eventually(lambda: depth_m(host, "p0") > 1e-5)
        host.tare("p0")
        assert eventually(lambda: host.stats().nodes["p0"].baselines == 1)
        assert eventually(lambda: depth_m(host, "p0") < 1e-6)
        assert host.stats().nodes["p1"].baselines == 0


class Mute:
    """Lets neither the chunks nor the summary of a scan through, from one scan on to another."""

    def __init__(self) -> None:
        self.wanted = self.active = False

    def __call__(self, can_id: int, data: bytes) -> bool:
        if can_id == 0x185 and data[0] == 0:
            self.active = self.wanted
        return not (self.active and can_id in (0x185, 0x285))


@pytest.mark.long
def test_a_tare_by_others_is_followed_though_the_scan_that_announces_it_is_lost(
    hand: HandConfig, rack: Rack, listener: CanPort
) -> None:
    mute = Mute()
    rack.pull("p0")
    node = rack.plug("p0", lets_through=mute)
    with Host.from_config(hand) as host:
        rest_ohm = rack.sources["p0"].ohm
        rack.sources["p0"].ohm = 0.98 * rest_ohm
        assert eventually(lambda: depth_m(host, "p0") > 1e-5)
        mute.wanted = True
        assert eventually(lambda: mute.active)
        scans = node.scans_sent
        listener.send(0x605, b"\x23\x21\x20\x04" + b"tare")
        assert eventually(lambda: (node.baseline_ohm < 0.99 * rest_ohm).all())
        assert eventually(lambda: node.scans_sent > scans + 3)
        mute.wanted = False
        assert eventually(lambda: host.stats().nodes["p0"].baselines == 1)
        assert eventually(lambda: depth_m(host, "p0") < 1e-6)
        assert host.stats().patches["p0"].assembler.summaries_lost == 0
        assert host.stats().nodes["p0"].rejoins == 0


def test_a_guest_does_not_tare(make_hand: Callable[..., HandConfig], rack_of: Callable[..., Rack]) -> None:
    bus = {"interface": "timed", "channel": uuid.uuid4().hex[:8], "role": "guest", "guest_sends": "sdo"}
    hand = make_hand(1, sync={"period_ms": 25, "counter_overflow": 0}, buses=[bus])
    rack_of(hand).plug("p0")
    with Host.from_config(hand) as host:
        with pytest.raises(NodeError, match=r"p0.*not tared: another master runs the bus"):
            host.tare("p0")
        with pytest.raises(KeyError):
            host.tare("thumb")


def test_a_baseline_of_a_file_is_not_tared_over(
    make_hand: Callable[..., HandConfig], rack_of: Callable[..., Rack], tmp_path: Path
) -> None:
    own = make_hand(1)
    rack = rack_of(own)
    np.savetxt(tmp_path / "p0.txt", rack.sources["p0"].ohm)
    rack.plug("p0")
    patch = own.patches[0].model_copy(update={"baseline": tmp_path / "p0.txt"})
    with (
        Host.from_config(own.model_copy(update={"patches": (patch,)})) as host,
        pytest.raises(NodeError, match=r"its baseline is kept in .*p0\.txt"),
    ):
        host.tare("p0")


def test_who_is_not_operational_is_not_tared(
    make_hand: Callable[..., HandConfig],
    rack_of: Callable[..., Rack],
    listener_of: Callable[[HandConfig], CanPort],
) -> None:
    hand = make_hand(2, bring_up={"missing": "wait"})
    rack_of(hand).plug("p1")
    listener = listener_of(hand)
    with Host.from_config(hand, boot_deadline_s=0.2) as host:
        with pytest.raises(NodeError, match="not operational"):
            host.tare("p0")
        host.tare("p1")
        assert eventually(lambda: any((f.can_id, f.data[:4]) == (0x206, b"tare") for f in heard(listener)))


def test_a_tap_hears_nothing_after_its_end(hand: HandConfig, rack: Rack, tmp_path: Path) -> None:
    with Host.from_config(hand) as host, Recorder(hand, tmp_path / "one.log") as recorder:
        untap = host.tap(recorder)
        assert eventually(lambda: recorder.stats().frames > 50)
        untap()
        scans = host.stats().patches["p0"].solved
        assert eventually(lambda: host.stats().patches["p0"].solved > scans + 2)
        frames = recorder.stats().frames
        assert eventually(lambda: host.stats().patches["p0"].solved > scans + 10)
        assert recorder.stats().frames == frames


def test_a_tare_returns_when_the_new_baseline_is_in_use(hand: HandConfig, rack: Rack) -> None:
    with Host.from_config(hand) as host:
        events = host.events()
        rest_ohm = rack.sources["p0"].ohm
        rack.sources["p0"].ohm = 0.98 * rest_ohm
        assert eventually(lambda: depth_m(host, "p0") > 1e-5)
        host.tare("p0")
        assert host.stats().nodes["p0"].baselines == 1
        for field in host.fields(patch="p0", timeout_s=5.0):  # the first one solved after it
            assert np.abs(field.displacement_m).max() < 1e-6
            break
        told: list[tuple[str, str]] = []

        def confirmed() -> bool:
            event = events.get(0.0)
            if event is not None:
                told.append((event.what, str(event)))
            return ("baselines", "p0: 1 new baseline in use") in told

        assert eventually(confirmed), told
        assert host.health("p0").baselines == 1
        assert host.health("p1").baselines == 0


@pytest.mark.long
def test_a_tare_whose_baseline_is_read_at_the_second_attempt_is_done(
    hand: HandConfig, rack: Rack, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, calls = Configurator.settle_baseline, []

    def fails_once(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 1:
            raise RuntimeError("first reading")
        return read(*arguments)

    with Host.from_config(hand) as host:
        monkeypatch.setattr(Configurator, "settle_baseline", fails_once)
        host.tare("p0")  # the patch is faulty meanwhile, and brought up again
        assert len(calls) == 2
        assert host.health("p0").baselines == 1


@pytest.mark.parametrize("deadline_s", [float("nan"), float("inf"), -1.0, 5000.0])
def test_a_time_limit_that_is_none_is_refused_before_the_tare(
    hand: HandConfig, rack: Rack, deadline_s: float
) -> None:
    with Host.from_config(hand) as host:
        with pytest.raises(ValueError, match=r"deadline_s: got .*, must be from 0 to 600"):
            host.tare("p0", deadline_s=deadline_s)
        assert host.health("p0").baselines == 0


def test_a_tare_can_be_cancelled(hand: HandConfig, rack: Rack) -> None:
    with Host.from_config(hand) as host:
        rack.pull("p0")  # its last heartbeat still counts
        with pytest.raises(SkinError, match=r"patch 'p0' on can0: tare commanded, but .* was cancelled"):
            host.tare("p0", deadline_s=60.0, cancelled=lambda: True)


def test_a_tare_that_the_node_does_not_take_is_a_timeout(hand: HandConfig, rack: Rack) -> None:
    with Host.from_config(hand) as host:
        rack.pull("p0")  # its last heartbeat still counts
        with pytest.raises(
            NodeTimeout,
            match=r"node 5: patch 'p0' on can0: tare commanded, but no new baseline arrived within 0.2 s",
        ):
            host.tare("p0", deadline_s=0.2)
        host.tare("p1")
