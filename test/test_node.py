# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node as a process of its own: images published to it, matches received."""

import signal

from diagnostic_msgs.msg import DiagnosticStatus
from image_messages import image_message
import numpy as np
from processes import node_process
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_msgs.srv import LoadMap, SetOperation
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
from std_msgs.msg import Float32, Int32

LENGTH, THRESHOLD = 5, 0.2
PAPER = {'mode': 'paper', 'threshold': THRESHOLD}
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def run(bench, tmp_path):
    """Start one node and wait for it; it is ended with the test."""
    started = []

    def run(wait=True, **parameters):
        values = {'sequence_length': LENGTH, 'nms_radius': 5, 'threads': 1} | parameters
        started.append(node_process(tmp_path / 'node.log', **values))
        if wait:
            bench.wait_for_node()
        return started[0]

    yield run
    started[0].end()
    bench.wait_for_nobody()


@pytest.fixture
def node(run, map_file):
    return run(map_path=map_file, **PAPER)


def recognize(place_map, images, threshold, mode):
    """Return the matches of the library."""
    settings = RecognizerSettings(
        threshold, sequence=SequenceSettings(LENGTH), nms_radius=5, mode=mode
    )
    recognizer, extractor = PlaceRecognizer(place_map, settings), place_map.extractor()
    return [recognizer.update(extractor.extract([image])) for image in images]


def nanoseconds(time):
    return time.sec * 10**9 + time.nanosec


def same_match(message, core):
    """Every field that the recognizer decides; features may differ in the last bits."""
    assert message.status == core.status
    assert (message.place_index, message.newest_index) == (core.place_index, core.newest_index)
    if core.sequence is None:
        assert message.sequence_first == -1
        assert np.isnan(message.distance)
        return
    sequence = core.sequence
    assert message.distance == pytest.approx(sequence.distance, abs=1e-4)
    assert (message.sequence_first, message.sequence_last) == (sequence.first, sequence.last)
    assert message.sequence_middle == sequence.middle
    assert message.second_best_index == sequence.second_best_index
    second = pytest.approx(sequence.second_best_distance, abs=1e-4)
    assert message.second_best_distance == second
    path = [(pair.query_index, pair.place_index) for pair in message.path]
    assert path == [tuple(cell) for cell in core.path.tolist()]


def test_node_publishes_the_matches_of_the_library(bench, node, small_map, route):
    """Every field of ~/match, and the plain topics for accepted matches only."""
    places = bench.listen(Int32, '/stavpr/place_index')
    distances = bench.listen(Float32, '/stavpr/distance')
    infos = bench.listen(MapInfo, '/stavpr/map_info', LATCHED)
    bench.until(lambda: len(infos) == 1, 'the map')
    info = infos[0]
    assert (info.places, info.features, info.strips, info.projected) == (60, 'gradient', 7, True)
    rng = np.random.default_rng(0)
    images = route[20:34] + [rng.integers(0, 256, (96, 128, 3), np.uint8) for _ in range(6)]
    cores = recognize(small_map, images, THRESHOLD, 'paper')
    stamps = [10**9 * (100 + i) + i for i in range(len(images))]
    matches = []
    for i, image in enumerate(images):
        message, core = bench.ask(image_message(image, stamps[i])), cores[i]
        assert (nanoseconds(message.header.stamp), message.header.frame_id) == (
            stamps[i],
            'camera',
        )
        same_match(message, core)
        assert message.threshold == pytest.approx(THRESHOLD)
        if core.sequence is not None:
            window = message.window_first, message.window_middle, message.window_last
            assert [nanoseconds(t) for t in window] == [stamps[i - 4], stamps[i - 2], stamps[i]]
        if message.status == PlaceMatch.MATCH:
            matches.append(message)
            assert message.reason == ''
            assert message.place_stamp.sec == message.place_index + 1
            assert message.place_id == f'place {message.place_index}'
            assert message.newest_id == f'place {message.newest_index}'
    assert 10 <= len(matches) < len(images) - LENGTH + 1
    bench.until(lambda: len(places) == len(distances) == len(matches), 'the plain topics')
    assert [place.data for place in places] == [match.place_index for match in matches]
    assert [distance.data for distance in distances] == [match.distance for match in matches]
    assert node.stop() == 0
    assert 'Traceback' not in node.output()
    received = len(images) + bench.probes
    assert f'{received} images received, {len(images)} processed' in node.output()
    assert f'{bench.probes} invalid: encoding' in node.output()
    assert 'backend auto' in node.output()


