"""What the view says of a host, held against the truth of the simulator; maps and lines of any size."""

from __future__ import annotations

import dataclasses
import json
import re
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from skinnode.host import Host, PatchHealth
from skinnode.host.health import Condition
from skinnode.model.data_fault import DataFault, FaultKind, FaultyPart
from skinnode.model.frames import FieldFrame, SolveStats
from skinnode.model.layout import PatchLayout
from skinnode.model.status import Status
from skinnode.monitor import field_map
from skinnode.monitor.field_map import Colours, MapStyle, Scale, aspect_of, paint_map, paint_shear, surface_of
from skinnode.monitor.live_source import HostSource
from skinnode.monitor.replay_source import ReplaySource
from skinnode.monitor.screen import screen
from skinnode.monitor.session_faults import FaultBook, as_json
from skinnode.monitor.theme import Paint, UiState, theme_for
from skinnode.monitor.view_model import History, PatchView, View, judge_patch
from skinnode.record import Recorder, replay
from tests.lanes import some_long
from vcan_sim.faults import Faults
from vcan_sim.fleet import Fleet

from .conftest import a_hand

LAYOUT = PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3)
"""10 × 10 electrodes."""


def as_text(lines: Sequence[field_map.Line]) -> str:
    """The text without its styles."""
    return "\n".join("".join(segment.text for segment in line) for line in lines)


def a_field(moved_m: dict[tuple[int, int], tuple[float, float, float]], std_m: float = 1e-7) -> FieldFrame:
    displacement_m = np.zeros_like(LAYOUT.upper_m)
    for place, vector in moved_m.items():
        displacement_m[place] = vector
    wires = displacement_m.shape[0]
    return FieldFrame(
        displacement_m=displacement_m,
        displacement_std_m=np.full_like(displacement_m, std_m),
        status=(Status.CONVERGED,) * wires,
        residual=np.zeros(wires),
        stats=SolveStats(0, 0, 0, 0.0),
    )


def cells(lines: list[field_map.Line], sign: str) -> set[tuple[int, int]]:
    text = as_text(lines).split("\n")
    return {(x, y) for y, line in enumerate(text) for x, found in enumerate(line) if found == sign}


@pytest.mark.parametrize(("width", "height"), [(20, 10), (40, 20), (60, 30)])
@pytest.mark.parametrize(("wire", "electrode"), [(0, 0), (9, 9), (2, 7)])
def test_an_electrode_has_its_cell(width: int, height: int, wire: int, electrode: int) -> None:
    surface = surface_of(a_field({(wire, electrode): (0.0, 0.0, -3e-4)}), LAYOUT.upper_m)
    lines = paint_map(surface, MapStyle(3e-4, "none"), width, height, arrows=False)
    heaviest = next(sign for sign in "@%#*+=-:" if sign in as_text(lines))
    found = cells(lines, heaviest)
    across, down = width / 10, height / 10
    for x, y in found:
        assert electrode * across <= x + 0.5 <= (electrode + 1) * across
        assert (9 - wire) * down <= y + 0.5 <= (10 - wire) * down


def test_colours_are_the_brighter_the_deeper() -> None:
    steps = {(5, i): (0.0, 0.0, -3e-5 * i) for i in range(10)}
    lines = paint_map(surface_of(a_field(steps), LAYOUT.upper_m), MapStyle(3e-4, "rgb"), 10, 10, arrows=False)
    line = lines[4]  # that of wire 5
    shades = []
    for segment in line:
        assert segment.style is not None
        colour = segment.style.bgcolor
        assert colour is not None
        assert colour.triplet is not None
        shades += [sum(colour.triplet)] * len(segment.text)
    assert shades == sorted(shades)
    assert shades[-1] > 10 * max(1, shades[0])


def test_sixteen_colours_and_none_are_kept_to() -> None:
    surface = surface_of(a_field({(4, 4): (1e-4, 0.0, -3e-4)}), LAYOUT.upper_m)
    for colours in ("ansi", "none"):
        lines = paint_map(surface, MapStyle(3e-4, colours), 30, 15, arrows=True)
        lines += paint_shear(surface, MapStyle(3e-4, colours), 30, 15)
        for segment in (segment for line in lines for segment in line):
            style = segment.style
            for colour in () if style is None else (style.color, style.bgcolor):
                assert colour is None or (
                    colours == "ansi" and colour.number is not None and colour.number < 16
                )


