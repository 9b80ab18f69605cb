"""Start the node: ros2 launch stavpr_ros stavpr.launch.py map_path:=FILE threshold:=VALUE."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Describe the node and its arguments."""
    defaults = PathJoinSubstitution([FindPackageShare('stavpr_ros'), 'config', 'stavpr.yaml'])
    return LaunchDescription(
        [
            DeclareLaunchArgument('map_path', default_value='', description='map file made by build_map'),
            DeclareLaunchArgument(
                'threshold',
                default_value='-1.0',
                description='a match is nearer than this; negative: 1 in mode robust, not set in mode paper',
            ),
            DeclareLaunchArgument('image', default_value='image', description='topic of the images'),
            DeclareLaunchArgument(
                'params_file', default_value=defaults, description='file of all parameters'
            ),
            Node(
                package='stavpr_ros',
                executable='node',
                name='stavpr',
                output='screen',
                remappings=[('image', LaunchConfiguration('image'))],
                parameters=[
                    LaunchConfiguration('params_file'),
                    {
                        'map_path': ParameterValue(LaunchConfiguration('map_path'), value_type=str),
                        'threshold': ParameterValue(LaunchConfiguration('threshold'), value_type=float),
                    },
                ],
            ),
        ]
    )