def test_invalid_images_leave_the_window_unchanged(bench, node, route):
    wrong_size = image_message(route[0], 1)
    wrong_size.height = 10**6
    depth = image_message(route[0], 3)
    depth.encoding = '32FC1'
    unknown = image_message(route[0], 4)
    unknown.encoding = 'teleport8'
    for i, bad in enumerate([None, wrong_size, None, Image(), None, depth, None, unknown]):
        if bad is not None:
            message = bench.ask(bad)
            assert message.status == PlaceMatch.INVALID_IMAGE
            assert message.header == bad.header
            assert message.reason
        message = bench.ask(image_message(route[i], 10 + i))
    assert (message.status, message.newest_index) == (PlaceMatch.MATCH, 7)
    assert node.stop(signal.SIGTERM) == 0
    for count, cause in ((2 + bench.probes, 'encoding'), (1, 'depth'), (1, 'cut off')):
        assert f'{count} invalid: {cause}' in node.output()
    assert 'Traceback' not in node.output()


def test_node_decodes_encodings_with_padded_rows(bench, node, route):
    for encoding in ('rgb8', 'bgr8', 'rgba8', 'bgra8', 'mono8', 'mono16'):
        for i in range(30, 38):
            image = image_message(route[i], 1000 + i, encoding, padding=5 if i % 2 else 0)
            message = bench.ask(image)
        assert (message.status, message.newest_index) == (PlaceMatch.MATCH, 37), encoding


def test_a_burst_of_images_gets_one_match_each(bench, node, route):
    """Every image that reached the node is processed or dropped, once; then all is well."""
    before = len(bench.answers)
    big = [
        image_message(np.kron(route[i], np.ones((5, 5, 1), np.uint8)), 2000 + i) for i in range(40)
    ]
    for image in big:
        bench.publisher.publish(image)
    for i in range(40, 46):
        message = bench.ask_until_answered(image_message(route[i], 5000 + i))
    assert (message.status, message.newest_index) == (PlaceMatch.MATCH, 45)
    stamps = [nanoseconds(message.header.stamp) for message in bench.answers[before:]]
    assert len(set(stamps)) == len(stamps)


def test_missing_map_and_threshold_are_set_later(bench, run, map_file, route):
    """The map by the service only, the threshold by the parameter; both without a restart."""
    process = run(mode='paper')
    message = bench.ask(image_message(route[0], 1))
    assert message.status == PlaceMatch.NOT_READY
    assert 'load_map' in message.reason
    for name, value, service in (
        ('map_path', map_file, 'load_map'),
        ('operation', 'mapping', 'set_operation'),
    ):
        done, reason = bench.set_parameter(name, value)
        assert (done, f'call the service ~/{service}' in reason) == (False, True)
    assert bench.call(LoadMap, 'load_map', path=map_file).success
    message = bench.ask(image_message(route[0], 2))
    assert message.status == PlaceMatch.NOT_READY
    assert 'threshold' in message.reason
    assert not bench.set_parameter('threshold', 0.0)[0]
    assert bench.set_parameter('threshold', THRESHOLD)[0]
    for i in range(LENGTH):
        message = bench.ask(image_message(route[i], 3 + i))
    assert (message.status, message.newest_index) == (PlaceMatch.MATCH, LENGTH - 1)
    assert bench.set_parameter('threshold', 1e-7)[0]
    message = bench.ask(image_message(route[7], 30))
    assert (message.status, message.place_index) == (PlaceMatch.NO_MATCH, -1)
    done, reason = bench.set_parameter('beta', 3.0)
    assert (done, 'while the node is unconfigured' in reason) == (False, True)
    assert process.popen.poll() is None
    assert 'no map: call the service load_map' in process.output()


