"""Writes the configuration of ros2_canopen, a CANopen master for ROS 2, for the buses of a hand.

ros2_canopen reads ``bus.yml``. When its package is built, Lely CANopen's dcfgen generates the configuration
of the master and of each node from ``bus.yml`` and the EDS files. At boot, the master writes the same values
to each patch, in the same order, as the host does when it is the NMT master of the bus
(:mod:`skinnode.host.configurator`).

The master does not receive the chunks. Otherwise, the proxy driver of ros2_canopen would put every mapped
value of every chunk into an unbounded queue, from which it removes at most ten values per period
(``node_canopen_base_driver_impl.hpp`` and ``exchange.hpp``, version 0.3.4).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Final

from skinnode.bus_load.plan import inhibit_time_100us
from skinnode.canopen import indices as od
from skinnode.config import BusConfig, HandConfig, PatchConfig
from skinnode.errors import ConfigError, Shown
from skinnode.messages.topics import ros_names
from skinnode.protocol.eds_files import eds_name, eds_text
from skinnode.protocol.profile import PatchProfile

BOOT_TIMEOUT_MS: Final = 3000
"""Time limit (ms) for a patch to boot; the same as the host's."""

SDO_TIMEOUT_MS: Final = 200
"""Time limit (ms) for an SDO response. The default of ros2_canopen, 20 ms, is too short for a Linux board
under load."""

_RESERVED: Final = ("master", "options")
"""Words that ros2_canopen looks for in device names (``device_container.cpp``)."""


def package_files(hand: HandConfig) -> dict[str, str]:
    """Return the files of a ROS 2 package with the bus configuration of a hand.

    Args:
        hand: The hand; every bus with patches gets a folder in ``config`` and a launch file.

    Returns:
        The text of each file, by its path relative to the folder that contains the package.

    Raises:
        ConfigError: A bus uses CAN FD, or ros2_canopen cannot use the name of a patch.
    """
    package = package_name(hand)
    buses = {bus.name: bus for bus in hand.buses if hand.patches_on(bus.name)}
    folders = ros_names(buses)
    files = {
        "package.xml": _PACKAGE.format(package=package),
        "CMakeLists.txt": _CMAKE.format(
            package=package, buses="\n".join(f"generate_dcf({folders[name]})" for name in buses)
        ),
    }
    for name, bus in buses.items():
        folder = folders[name]
        files[f"config/{folder}/bus.yml"] = bus_yml(hand, bus)
        for patch in hand.patches_on(name):
            profile = PatchProfile.from_config(patch, bus)
            files[f"config/{folder}/{eds_name(profile)}"] = eds_text(profile)
        files[f"launch/{folder}.launch.py"] = _LAUNCH.format(
            package=package,
            folder=folder,
            channel=json.dumps(bus.channel if bus.interface == "socketcan" else folder),
            namespace=f"/{folder}" if len(buses) > 1 else "",
        )
    return {f"{package}/{path}": text for path, text in files.items()}


def package_name(hand: HandConfig) -> str:
    """Return the name of a hand's package: lower-case letters, digits and single underscores."""
    name = re.sub("[^a-z0-9]+", "_", hand.name.lower()).strip("_")
    return f"{name}_canopen" if name[:1].isalpha() else f"hand_{name}_canopen".replace("__", "_")


def bus_yml(hand: HandConfig, bus: BusConfig) -> str:
    """Return the ``bus.yml`` of one bus.

    Args:
        hand: The hand.
        bus: Bus with at least one patch.

    Raises:
        ConfigError: The bus uses CAN FD, or ros2_canopen cannot use the name of a patch.
    """
    if bus.fd:
        key = f"buses[{hand.buses.index(bus)}].fd"
        allowed = "false for ros2_canopen, whose PDOs have at most 8 bytes"
        raise ConfigError(key, Shown("true"), allowed, where=hand.where(key))
    names = ros_names(patch.name for patch in hand.patches)
    text = _MASTER.format(
        hand=hand.name,
        bus=bus.name,
        node_id=master_node_id(hand, bus),
        kbit=bus.bitrate_bps // 1000,
        sync_us=hand.sync.period_ms * 1000,
        overflow=hand.sync.counter_overflow,
    )
    for patch in hand.patches_on(bus.name):
        if any(word in names[patch.name] for word in _RESERVED):
            key = f"patches[{hand.patches.index(patch)}].name"
            allowed = f"for ros2_canopen, a name that does not contain {' or '.join(_RESERVED)}"
            raise ConfigError(key, patch.name, allowed, where=hand.where(key))
        text += _device(hand, bus, patch, names[patch.name])
    return text


def master_node_id(hand: HandConfig, bus: BusConfig) -> int:
    """Return the node-ID of the master: ``heartbeat_node_id``, or the highest node-ID that no patch uses."""
    used = {patch.node_id for patch in hand.patches_on(bus.name)}
    return bus.heartbeat_node_id or max(set(range(1, od.MAX_NODE_ID + 1)) - used)


