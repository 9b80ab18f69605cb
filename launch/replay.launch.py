# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Replay a bag, a video or a folder of images into the node.

ros2 launch stavpr_ros replay.launch.py bag:=drive.bag map_path:=route.stavpr
ros2 launch stavpr_ros replay.launch.py bag:=drive.bag operation:=mapping keyframe_distance:=0.5
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from stavpr_ros.ros.launching import node_launch, PACKAGE, remappings

OPTIONS = {
    'topic': 'image topic in the bag; empty: the only one',
    'odometry': 'odometry topic in the bag, published on odom; empty: the only one if '
    'keyframe_distance or keyframe_angle_deg is given, else none',
    'also': 'further topics of the bag, separated by spaces, published under their names',
    'rate': 'factor on the recorded pace; empty: 1',
    'fps': 'images per second: of a folder, as recorded; taken of a video; empty: 10, 5',
    'start_offset': 'recorded seconds to leave out at the beginning; empty: 0',
    'duration': 'recorded seconds to replay; empty: all',
    'record': 'new file for the matches; empty: none',
}
SWITCHES = {
    'lossless': 'publish each image after the match of the last one; leave rate empty',
    'loop': 'start again at the end',
    'start_paused': 'start paused: see the services of /stavpr_replay',
    'shutdown': 'shut down the node after the replay',
}


def _replay(context: LaunchContext) -> list[Node]:
    """Start the replay with the given options; it waits for the subscription of the node."""
    texts = {name: LaunchConfiguration(name).perform(context) for name in (*OPTIONS, *SWITCHES)}

    def is_set(name: str) -> bool:
        return LaunchConfiguration(name).perform(context) not in {'', '0', '0.0', 'false', 'False'}

    words = [LaunchConfiguration('bag')]
    for name in OPTIONS:
        if texts[name]:
            words += [f'--{name.replace("_", "-")}', *texts[name].split()]
    moving = ('keyframe_distance', 'keyframe_angle_deg', 'keyframe_angle')
    if not texts['odometry'] and any(map(is_set, moving)):
        words.append('--odometry')
    for name in ('lossless', 'loop', 'start_paused'):
        if is_set(name):
            words.append(f'--{name.replace("_", "-")}')
    if is_set('use_sim_time'):
        words.append('--clock')
    return [
        Node(
            package=PACKAGE,
            executable='replay',
            namespace=LaunchConfiguration('namespace'),
            arguments=words,
            remappings=remappings(),
            output='screen',
            on_exit=[Shutdown(reason='the replay has ended')] if is_set('shutdown') else None,
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the node and the replay; with use_sim_time, the replay publishes /clock."""
    own = [
        DeclareLaunchArgument('bag', description='ROS 1 or ROS 2 bag, video, or folder of images'),
        *(
            DeclareLaunchArgument(name, default_value='', description=description)
            for name, description in OPTIONS.items()
        ),
        *(
            DeclareLaunchArgument(
                name, default_value='false', choices=['true', 'false'], description=description
            )
            for name, description in SWITCHES.items()
        ),
    ]
    return node_launch(*own, OpaqueFunction(function=_replay))
