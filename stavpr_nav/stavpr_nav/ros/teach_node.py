# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node that records the velocities of the taught run."""

from pathlib import Path
import sys
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from stavpr_msgs.msg import MapInfo
from stavpr_nav.parameters import TEACH
from stavpr_nav.taught_run import COLUMNS, SESSION
from stavpr_ros.errors import OutputError, SettingsError
from stavpr_ros.ros.messages import nanoseconds
from stavpr_ros.ros.qos import LATCHED
from stavpr_ros.units import SECOND

PARAMETERS = TEACH
READ_ONLY = ParameterDescriptor(read_only=True)
SOURCES: dict[str, tuple[str, Any]] = {
    'odom': ('odom', Odometry),
    'cmd_vel': ('cmd_vel', Twist),
    'cmd_vel_stamped': ('cmd_vel', TwistStamped),
}


class TeachNode(Node):
    """
    Writes each velocity to the file at once, so that a crash loses none.

    :raises StavprError: an invalid parameter, or a file that exists or cannot be written.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('teach', **options)
        values = {
            name: self.declare_parameter(name, default, READ_ONLY).value
            for name, (default, _) in PARAMETERS.items()
        }
        path, source = Path(values['run_path']).expanduser(), values['source']
        if source not in SOURCES:
            raise SettingsError(f'source = {source!r}: expected one of {", ".join(SOURCES)}')
        try:
            self._file = path.open('x', encoding='utf-8', buffering=1)
        except OSError as error:
            raise OutputError(f'run_path = {str(path)!r}: {error.strerror}') from error
        self._write(COLUMNS)
        self._session = ''
        self._last = -sys.float_info.max
        topic, kind = SOURCES[source]
        self.create_subscription(kind, topic, self._on_message, qos_profile_sensor_data)
        self.create_subscription(MapInfo, 'stavpr/map_info', self._on_map_info, LATCHED)
        self.get_logger().info(f'recording {topic} in {path}')

    def destroy_node(self) -> None:
        """Close the file."""
        self._file.close()
        super().destroy_node()

    def _on_map_info(self, info: MapInfo) -> None:
        """Name the session that the recognition node records, where its map has several."""
        if info.operation == 'mapping' and info.sessions and info.sessions[-1] != self._session:
            self._session = info.sessions[-1]
            self._write([f'{SESSION}{self._session}'])

    def _on_message(self, message: Any) -> None:
        twist = getattr(message, 'twist', message)
        twist = getattr(twist, 'twist', twist)  # of odometry, with covariance
        stamp = self.get_clock().now().nanoseconds / SECOND
        if hasattr(message, 'header'):
            stamp = nanoseconds(message.header.stamp) / SECOND or stamp
        if stamp < self._last:
            self.get_logger().warning('a stamp decreases: skipped', throttle_duration_sec=10.0)
            return
        self._last = stamp
        self._write([f'{stamp:.6f}', f'{twist.linear.x:.6g}', f'{twist.angular.z:.6g}'])

    def _write(self, cells: list[str]) -> None:
        self._file.write(','.join(cells) + '\n')