def test_mode_robust_has_a_default_threshold(bench, run, map_file, small_map, route):
    run(map_path=map_file)
    images = route[10:26]
    for i, core in enumerate(recognize(small_map, images, 1.0, 'robust')):
        message = bench.ask(image_message(images[i], 1 + i))
        same_match(message, core)
        assert message.threshold == 1
    assert message.status == PlaceMatch.MATCH
    done, reason = bench.set_parameter('threshold', 1.5)
    assert (done, 'chance' in reason) == (False, True)
    for i, (threshold, applied) in enumerate(((0.8, 0.8), (-1.0, 1.0))):
        assert bench.set_parameter('threshold', threshold)[0]
        message = bench.ask(image_message(route[26 + i], 26 + i))
        assert message.threshold == pytest.approx(applied)


def test_parameter_change_after_failed_start_starts_the_node(
    bench, run, map_file, route, tmp_path
):
    bad = tmp_path / 'bad.stavpr'
    bad.write_bytes(b'no map')
    process = run(wait=False, map_path=bad, **PAPER)
    bench.until_diagnosed('map', DiagnosticStatus.ERROR, 'bad.stavpr')
    bench.until_state('unconfigured')
    assert 'cannot configure' in process.output()
    assert bench.set_parameter('map_path', map_file) == (True, '')
    bench.wait_for_node()
    for i in range(LENGTH):
        message = bench.ask(image_message(route[i], 3 + i))
    assert (message.status, message.newest_index) == (PlaceMatch.MATCH, LENGTH - 1)


def test_float16_excludes_loop_closure(bench, run, map_file):
    process = run(map_path=map_file, precision='float16')
    response = bench.call(SetOperation, 'set_operation', operation='loop_closure')
    assert (response.success, 'precision float16' in response.message) == (False, True)
    assert f'set_operation failed: {response.message}' in process.output()
    assert bench.call(SetOperation, 'set_operation', operation='mapping').success


@pytest.mark.parametrize(
    ('parameters', 'word'),
    [
        ({'beta': 0.5}, 'beta'),
        ({'strategy': 'teleport'}, 'teleport'),
        ({'threshold': 'low'}, 'threshold'),
        ({'backend': 'tpu'}, 'tpu'),
        ({'image_transport': 'compressedDepth'}, 'take one of raw, compressed'),
        ({'operation': 'loop_closure', 'precision': 'float16'}, 'precision float16'),
    ],
)
def test_invalid_parameters_end_the_node(tmp_path, parameters, word):
    process = node_process(tmp_path / 'node.log', **parameters)
    assert process.wait() == 1
    assert 'cannot start' in process.output()
    assert word in process.output()
    assert 'Traceback' not in process.output()


@pytest.mark.parametrize('numbers', [[signal.SIGINT] * 2, [signal.SIGTERM]])
def test_signals_while_images_arrive_end_the_node(bench, node, route, numbers):
    """In the middle of an image; `ros2 launch` sends a second interrupt."""
    images = [image_message(route[i % 60], 7000 + i) for i in range(200)]
    for i, message in enumerate(images):
        bench.publisher.publish(message)
        bench.executor.spin_once(timeout_sec=0.002)
        if i == 100:
            for number in numbers:
                node.popen.send_signal(number)
    assert node.wait() == 0
    assert 'Traceback' not in node.output()
    assert 'Exception' not in node.output()
    assert 'images received' in node.output()
