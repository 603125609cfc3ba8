"""Writes the ROS 2 package ``skinnode_msgs``, so that ROS 2 programs can use this project's messages."""

from __future__ import annotations

from typing import Final

from skinnode.messages.definitions import DEFINITIONS, OURS

PACKAGE: Final = OURS.rstrip("/")


def package_files() -> dict[str, str]:
    """Return the files of the package ``skinnode_msgs``.

    Returns:
        The text of each file, by its path relative to the folder that contains the package.
    """
    messages = {
        f"msg/{name.rsplit('/', 1)[1]}.msg": text
        for name, text in DEFINITIONS.items()
        if name.startswith(OURS)
    }
    files = {
        "package.xml": _PACKAGE,
        "CMakeLists.txt": _CMAKE.format(messages="\n".join(f'  "{path}"' for path in messages)),
        **messages,
    }
    return {f"{PACKAGE}/{path}": text for path, text in files.items()}


_PACKAGE: Final = f"""\
<?xml version="1.0"?>
<!-- Written by skinnode hand ros2. -->
<package format="3">
  <name>{PACKAGE}</name>
  <version>0.1.0</version>
  <description>Messages of skinnode, a host for robot skin</description>
  <maintainer email="maintainer@example.org">maintainer</maintainer>
  <license>MIT</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <build_depend>rosidl_default_generators</build_depend>
  <depend>geometry_msgs</depend>
  <depend>std_msgs</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export>
    <build_type>ament_cmake</build_type>
  </export>
</package>
"""

_CMAKE: Final = """\
# Written by skinnode hand ros2.
cmake_minimum_required(VERSION 3.8)
project(${{PACKAGE}})

find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(std_msgs REQUIRED)

rosidl_generate_interfaces(${{PROJECT_NAME}}
{messages}
  DEPENDENCIES geometry_msgs std_msgs
)

ament_export_dependencies(rosidl_default_runtime)
ament_package()
""".replace("${{PACKAGE}}", PACKAGE)
