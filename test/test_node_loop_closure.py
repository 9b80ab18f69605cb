# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Operation loop_closure: a hallway of the data folder, and a synthetic loop with odometry."""

from dataclasses import dataclass

from conftest import route_images
from image_messages import image_message
from nav_msgs.msg import Odometry
import numpy as np
from processes import Bench, node_process, RELIABLE, TAKEN_RELIABLY
import pytest
from stavpr_msgs.msg import LoopClosure, PlaceMatch
from stavpr_msgs.srv import SaveMap
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import load_map
from stavpr_ros.recognition import RecognizerSettings
from stavpr_ros.recognition.loop_closer import LoopCloser
from stavpr_ros.sources import open_source

SECOND = 10**9
LAP, LENGTH = 40, 5


@dataclass
class Results:
    """Matches, loop closures by their last image, and the matches of the library."""

    matches: list
    closures: dict
    core: list


@pytest.fixture(scope='module')
def bench():
    bench = Bench(RELIABLE)
    bench.odometry = bench.node.create_publisher(Odometry, 'odom', 100)
    bench.closures = bench.listen(LoopClosure, '/stavpr/loop_closure', 1000)
    yield bench
    bench.close()


@pytest.fixture(scope='module')
def start(bench, tmp_path_factory):
    started = []

    def start(**parameters):
        end()
        values = {'operation': 'loop_closure', 'threads': 1, 'keyframe_change': 0.0} | parameters
        log = tmp_path_factory.mktemp('node') / 'node.log'
        started.append(node_process(log, **values | TAKEN_RELIABLY))
        bench.wait_for_node()
        bench.closures.clear()

    def end():
        while started:
            process = started.pop()
            assert process.stop() == 0
            assert 'Traceback' not in process.output()
            bench.wait_for_nobody()

    yield start
    end()


def pose(x):
    message = Odometry()
    message.pose.pose.position.x = float(x)
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = 0.6, 0.8
    return message


def process(bench, images, settings, exclude, x_of=None):
    """
    Publish image i at i + 1 seconds, with odometry at x_of(i) if that is not None.

    With the rule of motion, an image without a pose yet is skipped: both are published once more.
    """
    extractor = FeatureExtractor()
    closer = LoopCloser(settings, exclude, extractor.settings)
    matches, core = [], []
    for i, image in enumerate(images):
        message = image_message(image, (i + 1) * SECOND)
        x = None if x_of is None else x_of(i)
        if x_of is not None:
            assert bench.set_parameter('keyframe_distance', 0.0 if x is None else 0.001)[0]
        match = None
        while match is None or 'no odometry' in match.reason:
            if x is not None:
                odometry = pose(x)
                odometry.header.stamp = message.header.stamp
                bench.odometry.publish(odometry)
            match = bench.ask(message)
        matches.append(match)
        core.append(closer.update(extractor.extract([image]), (i + 1) * SECOND))
    count = sum(match.status == PlaceMatch.MATCH for match in matches)
    bench.until(lambda: len(bench.closures) >= count, 'a loop closure for each match')
    assert len(bench.closures) == count
    closures = {closure.header.stamp.sec - 1: closure for closure in bench.closures}
    return Results(matches, closures, core)


def same_as_core(results, length):
    """Match for match: status, places, distance; and the loop closure of each match."""
    for i, (match, core) in enumerate(zip(results.matches, results.core, strict=True)):
        assert match.status == core.status
        assert (match.place_index, match.newest_index) == (core.place_index, core.newest_index)
        assert (i in results.closures) == core.accepted
        if core.sequence is not None:
            assert match.distance == pytest.approx(core.sequence.distance, abs=1e-4)
        if i not in results.closures:
            continue
        closure, first = results.closures[i], i - length + 1
        assert closure.header == match.header
        assert (closure.distance, closure.threshold) == (match.distance, match.threshold)
        query, place = closure.query_index, closure.place_index
        assert (query, place) == (first + (length - 1) // 2, core.place_index)
        assert (closure.query_stamp.sec, closure.place_stamp.sec) == (query + 1, place + 1)
        assert closure.query_stamp == match.window_middle
        assert closure.inliers == -1
        pairs = [(pair.query_index, pair.place_index) for pair in closure.pairs]
        assert pairs == [(first + q, m) for q, m in core.path.tolist()]
        stamps = [(p.query_stamp.sec - 1, p.place_stamp.sec - 1) for p in closure.pairs]
        assert stamps == pairs


def test_hallway_loop_closures_are_correct(bench, start, data_folder):
    """Those of the library, and every one agrees with the ground truth."""
    folder = data_folder / 'rtabmap_hallway_loop'
    images = [frame.image for frame in open_source(folder / 'samples')]
    truth = GroundTruth.from_file(folder / 'samples_GT.bmp', 84, 84, 0).loop_closures(19)
    start(exclude_places=20)
    results = process(bench, images, RecognizerSettings(0.8, mode='robust'), 20)
    same_as_core(results, 20)
    places = np.full(84, -1)
    for closure in results.closures.values():
        places[closure.query_index] = closure.place_index
    indices = np.flatnonzero(places >= 0)
    assert len(indices) == len(results.closures) >= 20
    assert truth.accepts(places)[indices].all()
    # images after the middle of the last window are in its pairs only
    for pair in results.closures[max(results.closures)].pairs:
        if places[pair.query_index] < 0:
            places[pair.query_index] = pair.place_index
    assert truth.accepts(places)[truth.has_match].mean() >= 0.8


@pytest.fixture(scope='module')
def loop(bench, start):
    """Process a loop, two laps and a half, with drift, without poses for places 10 to 14."""
    start(sequence_length=LENGTH, exclude_places=10, nms_radius=5, candidates=2)
    sequence = SequenceSettings(LENGTH)
    settings = RecognizerSettings(0.8, sequence=sequence, nms_radius=5, mode='robust')
    images = (route_images(LAP) * 3)[: 2 * LAP + LAP // 2]

    def x_of(i):
        return None if 10 <= i < 15 else i % LAP + 0.1 * (i // LAP)

    return process(bench, images, settings, 10, x_of)


def test_loop_closures_connect_the_laps(loop):
    same_as_core(loop, LENGTH)
    for i in range(LAP + LENGTH, 2 * LAP):
        closure = loop.closures[i]
        assert closure.query_index - closure.place_index == LAP
        assert closure.pairs[-1].place_index == i - LAP


def test_loop_closures_have_both_poses_or_none(loop):
    """The odometry at either time; none where it is missing at one of them."""
    known = 0
    for closure in loop.closures.values():
        places = closure.query_index, closure.place_index
        poses = closure.query_pose, closure.place_pose
        missing = any(10 <= place < 15 for place in places)
        assert closure.has_poses != missing
        for place, found in zip(places, poses, strict=True):
            x = 0 if missing else place % LAP + 0.1 * (place // LAP)
            assert found.position.x == pytest.approx(x, abs=1e-9)
            if not missing:
                assert (found.orientation.z, found.orientation.w) == pytest.approx((0.6, 0.8))
        known += not missing
    assert known >= 40


def test_the_recorded_route_is_saved(bench, loop, tmp_path):
    path = tmp_path / 'route.stavpr'
    response = bench.call(SaveMap, 'save_map', path=str(path))
    assert (response.success, response.places) == (True, 2 * LAP + LAP // 2)
    saved = load_map(path)
    assert [stamp // SECOND for stamp in saved.stamps] == list(range(1, len(saved) + 1))
    assert np.flatnonzero(np.isnan(saved.poses[:, 0])).tolist() == [10, 11, 12, 13, 14]
