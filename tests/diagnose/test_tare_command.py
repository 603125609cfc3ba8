"""``skinnode tare``: patches are tared with and without a host, and what could not be done is said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinnode.canopen import indices as od
from skinnode.config import BusConfig, load_hand
from skinnode.diagnose.bus_connection import BusConnection
from skinnode.host import Host
from skinnode.model.forward import resistance_ohm
from skinnode.node import PatchNode
from skinnode.process import clock
from vcan_sim.fleet import Fleet

from .conftest import LAYOUT, Rest, run

Powered = Callable[..., list[PatchNode]]


def baseline_ohm(connection: BusConnection, node_id: int) -> np.ndarray[Any, Any]:
    return np.frombuffer(connection.od(node_id).read_block(od.BASELINE_DOMAIN), "<f4").astype(np.float64)


def test_a_node_takes_what_it_feels_now(
    any_bus: BusConfig, powered: Powered, connection_on: Callable[[BusConfig], BusConnection]
) -> None:
    source = Rest(LAYOUT)
    powered(any_bus, 5, 6, source=source)
    source.change = lambda ohm: 0.98 * ohm
    done = run(["tare", "5", "--json"], any_bus)
    assert done.status == 0, done.stderr
    (row,) = done.json
    assert (row["node_id"], row["tared"], row["problem"], row["crossings"]) == (5, True, None, 12)
    assert row["median_change"] == pytest.approx(-0.02, abs=1e-6)
    rest_ohm = resistance_ohm(LAYOUT, LAYOUT.upper_m).ravel()
    connection = connection_on(any_bus)
    assert baseline_ohm(connection, 5) == pytest.approx(0.98 * rest_ohm)
    assert baseline_ohm(connection, 6) == pytest.approx(rest_ohm)
    text = run(["tare", "5", "6"], any_bus).stdout
    assert "tared: 12 crossings" in text
    assert "+0.000 %" in text
    assert "-2.000 %" in text


def test_what_was_not_tared_is_said(bus: BusConfig, powered: Powered) -> None:
    source = Rest(LAYOUT)
    powered(bus, 5, source=source)

    def fail(ohm: Any) -> Any:
        raise OSError("no reference voltage")

    source.change = fail
    done = run(["tare", "5", "9", "--json"], bus)
    assert done.status == 1
    assert [(row["node_id"], row["tared"], row["problem"]) for row in done.json] == [
        (5, False, "its converter returned no reading (SDO abort 0x06060000)"),
        (9, False, "does not answer SDO requests"),
    ]
    assert run(["tare"], bus).stderr.startswith("error: PATCH: got nothing, allowed: names of patches")


def test_a_baseline_of_a_file_is_not_tared_over(
    hand_file: Callable[..., Path], on: Callable[[Any], Any], tmp_path: Path
) -> None:
    file = hand_file(f'baseline = "{tmp_path / "thumb.txt"}"')
    (tmp_path / "thumb.txt").touch()  # nobody reads it here
    on(Fleet(load_hand(file)))
    done = run(["tare", "--hand", file, "--json"])
    assert done.status == 1
    thumb, index = done.json
    assert (thumb["patch"], thumb["tared"]) == ("thumb", False)
    assert "thumb.txt" in thumb["problem"]
    assert (index["patch"], index["tared"]) == ("index", True)


def test_a_host_that_runs_reads_the_new_baseline_and_goes_on(
    hand_file: Callable[..., Path], on: Callable[[Any], Any]
) -> None:
    file = hand_file()
    on(Fleet(load_hand(file)))
    host = on(Host.from_toml(file))
    done = run(["tare", "thumb", "--hand", file, "--json"])
    assert done.status == 0, done.stdout + done.stderr
    end_s = clock.monotonic() + 20.0
    while host.stats().nodes["thumb"].baselines == 0 and clock.monotonic() < end_s:
        clock.sleep(0.02)
    stats = host.stats()
    assert (stats.nodes["thumb"].baselines, stats.nodes["index"].baselines) == (1, 0)
    assert {node.complaint for node in stats.nodes.values()} == {None}
    assert {node.rejoins for node in stats.nodes.values()} == {0}
    for name, stream in stats.patches.items():
        while (
            host.health(name).condition != "operational"
        ):  # a node that missed a scan is faulty for a moment
            assert clock.monotonic() < end_s, host.health(name)
            clock.sleep(0.02)
        assert (stream.assembler.chunks_lost, stream.assembler.scans_torn) == (0, 0)


def test_a_touch_during_the_tare_is_said(bus: BusConfig, powered: Powered) -> None:
    source = Rest(LAYOUT)
    powered(bus, 5, source=source)

    def press(ohm: Any) -> Any:
        pressed = 0.98 * ohm
        pressed[1, 1] *= 0.9
        return pressed

    source.change = press
    touched = run(["tare", "5"], bus)
    assert touched.status == 0, touched.stderr
    assert "as if something touched the skin now or at the previous tare" in touched.stdout
    source.change = lambda ohm: ohm
    assert run(["tare", "5", "--json"], bus).json[0]["touched_crossings"] > 0, "the old baseline was touched"
    assert run(["tare", "5", "--json"], bus).json[0]["touched_crossings"] == 0
