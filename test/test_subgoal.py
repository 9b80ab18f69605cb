# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The subgoal for learned policies: its place, its image, and the topics of a node."""

from dataclasses import replace
from itertools import cycle

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import CompressedImage
from stavpr_msgs.msg import PlaceCandidates
from stavpr_ros.mapping import Session
from stavpr_ros.ros.subgoal import place_ahead, thumbnail_of_width


@pytest.mark.parametrize(
    ('index', 'distance', 'expected'),
    [(10, 3.0, 13), (10, 2.5, 13), (10, 0.0, 10), (57, 9.0, 59), (59, 1.0, 59)],
)
def test_place_ahead_is_at_the_distance_along_the_route_or_its_end(
    small_map, index, distance, expected
):
    assert place_ahead(small_map, index, distance) == expected  # places are 1 m apart
    assert place_ahead(replace(small_map, poses=None), index, distance) == expected
    wide = small_map.poses.copy()
    wide[:, 0] *= 2
    wide[12] = np.nan  # unknown
    half = place_ahead(replace(small_map, poses=wide), index, 2 * distance)
    assert half == expected


def test_place_ahead_stays_in_its_session(small_map):
    two = replace(
        small_map,
        sessions=(Session('a'), Session('b')),
        session_index=np.repeat(np.arange(2, dtype=np.int32), 30),
    )
    assert [place_ahead(two, index, 5.0) for index in (20, 27, 29, 30)] == [25, 29, 29, 35]
    assert [place_ahead(two, index, 5.0, -1) for index in (2, 20, 30, 36)] == [0, 15, 30, 31]


def test_thumbnail_has_the_width(small_map):
    own = small_map.thumbnails[7]
    assert thumbnail_of_width(small_map, 7, 0) == own
    height, width = small_map.thumbnail(7).shape[:2]
    for wanted in (width // 2, 2 * width):
        content = thumbnail_of_width(small_map, 7, wanted)
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        assert image.shape[:2] == (height * wanted // width, wanted)
        back = cv2.resize(image[..., ::-1], (width, height), interpolation=cv2.INTER_AREA)
        assert np.abs(back.astype(int) - small_map.thumbnail(7)).mean() < 30
    assert not thumbnail_of_width(replace(small_map, thumbnails=()), 7, 100)


def test_node_publishes_the_subgoal_of_each_match(robot, start, route, small_map):
    start(subgoal_distance=3.0, robot_id='r2')
    images = robot.listen(CompressedImage, '/stavpr/subgoal')
    places = robot.listen(PlaceCandidates, '/stavpr/subgoal_place')
    frames = cycle(route[10:50])  # until the topics are discovered
    matches = {}

    def is_received():
        match = robot.show(next(frames))
        matches[match.header.stamp.sec] = match
        return bool(images and places)

    robot.until(is_received, 'a subgoal')
    robot.until(lambda: images[-1].header == places[-1].header, 'both topics of one image')
    image, place = images[-1], places[-1]
    match, (subgoal,) = matches[image.header.stamp.sec], place.candidates
    assert (place.header, place.robot_id, place.map_id) == (match.header, 'r2', match.map_id)
    assert subgoal.place_index == match.newest_index + 3
    assert subgoal.place_id == f'place {subgoal.place_index}'
    assert (subgoal.probability, subgoal.distance) == (match.probability, match.distance)
    assert image.format == 'jpeg'
    assert bytes(image.data) == small_map.thumbnails[subgoal.place_index]
