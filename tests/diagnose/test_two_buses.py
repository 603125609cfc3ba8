"""A hand on two buses: the commands find the bus of a patch themselves, and say so if they cannot."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from skinnode.config import load_hand
from vcan_sim.fleet import Fleet

from .conftest import SMALL, interface_in_this_time, run


@pytest.fixture
def two_buses(tmp_path: Path, on: Callable[[Any], Any]) -> Path:
    """The file of a hand whose node-ID 5 is on both buses, 6 on the second only; its nodes run."""
    sizes = ", ".join(f"{key} = {value}" for key, value in SMALL.items())
    text = "[sync]\nperiod_ms = 50\n"
    for bus in ("left", "right"):
        text += f'[[buses]]\nname = "{bus}"\ninterface = "{interface_in_this_time()}"\n'
        text += f'channel = "{uuid.uuid4().hex}"\n'
    for name, bus, node_id in (("palm", "left", 5), ("thumb", "right", 5), ("index", "right", 6)):
        text += f'[[patches]]\nname = "{name}"\nbus = "{bus}"\n'
        text += f"node_id = {node_id}\nserial = {node_id}{len(name)}\n"
        text += f'layout = {{ preset = "staggered", {sizes} }}\n'
    file = tmp_path / "two.toml"
    file.write_text(text)
    on(Fleet(load_hand(file)))
    return file


@pytest.mark.long
def test_a_patch_is_found_on_its_bus(two_buses: Path) -> None:
    for patch, serial in (("palm", 54), ("thumb", 55), ("index", 65)):
        done = run(["info", patch, "--hand", two_buses, "--json"])
        assert done.status == 0, done.stderr
        assert (done.json["patch_name"], done.json["serial"]) == (patch, serial)
    assert run(["info", "6", "--hand", two_buses, "--json"]).json["patch_name"] == "index"
    assert "thumb" in run(["info", "5", "--hand", two_buses, "--bus", "right"]).stdout
    assert run(["od", "index", "1018:4", "--hand", two_buses, "--json"]).json[0]["value"] == 65
    (change,) = run(["nmt", "thumb", "start", "--hand", two_buses, "--json"]).json
    assert (change["bus"], change["node_id"], change["followed"]) == ("right", 5, True)


@pytest.mark.long
@pytest.mark.parametrize(
    "command",
    [["info", "5"], ["od", "5", "1018:4"], ["nmt", "5", "start"]],
    ids=lambda command: command[0],
)
def test_a_node_id_of_both_buses_is_asked_about(two_buses: Path, command: list[str]) -> None:
    done = run([*command, "--hand", two_buses])
    assert done.status == 2
    assert done.stderr == (
        "error: NODE: got 5, allowed: a node-ID that is on one bus only; this node-ID is palm on left "
        "and thumb on right; name the patch, or add --bus left or --bus right"
    )


@pytest.mark.long
def test_a_patch_named_like_a_number_is_not_mistaken_for_a_node(two_buses: Path) -> None:
    """The index, node 6, is renamed to 5, the node-ID of both other patches."""
    two_buses.write_text(two_buses.read_text().replace('"index"', '"5"'))
    assert run(["info", "5", "--hand", two_buses, "--json"]).json["serial"] == 65
    assert run(["info", "0x5", "--hand", two_buses, "--bus", "right", "--json"]).json["serial"] == 55
    assert run(["info", "5", "--hand", two_buses, "--bus", "right", "--json"]).json["serial"] == 65


@pytest.mark.long
def test_a_node_id_of_no_patch_needs_a_bus(two_buses: Path) -> None:
    done = run(["info", "9", "--hand", two_buses])
    assert done.status == 2
    assert "a node-ID in the hand, or any node-ID with --bus left or --bus right" in done.stderr
    done = run(["info", "pinky", "--hand", two_buses])
    assert done.stderr == (
        "error: NODE: got 'pinky', allowed: a node-ID from 1 to 127, or palm, thumb, index"
    )
    done = run(["info", "palm", "--hand", two_buses, "--bus", "right"])
    assert done.stderr == "error: NODE: got 'palm', allowed: a node-ID from 1 to 127, or thumb, index"
    assert "got 'up', allowed: one of left, right" in run(["scan", "--hand", two_buses, "--bus", "up"]).stderr


@pytest.mark.long
def test_scan_and_nmt_all_take_every_bus(two_buses: Path) -> None:
    done = run(["scan", "--hand", two_buses, "--json"])
    assert done.status == 0
    assert [(node["bus"], node["patch"]) for node in done.json["nodes"]] == [
        ("left", "palm"),
        ("right", "thumb"),
        ("right", "index"),
    ]
    assert [bus["name"] for bus in done.json["buses"]] == ["left", "right"]
    changes = run(["nmt", "all", "start", "--hand", two_buses, "--json"]).json
    assert [(change["bus"], change["node_id"]) for change in changes] == [
        ("left", 5),
        ("right", 5),
        ("right", 6),
    ]
    assert all(change["followed"] for change in changes)
    text = run(["scan", "--hand", two_buses]).stdout
    assert "(palm)" in text
    assert "(index)" in text
    assert "without a node-ID" in run(["lss", "list", "--hand", two_buses]).stdout


@pytest.mark.long
def test_lss_set_finds_the_bus_by_serial_number_or_node_id(two_buses: Path) -> None:
    done = run(["lss", "set", "--serial", 65, "--node-id", 7, "--yes", "--no-store", "--hand", two_buses])
    assert done.status == 0, done.stderr
    done = run(["lss", "set", "--node-id", 5, "--yes", "--hand", two_buses])
    assert done.status == 2
    assert done.stderr == "error: --bus: got nothing, allowed: one of left, right"
