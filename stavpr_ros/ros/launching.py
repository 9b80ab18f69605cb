"""What the launch files share: the arguments and the node. Imports ``launch`` and nothing that is heavy."""

from collections.abc import Sequence
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription

PACKAGE = 'stavpr_ros'

# Parameters of the node that a launch file may offer: type and description.
PARAMETERS: dict[str, tuple[type, str]] = {
    'operation': (str, 'what is done with images: localization, mapping or loop_closure'),
    'map_path': (str, 'map file, made by build_map or by the service save_map'),
    'threshold': (float, 'a window is matched when its distance is below this'),
    'mode': (str, 'paper: STA-VPR as published; robust: beyond it'),
    'sequence_length': (int, 'images in the query window'),
    'geometric_check': (str, 'check matches by keypoints: none, orb or sift'),
    'image_transport': (str, 'raw, or compressed: sensor_msgs/CompressedImage on IMAGE/compressed'),
    'keyframe_interval': (float, 'an image counts only so long after the last that counted, s'),
    'keyframe_distance': (float, 'an image counts only so far from the last that counted, m, by odometry'),
    'keyframe_angle': (float, 'or when the camera has turned so far, degrees, by odometry'),
    'keyframe_change': (float, 'an image counts only when it differs by this from the last that counted'),
    'features': (str, 'features of a map that is begun anew: gradient, onnx ...'),
    'max_places': (int, 'most places of a growing map'),
    'save_path': (str, 'file that the map is written to when the node is deactivated or ends'),
    'exclude_places': (int, 'the latest places of the route, which are not compared'),
    'exclude_seconds': (float, 'nor are places younger than this, s'),
    'use_sim_time': (bool, 'take the time from the topic /clock'),
    'autostart': (bool, 'the node configures and activates itself; false: a life-cycle manager does it'),
}
EVERYWHERE = ('image_transport', 'use_sim_time', 'autostart')


def arguments(parameters: Sequence[str]) -> list[DeclareLaunchArgument]:
    """
    Declare the arguments of a launch file that starts the node.

    :param parameters: names in :data:`PARAMETERS`, besides those that every launch file has.
    """
    declared = [
        DeclareLaunchArgument('image', default_value='image', description='topic of the images'),
        DeclareLaunchArgument('odom', default_value='odom', description='topic of the odometry'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of node and topics'),
        DeclareLaunchArgument(
            'params_file',
            default_value=PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', 'stavpr.yaml']),
            description='file of all parameters',
        ),
    ]
    for name in (*parameters, *EVERYWHERE):
        description = f'{PARAMETERS[name][1]}; empty: as params_file has it'
        declared.append(DeclareLaunchArgument(name, default_value='', description=description))
    return declared


def remappings() -> list[tuple[str | LaunchConfiguration, Any]]:
    """Return the topics that arguments name."""
    image = LaunchConfiguration('image')
    return [
        ('image', image),
        ('image/compressed', [image, '/compressed']),
        ('odom', LaunchConfiguration('odom')),
    ]


def node(parameters: Sequence[str], **fixed: object) -> OpaqueFunction:
    """
    Start the node with the arguments that are given; the others are left to the parameter file.

    :param parameters: as in :func:`arguments`.
    :param fixed: parameters that the launch file itself decides.
    """

    def start(context: LaunchContext) -> list[Node]:
        given = {
            name: ParameterValue(LaunchConfiguration(name), value_type=PARAMETERS[name][0])
            for name in (*parameters, *EVERYWHERE)
            if LaunchConfiguration(name).perform(context)
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


def node_launch(parameters: Sequence[str], *others: Any, **fixed: object) -> LaunchDescription:
    """
    Describe the launch of the node.

    :param parameters: as in :func:`arguments`.
    :param others: further actions, after the node's.
    :param fixed: parameters that the launch file itself decides.
    """
    return LaunchDescription([*arguments(parameters), node(parameters, **fixed), *others])
