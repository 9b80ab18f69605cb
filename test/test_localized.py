# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether the robot is localized, and its subgoal: by hand, and the topics of a node."""

from dataclasses import replace
from itertools import cycle, pairwise
import math
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import cv2
import numpy as np
from places import features_of, map_of, route_strips
import pytest
import rclpy
from robot import LATCHED, LENGTH
from sensor_msgs.msg import CompressedImage
from stavpr_msgs.msg import PlaceCandidates
from stavpr_ros.mapping import Session
from stavpr_ros.mapping.merging import along_route
from stavpr_ros.ros.localized import Localization, NOWHERE
from stavpr_ros.ros.subgoal import place_ahead, thumbnail_of_width
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger

SETTINGS = SimpleNamespace(
    localized_probability=0.9,
    lost_images=3,
    lost_distance=5.0,
    pipeline=SimpleNamespace(nms_radius=10),
)
TREE = Path(__file__).parents[1] / 'config' / 'nav2_localized.xml'
# nodes of BehaviorTree.CPP 4, and of nav2_behavior_tree/nav2_tree_nodes.xml of Jazzy, their ports
TREE_NODES = {
    'ReactiveSequence': set(),
    'ReactiveFallback': set(),
    'Sequence': set(),
    'KeepRunningUntilFailure': set(),
    'ScriptCondition': {'code'},
    'ControllerSelector': {'topic_name', 'default_controller', 'selected_controller'},
    'Wait': {'wait_duration', 'error_code_id'},
    'PipelineSequence': set(),
    'RateController': {'hz'},
    'ComputePathToPose': {'goal', 'start', 'path', 'planner_id', 'error_code_id'},
    'FollowPath': {'path', 'controller_id', 'goal_checker_id', 'error_code_id'},
}
SURE, UNSURE, NONE = (7, 0.95), (8, 0.5), (-1, 0.2)  # place and probability


def states(*results, positions=()):
    """Return the state after each result."""
    localization = Localization(SETTINGS)
    positions = [np.array([x, 0, 0]) for x in positions] or [None] * len(results)
    return [
        localization.update(*result, position) or localization.is_localized
        for result, position in zip(results, positions, strict=True)
    ]


@pytest.mark.parametrize(
    ('results', 'count'),
    [
        ([SURE, UNSURE, UNSURE, UNSURE], 3),
        ([SURE, NONE, UNSURE, NONE, UNSURE, UNSURE], 5),  # the last of five
        ([UNSURE] * 9, None),
        ([SURE, (18, 0.95), (-1, 0.2), (17, 0.6), (17, 0.6), (17, 0.6)], 5),  # too far is no proof
        ([SURE, NONE, NONE, NONE, UNSURE, UNSURE, UNSURE, UNSURE], None),
        ([SURE, NONE, NONE, NONE, UNSURE, SURE, UNSURE, UNSURE, UNSURE], 8),  # a second trial
        ([(7, math.nan)] * 4, 3),  # mode paper
    ],
)
def test_robot_is_localized_after_a_sure_match_that_three_of_five_confirm(results, count):
    expected = [False] * len(results)
    if count is not None:
        expected[count:] = [True] * (len(results) - count)
    assert states(*results) == expected


@pytest.mark.parametrize('step', [-4.5, 0.5, 4.5])
def test_robot_is_localized_while_it_moves(step):
    """Whatever is a second best match: nms_radius is no limit of the speed."""
    assert states(*[(round(100 + step * i), 0.95) for i in range(6)])[3:] == [True] * 3


def test_matches_that_jump_confirm_nothing():
    assert not any(states(*[(100 + 200 * (i % 2), 0.95) for i in range(4)]))


