"""Frozen patches, wires and crossings on the whole road: named, left out or not trusted, and readmitted."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np
import pytest

from skinnode.config import parse_hand
from skinnode.host import Condition, Host
from skinnode.host.converter_liveness import Alive
from skinnode.host.publish import Subscription
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.model.forward import resistance_ohm
from skinnode.model.frames import FieldFrame
from tests.lanes import some_long
from vcan_sim.faults import NO_FAULTS, Faults
from vcan_sim.fleet import Fleet

from .conftest import SMALL, eventually

PRESSED_M = 5e-5
"""Depth from which a press is under way: a twelfth of its final depth."""
IN_FLIGHT = 3
"""Scans that may have been read before a fault took effect, or await their field."""


class Road:
    """A patch that is being pressed, from its converter to its fields."""

    def __init__(self, fleet: Fleet, host: Host, fields: Subscription) -> None:
        self.fleet, self.host, self._fields = fleet, host, fields

    def inject(self, faults: Faults) -> int:
        """Inject faults; returns the newest scan before them."""
        self.fleet.inject(faults, "p0")
        return self.newest

    @property
    def newest(self) -> int:
        field = self.host.latest("p0")
        assert field is not None
        assert field.stamp is not None
        return field.stamp.scan

    def fields_until(self, scan: int) -> list[FieldFrame]:
        """The fields up to this scan that were not taken before."""
        found = []
        while not found or found[-1].stamp.scan < scan:
            field = self._fields.get(10.0)
            assert field is not None
            found.append(field)
        return found

    def pressed(self) -> bool:
        field = self.host.latest("p0")
        return field is not None and field.displacement_m[..., 2].min() < -PRESSED_M

    def under_the_press(self) -> tuple[int, int]:
        """The upper and the lower wire that cross where the resistances change most, inside the patch."""
        scene = self.fleet.patches["p0"].scene
        rest, held_s = scene.layout.upper_m, scene.lead_s + 0.4 * scene.simulation.cycle_s
        pressed_ohm = resistance_ohm(scene.layout, scene.upper_m(held_s))
        change = np.abs(np.log(pressed_ohm / resistance_ohm(scene.layout, rest)))[1:-1, 1:-1]
        upper, lower = np.unravel_index(int(change.argmax()), change.shape)
        return int(upper) + 1, int(lower) + 1

    def deviations(self, field: FieldFrame) -> float:
        """Largest error of a field, in its standard deviations."""
        assert field.stamp is not None
        truth_m = self.fleet.truth_m("p0", field.stamp.device_time_us)
        rest_m = self.host.hand.patches[0].layout.build().upper_m
        error = np.abs(field.displacement_m - (truth_m - rest_m)) / field.displacement_std_m
        return float(np.nanmax(error))


@pytest.fixture
def road() -> Callable[..., AbstractContextManager[Road]]:
    """A small patch with a converter of ``noise``, in mid-press."""

    @contextmanager
    def pressed(noise: float, faults: Faults = NO_FAULTS) -> Iterator[Road]:
        hand = parse_hand(
            {
                "buses": [{"name": "can0", "interface": "timed", "channel": uuid.uuid4().hex[:8]}],
                "patches": [{"name": "p0", "node_id": 5, "layout": SMALL, "relative_noise": noise}],
                "sync": {"period_ms": 50},
                "simulation": {"cycle_s": 16.0, "depth": 0.3, "converter_noise": noise},
            }
        )
        with Fleet(hand, faults=faults) as fleet, Host.from_config(hand) as host:
            road = Road(fleet, host, host.fields(capacity=5000))
            assert eventually(road.pressed, 20.0)
            yield road

    return pressed


def of_patch(field: FieldFrame) -> list[DataFault]:
    return [fault for fault in field.faults if fault.part is FaultyPart.PATCH]


@pytest.mark.parametrize(
    ("noise", "faults", "within"),
    [
        (3e-6, Faults(frozen=True), 1),
        pytest.param(1e-4, Faults(frozen=True, uncounted=True), 6, marks=pytest.mark.long),
    ],
)
def test_patch_frozen_in_mid_press_is_never_trusted(road, noise: float, faults: Faults, within: int) -> None:
    before = Faults(uncounted=faults.uncounted)
    with road(noise, before) as it:
        last = it.inject(faults)
        assert eventually(lambda: it.host.health("p0").condition is Condition.FROZEN)
        assert it.host.health("p0").alive is Alive.NO
        reason = it.host.health("p0").reason
        assert reason.startswith("node 5 is frozen: its co")
        target = it.newest + 20
        frozen = [field for field in it.fields_until(target) if field.stamp.scan > last + IN_FLIGHT + within]
        assert frozen
        for field in frozen:
            assert not field.trusted
            assert field.distrust.startswith("its converter" if within == 1 else "its codes")
            (fault,) = of_patch(field)
            assert fault.kind is FaultKind.FROZEN
            assert last < fault.since <= last + IN_FLIGHT + within + 1
        it.inject(before)
        assert eventually(lambda: it.host.health("p0").condition is Condition.OPERATIONAL)
        assert eventually(lambda: not of_patch(it.host.latest("p0")))
        assert it.host.health("p0").alive is Alive.YES


@pytest.mark.parametrize(
    ("part", "names"),
    [
        pytest.param(FaultyPart.LOWER, {"lower": "frozen_lower"}, marks=pytest.mark.long),
        (FaultyPart.UPPER, {"upper": "frozen_upper"}),
        pytest.param(
            FaultyPart.CROSSING, {"upper": "stuck_upper", "lower": "stuck_lower"}, marks=pytest.mark.long
        ),
    ],
)
@pytest.mark.parametrize("noise", some_long([3e-6, 1e-4], 3e-6))
def test_frozen_part_is_named_left_out_and_readmitted(
    road, part: FaultyPart, names: dict[str, str], noise: float
) -> None:
    with road(noise) as it:
        wire = dict(zip(("upper", "lower"), it.under_the_press(), strict=True))
        wire = {side: wire[side] for side in names}
        faults = Faults(**{name: wire[side] for side, name in names.items()})
        events = it.host.events()
        last = it.inject(faults)

        def named() -> list[DataFault]:
            return [fault for fault in it.host.health("p0").faults if fault.kind is FaultKind.FROZEN]

        assert eventually(lambda: bool(named()), 10.0)
        (fault,) = named()
        assert (fault.part, fault.upper, fault.lower) == (part, wire.get("upper"), wire.get("lower"))
        assert fault.since > last
        assert fault.deviations > 3.0
        assert eventually(lambda: it.host.health("p0").condition is Condition.OPERATIONAL, 10.0)
        left_out = [field for field in it.fields_until(it.newest + 10) if fault in field.faults]
        assert left_out
        for field in left_out:
            assert not field.trusted or it.deviations(field) < 5.0
        it.inject(NO_FAULTS)
        assert eventually(lambda: not named(), 10.0)
        found = {event.what: event.text for event in iter(lambda: events.get(0.2), None)}
        assert found["left out"].startswith(f"{fault.place} repeats its codes; left out of the solve")
        assert found["readmitted"] == f"{fault.place} no longer repeats its codes"


@pytest.mark.parametrize(
    ("faults", "part", "kind", "wire"),
    [
        (Faults(open_lower=7), FaultyPart.LOWER, FaultKind.OPEN, {"lower": 7}),
        pytest.param(
            Faults(shorted_upper=1), FaultyPart.UPPER, FaultKind.SHORT, {"upper": 1}, marks=pytest.mark.long
        ),
    ],
)
def test_broken_wires_of_either_layer_are_in_the_field(
    road, faults: Faults, part: FaultyPart, kind: FaultKind, wire: dict[str, int]
) -> None:
    with road(3e-6) as it:
        last = it.inject(faults)
        broken = [
            [fault for fault in field.faults if fault.kind is kind]
            for field in it.fields_until(last + 20)
            if field.stamp.scan > last + IN_FLIGHT
        ]
        assert broken
        assert {len(found) for found in broken} == {1}
        assert broken[0] == broken[-1]
        (fault,) = broken[0]
        assert (fault.part, fault.upper, fault.lower) == (part, wire.get("upper"), wire.get("lower"))
        assert last < fault.since <= last + IN_FLIGHT + 1
        assert fault.deviations == np.inf