@pytest.mark.parametrize("turn", range(8))
def test_arrows_of_all_eight_directions(turn: int) -> None:
    angle = turn * np.pi / 4
    everywhere = {
        (wire, electrode): (2e-4 * np.cos(angle), 2e-4 * np.sin(angle), -3e-4)
        for wire in range(10)
        for electrode in range(10)
    }
    surface = surface_of(a_field(everywhere), LAYOUT.upper_m)
    sign = "→↗↑↖←↙↓↘"[turn]
    assert len(cells(paint_shear(surface, MapStyle(3e-4, "none"), 40, 20), sign)) >= 100
    assert cells(paint_map(surface, MapStyle(3e-4, "none"), 40, 20, arrows=True), sign)
    assert not cells(paint_map(surface, MapStyle(3e-4, "none"), 40, 20, arrows=False), sign)


def test_shear_within_its_noise_is_no_arrow_and_unknown_skin_is_not_untouched() -> None:
    noisy = surface_of(a_field({(4, 4): (1e-4, 0.0, -3e-4)}, std_m=5e-5), LAYOUT.upper_m)
    assert "→" not in as_text(paint_shear(noisy, MapStyle(3e-4, "none"), 40, 20))
    unknown = surface_of(a_field({}, std_m=np.inf), LAYOUT.upper_m)
    assert set(as_text(paint_map(unknown, MapStyle(3e-4, "none"), 20, 10, arrows=True))) == {"?", "\n"}
    assert unknown.deepest_m == 0.0


def test_a_long_patch_is_drawn_long() -> None:
    long = PatchLayout.preset("staggered", pitch_m=4e-3, height_m=2e-3, upper_wires=4, upper_electrodes=12)
    assert aspect_of(long.upper_m) == pytest.approx(3.0, rel=0.05)
    assert field_map.fit(60, 30, 3.0) == (60, 10)
    assert field_map.fit(60, 5, 3.0) == (30, 5)


def test_the_scale_has_room_for_what_is_deepest_and_goes_back() -> None:
    scale, second = Scale(), 1_000_000_000
    scale.update(0, 2e-6)
    assert scale.full_m == pytest.approx(5e-5)
    scale.update(1 * second, 5.5e-4)
    assert scale.full_m == pytest.approx(7e-4)
    scale.update(2 * second, 1e-5)
    assert scale.full_m == pytest.approx(7e-4)  # so that it does not flicker
    scale.update(9 * second, 1e-5)
    assert scale.full_m == pytest.approx(5e-5)


def the_view(source: HostSource, history: History, until: float = 8.0) -> View:
    """A view of a host that has been looked at for a second, and is pressed."""
    end_s = time.monotonic() + until
    view, begun_s = history.add(source.snapshot()), time.monotonic()
    while time.monotonic() < end_s:
        time.sleep(0.02)
        view = history.add(source.snapshot())
        if time.monotonic() > begun_s + 1.0 and all((patch.depth_m or 0.0) > 1e-4 for patch in view.patches):
            break
    return view


@pytest.mark.long
def test_touches_and_rates_are_those_of_the_scene() -> None:
    hand = a_hand(1, simulation={"seed": 3, "depth": 0.2, "cycle_s": 2.0, "indenter_radius_m": 0.02})
    with Fleet(hand) as fleet, Host.from_config(hand) as host, HostSource(host) as source:
        view = the_view(source, History(hand))
        field = host.latest("p0")
        patch = view.patch("p0")
        while field is None or field.stamp is None or field.stamp.scan != patch.scan:
            view = History(hand).add(source.snapshot())
            patch, field = view.patch("p0"), host.latest("p0")
        truth_m = fleet.truth_m("p0", field.stamp.device_time_us) - hand.patches[0].layout.build().upper_m
        report = json.loads(json.dumps(as_json(view)))
    depth_m = -truth_m[..., 2]
    assert patch.depth_m == pytest.approx(float(depth_m.max()), abs=5e-6)
    (touch,) = patch.touches
    wire, electrode = np.unravel_index(int(depth_m.argmax()), depth_m.shape)
    x_m, y_m = hand.patches[0].layout.build().upper_m[wire, electrode, :2]
    assert abs(touch.x_m - x_m) < 4e-3  # a pitch
    assert abs(touch.y_m - y_m) < 4e-3
    assert patch.method == "exact"
    assert touch.force_n is not None
    assert touch.force_n > 0.0
    assert report["patches"]["p0"]["touches"][0]["x_m"] == touch.x_m
    assert report["patches"]["p0"]["condition"] == "operational"
    assert report["buses"]["can0"]["level"] == "good"


