"""Operation loop_closure from the outside: the hallway of the data folder, a made-up loop with odometry."""

from dataclasses import dataclass

import numpy as np
import pytest
from conftest import route_images
from image_messages import image_message
from nav_msgs.msg import Odometry
from processes import RELIABLE, TAKEN_RELIABLY, Bench, node_process

from stavpr_msgs.msg import LoopClosure, PlaceMatch
from stavpr_msgs.srv import SaveMap
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.metrics import counts_at, image_matches
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import load_map
from stavpr_ros.pipeline import PipelineSettings
from stavpr_ros.recognition import Status
from stavpr_ros.sources import open_source

SECOND = 10**9
LAP, LENGTH = 40, 5


@dataclass
class Drive:
    """What came of a drive: answers, loop closures by their last image, and what the core says."""

    answers: list
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
        started.append(node_process(tmp_path_factory.mktemp('node') / 'node.log', **values | TAKEN_RELIABLY))
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
    """Where odometry believes to be: the second lap is a little off the first."""
    message = Odometry()
    message.pose.pose.position.x = float(x)
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = 0.6, 0.8
    return message


def drive(bench, images, settings, x_of=None):
    """
    Show image i at i + 1 seconds, with odometry, if there is any, at x_of(i), None = none for that image.

    With the rule of motion, an image whose pose has not arrived yet is skipped: both are sent once more.
    """
    extractor = FeatureExtractor()
    closer = settings.loop_closer(extractor, settings.applied_threshold('loop_closure'))
    answers, core = [], []
    for i, image in enumerate(images):
        message = image_message(image, (i + 1) * SECOND)
        x = None if x_of is None else x_of(i)
        if x_of is not None:
            assert bench.set_parameter('keyframe_distance', 0.0 if x is None else 0.001)[0]
        answer = None
        while answer is None or 'no odometry' in answer.reason:
            if x is not None:
                odometry = pose(x)
                odometry.header.stamp = message.header.stamp
                bench.odometry.publish(odometry)
            answer = bench.ask(message)
        answers.append(answer)
        core.append(closer.update(extractor.extract([image]), (i + 1) * SECOND))
    matches = sum(answer.status == PlaceMatch.MATCH for answer in answers)
    bench.until(lambda: len(bench.closures) >= matches, 'a loop closure for each match')
    assert len(bench.closures) == matches
    return Drive(answers, {closure.header.stamp.sec - 1: closure for closure in bench.closures}, core)


def check_against_core(driven, length):
    """Match for match: statuses, places, distances, paths; and what a loop closure makes of them."""
    for i, (answer, core) in enumerate(zip(driven.answers, driven.core, strict=True)):
        assert answer.status == {'warming up': 0, 'no match': 1, 'match': 2}[core.status.value]
        assert (answer.place_index, answer.newest_index) == (core.place_index, core.newest_index)
        assert (i in driven.closures) == (core.status is Status.MATCH)
        if core.sequence is None:
            continue
        assert answer.distance == pytest.approx(core.sequence.distance, abs=1e-4)
        if i not in driven.closures:
            continue
        closure, first = driven.closures[i], i - length + 1
        assert closure.header == answer.header
        assert (closure.distance, closure.threshold) == (answer.distance, answer.threshold)
        assert (closure.query_index, closure.place_index) == (first + (length - 1) // 2, core.place_index)
        assert (closure.query_stamp.sec, closure.place_stamp.sec) == (closure.query_index + 1, core.place_index + 1)
        assert closure.query_stamp == answer.window_middle
        assert closure.inliers == -1
        pairs = [(pair.query_index, pair.place_index) for pair in closure.pairs]
        assert pairs == [(first + q, m) for q, m in core.path.tolist()]
        assert (pairs[0][0], pairs[-1][0]) == (first, i)
        stamps = [(pair.query_stamp.sec - 1, pair.place_stamp.sec - 1) for pair in closure.pairs]
        assert stamps == pairs


def test_the_hallway_is_closed(bench, start, data_folder):
    """As the core closes it in test_robust, and every loop closure is right."""
    images = [frame.image for frame in open_source(data_folder / 'rtabmap_hallway_loop' / 'samples')]
    truth_file = data_folder / 'rtabmap_hallway_loop' / 'samples_GT.bmp'
    truth = GroundTruth.from_file(truth_file, 84, 84, 0).loop_closures(19)
    start(exclude_places=20)
    driven = drive(bench, images, PipelineSettings(exclude_places=20))
    check_against_core(driven, 20)
    places = np.full(84, -1)
    for closure in driven.closures.values():
        places[closure.query_index] = closure.place_index
    told = np.flatnonzero(places >= 0)
    correct = truth.accepts(places)
    offline = image_matches(driven.core, 20)
    score = counts_at(1.0, offline.distances, truth.accepts(offline.places), truth.has_match)
    print(f'hallway: {len(told)} loop closures, {correct[told].mean():.3f} right, '
          f'{correct.sum()} of {truth.has_match.sum()} places; core with its ends '
          f'precision {score.precision:.3f}, recall {score.recall:.3f}')  # fmt: skip
    assert len(told) == len(driven.closures) >= 20
    assert correct[told].all()
    assert score.precision == 1
    # frames after the last window's middle have no loop closure of their own, but a pair in the last one
    last = driven.closures[max(driven.closures)]
    for pair in last.pairs:
        if places[pair.query_index] < 0:
            places[pair.query_index] = pair.place_index
    assert truth.accepts(places)[truth.has_match].mean() >= 0.8


@pytest.fixture(scope='module')
def loop(bench, start):
    """A made-up loop, driven twice and a half; odometry drifts, and is silent for places 10 to 14."""
    start(sequence_length=LENGTH, exclude_places=10, nms_radius=5, candidates=2, geometric_check='none')
    settings = PipelineSettings(sequence=SequenceSettings(LENGTH), exclude_places=10, nms_radius=5)
    images = (route_images(LAP) * 3)[: 2 * LAP + LAP // 2]
    return drive(bench, images, settings, lambda i: None if 10 <= i < 15 else i % LAP + 0.1 * (i // LAP))


def test_a_made_up_loop_is_closed_as_the_core_closes_it(loop):
    check_against_core(loop, LENGTH)
    for i in range(LAP + LENGTH, 2 * LAP):
        closure = loop.closures[i]
        assert closure.query_index - closure.place_index == LAP
        assert closure.pairs[-1].place_index == i - LAP


def test_odometry_gives_both_poses(loop):
    """What odometry believed at either time; none where it was silent at one of them."""
    known = 0
    for closure in loop.closures.values():
        places = closure.query_index, closure.place_index
        silent = any(10 <= place < 15 for place in places)
        assert closure.has_poses != silent
        if silent:
            assert closure.query_pose.position.x == closure.place_pose.position.x == 0
            continue
        known += 1
        for place, believed in zip(places, (closure.query_pose, closure.place_pose), strict=True):
            assert believed.position.x == pytest.approx(place % LAP + 0.1 * (place // LAP), abs=1e-9)
            assert (believed.orientation.z, believed.orientation.w) == pytest.approx((0.6, 0.8))
    assert known >= 40


def test_the_route_can_be_saved(bench, loop, tmp_path):
    path = tmp_path / 'route.stavpr'
    response = bench.call(SaveMap, 'save_map', path=str(path))
    assert (response.success, response.places) == (True, 2 * LAP + LAP // 2)
    saved = load_map(path)
    assert [stamp // SECOND for stamp in saved.stamps] == list(range(1, len(saved) + 1))
    assert np.flatnonzero(np.isnan(saved.poses[:, 0])).tolist() == [10, 11, 12, 13, 14]
