# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Operation loop_closure over ROS: a synthetic loop with odometry."""

from fixtures import route_images
from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
import pytest
from robot import LENGTH, SECOND
from stavpr_msgs.msg import LoopClosure, PlaceMatch
from stavpr_msgs.srv import SaveMap
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import load_map
from stavpr_ros.recognition import RecognizerSettings
from stavpr_ros.recognition.loop_closer import LoopCloser

LAP, IMAGES, EXCLUDED = 30, 75, 10
BLIND = range(10, 15)  # images without odometry


def x_of(i):
    """Return where image i is taken, with drift."""
    return i % LAP + 0.1 * (i // LAP)


@pytest.fixture
def laps(robot, start):
    """Two laps and a half: matches, loop closures, stamps."""
    closures = robot.listen(LoopClosure, '/stavpr/loop_closure', 1000)
    poses = robot.listen(PoseWithCovarianceStamped, '/stavpr/pose')
    start(operation='loop_closure', map_path='', exclude_places=EXCLUDED, keyframe_distance=0.001)
    robot.until(lambda: robot.odometry.get_subscription_count() > 0, 'a subscriber of odometry')
    matches, stamps = [], []
    for i, image in enumerate((route_images(LAP) * 3)[:IMAGES]):
        if i in (BLIND.start, BLIND.stop):  # without the rule of motion, images need no pose
            robot.set(keyframe_distance=0.0 if i == BLIND.start else 0.001)
        matches.append(robot.show(image) if i in BLIND else robot.show_at(x_of(i), image))
        stamps.append(robot.stamp)
    count = sum(match.status == PlaceMatch.MATCH for match in matches)
    robot.until(
        lambda: sum(not each.is_late for each in closures) >= count,
        'a loop closure for each match',
    )
    robot.until(lambda: bool(poses), 'poses')
    assert {pose.header.frame_id for pose in poses} == {'wheels'}  # of the odometry
    return matches, closures, stamps


def test_loop_closures_of_the_node_are_those_of_the_library(robot, laps, tmp_path):
    """Match for match, with both poses or none; the recorded route is saved."""
    matches, closures, stamps = laps
    extractor, sequence = FeatureExtractor('gradient'), SequenceSettings(LENGTH)
    settings = RecognizerSettings(
        sequence=sequence, nms_radius=5, mode='robust', min_probability=0.05
    )
    closer = LoopCloser(settings, EXCLUDED, extractor.settings)
    on_time = {each.header.stamp.sec: each for each in closures if not each.is_late}
    closed, late = 0, []
    for i, image in enumerate((route_images(LAP) * 3)[:IMAGES]):
        match, core = matches[i], closer.update(extractor.extract([image]), stamps[i])
        assert match.status == core.status
        assert (match.place_index, match.newest_index) == (core.place_index, core.newest_index)
        for each in core.late:
            query = each.first_image_index + each.position
            late.append((stamps[each.image_index] // SECOND, query, each.place_index))
        closure = on_time.get(stamps[i] // SECOND)
        assert (closure is not None) == core.accepted
        if closure is None:
            continue
        closed += 1
        assert closure.probability == match.probability == pytest.approx(core.probability)
        places = closure.query_index, closure.place_index
        assert places == (i - LENGTH // 2, core.place_index)
        assert closure.has_poses == (not set(places) & set(BLIND))
    assert len(on_time) == closed >= IMAGES - LAP - 2 * LENGTH
    assert late == [
        (each.header.stamp.sec, each.query_index, each.place_index)
        for each in closures
        if each.is_late
    ]
    assert len(late) >= LENGTH // 2

    path = tmp_path / 'route.stavpr'
    assert robot.does(SaveMap, 'save_map', path=str(path)).places == IMAGES
    saved = load_map(path)
    assert saved.stamps.tolist() == stamps
    assert np.flatnonzero(np.isnan(saved.poses[:, 0])).tolist() == list(BLIND)