@pytest.mark.long
def test_the_posterior_tells_forces() -> None:
    hand = a_hand(1, solver={"method": "posterior"}, simulation={"depth": 0.3, "indenter_radius_m": 0.02})
    with Fleet(hand), Host.from_config(hand) as host, HostSource(host) as source:
        patch = the_view(source, History(hand)).patch("p0")
    assert patch.method == "posterior"
    assert patch.touches
    assert patch.touches[0].force_n is not None
    assert patch.touches[0].force_n > 0.1


@pytest.mark.long
@pytest.mark.parametrize("colours", some_long(["rgb", "ansi", "none"], "rgb"))
@pytest.mark.parametrize("patches", some_long([1, 3, 16], 1, 3))
def test_every_line_has_its_width_at_every_size(patches: int, colours: Colours) -> None:
    hand = a_hand(patches, sync={"period_ms": 200})
    with Fleet(hand), Host.from_config(hand) as host, HostSource(host) as source:
        time.sleep(0.5)
        view = History(hand).add(source.snapshot())
    for width, height in ((80, 24), (50, 16), (132, 43), (200, 50), (20, 5)):
        for zoomed in (False, True):
            ui = UiState("hand", "p0", zoomed=zoomed, message="said" if zoomed else "")
            lines = screen(view, Paint(theme_for(colours), ui, 1e-4), [], width, height)
            assert len(lines) == height
            assert {sum(segment.cell_length for segment in line) for line in lines} == {width}
            if width >= 80 and not zoomed:
                assert all(f"p{number}" in as_text(lines) for number in range(patches))


def test_untouched_skin_has_an_outline() -> None:
    hand = a_hand(2, sync={"period_ms": 100}, simulation={"depth": 0.0})
    with Fleet(hand), Host.from_config(hand) as host, HostSource(host) as source:
        history = History(hand)
        view = history.add(source.snapshot())
        while any(patch.surface is None for patch in view.patches):
            time.sleep(0.02)
            view = history.add(source.snapshot())
    for width, height in ((80, 24), (132, 43)):
        text = as_text(screen(view, Paint(theme_for("rgb"), UiState("hand", "p0"), 1e-4), [], width, height))
        assert text.count("┌") == text.count("┘") == 2
        alone = UiState("hand", "p0", zoomed=True)
        text = as_text(screen(view, Paint(theme_for("rgb"), alone, 1e-4), [], width, height))
        assert text.count("┌") == text.count("┘") == 2  # depth and shear


def test_no_line_says_that_all_is_well_beside_a_fault() -> None:
    hand = a_hand(2, sync={"period_ms": 50})
    with Fleet(hand) as fleet, Host.from_config(hand) as host, HostSource(host) as source:
        history = History(hand)
        ui, theme = UiState("hand", "p0"), theme_for("rgb")
        begun_s = time.monotonic()
        while time.monotonic() < begun_s + 8.0:
            time.sleep(0.05)
            view = history.add(source.snapshot())
            if all(patch.level == "good" and patch.depth_m is not None for patch in view.patches):
                break
        well = as_text(screen(view, Paint(theme, ui, 1e-4), [], 120, 40))
        fleet.inject(Faults(lost=0.05, open_upper=1), "p0")
        while time.monotonic() < begun_s + 20.0:
            time.sleep(0.05)
            view = history.add(source.snapshot())
            patch = view.patch("p0")
            if patch.level == "bad" and patch.stream.assembler.chunks_lost:
                break
        lines = screen(view, Paint(theme, ui, 1e-4), [], 120, 40)
    assert "nothing happened" in well
    assert "nothing lost" in well
    ill = as_text(lines)
    assert "nothing happened" not in ill
    assert "no events yet; earlier faults: p0 faulty" in ill
    assert "nothing lost" not in ill
    (told,) = [segment for line in lines for segment in line if re.match(r"\d+ chunks? lost", segment.text)][
        :1
    ]
    assert told.style != theme.good


