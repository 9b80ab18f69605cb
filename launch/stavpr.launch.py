"""Start the node: ros2 launch stavpr_ros stavpr.launch.py map_path:=FILE image:=/camera/image_raw."""

from launch import LaunchDescription
from stavpr_ros.ros.launching import node_launch

PARAMETERS = (
    'operation',
    'map_path',
    'threshold',
    'mode',
    'sequence_length',
    'keyframe_interval',
    'keyframe_distance',
    'keyframe_angle',
    'keyframe_change',
    'geometric_check',
)


def generate_launch_description() -> LaunchDescription:
    """Describe the node, whose operation is localization unless it is told otherwise."""
    return node_launch(PARAMETERS)
