# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of the pose graph: loop closures in; paths, poses and markers out."""

import struct

from geometry_msgs.msg import Point
import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from stavpr_msgs.msg import LoopClosure, RelativePose
from stavpr_ros.palette import BLUE, rgb, VERMILION
from stavpr_ros.ros.messages import nanoseconds, pose_array
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph import Closure
from stavpr_slam.pose_graph.alignment import APPEARANCE
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

__all__ = ['closure_of']  # the public names

ODOMETRY_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
CLOSURE_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)


def closure_of(message: LoopClosure, appearance: bool = False) -> Closure | None:
    """
    Return a loop closure as a measurement; None = it measures nothing.

    :param appearance: whether a closure whose relative pose could not be measured counts as one at
        the same place, with a covariance of meters; those that PnP refuted, or was not tried on,
        never do.
    """
    relative = message.relative_pose
    if relative.source in (RelativePose.REFUTED, RelativePose.DROPPED):
        return None
    is_measured = message.has_relative_pose and relative.source != RelativePose.NONE
    pose, covariance = pose_array(relative.pose.pose), relative.pose.covariance.reshape(6, 6)
    stamps: LoopClosure | RelativePose = relative
    if not is_measured:
        if not appearance:
            return None
        pose[:3], covariance, stamps = 0, APPEARANCE, message  # turned by the mountings
    on_map = message.query_index < 0 and message.has_poses
    return Closure(
        nanoseconds(stamps.query_stamp), nanoseconds(stamps.place_stamp), pose, covariance,
        is_measured and relative.is_independent,
        (message.map_id or 'map') if on_map else '',
        pose_array(message.place_pose) if on_map else None,
    )  # fmt: skip


def path_bytes(frame: str, stamps: np.ndarray, poses: np.ndarray) -> bytes:
    """
    Return a ``nav_msgs/Path`` as it is serialized (CDR, little endian).

    A message of 100,000 poses takes 3.6 s to make, and 0.6 s of the interpreter lock to publish.

    :param stamps: ns, shape (n,).
    :param poses: shape (n, 7).
    """
    name, count = frame.encode() + b'\0', len(stamps)
    newest = divmod(int(stamps[-1]) if count else 0, SECOND)
    head = struct.pack(f'<iII{len(name)}s', *newest, len(name), name)
    head += bytes(-len(head) % 4) + struct.pack('<I', count)
    parts = [b'\0\1\0\0', head]
    # numbers of 8 bytes are aligned: the name before them is padded, in the first pose differently
    for offset, part in ((len(head), slice(0, 1)), (0, slice(1, None))):
        size = len(name) + -(offset + 12 + len(name)) % 8
        kind = [('stamp', '<u4', 2), ('size', '<u4'), ('name', f'S{size}'), ('pose', '<f8', 7)]
        rows = np.zeros(len(stamps[part]), np.dtype(kind))
        rows['stamp'] = np.stack(np.divmod(stamps[part], SECOND), axis=-1)
        rows['size'], rows['name'], rows['pose'] = len(name), name, poses[part]
        parts.append(rows.tobytes())
    return b''.join(parts)


def edge_markers(frame: str, accepted: np.ndarray, rejected: np.ndarray) -> MarkerArray:
    """Return the ends of edges, (m, 2, 3), as lines: accepted ones blue, rejected vermilion."""
    markers = MarkerArray()
    for number, (ends, color) in enumerate(((accepted, BLUE), (rejected, VERMILION))):
        action = Marker.ADD if len(ends) else Marker.DELETE
        marker = Marker(ns='closures', id=number, type=Marker.LINE_LIST, action=action)
        marker.header.frame_id = frame
        marker.pose.orientation.w = 1.0
        marker.scale.x = 0.15
        red, green, blue = (level / 255 for level in rgb(color))
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=0.8)
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in ends.reshape(-1, 3).tolist()]
        markers.markers.append(marker)
    return markers
