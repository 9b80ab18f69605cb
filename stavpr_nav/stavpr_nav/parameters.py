# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parameters of the nodes, default and sentence by name; a light import."""

from typing import Any

TEACH: dict[str, tuple[Any, str]] = {
    'run_path': ('', 'CSV file to write; it must not exist'),
    'source': ('odom', 'odom (nav_msgs/Odometry), cmd_vel or cmd_vel_stamped (TwistStamped)'),
}
REPEAT: dict[str, tuple[Any, str]] = {
    'map_path': ('', 'the map of the taught run, that the recognition node uses as well'),
    'run_path': ('', "velocities that `teach` has recorded; '' = from the poses of the map"),
    'match_topic': ('stavpr/match', 'matches of the recognition node'),
    'image_transport': ('raw', 'raw or compressed (topic image/compressed)'),
    'require_deadman': (True, 'drive only while `deadman` (std_msgs/Bool) is true'),
    'use_odometry': (False, 'stop where `odom` (nav_msgs/Odometry) shows other motion, or none'),
    'give_up_after': (30.0, 's not localized after which a goal is aborted; 0 = never'),
    'stamped': (False, 'publish geometry_msgs/TwistStamped'),
    'base_frame': ('base_link', 'frame of TwistStamped'),
    'gain': (0.9, 'radians of a turn per meter, for an offset of a width of the image'),
    'parallax_weight': (5.0, 'weight of the parallax, relative to the shift'),
    'max_speed': (1.0, 'm/s'),
    'max_turn': (0.5, 'rad/s'),
    'max_acceleration': (0.5, 'm/s^2; a stop is not limited'),
    'max_turn_acceleration': (1.0, 'rad/s^2'),
    'max_age': (0.5, 's without a processed image after which the robot stops'),
    'max_delay': (1.0, 's since the newest image was taken after which the robot stops'),
    'max_unconfirmed': (0.5, 's without an image of the route after which the robot stops'),
}