def test_positions_are_those_of_the_route_whatever_session_shows_them():
    """Of two drives on one route, the second with two places of its own; of a closed route."""
    index = np.repeat(np.arange(2, dtype=np.int32), [7, 6])
    two = {'sessions': (Session('a'), Session('b')), 'session_index': index}
    for same_as, sessions, lap, places in [
        ([*range(7), 1, 2, 9, 10, 5, 6], two, 0, (1, 8, 3, 11)),  # of one session or the other
        ([*range(80), *range(20)], {}, 80, (77, 79, 81, 3)),
    ]:
        features = features_of(route_strips(0, len(same_as)))
        place_map = map_of(features, same_as=np.array(same_as, np.int32), **sessions)
        positions, found_lap = along_route(place_map)
        localization = Localization(SETTINGS)
        for place in places:
            localization.update(int(positions[place]), 0.95, None, found_lap)
        assert (found_lap, localization.is_localized) == (lap, True)


def test_robot_is_lost_after_images_or_meters_without_a_match():
    start = [SURE, *[UNSURE] * 3]
    assert states(*start, NONE, NONE, UNSURE, NONE, NONE, NONE)[3:] == [*[True] * 6, False]
    far = states(*start, NONE, UNSURE, NONE, NONE, positions=[0, 1, 2, 3, 7.9, 8, 12, 13])
    assert far[3:] == [True, True, True, True, False]


def test_node_publishes_latched_whether_and_where_the_robot_is_localized(robot, start, route):
    node = start(localized_probability=0.05)
    localized = robot.listen(Bool, '/stavpr/localized', LATCHED)
    places = robot.listen(String, '/stavpr/current_node', LATCHED)
    robot.until(lambda: bool(localized and places), 'the latched messages')
    assert (localized[0].data, places[0].data) == (False, 'none')
    matches = robot.drive(route[:20])
    robot.until(lambda: localized[-1].data, 'being localized')
    last = matches[-1].newest_id
    robot.until(lambda: places[-1].data == last, 'the place of the last image')
    names = [message.data for message in places]
    assert all(a != b for a, b in pairwise(names))  # only changes
    assert set(names[1:]) <= {match.newest_id for match in matches[LENGTH - 1 :]}
    late = robot.listen(String, '/stavpr/current_node', LATCHED)
    robot.until(lambda: bool(late), 'the place, for a later subscriber')
    assert late[-1].data == last
    robot.until(lambda: robot.counts('recognition')['localized'] == 'True', 'the diagnostics')
    robot.does(Trigger, 'reset')
    robot.until(lambda: not localized[-1].data, 'being lost')
    robot.until(lambda: places[-1].data == 'none', 'no place')
    assert [message.data for message in localized] == [False, True, False]
    assert node.state == 'active'


def test_behavior_tree_has_nodes_of_nav2_and_reads_the_place():
    root = ElementTree.parse(TREE).getroot()
    (tree,) = root.iter('BehaviorTree')
    assert root.attrib == {'BTCPP_format': '4', 'main_tree_to_execute': tree.get('ID')}
    nodes = [node for node in tree.iter() if node is not tree]
    assert all(set(node.attrib) - {'name'} <= TREE_NODES[node.tag] for node in nodes)
    by_tag = {node.tag: node.attrib for node in nodes}
    selector = by_tag['ControllerSelector']
    assert selector['default_controller'] == NOWHERE
    assert selector['selected_controller'] == '{place}'
    assert by_tag['ScriptCondition']['code'] == f"place != '{NOWHERE}'"


def test_behavior_tree_reads_the_topic_of_the_node_in_its_own_namespace(robot, start):
    """Nav2 subscribes by a node in the namespace of bt_navigator."""
    topic = next(ElementTree.parse(TREE).getroot().iter('ControllerSelector')).get('topic_name')
    start('-r', '__ns:=/fleet/robot_2', wait=False)
    navigator = rclpy.create_node('navigator', context=robot.context, namespace='/fleet/robot_2')
    places = robot.listen(String, navigator.resolve_topic_name(topic), LATCHED)
    navigator.destroy_node()
    robot.until(lambda: bool(places), 'the place')


# The subgoal for learned policies: its place, its image, and the topics of a node


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