def _device(hand: HandConfig, bus: BusConfig, patch: PatchConfig, name: str) -> str:
    profile = PatchProfile.from_config(patch, bus)
    chunk_cob_id = od.chunk_cob_id(patch.node_id)
    lines = [
        "",
        f"{name}:",
        f"  node_id: {patch.node_id}",
        *([] if patch.serial is None else [f"  serial_number: {patch.serial}"]),
        f'  dcf: "{eds_name(profile)}"',
        '  driver: "ros2_canopen::ProxyDriver"',
        '  package: "canopen_proxy_driver"',
        "  polling: true",
        "  period: 10                   # ms",
        f"  sdo_timeout_ms: {SDO_TIMEOUT_MS}",
        f"  boot_timeout_ms: {BOOT_TIMEOUT_MS}",
        f"  heartbeat_producer: {hand.bring_up.heartbeat_ms}      # ms",
        "  tpdo:",
        f"    1: {{cob_id: 0x{chunk_cob_id | od.PDO_INVALID:08X}}}    # chunks: not received by the master",
        "  sdo:",
        *(_entry(*item) for item in _values(hand, patch, profile)),
    ]
    return "\n".join(lines) + "\n"


def _values(
    hand: HandConfig, patch: PatchConfig, profile: PatchProfile
) -> Iterator[tuple[int, int, int, str]]:
    """Yield index, sub-index, value and meaning of each object the master writes to a patch, in order."""
    sync = hand.sync
    yield od.COB_ID_SYNC, 0, od.SYNC_COB_ID, "identifier of SYNC"
    yield od.CYCLE_PERIOD, 0, 0, "0x1019 can be written only while this is 0"
    yield od.SYNC_COUNTER_OVERFLOW, 0, sync.counter_overflow, "maximum SYNC counter"
    yield od.CYCLE_PERIOD, 0, sync.period_ms * 1000, "SYNC period, µs"
    yield od.SYNC_WINDOW, 0, 0, "no synchronous window"
    yield od.ACQUISITION, od.ACQUISITION_PERIOD, 0, "scans start at SYNC"
    yield od.SEND_POLICY, od.SEND_MODE, 0, "send all chunks"
    inhibit = inhibit_time_100us(sync.period_ms, profile.n_chunks + 1)
    for index, cob_id, kind, inhibit_100us, what in (
        (od.TPDO1_PARAMETER, od.chunk_cob_id(patch.node_id), 254, inhibit, "chunks, when they are ready"),
        (od.TPDO2_PARAMETER, od.summary_cob_id(patch.node_id), 1, 0, "summary, at every SYNC"),
    ):
        yield index, od.PDO_COB_ID, cob_id | od.PDO_INVALID, "off while it is configured"
        yield index, od.PDO_TYPE, kind, what
        yield index, od.PDO_INHIBIT_TIME, inhibit_100us, "inhibit time, 100 µs"
        yield index, od.PDO_EVENT_TIMER, 0, "no event timer"
        yield index, od.PDO_COB_ID, cob_id, "on"


def _entry(index: int, subindex: int, value: int, meaning: str) -> str:
    identifier = (index, subindex) in _IDENTIFIERS
    shown = f"0x{value:X}" if identifier else str(value)
    entry = f"    - {{index: 0x{index:04X}, sub_index: {subindex}, value: {shown}}}"
    return f"{entry:60s} # {meaning}"


_IDENTIFIERS: Final = (
    (od.COB_ID_SYNC, 0),
    (od.TPDO1_PARAMETER, od.PDO_COB_ID),
    (od.TPDO2_PARAMETER, od.PDO_COB_ID),
)
"""Objects that contain a CAN identifier, which is written as a hexadecimal number."""

_MASTER: Final = """\
# bus.yml of ros2_canopen for bus {bus} of hand {hand}, written by skinnode hand ros2.
options:
  dcf_path: "@BUS_CONFIG_PATH@"

master:
  node_id: {node_id}
  driver: "ros2_canopen::MasterDriver"
  package: "canopen_master_driver"
  baudrate: {kbit}               # kbit/s; ip sets the bit rate of the interface
  sync_period: {sync_us}           # µs
  sync_overflow: {overflow}
"""

_PACKAGE: Final = """\
<?xml version="1.0"?>
<!-- Written by skinnode hand ros2. -->
<package format="3">
  <name>{package}</name>
  <version>0.1.0</version>
  <description>Buses of a hand with robot skin, for ros2_canopen</description>
  <maintainer email="maintainer@example.org">maintainer</maintainer>
  <license>MIT</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <build_depend>lely_core_libraries</build_depend>
  <exec_depend>ament_index_python</exec_depend>
  <exec_depend>canopen_core</exec_depend>
  <exec_depend>canopen_master_driver</exec_depend>
  <exec_depend>canopen_proxy_driver</exec_depend>
  <exec_depend>launch</exec_depend>
  <export>
    <build_type>ament_cmake</build_type>
  </export>
</package>
"""

_CMAKE: Final = """\
# Written by skinnode hand ros2.
cmake_minimum_required(VERSION 3.8)
project({package})

find_package(ament_cmake REQUIRED)
find_package(lely_core_libraries REQUIRED)

{buses}

install(DIRECTORY launch DESTINATION share/${{PROJECT_NAME}})
ament_package()
"""

_LAUNCH: Final = '''\
"""Start ros2_canopen as the master of bus {folder}. Written by skinnode hand ros2."""

import os

from ament_index_python import get_package_share_directory
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource


def generate_launch_description():
    config = os.path.join(get_package_share_directory("{package}"), "config", "{folder}")
    core = get_package_share_directory("canopen_core")
    container = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(os.path.join(core, "launch", "canopen.launch.py")),
        launch_arguments={{
            "master_config": os.path.join(config, "master.dcf"),
            "master_bin": os.path.join(config, "master.bin"),
            "bus_config": os.path.join(config, "bus.yml"),
            "can_interface_name": {channel},
            "namespace": "{namespace}",
        }}.items(),
    )
    return LaunchDescription([container])
'''
