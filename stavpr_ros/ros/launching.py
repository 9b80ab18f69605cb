# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arguments and node of the launch files, from the table of parameters; a light import."""

from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare
from stavpr_ros.parameters import PARAMETERS

PACKAGE = 'stavpr_ros'
TYPES: dict[str, type] = {row.name: type(row.default) for row in PARAMETERS} | {
    'use_sim_time': bool
}


def remappings() -> list[tuple[str, Any]]:
    """Return the remappings of the topics that are arguments."""
    image = LaunchConfiguration('image')
    return [
        ('image', image),
        ('image/compressed', [image, '/compressed']),
        ('odom', LaunchConfiguration('odom')),
    ]


def node_launch(*others: Any, **fixed: object) -> LaunchDescription:
    """
    Describe the launch of the node; every parameter is an argument.

    :param others: further actions, after the node.
    :param fixed: parameters that the launch file sets itself.
    """
    return LaunchDescription([*_arguments(fixed), _node(fixed), *others])


def _arguments(fixed: dict[str, object]) -> list[DeclareLaunchArgument]:
    sentences = {row.name: row.sentence for row in PARAMETERS}
    sentences['use_sim_time'] = 'Take the time from the topic /clock.'
    return [
        DeclareLaunchArgument('image', default_value='image', description='topic of the images'),
        DeclareLaunchArgument('odom', default_value='odom', description='topic of the odometry'),
        DeclareLaunchArgument(
            'namespace', default_value='', description='namespace of node and topics'
        ),
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution(
                [FindPackageShare(PACKAGE), 'config', 'stavpr.yaml']
            ),
            description='file of all parameters',
        ),
        *(
            DeclareLaunchArgument(
                name, default_value='', description=f'{sentence} Empty: as set in params_file.'
            )
            for name, sentence in sentences.items()
            if name not in fixed
        ),
    ]


def _node(fixed: dict[str, object]) -> OpaqueFunction:
    """Start the node with the given arguments; the others are left to the parameter file."""

    def start(context: LaunchContext) -> list[Node]:
        given = {
            name: ParameterValue(LaunchConfiguration(name), value_type=kind)
            for name, kind in TYPES.items()
            if name not in fixed and LaunchConfiguration(name).perform(context)
        }
        return [
            Node(
                package=PACKAGE,
                executable='node',
                name='stavpr',
                namespace=LaunchConfiguration('namespace'),
                output='screen',
                remappings=remappings(),
                parameters=[LaunchConfiguration('params_file'), given | fixed],
            )
        ]

    return OpaqueFunction(function=start)
