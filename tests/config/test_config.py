"""A hand file is read strictly; a mistake is one line: the thing, what it was, what is allowed."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from skinnode.config import BusConfig, load_hand, parse_hand
from skinnode.errors import ConfigError
from skinnode.model.layout import PatchLayout
from skinnode.model.tolerances import EXACT, ORDINARY, Tolerances

EXAMPLE = Path(__file__).parents[2] / "examples" / "hand.toml"
FD_EXAMPLE = EXAMPLE.with_name("hand-fd.toml")
MINIMAL: dict[str, Any] = {
    "buses": [{"name": "can0"}],
    "patches": [{"name": "thumb", "node_id": 1}, {"name": "index", "node_id": 2}],
}


def minimal() -> dict[str, Any]:
    return copy.deepcopy(MINIMAL)


def change(path: list[str | int], value: Any) -> Callable[[dict[str, Any]], None]:
    """A function that puts ``value`` at ``path``."""

    def apply(table: Any) -> None:
        for part in path[:-1]:
            table = table.setdefault(part, {}) if isinstance(part, str) else table[part]
        table[path[-1]] = value

    return apply


def test_example_is_the_hand_of_the_readme() -> None:
    hand = load_hand(EXAMPLE)
    assert [(patch.name, patch.node_id) for patch in hand.patches] == [
        ("thumb", 11),
        ("index", 12),
        ("middle", 13),
        ("palm", 14),
    ]
    assert hand.bus("can0").interface == "udp_multicast"
    layout = hand.patch("thumb").layout.build()
    assert layout.layout_hash == PatchLayout.preset("staggered", height_m=2e-3).layout_hash
    assert layout.shape == (10, 30)


def test_fd_example_is_the_same_hand_faster() -> None:
    hand, fd = load_hand(EXAMPLE), load_hand(FD_EXAMPLE)
    assert fd.buses[0].fd
    hashes = [[patch.layout.build().layout_hash for patch in one.patches] for one in (hand, fd)]
    assert hashes[0] == hashes[1]
    assert fd.sync.period_ms == 20


def test_example_says_the_defaults() -> None:
    """Its comment promises that the values shown are those of a file that leaves them out."""
    hand = load_hand(EXAMPLE)
    buses = [{"name": "can0", "interface": "udp_multicast", "channel": "239.74.163.2"}]
    patches = [{"name": patch.name, "node_id": patch.node_id} for patch in hand.patches]
    spare = parse_hand({"name": hand.name, "buses": buses, "patches": patches})
    assert (hand.solver.method, spare.solver.method) == ("posterior", "auto")  # as its comment says
    hand = hand.model_copy(update={"solver": hand.solver.model_copy(update={"method": "auto"})})
    spare_patches = [patch.model_copy(update={"eds": None}) for patch in hand.patches]
    assert [patch.layout.build().layout_hash for patch in spare.patches] == [
        patch.layout.build().layout_hash for patch in hand.patches
    ]
    assert {patch.tolerances.build() for patch in hand.patches} == {EXACT}  # as its comment says
    assert all(patch.calibration.force_calibrated for patch in hand.patches)  # as its comment says
    others = {"layout", "tolerances", "calibration"}
    assert [patch.model_dump(exclude=others) for patch in spare.patches] == [
        patch.model_dump(exclude=others) for patch in spare_patches
    ]
    for part in ("buses", "sync", "solver", "simulation"):
        assert getattr(spare, part) == getattr(hand, part)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, ORDINARY),
        ("ordinary", ORDINARY),
        ("exact", EXACT),
        ({"placement": 0.01}, replace(ORDINARY, placement=0.01)),
        ({"placement": 0, "thickness": 0, "electrode_radius": 0, "gain": 0}, EXACT),
    ],
)
def test_tolerances_are_ordinary_exact_or_numbers(value: Any, expected: Tolerances) -> None:
    """Also after the hand has been written to a recording and read again."""
    table = minimal()
    if value is not None:
        table["patches"][0]["tolerances"] = value
    hand = parse_hand(table)
    assert hand.patches[0].tolerances.build() == expected
    again = parse_hand(json.loads(hand.model_dump_json()))
    assert again.patches[0].tolerances.build() == expected


NAME = "a string of 1 to 64 printable characters, not all blank"


@pytest.mark.parametrize(
    ("path", "value", "line"),
    [
        (
            ["patches", 1, "nodeid"],
            3,
            "patches[1].nodeid: got an unknown key, allowed: a key of this table "
            "(did you mean node_id?): name, node_id, bus, link, pose, eds, layout, code_bits, "
            "serial, relative_noise, row_time_us, baseline, calibration, tolerances",
        ),
        (
            ["colour"],
            "red",
            "colour: got an unknown key, allowed: a key of this table: "
            "name, buses, patches, links, sync, bring_up, solver, stream, simulation",
        ),
        (
            ["solver", "false_alarms_per_hour"],
            0,
            "solver.false_alarms_per_hour: got 0, allowed: a number from 1e-6 to 1e4 (1/h)",
        ),
        (["solver", "past"], "on", "solver.past: got 'on', allowed: off or auto"),
        (["solver", "prior"], "local", "solver.prior: got 'local', allowed: auto or cells or discs"),
        (
            ["patches", 1, "row_time_us"],
            -1,
            "patches[1].row_time_us: got -1, allowed: a number from 0 to 1e6 (µs)",
        ),
        (
            ["patches", 1, "row_time_us"],
            8001,
            "patches[1].row_time_us: got 8001.0, allowed: at most 8000, because 10 upper wires must be "
            "sampled within one SYNC period of 80 ms",
        ),
        (
            ["sync", "overflow"],
            240,
            "sync.overflow: got an unknown key, allowed: a key of this table "
            "(did you mean counter_overflow?): period_ms, counter_overflow, stagger_ms",
        ),
        (
            ["patches", 1, "node_id"],
            1,
            "patches[1].node_id: got 1, allowed: a value that patches[0] does not use",
        ),
        (
            ["patches", 1, "name"],
            "thumb",
            "patches[1].name: got 'thumb', allowed: a value that patches[0] does not use",
        ),
        *(
            (path, name, f"{key}: got {name!r}, allowed: {NAME}")
            for name in (
                "",
                "  ",
                "a\nb",
                "\x1b[31mred",
                "\u202e",
            )
            for path, key in (
                (["name"], "name"),
                (["buses", 0, "name"], "buses[0].name"),
                (["patches", 1, "name"], "patches[1].name"),
                (["patches", 1, "link"], "patches[1].link"),
            )
        ),
        (["patches", 0, "node_id"], 0, "patches[0].node_id: got 0, allowed: an integer from 1 to 127"),
        (["patches", 0, "node_id"], 128, "patches[0].node_id: got 128, allowed: an integer from 1 to 127"),
        (["patches", 0, "node_id"], "1", "patches[0].node_id: got '1', allowed: an integer from 1 to 127"),
        (["patches", 0, "node_id"], True, "patches[0].node_id: got True, allowed: an integer from 1 to 127"),
        (["patches", 0, "node_id"], 1.0, "patches[0].node_id: got 1.0, allowed: an integer from 1 to 127"),
        (["patches", 0, "bus"], "can7", "patches[0].bus: got 'can7', allowed: a bus of this file: can0"),
        (["patches", 0, "code_bits"], 12, "patches[0].code_bits: got 12, allowed: 16 or 24"),
        (["patches", 0, "serial"], -1, "patches[0].serial: got -1, allowed: an integer from 0 to 2^32 - 1"),
        (
            ["patches", 0, "layout", "preset"],
            "zigzag",
            "patches[0].layout.preset: got 'zigzag', allowed: aligned or symmetric or staggered",
        ),
        (
            ["patches", 0, "layout", "height_m"],
            0,
            "patches[0].layout.height_m: got 0, allowed: a number from 1e-6 to 1 (m)",
        ),
        (
            ["patches", 0, "layout", "height_m"],
            float("nan"),
            "patches[0].layout.height_m: got nan, allowed: a number from 1e-6 to 1 (m)",
        ),
        (
            ["patches", 0, "layout", "lower_wires"],
            255,
            "patches[0].layout.lower_wires: got 255, allowed: an integer from 1 to 254",
        ),
        (["patches", 0, "layout"], "flat", "patches[0].layout: got 'flat', allowed: a table"),
        *(
            (
                ["patches", 0, "tolerances"],
                wrong,
                f'patches[0].tolerances: got {wrong!r}, allowed: "ordinary", "exact" or a table of numbers',
            )
            for wrong in ("Exact", 0.02, ["exact"])
        ),
        (
            ["patches", 0, "tolerances"],
            {"placement": 0.5},
            "patches[0].tolerances.placement: got 0.5, allowed: a non-negative number below 0.5",
        ),
        (
            ["patches", 0, "tolerances"],
            {"thicknes": 0.1},
            "patches[0].tolerances.thicknes: got an unknown key, allowed: a key of this table "
            "(did you mean thickness?): placement, thickness, electrode_radius, gain",
        ),
        (["patches", 0], 7, "patches[0]: got 7, allowed: a table"),
        (["patches"], [], "patches: got [], allowed: at least one [[patches]]"),
        (["buses"], [], "buses: got [], allowed: at least one [[buses]]"),
        (
            ["buses", 0, "bitrate_bps"],
            5_000_000,
            "buses[0].bitrate_bps: got 5000000, allowed: an integer from 10000 to 1000000, as in classic CAN",
        ),
        (["sync", "period_ms"], 8.5, "sync.period_ms: got 8.5, allowed: an integer from 1 to 60000"),
        (
            ["sync", "stagger_ms"],
            -1,
            "sync.stagger_ms: got -1, allowed: a non-negative delay",
        ),
        (
            ["sync", "counter_overflow"],
            241,
            "sync.counter_overflow: got 241, "
            "allowed: an integer from 2 to 240; or 0 if the host is a guest on all buses",
        ),
        (
            ["solver", "operator"],
            "newton",
            "solver.operator: got 'newton', allowed: gauss_newton or levenberg_marquardt or dogleg",
        ),
        *(
            (
                ["buses", 0, "options"],
                {"port": 1, key: [1]},
                f"buses[0].options.{key}: got [1], allowed: a string, a number, true or false",
            )
            for key in ("a", "role")
        ),
        (
            ["buses", 0, "options"],
            {"bitrate": 500000},
            "buses[0].options.bitrate: got 500000, allowed: use the key of [[buses]] instead",
        ),
        (
            ["buses", 0, "others"],
            [{"can_id": 0x800, "period_ms": 10}],
            "buses[0].others[0].can_id: got 2048, allowed: an integer from 0 to 0x7FF",
        ),
        (
            ["buses", 0, "max_load"],
            1.5,
            "buses[0].max_load: got 1.5, allowed: a number greater than 0 and at most 1",
        ),
        (["buses", 0, "role"], "slave", "buses[0].role: got 'slave', allowed: master or guest"),
        (
            ["buses", 0, "role"],
            "guest",
            "patches[0].baseline: got nothing, "
            "allowed: a file, because the host is a guest that sends nothing on can0",
        ),
        (
            ["buses", 0, "heartbeat_node_id"],
            2,
            "buses[0].heartbeat_node_id: got 2, allowed: an integer from 1 to 127 that no node uses",
        ),
        (["stream", "partial"], "drop", "stream.partial: got 'drop', allowed: pass or withhold"),
        (
            ["patches", 0, "pose", "position_m"],
            [0.0, 1.0],
            "patches[0].pose.position_m[2]: got nothing, allowed: three numbers [x, y, z] in metres",
        ),
        (
            ["patches", 0, "pose", "position_m"],
            [0.0, 1.0, "2"],
            "patches[0].pose.position_m[2]: got '2', allowed: three numbers [x, y, z] in metres",
        ),
        (
            ["patches", 0, "pose", "quaternion_xyzw"],
            [0.0, 0.0, 0.5, 0.5],
            "patches[0].pose.quaternion_xyzw: got [0.0, 0.0, 0.5, 0.5], "
            "allowed: unit length (quaternion_xyzw: got length 0.7071, must be 1)",
        ),
        (
            ["patches", 0, "pose"],
            {"quaternion_xyzw": [0.0, 0.0, 0.0, 1.0], "rpy_rad": [0.0, 0.0, 1.0]},
            "patches[0].pose.rpy_rad: got [0.0, 0.0, 1.0], allowed: only without quaternion_xyzw",
        ),
        (["links"], [{"name": "palm"}], "links[0].name: got 'palm', allowed: only if patches have a link"),
        (
            ["links"],
            [{"name": "hand"}],
            "links[0].name: got 'hand', allowed: "
            "a name other than 'hand', which is the frame of the hand itself",
        ),
        (
            ["links"],
            [{"name": "palm", "pose": {"position_m": [0.0, 0.0]}}],
            "links[0].pose.position_m[2]: got nothing, allowed: three numbers [x, y, z] in metres",
        ),
        (
            ["patches", 0, "calibration", "upper_gain"],
            [1.0, 1.01],
            "patches[0].calibration.upper_gain: got [1.0, 1.01], allowed: 10 numbers, one per upper wire",
        ),
        (
            ["patches", 0, "relative_noise"],
            0.0,
            "patches[0].relative_noise: got 0.0, allowed: a number of at least 1e-12 and below 1",
        ),
        (
            ["simulation", "depth"],
            1.0,
            "simulation.depth: got 1.0, allowed: a non-negative number below 1",
        ),
    ],
)
def test_one_line_a_mistake(path: list[str | int], value: Any, line: str) -> None:
    table = minimal()
    change(path, value)(table)
    with pytest.raises(ConfigError) as caught:
        parse_hand(table, where="hand.toml")
    assert str(caught.value) == f"hand.toml: {line}"


def test_missing_key() -> None:
    table = minimal()
    del table["patches"][0]["node_id"]
    with pytest.raises(
        ConfigError, match=r"^patches\[0\]\.node_id: got nothing, allowed: an integer from 1 to 127$"
    ):
        parse_hand(table)


def test_a_serial_number_is_of_one_patch() -> None:
    table = minimal()
    for patch in table["patches"]:
        patch["serial"] = 1041
    with pytest.raises(ConfigError) as caught:
        parse_hand(table)
    assert str(caught.value) == "patches[1].serial: got 1041, allowed: a value that patches[0] does not use"


def test_same_node_id_on_two_buses_is_fine() -> None:
    table = minimal()
    table["buses"].append({"name": "can1", "channel": "skin1"})
    table["patches"][1].update(node_id=1, bus="can1")
    hand = parse_hand(table)
    assert [patch.name for patch in hand.patches_on("can1")] == ["index"]


def test_two_buses_on_one_channel() -> None:
    table = minimal()
    table["buses"].append({"name": "can1"})
    with pytest.raises(ConfigError) as caught:
        parse_hand(table)
    assert str(caught.value) == "buses[1].channel: got 'skin', allowed: a value that buses[0] does not use"


def write(folder: Path, text: str) -> Path:
    path = folder / "hand.toml"
    path.write_text(text)
    return path


HEAD = '[[buses]]\nname = "can0"\n[[patches]]\nname = "thumb"\nnode_id = 1\n'


def test_eds_is_relative_to_the_file(tmp_path: Path) -> None:
    (tmp_path / "eds").mkdir()
    (tmp_path / "eds" / "patch.eds").write_text("")
    hand = load_hand(write(tmp_path, HEAD + 'eds = "eds/patch.eds"\n'))
    assert hand.patches[0].eds == tmp_path / "eds" / "patch.eds"


def test_missing_eds(tmp_path: Path) -> None:
    path = write(tmp_path, HEAD + 'eds = "eds/patch.eds"\n')
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value) == (
        f"{path}:6:1: patches[0].eds: got 'eds/patch.eds', "
        f"allowed: the path of an EDS file; there is no file {tmp_path}/eds/patch.eds"
    )


def test_toml_syntax(tmp_path: Path) -> None:
    path = write(tmp_path, HEAD + "bus = can0\n")
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value).startswith(f"{path}: line 6, column 7: got 'bus = can0', allowed: TOML (")
    assert "\n" not in str(caught.value)


def test_toml_that_ends_too_soon(tmp_path: Path) -> None:
    path = write(tmp_path, HEAD + 'bus = "can0')
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "allowed: TOML (" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_not_text(tmp_path: Path) -> None:
    path = tmp_path / "hand.toml"
    path.write_bytes(b'name = "\xff"\n')
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value) == f"{path}: byte 8: got b'\\xff', allowed: UTF-8"


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "[" * 3000 + "]" * 3000,
        "x = " + "[" * 100 + "]" * 100,
        "x = " + "{a = " * 100 + "1" + "}" * 100,
        ".".join(["a"] * 5000) + " = 1",
        "[" + ".".join(["a"] * 5000) + "]",
    ],
    ids=["arrays beyond the parser", "arrays", "inline tables", "dotted key", "header"],
)
def test_nesting_has_an_end(text: str, tmp_path: Path) -> None:
    path = write(tmp_path, text + "\n")
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value) == (
        f"{path}: hand file: got deeper nesting, allowed: tables and arrays nested at most 32 deep"
    )


@pytest.mark.parametrize(
    ("number", "place"),
    [("9" * 5000, ": hand file"), ("0x" + "F" * 5000, ":5:1: node_id"), (str(1 << 63), ":5:1: node_id")],
    ids=["beyond Python", "hexadecimal", "2^63"],
)
def test_integers_have_64_bits(number: str, place: str, tmp_path: Path) -> None:
    path = write(tmp_path, HEAD.replace("node_id = 1", f"node_id = {number}"))
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value) == (
        f"{path}{place}: got a longer integer, allowed: integers from -2^63 to 2^63 - 1"
    )


@pytest.mark.parametrize(
    ("counts", "line"),
    [
        (
            (254, 254, 254, 254),
            "upper_wires × upper_electrodes: got 254 × 254, allowed: at most 1024",
        ),
        (
            (32, 32, 96, 254),
            "lower_wires × lower_electrodes: got 96 × 254, allowed: at most 4096 with 1024 upper electrodes",
        ),
    ],
)
@pytest.mark.parametrize("in_a_file", [False, True])
def test_patches_beyond_any_memory(
    counts: tuple[int, ...], line: str, in_a_file: bool, tmp_path: Path
) -> None:
    names = "upper_wires", "upper_electrodes", "lower_wires", "lower_electrodes"
    keys = "".join(f"{name} = {count}\n" for name, count in zip(names, counts, strict=True))
    (tmp_path / "layout.toml").write_text(keys)
    path = write(tmp_path, f"{HEAD}[patches.layout]\n" + ('file = "layout.toml"\n' if in_a_file else keys))
    where = f"{tmp_path / 'layout.toml'}: " if in_a_file else f"{path}:6:1: patches[0].layout."
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value).endswith(where + line + ")" * in_a_file)


def test_no_such_file(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    with pytest.raises(ConfigError) as caught:
        load_hand(path)
    assert str(caught.value) == (
        f"hand file: got '{path}', allowed: a file that can be read (No such file or directory)"
    )


def test_another_interface_and_channel() -> None:
    hand = parse_hand(minimal()).on("socketcan", "vcan0")
    assert hand.buses == (BusConfig(name="can0", interface="socketcan", channel="vcan0"),)
    assert parse_hand(minimal()).on() == parse_hand(minimal())


def test_one_channel_for_several_buses() -> None:
    table = minimal()
    table["buses"].append({"name": "can1", "channel": "skin1"})
    hand = parse_hand(table)
    with pytest.raises(
        ConfigError, match=r"^--channel: got 'vcan0', allowed: only for a hand with one bus; this one has 2$"
    ):
        hand.on(channel="vcan0")


def test_another_interface_does_not_make_one_bus_of_two() -> None:
    """The frames of both would arrive at each, and nodes with the same node-ID would be mixed."""
    buses = [{"name": name, "interface": name, "channel": "0"} for name in ("pcan", "kvaser")]
    patches = [{"name": f"of {bus['name']}", "node_id": 5, "bus": bus["name"]} for bus in buses]
    hand = parse_hand({"buses": buses, "patches": patches})
    with pytest.raises(ConfigError) as caught:
        hand.on("virtual")
    line = "--interface: got 'virtual', allowed: only for a hand whose buses have different channels"
    assert str(caught.value) == line


def test_options_do_not_change() -> None:
    hand = parse_hand(minimal())
    with pytest.raises(ValueError, match="frozen"):
        hand.name = "other"


def test_a_misspelt_required_key_is_named_as_such() -> None:
    table = {"buses": [{}], "patches": [{"name": "palm", "node_idd": 3}]}
    with pytest.raises(
        ConfigError, match=r"patches\[0\]\.node_idd: got an unknown key, .* \(did you mean node_id\?\)"
    ):
        parse_hand(table)


def test_a_guest_says_what_the_master_does() -> None:
    """Its SYNC period is nobody's default."""
    table: dict[str, Any] = {
        "buses": [{"name": "can0"}, {"name": "can1", "role": "guest", "guest_sends": "sdo"}],
        "patches": [{"name": "palm", "node_id": 1}],
    }
    table["buses"][1]["channel"] = "other"
    with pytest.raises(ConfigError) as caught:
        parse_hand(table)
    assert str(caught.value) == (
        "sync.period_ms: got nothing, allowed: the period of the SYNC on can1, where the host is a guest"
    )
    assert parse_hand(table | {"sync": {"period_ms": 80}}).sync.period_ms == 80


def test_a_link_that_no_patch_names_or_that_is_listed_twice() -> None:
    table = minimal()
    table["patches"][0]["link"] = "palm_link"
    table["links"] = [{"name": "palm_lnk"}]
    with pytest.raises(
        ConfigError, match=r"^links\[0\].name: got 'palm_lnk', allowed: the link of a patch: palm_l"
    ):
        parse_hand(table)
    table["links"] = [{"name": "palm_link"}, {"name": "palm_link"}]
    with pytest.raises(
        ConfigError, match=r"^links\[1\].name: got 'palm_link', allowed: a value that links\[0\]"
    ):
        parse_hand(table)
