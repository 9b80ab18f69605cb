# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The image of the map further ahead, as the subgoal of a learned policy of navigation."""

from dataclasses import replace

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage
from stavpr_msgs.msg import PlaceCandidates
from stavpr_ros.errors import MapFileError
from stavpr_ros.mapping import Map
from stavpr_ros.mapping.place_map import encode_jpeg, resized
from stavpr_ros.method import Candidate
from stavpr_ros.pipeline import ImageResult, NodeSettings
from stavpr_ros.ros.messages import candidates_message, Outcome
from stavpr_ros.ros.output import Publishers

QUALITY = 90  # of JPEG, of an image whose width is changed


class SubgoalPublisher(Publishers):
    """
    Publishes ``~/subgoal``, a thumbnail of the map, and its place on ``~/subgoal_place``.

    Both have the header of the image that was matched; only with a subscriber.
    """

    def __init__(self, node: Node, settings: NodeSettings) -> None:
        super().__init__(node)
        self._settings = settings
        self._image = self._make(CompressedImage, '~/subgoal')
        self._place = self._make(PlaceCandidates, '~/subgoal_place')

    def publish(self, outcome: Outcome) -> None:
        """Publish the subgoal of a match on a map."""
        match, places, settings = outcome.match, outcome.place_map, self._settings
        if not match.accepted or places is None:
            return
        if not self._is_requested(self._image, self._place):
            return
        index = place_ahead(places, match.newest, settings.subgoal_distance, match.path.direction)
        subgoal = Candidate(index, match.distance, match.probability)
        only = replace(outcome, result=ImageResult(match, candidates=(subgoal,)))
        self._send(self._place, candidates_message(only))
        if content := thumbnail_of_width(places, index, settings.subgoal_width):
            image = CompressedImage(header=outcome.header, format='jpeg', data=content)
            self._send(self._image, image)


def place_ahead(places: Map, index: int, distance: float, direction: int = 1) -> int:
    """
    Return the first place at least so far ahead on the route, or the last one of its session.

    :param distance: along the route, meters; on a map without poses, number of places.
    :param direction: 1 = along the map, -1 = against it.
    """
    session, ahead, length, here = places.session(index), index, 0.0, places.pose(index)
    while length < distance:
        following = ahead + direction
        if not 0 <= following < len(places) or places.session(following) != session:
            break
        ahead = following
        pose = places.pose(ahead)
        if not places.has_poses:
            length += 1
        elif pose is not None:
            length += 0.0 if here is None else float(np.linalg.norm(pose[:3] - here[:3]))
            here = pose
    return ahead


def thumbnail_of_width(places: Map, index: int, width: int) -> bytes:
    """
    Return the thumbnail of a place as JPEG, empty = none.

    :param width: pixels, 0 = as it is in the map.
    """
    try:
        content = bytes(places.thumbnails[index]) if len(places.thumbnails) else b''
    except MapFileError:  # the file has been overwritten since it was opened
        return b''
    image = places.thumbnail(index) if content and width else None
    if image is None or image.shape[1] == width:
        return content
    size = width, max(1, round(width * image.shape[0] / image.shape[1]))
    return encode_jpeg(resized(image, size), QUALITY)
