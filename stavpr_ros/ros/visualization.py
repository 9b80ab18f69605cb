# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics for viewers (RViz 2, Foxglove, the monitor), published while somebody subscribes."""

from collections import deque
from collections.abc import Callable
import math
from typing import Any

from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import Path
import numpy as np
from rclpy.event_handler import PublisherEventCallbacks, UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CompressedImage, Image
from stavpr_ros.mapping import Map
from stavpr_ros.mapping.place_map import encode_jpeg
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.palette import BLUE, GRAY, rgb, VERMILION
from stavpr_ros.pipeline.operations import Operation
from stavpr_ros.pipeline.overlay import column_minima, draw_match, draw_window, places_to_draw
from stavpr_ros.ros.messages import image_message, Outcome, Places, pose_message
from stavpr_ros.ros.output import Publishers
from stavpr_ros.ros.qos import LATCHED
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

MAX_POSES = 200  # matched poses, and lines from queries to places, that are shown
COLUMNS = 512  # of ~/distances, at most
GROWTH = 1.05  # a growing route is published again when it has grown by this factor
QUALITY = 80  # of JPEG


class Visualization(Publishers):
    """
    Publishers of the map's route, matched poses, markers, match images and distances.

    :param operation: returns the operation, whose places are matched.
    :param on_subscriber: called on another thread when the route has a new subscriber; it calls
        :meth:`publish_route` on the worker.

    ``frame`` is the last image's.
    """

    def __init__(
        self,
        node: Node,
        operation: Callable[[], Operation],
        on_subscriber: Callable[[], object],
    ) -> None:
        super().__init__(node)
        self.operation, self._on_subscriber = operation, on_subscriber
        self._route = self._make_latched(Path, '~/map_path')
        self._matched = self._make(Path, '~/matched_path')
        self._markers = self._make(MarkerArray, '~/markers')
        self._image = self._make(CompressedImage, '~/match_image/compressed')
        self._window = self._make(Image, '~/window_image')
        self._distances = self._make(Image, '~/distances', 10)
        self._published: tuple[Places, int, str] = (None, 0, '')
        self.frame = ''
        self._poses: deque[PoseStamped] = deque(maxlen=MAX_POSES)
        self._lines: deque[tuple[Point, Point, ColorRGBA]] = deque(maxlen=MAX_POSES)
        self._map: Map | None = None  # of the poses and lines; None = the route
        self._correction: np.ndarray | None = None  # from the odometry to the map, (4, 4)

    @property
    def needs_candidates(self) -> bool:
        """Whether the markers, which show candidates, have a subscriber."""
        return self._is_requested(self._markers)

    def publish(self, outcome: Outcome) -> None:
        """Publish the requested topics for one image."""
        result, frame = outcome.result, outcome.about.frame
        if frame != self.frame or outcome.place_map is not self._map:
            self.frame, self._map, self._correction = frame, outcome.place_map, None
            self._poses.clear()
            self._lines.clear()
        self._note(outcome)
        self.publish_route(outcome.places, frame)
        if self._is_requested(self._matched) and result.match.accepted:
            header = Header(stamp=outcome.header.stamp, frame_id=frame)
            self._send(self._matched, Path(header=header, poses=list(self._poses)))
        if self._is_requested(self._markers):
            self._send(self._markers, self._markers_message(outcome))
        if result.image is not None and self._is_requested(self._image):
            jpeg = encode_jpeg(draw_match(result, outcome.places), QUALITY)
            image = CompressedImage(header=outcome.header, format='jpeg', data=jpeg)
            self._send(self._image, image)
        if self._is_requested(self._window, self._distances):
            self._publish_distances(outcome)

    def publish_route(self, places: Places, frame: str) -> None:
        """Publish the poses of all places, if they are requested and not published yet."""
        if not self._is_requested(self._route):
            return
        last, count, last_frame = self._published
        size = 0 if places is None else len(places)
        if places is last and frame == last_frame and count <= size < count * GROWTH + 1:
            return
        self._published = places, size, frame
        message = Path(header=Header(frame_id=frame, stamp=self._node.get_clock().now().to_msg()))
        poses = None if places is None else places.poses
        if poses is not None:
            poses_known = poses[np.isfinite(poses).all(axis=1)]
            message.poses = [
                PoseStamped(header=message.header, pose=pose_message(pose)) for pose in poses_known
            ]
        self._send(self._route, message)

    def close(self) -> None:
        """Destroy the publishers, and release the map: the executor may keep them for a while."""
        self._on_subscriber, self._published = lambda: None, (None, 0, '')
        self._map = None
        del self.operation
        super().close()

    def _publish_distances(self, outcome: Outcome) -> None:
        recognizer, places, match = self.operation().recognizer, outcome.places, outcome.match
        if recognizer is None or places is None or not recognizer.window_fill:
            return
        row = recognizer.newest_row()
        if not row.size:
            return
        first = getattr(places, 'first', 0)  # of a route
        near = places_to_draw(match, first, len(row))
        if self._is_requested(self._window):
            drawn = draw_window(recognizer.window_columns(near), int(near[0]), match)
            self._send(self._window, image_message(outcome.header, drawn))
        if self._is_requested(self._distances):
            row = np.pad(row, (0, len(places) - len(row)), constant_values=np.inf)[None]
            numbers = np.arange(first, first + row.size)[None]
            columns = np.stack(
                [column_minima(row, COLUMNS)[0], column_minima(numbers, COLUMNS)[0]], axis=1
            ).astype(np.float32)
            self._send(self._distances, image_message(outcome.header, columns[None], '32FC2'))

    def _note(self, outcome: Outcome) -> None:
        """Keep the pose of the matched place, and the line from the query to it."""
        match, places, odometry = outcome.match, outcome.places, outcome.about.pose
        if places is None or outcome.newest is None or (pose := outcome.newest.pose) is None:
            return
        stamped = Header(stamp=outcome.header.stamp, frame_id=self.frame)
        self._poses.append(PoseStamped(header=stamped, pose=pose_message(pose)))
        query = None
        if match.first_image >= 0:
            query = places.place(outcome.result.image_index).pose
        elif odometry is not None:  # where it leads to from the last match: a long line is a jump
            if self._correction is not None:
                query = to_poses(self._correction @ matrices(odometry))
            self._correction = matrices(pose) @ inverse(matrices(odometry))
        if query is not None:
            self._lines.append((_point(query), _point(pose), color(match.probability)))

    def _markers_message(self, outcome: Outcome) -> MarkerArray:
        """Return the lines, the matched place with its text, and the candidates."""
        match, places = outcome.match, outcome.places
        header = Header(stamp=outcome.header.stamp, frame_id=self.frame)
        markers = [Marker(header=header, action=Marker.DELETEALL)]

        def add(kind: int, **fields: Any) -> Marker:
            marker = Marker(header=header, ns='stavpr', id=len(markers), type=kind, **fields)
            marker.pose.orientation.w = 1.0
            markers.append(marker)
            return marker

        if self._lines:
            lines = add(Marker.LINE_LIST)
            lines.scale.x = 0.05
            lines.points = [point for a, b, _ in self._lines for point in (a, b)]
            lines.colors = [shade for *_, shade in self._lines for _ in range(2)]
        if places is not None:
            balls = [(match.newest, match.probability, 0.8)] if match.accepted else []
            balls += [(row.place, row.probability, 0.4) for row in outcome.result.candidates]
            for place, probability, size in balls:
                if (pose := places.place(place).pose) is not None:
                    ball = add(Marker.SPHERE, color=color(probability))
                    ball.pose.position = _point(pose)
                    ball.scale.x = ball.scale.y = ball.scale.z = size
            if outcome.newest is not None and (pose := outcome.newest.pose) is not None:
                text = add(Marker.TEXT_VIEW_FACING, color=color(match.probability))
                text.pose.position = _point(pose)
                text.pose.position.z += 1.0
                text.scale.z = 0.6
                text.text = f'place {match.newest}'
                if not math.isnan(match.probability):
                    text.text += f', p {match.probability:.2f}'
        return MarkerArray(markers=markers)

    def _make_latched(self, kind: type, topic: str) -> Publisher:
        def on_matched(event: Any) -> None:
            if event.current_count_change > 0:
                self._on_subscriber()

        events = PublisherEventCallbacks(matched=on_matched)
        try:
            return self._make(kind, topic, LATCHED, event_callbacks=events)
        except UnsupportedEventTypeError:  # then it is published with the next image
            return self._make(kind, topic, LATCHED)


def color(probability: float) -> ColorRGBA:
    """Return the color of a probability, vermilion = 0 to blue = 1; gray = unknown."""
    ends = (GRAY, GRAY) if math.isnan(probability) else (VERMILION, BLUE)
    low, high = (np.array(rgb(end)) / 255 for end in ends)
    red, green, blue = (low + np.nan_to_num(probability) * (high - low)).tolist()
    return ColorRGBA(r=red, g=green, b=blue, a=0.9)


def _point(pose: np.ndarray) -> Point:
    x, y, z = map(float, pose[:3])
    return Point(x=x, y=y, z=z)