def test_a_patch_that_cannot_be_brought_up_says_why() -> None:
    sound = PatchHealth(
        patch="p0",
        node_id=5,
        condition=Condition.BOOTING,
        nmt_state=127,
        heartbeat_age_s=0.1,
        scan_age_s=None,
        boot_ups=1,
        emergencies=0,
        last_emergency=None,
        emergency_text="",
        error_register=0,
    )
    why = "node 5: no answer to 0x1018"
    for condition, word in ((Condition.BOOTING, "booting"), (Condition.STALE, "starting")):
        health = dataclasses.replace(sound, condition=condition)
        assert judge_patch(health, []) == (word, "note", ())
        assert judge_patch(dataclasses.replace(health, complaint=why), []) == (word, "note", (why,))
    refused = dataclasses.replace(sound, condition=Condition.REFUSED, complaint=why, refusal=why)
    assert judge_patch(refused, []) == ("refused", "bad", (why,))


@pytest.mark.long
def test_a_recording_is_shown_as_it_was_and_cannot_be_tared(tmp_path: Path) -> None:
    hand = a_hand(2, sync={"period_ms": 200})
    with (
        Fleet(hand),
        Recorder(hand, tmp_path / "run.log") as recorder,
        Host.from_config(hand, tap=recorder) as host,
    ):
        end_s = time.monotonic() + 10.0
        while host.stats().patches["p1"].solved < 6 and time.monotonic() < end_s:
            time.sleep(0.02)
        live = host.stats().patches["p0"].solved
    faults = FaultBook(live=False)
    with ReplaySource(replay(tmp_path / "run.log", speed=20.0)) as source:
        history = History(source.hand)
        end_s = time.monotonic() + 10.0
        while not source.over and time.monotonic() < end_s:
            faults.update(history.add(source.snapshot()), time.monotonic_ns())
            time.sleep(0.01)
        view = history.add(source.snapshot())
        assert source.over
        assert not source.live
    assert view.patch("p0").stream.solved >= live
    assert view.patch("p0").surface is not None
    assert faults.lines == []


@pytest.mark.parametrize(("live", "says"), [(True, ["p0: never seen"]), (False, [])])
def test_a_patch_that_never_comes_is_a_fault_after_three_seconds_or_at_the_end_of_a_recording(
    live: bool, says: list[str]
) -> None:
    hand = a_hand(1, bring_up={"missing": "wait"})
    with Host.from_config(hand) as host, HostSource(host) as source:
        view = History(source.hand).add(source.snapshot())
    faults = FaultBook(live=live)
    for t_s in (0, 1, 4):
        faults.update(view, t_s * 1_000_000_000)
    assert faults.lines == says
    faults.update(view, 5_000_000_000, ending=True)
    assert faults.lines == ["p0: never seen"]


def test_a_field_that_is_not_to_be_trusted_says_why_on_its_tile_and_alone() -> None:
    hand = a_hand(1, sync={"period_ms": 50}, simulation={"depth": 0.0})
    with Fleet(hand), Host.from_config(hand) as host, HostSource(host) as source:
        history = History(hand)
        view = history.add(source.snapshot())
        while view.patches[0].depth_m is None:
            time.sleep(0.02)
            view = history.add(source.snapshot())
    fault = DataFault(FaultyPart.LOWER, FaultKind.CONTRADICTS, lower=7, since=90)
    sound = dataclasses.replace(view.patches[0], condition="operational", level="good", words=())
    doubtful = dataclasses.replace(
        sound, trusted=False, distrust="half of its readings are lost", data_share=0.25, data_faults=(fault,)
    )

    def shown(patch: PatchView, *, zoomed: bool) -> str:
        ui = UiState("hand", "p0", zoomed=zoomed)
        return as_text(
            screen(
                dataclasses.replace(view, patches=(patch,)), Paint(theme_for("none"), ui, 1e-4), [], 200, 50
            )
        )

    tile = shown(doubtful, zoomed=False)
    assert "not trusted: half of its readings are lost" in tile
    alone = re.sub(r"\s+", " ", shown(doubtful, zoomed=True))
    assert "not trusted, precise" in alone
    assert "half of its readings are lost" in alone
    assert "25% of the depth comes from the data" in alone
    assert "lower wire 7" in alone
    assert "not precise" in shown(dataclasses.replace(sound, precise=False), zoomed=False)
    assert "left out: lower wire 7" in shown(dataclasses.replace(sound, data_faults=(fault,)), zoomed=False)
    assert "trusted, precise" in shown(sound, zoomed=True)
