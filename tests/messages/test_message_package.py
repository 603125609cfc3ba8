"""The ROS 2 package skinnode_msgs, read by two parsers that do not know skinnode."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

from mcap_ros2._vendor.rosidl_adapter.parser import parse_message_string
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from skinnode.config import parse_hand
from skinnode.messages import ros2_canopen
from skinnode.messages.message_package import PACKAGE, package_files
from skinnode.messages.typestore import typestore
from tests.commands import run_here

FILES = package_files()
MESSAGES = {Path(path).stem: text for path, text in FILES.items() if path.endswith(".msg")}
HAND = '[[buses]]\nname = "can0"\n[[patches]]\nname = "palm"\nnode_id = 5\n'


def test_the_rules_of_rosidl_hold_for_every_message() -> None:
    """The parser of rosidl, as mcap-ros2-support ships it, checks names, types and constants."""
    for name, text in MESSAGES.items():
        parsed = parse_message_string(PACKAGE, name, text)
        assert [constant.name for constant in parsed.constants] == ["VERSION"]
        assert parsed.fields
        for field in parsed.fields:
            if field.type.pkg_name == PACKAGE:
                assert field.type.type in MESSAGES


def test_messages_built_from_the_package_have_the_hashes_of_the_topics() -> None:
    """A subscriber of rmw_zenoh finds a topic by the hash of its message."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for name, text in MESSAGES.items():
        types.update(get_types_from_msg(text, f"{PACKAGE}/msg/{name}"))
    store.register(types)
    for name in MESSAGES:
        message = f"{PACKAGE}/msg/{name}"
        assert store.hash_rihs01(message) == typestore().hash_rihs01(message)


def test_the_package_builds_every_message_with_what_it_uses() -> None:
    cmake = FILES[f"{PACKAGE}/CMakeLists.txt"]
    assert sorted(re.findall(r'"msg/(\w+)\.msg"', cmake)) == sorted(MESSAGES)
    used = {
        field.type.pkg_name
        for name, text in MESSAGES.items()
        for field in parse_message_string(PACKAGE, name, text).fields
        if field.type.pkg_name not in (None, PACKAGE)
    }
    manifest = ElementTree.fromstring(FILES[f"{PACKAGE}/package.xml"])
    assert {each.text for each in manifest.findall("depend")} == used
    for package in used:
        assert f"find_package({package} REQUIRED)" in cmake
        assert re.search(rf"DEPENDENCIES .*\b{package}\b", cmake)
    assert manifest.findtext("member_of_group") == "rosidl_interface_packages"


def test_the_bus_package_depends_on_what_its_files_use() -> None:
    """As REP 149 demands: what CMake finds, and at run time the drivers and what the launch file imports."""
    hand = parse_hand(
        {"name": "R&D <1>", "buses": [{"name": "can0"}], "patches": [{"name": "palm", "node_id": 5}]}
    )
    files = ros2_canopen.package_files(hand)
    manifest = ElementTree.fromstring(files["r_d_1_canopen/package.xml"])
    assert manifest.get("format") == "3"
    assert manifest.findtext("name") == "r_d_1_canopen"
    launch = ast.parse(files["r_d_1_canopen/launch/can0.launch.py"])
    imported = {node.module for node in ast.walk(launch) if isinstance(node, ast.ImportFrom)}
    modules = {str(module).split(".")[0] for module in imported} - sys.stdlib_module_names
    shared = set(re.findall(r'get_package_share_directory\("(\w+)"\)', ast.unparse(launch).replace("'", '"')))
    drivers = set(re.findall(r'package: "(\w+)"', files["r_d_1_canopen/config/can0/bus.yml"]))
    needed = modules | drivers | shared - {"r_d_1_canopen"}
    assert {each.text for each in manifest.findall("exec_depend")} == needed
    found = set(re.findall(r"find_package\((\w+) REQUIRED\)", files["r_d_1_canopen/CMakeLists.txt"]))
    built = [*manifest.findall("buildtool_depend"), *manifest.findall("build_depend")]
    assert {each.text for each in built} == found


def test_packages_of_two_hands_fit_into_one_workspace_and_nothing_is_overwritten(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / f"{name}.toml").write_text(f'name = "{name}"\n{HAND}', encoding="utf-8")
        done = run_here("hand", "ros2", str(tmp_path / f"{name}.toml"), "-o", str(tmp_path))
        assert (done.returncode, done.stderr) == (0, "")
        assert 'note: can0: the host must be a guest alongside ros2_canopen (role = "guest")' in done.stdout
    found = {str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*.*") if file.is_file()}
    assert {"left_canopen/config/can0/bus.yml", "right_canopen/launch/can0.launch.py", *FILES} <= found
    changed = tmp_path / "left_canopen" / "config" / "can0" / "bus.yml"
    changed.write_text("drive_1:\n", encoding="utf-8")
    done = run_here("hand", "ros2", str(tmp_path / "left.toml"), "-o", str(tmp_path))
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: --output: got '{changed}', allowed: a new file, or a file with ")
    assert changed.read_text(encoding="utf-8") == "drive_1:\n"
