# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Message packages of other projects, built for the tests of the bridges.

data/interfaces has only the interfaces that the bridges use, with the fields of the published
definitions (comments left out): rtabmap_msgs 0.22.1 (github.com/introlab/rtabmap_ros, BSD).
"""

import os
from pathlib import Path
import shutil
import subprocess
import sys

INTERFACES = {
    folder.name: folder for folder in (Path(__file__).parents[1] / 'data' / 'interfaces').iterdir()
}
DEPENDENCIES = ('geometry_msgs', 'nav_msgs', 'sensor_msgs', 'std_msgs')
CMAKE = """cmake_minimum_required(VERSION 3.20)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
foreach(dependency {dependencies})
  find_package(${{dependency}} REQUIRED)
endforeach()
file(GLOB files RELATIVE ${{CMAKE_CURRENT_SOURCE_DIR}} msg/*.msg srv/*.srv)
rosidl_generate_interfaces({name} ${{files}} DEPENDENCIES {dependencies})
ament_package()
"""
PACKAGE = """<package format="3">
  <name>{name}</name><version>0.0.0</version><description>For tests.</description>
  <maintainer email="tests@example.com">The stavpr_ros maintainers</maintainer>
  <license>BSD</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  {dependencies}
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""


def build_interfaces(folder: Path) -> Path:
    """Build the packages with colcon; return the folder of their local_setup.bash."""
    for name, interfaces in INTERFACES.items():
        package = folder / 'src' / name
        shutil.copytree(interfaces, package)
        text = CMAKE.format(name=name, dependencies=' '.join(DEPENDENCIES))
        (package / 'CMakeLists.txt').write_text(text)
        depends = ''.join(f'<depend>{name}</depend>' for name in DEPENDENCIES)
        (package / 'package.xml').write_text(PACKAGE.format(name=name, dependencies=depends))
    command = [sys.executable, '-m', 'colcon', '--log-base', 'log', 'build']
    command += ['--cmake-args', '-DBUILD_TESTING=OFF', f'-DPython3_EXECUTABLE={sys.executable}']
    prefixes = {'AMENT_PREFIX_PATH': sys.prefix, 'CMAKE_PREFIX_PATH': sys.prefix}
    environment = os.environ | prefixes | {'MAKEFLAGS': '-j2'}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / 'install'
