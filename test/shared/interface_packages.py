# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Message packages of other projects, built for the tests of the bridges.

Only the interfaces that the bridges use, with the fields of the published definitions (comments
left out): rtabmap_msgs 0.22.1 (github.com/introlab/rtabmap_ros, BSD), pose_graph_tools_msgs
(github.com/MIT-SPARK/pose_graph_tools, BSD), cslam_common_interfaces
(github.com/lajoiepy/cslam_interfaces, MIT).
"""

import os
from pathlib import Path
import subprocess
import sys

INTERFACES = {
    'rtabmap_msgs': {
        'msg/Link.msg': """
            int32 from_id
            int32 to_id
            int32 type
            geometry_msgs/Transform transform
            float64[36] information""",
        'msg/MapGraph.msg': """
            std_msgs/Header header
            geometry_msgs/Transform map_to_odom
            int32[] poses_id
            geometry_msgs/Pose[] poses
            Link[] links""",
        'msg/Info.msg': """
            std_msgs/Header header
            int32 ref_id
            int32 loop_closure_id
            int32 proximity_detection_id
            int32 landmark_id
            geometry_msgs/Transform loop_closure_transform
            int32[] wm_state
            int32[] posterior_keys
            float32[] posterior_values
            int32[] likelihood_keys
            float32[] likelihood_values
            int32[] raw_likelihood_keys
            float32[] raw_likelihood_values
            int32[] weights_keys
            int32[] weights_values
            int32[] labels_keys
            string[] labels_values
            string[] stats_keys
            float32[] stats_values
            int32[] local_path
            int32 current_goal_id
            MapGraph odom_cache""",
        'srv/AddLink.srv': """
            Link link
            ---""",
    },
    'pose_graph_tools_msgs': {
        'msg/PoseGraphEdge.msg': """
            std_msgs/Header header
            uint64 key_from
            uint64 key_to
            int32 robot_from
            int32 robot_to
            int32 type
            int32 ODOM = 0
            int32 LOOPCLOSE = 1
            int32 LANDMARK = 2
            int32 REJECTED_LOOPCLOSE = 3
            int32 MESH = 4
            int32 POSE_MESH = 5
            int32 MESH_POSE = 6
            geometry_msgs/Pose pose
            float64[36] covariance""",
        'msg/PoseGraphNode.msg': """
            std_msgs/Header header
            int32 robot_id
            uint64 key
            geometry_msgs/Pose pose""",
        'msg/PoseGraph.msg': """
            std_msgs/Header header
            pose_graph_tools_msgs/PoseGraphNode[] nodes
            pose_graph_tools_msgs/PoseGraphEdge[] edges""",
    },
    'cslam_common_interfaces': {
        'msg/KeyframeOdom.msg': """
            uint32 id
            nav_msgs/Odometry odom
            sensor_msgs/NavSatFix gps""",
        'msg/IntraRobotLoopClosure.msg': """
            uint32 keyframe0_id
            uint32 keyframe1_id
            bool success
            geometry_msgs/Transform transform""",
        'msg/InterRobotLoopClosure.msg': """
            uint32 robot0_keyframe_id
            uint32 robot0_id
            uint32 robot1_keyframe_id
            uint32 robot1_id
            bool success
            geometry_msgs/Transform transform""",
    },
}
DEPENDENCIES = ('geometry_msgs', 'nav_msgs', 'sensor_msgs', 'std_msgs')
CMAKE = """cmake_minimum_required(VERSION 3.20)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{packages}
rosidl_generate_interfaces({name}
  {files}
  DEPENDENCIES {dependencies}
)
ament_package()
"""
PACKAGE = """<package format="3">
  <name>{name}</name><version>0.0.0</version><description>For tests.</description>
  <maintainer email="maintainers@stavpr-ros.org">The stavpr_ros maintainers</maintainer>
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
    for name, files in INTERFACES.items():
        package = folder / 'src' / name
        for file, text in files.items():
            (package / file).parent.mkdir(parents=True, exist_ok=True)
            lines = [line.strip() for line in text.strip().splitlines()]
            (package / file).write_text('\n'.join(lines) + '\n')
        packages = '\n'.join(f'find_package({each} REQUIRED)' for each in DEPENDENCIES)
        (package / 'CMakeLists.txt').write_text(
            CMAKE.format(
                name=name, packages=packages, files=' '.join(files),
                dependencies=' '.join(DEPENDENCIES),
            )
        )  # fmt: skip
        depends = ''.join(f'<depend>{each}</depend>' for each in DEPENDENCIES)
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
