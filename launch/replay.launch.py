"""
Replay a bag, or a folder of images, into the node.

ros2 launch stavpr_ros replay.launch.py bag:=drive.bag map_path:=route.stavpr
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from stavpr_ros.ros.launching import PACKAGE, node_launch, remappings

PARAMETERS = (
    'operation',
    'map_path',
    'threshold',
    'mode',
    'sequence_length',
    'exclude_places',
    'keyframe_interval',
    'keyframe_distance',
    'keyframe_angle',
    'keyframe_change',
    'geometric_check',
)


def _replay(context: LaunchContext) -> list[Node]:
    """Start the replay with the options that are given; it waits until the node listens."""
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
    truth = ['true', 'false']
    own = [
        DeclareLaunchArgument('bag', description='ROS 1 or ROS 2 bag, or folder of images'),
        DeclareLaunchArgument(
            'topic', default_value='', description='image topic in the bag; empty: there is one only'
        ),
        DeclareLaunchArgument(
            'rate',
            default_value='',
            description='factor on the recorded pace, or images per second of a folder; empty: 1, or 10',
        ),
        DeclareLaunchArgument(
            'lossless',
            default_value='false',
            choices=truth,
            description='send the next image when the last one is answered; rate is left empty then',
        ),
        DeclareLaunchArgument(
            'shutdown', default_value='false', choices=truth, description='end the node with the replay'
        ),
    ]
    described = node_launch(PARAMETERS, OpaqueFunction(function=_replay))
    return LaunchDescription([*own, *described.entities])
