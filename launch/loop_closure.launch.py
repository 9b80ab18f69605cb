"""
Close loops: ros2 launch stavpr_ros loop_closure.launch.py image:=/camera/image_raw odom:=/odom.

With map_path, features are those of that map; its places are not compared.
"""

from launch import LaunchDescription
from stavpr_ros.ros.launching import node_launch

PARAMETERS = (
    'map_path',
    'threshold',
    'mode',
    'sequence_length',
    'exclude_places',
    'exclude_seconds',
    'features',
    'keyframe_interval',
    'keyframe_distance',
    'keyframe_angle',
    'keyframe_change',
    'max_places',
    'save_path',
    'geometric_check',
)


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation loop_closure."""
    return node_launch(PARAMETERS, operation='loop_closure')
