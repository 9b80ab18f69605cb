"""
Make a map while driving: ros2 launch stavpr_ros mapping.launch.py image:=/camera/image_raw.

With map_path, a map goes on growing. What has grown is written to save_path at the end,
or by the service save_map.
"""

from launch.actions import LogInfo
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription
from stavpr_ros.ros.launching import node_launch

PARAMETERS = (
    'map_path',
    'features',
    'keyframe_interval',
    'keyframe_distance',
    'keyframe_angle',
    'keyframe_change',
    'max_places',
    'save_path',
)


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation mapping."""
    how_to_save = LogInfo(
        msg=[
            'to save the map before the end (at the end, save_path does): ros2 service call ',
            LaunchConfiguration('namespace'),
            '/stavpr/save_map stavpr_msgs/srv/SaveMap "{path: FILE}"',
        ]
    )
    return node_launch(PARAMETERS, how_to_save, operation='mapping')
