# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of the pose graph: loop closures in; paths, poses and markers out."""

import math
from typing import Any

from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Path
import numpy as np
from stavpr_msgs.msg import LoopClosure, RelativePose
from stavpr_ros.mapping.transforms import to_poses
from stavpr_ros.ros.output import nanoseconds, pose_message, time_message
from stavpr_slam.pose_graph import Closure, PoseGraph
from stavpr_slam.pose_graph.alignment import APPEARANCE, IDENTITY
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

COLORS = {
    True: ColorRGBA(r=0.1, g=0.7, b=0.2, a=0.8),
    False: ColorRGBA(r=0.9, g=0.2, b=0.1, a=0.5),
}


def closure_of(message: LoopClosure, appearance: bool) -> Closure | None:
    """
    Return a loop closure as a measurement; None = it measures nothing.

    :param appearance: whether a closure whose relative pose could not be measured counts as one at
        the same place, with a covariance of meters; those that PnP refuted, or was not tried on,
        never do.
    """
    relative = message.relative_pose
    if relative.source in (RelativePose.REFUTED, RelativePose.DROPPED):
        return None
    on_map = message.query_index < 0 and message.has_poses
    # a late closure has the window, and so the changes, of the closure published before it
    known: dict[str, Any] = {
        'map_id': (message.map_id or 'map') if on_map else '',
        'place_pose': pose_array(message.place_pose) if on_map else None,
        'changes': tuple(
            (nanoseconds(pair.query_stamp), pair.query_change)
            for pair in message.pairs
            if math.isfinite(pair.query_change) and not message.is_late
        ),
    }
    if message.has_relative_pose and relative.source != RelativePose.NONE:
        covariance = np.array(relative.pose.covariance).reshape(6, 6)
        return Closure(
            nanoseconds(relative.query_stamp), nanoseconds(relative.place_stamp),
            pose_array(relative.pose.pose), covariance, relative.is_independent, **known,
        )  # fmt: skip
    if not appearance:
        return None
    stamps = nanoseconds(message.query_stamp), nanoseconds(message.place_stamp)
    return Closure(*stamps, IDENTITY, APPEARANCE, False, **known)


def pose_array(pose: object) -> np.ndarray:
    """Return a pose message as x y z and quaternion x y z w, shape (7,)."""
    p, o = pose.position, pose.orientation  # type: ignore[attr-defined]
    return np.array([p.x, p.y, p.z, o.x, o.y, o.z, o.w])


def path_message(frame: str, stamps: np.ndarray, poses: np.ndarray) -> Path:
    """Return a path of poses (N, 7) at stamps (N,), ns."""
    stamp = time_message(int(stamps[-1])) if len(stamps) else time_message(0)
    path = Path(header=Header(frame_id=frame, stamp=stamp))
    path.poses = [
        PoseStamped(
            header=Header(frame_id=frame, stamp=time_message(own)), pose=pose_message(pose)
        )
        for own, pose in zip(stamps.tolist(), poses, strict=True)
    ]
    return path


def path_messages(
    frame: str, stamps: np.ndarray, odometry: np.ndarray, corrected: np.ndarray
) -> tuple[Path, Path]:
    """Return the path of the odometry, and the corrected one; transforms are (N, 4, 4) each."""
    return (
        path_message(frame, stamps, to_poses(odometry)),
        path_message(frame, stamps, to_poses(corrected)),
    )


def edge_markers(graph: PoseGraph, frame: str) -> MarkerArray:
    """Return accepted edges as green lines, rejected ones as red lines."""
    markers = MarkerArray()
    for number, accepted in enumerate(COLORS):
        marker = Marker(ns='closures', id=number, type=Marker.LINE_LIST, action=Marker.ADD)
        marker.header.frame_id = frame
        marker.pose.orientation.w = 1.0
        marker.scale.x = 0.15
        marker.color = COLORS[accepted]
        for edge in graph.edges:
            if edge.accepted == accepted and max(edge.query, edge.place) < len(graph.solved):
                for node in (edge.query, edge.place):
                    x, y, z = graph.solved[node][:3, 3].tolist()
                    marker.points.append(Point(x=x, y=y, z=z))
        if not marker.points:
            marker.action = Marker.DELETE
        markers.markers.append(marker)
    return markers
