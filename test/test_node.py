"""The node from the outside: a process of its own, images published to it, answers heard."""

import signal

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from image_messages import image_message
from processes import node_process
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Float32, Int32

from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.evaluation.evaluate import recognize_all
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings

LENGTH, THRESHOLD = 5, 0.2


def start(log, map_file=None, threshold=None, **parameters):
    values = {'sequence_length': LENGTH, 'nms_radius': 5, 'mode': 'paper'} | parameters
    if map_file is not None:
        values['map_path'] = map_file
    if threshold is not None:
        values['threshold'] = threshold
    return node_process(log, **values)


@pytest.fixture
def run(bench, tmp_path):
    """Start one node and wait for it; it is ended with the test."""
    started = []

    def run(*arguments, wait=True, **parameters):
        started.append(start(tmp_path / 'node.log', *arguments, **parameters))
        if wait:
            bench.wait_for_node()
        return started[0]

    yield run
    started[0].end()
    bench.wait_for_nobody()


@pytest.fixture
def node(run, map_file):
    return run(map_file, THRESHOLD)


def test_answers_are_the_cores_match_for_match(bench, node, small_map, route):
    """Every field of every answer against the library's, and the plain topics for matches alone."""
    places, distances, infos = [], [], []
    subscriptions = [
        bench.node.create_subscription(Int32, '/stavpr/place_index', lambda m: places.append(m.data), 50),
        bench.node.create_subscription(Float32, '/stavpr/distance', lambda m: distances.append(m.data), 50),
        bench.node.create_subscription(
            MapInfo,
            '/stavpr/map_info',
            infos.append,
            QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
        ),
    ]
    rng = np.random.default_rng(0)
    images = route[20:34] + [rng.integers(0, 256, (96, 128, 3), np.uint8) for _ in range(6)]
    settings = RecognizerSettings(THRESHOLD, sequence=SequenceSettings(LENGTH), nms_radius=5)
    expected = recognize_all(PlaceRecognizer(small_map, settings), small_map.extractor().extract(images))
    stamps = [10**9 * (100 + i) + i for i in range(len(images))]
    for i, image in enumerate(images):
        answer, core = bench.ask(image_message(image, stamps[i])), expected[i]
        stamp = answer.header.stamp
        assert (stamp.sec * 10**9 + stamp.nanosec, answer.header.frame_id) == (stamps[i], 'camera')
        assert answer.status == {'warming up': 0, 'no match': 1, 'match': 2}[core.status.value]
        assert (answer.place_index, answer.newest_index) == (core.place, core.newest)
        assert answer.threshold == pytest.approx(THRESHOLD)
        if core.nearest is None:
            assert i < LENGTH - 1
            assert answer.sequence_first == -1
            assert np.isnan(answer.distance)
            continue
        nearest = core.nearest
        # features of one image and of a batch may differ in the last bits
        assert answer.distance == pytest.approx(nearest.distance, abs=1e-5)
        assert (answer.sequence_first, answer.sequence_last) == (nearest.first, nearest.last)
        assert answer.sequence_middle == nearest.middle
        assert answer.second_best_index == nearest.second_best_index
        assert answer.second_best_distance == pytest.approx(nearest.second_best_distance, abs=1e-5)
        assert [(p.query_index, p.map_index) for p in answer.path] == [tuple(p) for p in core.path.tolist()]
        window = [answer.window_first, answer.window_middle, answer.window_last]
        assert [t.sec * 10**9 + t.nanosec for t in window] == [stamps[i - 4], stamps[i - 2], stamps[i]]
        if answer.status == PlaceMatch.MATCH:
            assert answer.reason == ''
            assert answer.place_stamp.sec == answer.place_index + 1
            assert answer.place_id == f'place {answer.place_index}'
            assert answer.newest_id == f'place {answer.newest_index}'
        else:
            assert 'threshold' in answer.reason
    statuses = [answer.status for answer in bench.answers[-len(images) :]]
    assert statuses.count(PlaceMatch.MATCH) >= 10
    assert PlaceMatch.NO_MATCH in statuses
    matches = [a for a in bench.answers[-len(images) :] if a.status == PlaceMatch.MATCH]
    bench.until(lambda: len(places) == len(distances) == len(matches) and len(infos) == 1, 'the plain topics')
    assert places == [match.place_index for match in matches]
    assert distances == [match.distance for match in matches]
    assert (infos[0].places, infos[0].features, infos[0].strips, infos[0].projected) == (
        60,
        'gradient',
        7,
        True,
    )
    assert infos[0].has_poses
    assert node.stop() == 0
    assert 'Traceback' not in node.output()
    assert f'{len(images) + bench.probes} images received, {len(images)} answered' in node.output()
    assert f'{bench.probes} invalid: encoding' in node.output()
    for subscription in subscriptions:
        bench.node.destroy_subscription(subscription)


