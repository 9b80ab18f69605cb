# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Replay a bag, or a folder of images, into the node.

ros2 launch stavpr_ros replay.launch.py bag:=drive.bag map_path:=route.stavpr
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from stavpr_ros.ros.launching import node_launch, PACKAGE, remappings


def _replay(context: LaunchContext) -> list[Node]:
    """Start the replay with the given options; it waits for the subscription of the node."""
    words = [LaunchConfiguration('bag')]
    for option in ('topic', 'rate'):
        if LaunchConfiguration(option).perform(context):
            words += [f'--{option}', LaunchConfiguration(option)]
    if LaunchConfiguration('lossless').perform(context) == 'true':
        words.append('--lossless')
    ends = LaunchConfiguration('shutdown').perform(context) == 'true'
    return [
        Node(
            package=PACKAGE,
            executable='replay',
            namespace=LaunchConfiguration('namespace'),
            arguments=words,
            remappings=remappings(),
            output='screen',
            on_exit=[Shutdown(reason='the replay has ended')] if ends else None,
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the node and the replay."""
    booleans = ['true', 'false']
    own = [
        DeclareLaunchArgument('bag', description='ROS 1 or ROS 2 bag, or folder of images'),
        DeclareLaunchArgument(
            'topic', default_value='', description='image topic in the bag; empty: the only one'
        ),
        DeclareLaunchArgument(
            'rate',
            default_value='',
            description='factor on the recorded rate, or Hz of a folder; empty: 1, or 10',
        ),
        DeclareLaunchArgument(
            'lossless',
            default_value='false',
            choices=booleans,
            description='publish each image after the match of the last one; leave rate empty',
        ),
        DeclareLaunchArgument(
            'shutdown',
            default_value='false',
            choices=booleans,
            description='shut down the node after the replay',
        ),
    ]
    return node_launch(*own, OpaqueFunction(function=_replay))