def test_broken_images_among_good_ones(bench, node, route):
    """Each is answered as invalid, with its own header; the window goes on as if it had not come."""
    lying = image_message(route[0], 1)
    lying.height = 10**6
    empty = Image()
    depth = image_message(route[0], 3)
    depth.encoding = '32FC1'
    unknown = image_message(route[0], 4)
    unknown.encoding = 'teleport8'
    broken = [lying, empty, depth, unknown]
    for i in range(12):
        if i % 3 == 1:
            bad = broken[i // 3]
            answer = bench.ask(bad)
            assert answer.status == PlaceMatch.INVALID_IMAGE
            assert answer.header == bad.header
            assert answer.reason
            assert answer.place_index == -1
        answer = bench.ask(image_message(route[i], 10 + i))
        if i < LENGTH - 1:
            assert answer.status == PlaceMatch.WARMING_UP
        else:
            assert (answer.status, answer.newest_index) == (PlaceMatch.MATCH, i)
    assert node.stop(signal.SIGTERM) == 0
    assert f'{2 + bench.probes} invalid: encoding' in node.output()
    assert '1 invalid: depth' in node.output()
    assert '1 invalid: cut off' in node.output()
    assert 'Traceback' not in node.output()


def test_encodings_and_padded_rows(bench, node, route):
    for encoding in ('rgb8', 'bgr8', 'rgba8', 'bgra8', 'mono8', 'mono16'):
        for i in range(30, 38):
            answer = bench.ask(image_message(route[i], 1000 + i, encoding, padding=5 if i % 2 else 0))
        assert (answer.status, answer.newest_index) == (PlaceMatch.MATCH, 37), encoding


def test_a_flood_is_answered_image_by_image(bench, node, route):
    """Every image that reached the node has one answer, in time or as dropped; then all is well."""
    before = len(bench.answers)
    big = [image_message(np.kron(route[i], np.ones((5, 5, 1), np.uint8)), 2000 + i) for i in range(40)]
    for message in big:
        bench.publisher.publish(message)
    for i in range(40, 46):
        answer = bench.ask_until_answered(image_message(route[i], 5000 + i))
    assert (answer.status, answer.newest_index) == (PlaceMatch.MATCH, 45)
    stamps = [(a.header.stamp.sec, a.header.stamp.nanosec) for a in bench.answers[before:]]
    assert len(set(stamps)) == len(stamps)


def test_what_is_missing_is_said_and_can_be_set_later(bench, run, map_file, route, tmp_path):
    process = run()
    answer = bench.ask(image_message(route[0], 1))
    assert answer.status == PlaceMatch.NOT_READY
    assert 'map_path' in answer.reason
    done, reason = bench.set_parameter('map_path', str(tmp_path / 'missing.stavpr'))
    assert not done
    assert 'does not exist' in reason
    assert bench.set_parameter('map_path', map_file) == (True, '')
    answer = bench.ask(image_message(route[0], 2))
    assert answer.status == PlaceMatch.NOT_READY
    assert 'threshold' in answer.reason
    assert not bench.set_parameter('threshold', 0.0)[0]
    assert bench.set_parameter('threshold', THRESHOLD)[0]
    for i in range(LENGTH):
        answer = bench.ask(image_message(route[i], 3 + i))
    assert (answer.status, answer.newest_index) == (PlaceMatch.MATCH, LENGTH - 1)
    assert bench.set_parameter('threshold', 1e-7)[0]
    answer = bench.ask(image_message(route[7], 30))
    assert (answer.status, answer.place_index) == (PlaceMatch.NO_MATCH, -1)
    assert answer.sequence_middle >= 0
    assert not bench.set_parameter('beta', 3.0)[0]
    assert process.popen.poll() is None
    assert "no map: set parameter 'map_path'" in process.output()


def test_mode_robust_needs_no_threshold(bench, run, map_file, small_map, route):
    """The default mode: answers are the core's, and 1 is the largest threshold there is."""
    run(map_file, mode='robust')
    settings = RecognizerSettings(1.0, sequence=SequenceSettings(LENGTH), nms_radius=5, mode='robust')
    images = route[10:30]
    expected = recognize_all(PlaceRecognizer(small_map, settings), small_map.extractor().extract(images))
    for i, image in enumerate(images):
        answer, core = bench.ask(image_message(image, 1 + i)), expected[i]
        assert (answer.place_index, answer.newest_index) == (core.place, core.newest)
        assert answer.threshold == 1
        if core.nearest is not None:
            assert answer.status == PlaceMatch.MATCH
            assert answer.distance == pytest.approx(core.nearest.distance, abs=1e-4)
            assert answer.sequence_middle == core.nearest.middle
    done, reason = bench.set_parameter('threshold', 1.5)
    assert not done
    assert 'chance' in reason
    assert bench.set_parameter('threshold', 0.8)[0]
    assert bench.ask(image_message(route[30], 30)).threshold == pytest.approx(0.8)
    assert bench.set_parameter('threshold', -1.0)[0]
    assert bench.ask(image_message(route[31], 31)).threshold == 1


def test_a_damaged_map_is_said_and_a_good_one_starts_the_node(bench, run, map_file, route, tmp_path):
    bad = tmp_path / 'bad.stavpr'
    bad.write_bytes(b'no map')
    process = run(bad, THRESHOLD, wait=False)
    bench.until_diagnosed('map', DiagnosticStatus.ERROR, 'bad.stavpr')
    bench.until_state('unconfigured')
    assert 'cannot configure' in process.output()
    assert bench.set_parameter('map_path', map_file) == (True, '')
    bench.wait_for_node()
    for i in range(LENGTH):
        answer = bench.ask(image_message(route[i], 3 + i))
    assert (answer.status, answer.newest_index) == (PlaceMatch.MATCH, LENGTH - 1)


@pytest.mark.parametrize(
    ('parameters', 'word'),
    [
        ({'beta': 0.5}, 'beta'),
        ({'strategy': 'teleport'}, 'teleport'),
        ({'sequence_length': 1}, 'sequence_length'),
        ({'threshold': 'low'}, 'threshold'),
        ({'backend': 'tpu'}, 'tpu'),
    ],
)
def test_parameters_that_do_not_do_end_the_node(tmp_path, parameters, word):
    process = start(tmp_path / 'node.log', **parameters)
    assert process.wait() == 1
    assert 'cannot start' in process.output()
    assert word in process.output()
    assert 'Traceback' not in process.output()


def test_a_second_interrupt_does_not_spoil_the_end(bench, node, route):
    """As `ros2 launch` does it: Ctrl-C reaches the whole group, and launch sends one more."""
    for i in range(3):
        bench.publisher.publish(image_message(route[i], i))
    node.popen.send_signal(signal.SIGINT)
    node.popen.send_signal(signal.SIGINT)
    assert node.wait() == 0
    assert 'Traceback' not in node.output()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_images_stream(bench, node, route, number):
    """The end comes in the middle of an image, and is clean all the same."""
    images = [image_message(route[i % 60], 7000 + i) for i in range(300)]
    for i, message in enumerate(images):
        bench.publisher.publish(message)
        bench.executor.spin_once(timeout_sec=0.002)
        if i == 100:
            node.popen.send_signal(number)
    assert node.wait() == 0
    assert 'Traceback' not in node.output()
    assert 'Exception' not in node.output()
    assert 'images received' in node.output()
