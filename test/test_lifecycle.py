# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The life cycle of the node from outside: states, transitions, and requests at any time."""

import dataclasses
import os
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from image_messages import image_message
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState
from processes import Bench, DOMAIN, node_process, Process, RELIABLE, TAKEN_RELIABLY
import pytest
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_msgs.srv import LoadMap, Relocalize, SaveMap, SetOperation
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping import PlaceMap, save_map
from std_srvs.srv import Trigger

LENGTH = 5
PARAMETERS = {
    'sequence_length': LENGTH,
    'xi': 0,
    'threshold': 0.2,
    'max_rate': 0.0,
    'verbosity': 'info',
}
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BACK = {'unconfigured': (), 'inactive': ('cleanup',), 'active': ('deactivate', 'cleanup')}
MEGABYTE = 1 << 20


@pytest.fixture(scope='module')
def bench():
    bench = Bench(RELIABLE)
    yield bench
    bench.close()


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('lifecycle')


def part_of(whole: PlaceMap, places: slice) -> PlaceMap:
    return PlaceMap(
        whole.features[places],
        whole.projection,
        whole.stamps[places],
        whole.ids[places],
        whole.poses[places],
    )


@pytest.fixture(scope='module')
def map_file(small_map, folder):
    save_map(small_map, folder / 'route.stavpr')
    return str(folder / 'route.stavpr')


@pytest.fixture(scope='module')
def late_map_file(small_map, folder):
    """The second half of the route: its place 0 is place 30 of the whole."""
    save_map(part_of(small_map, slice(30, 60)), folder / 'late.stavpr')
    return str(folder / 'late.stavpr')


@pytest.fixture(scope='module')
def managed(bench, folder):
    """One node for the module; the tests manage its life cycle."""
    process = node_process(
        folder / 'node.log',
        **PARAMETERS | TAKEN_RELIABLY,
        autostart=False,
        mode='paper',
        nms_radius=5,
        keyframe_change=0.0,
        diagnostics_period=0.1,
    )
    yield process
    process.end()


@pytest.fixture
def node(bench, managed):
    """The node, unconfigured, with its initial parameters."""
    for label in BACK[bench.state()]:
        assert bench.transition(label)
    values = [
        Parameter(n, value=v).to_parameter_msg()
        for n, v in (PARAMETERS | {'map_path': ''}).items()
    ]
    results = bench.call(SetParameters, 'set_parameters', parameters=values).results
    assert all(result.successful for result in results)
    bench.wait_for_nobody()
    return managed


@pytest.fixture
def receive(bench):
    """Return ``receive(type, topic, qos)``: a list that fills until the test ends."""
    subscriptions = []

    def receive(kind, topic, qos=50):
        messages = []
        subscriptions.append(bench.node.create_subscription(kind, topic, messages.append, qos))
        return messages

    yield receive
    for subscription in subscriptions:
        bench.node.destroy_subscription(subscription)


def configure(bench, path, *, activate=False):
    assert bench.set_parameter('map_path', path) == (True, '')
    assert bench.transition('configure')
    if activate:
        assert bench.transition('activate')
        bench.wait_for_node()


def statuses(bench, images, stamp=1):
    return [bench.ask(image_message(image, stamp + i)).status for i, image in enumerate(images)]


def rejections(bench):
    """Return the message of each service; all must fail."""
    requests = {
        'reset': (Trigger, {}),
        'load_map': (LoadMap, {'path': 'any.stavpr'}),
        'save_map': (SaveMap, {'path': 'any.stavpr'}),
        'relocalize': (Relocalize, {}),
        'set_operation': (SetOperation, {'operation': 'mapping'}),
    }
    answers = [bench.call(kind, name, **fields) for name, (kind, fields) in requests.items()]
    assert not any(answer.success for answer in answers)
    return [answer.message for answer in answers]


def test_node_through_all_states_behaves_as_each_state(bench, node, receive, map_file, route):
    infos, warming = (
        receive(MapInfo, '/stavpr/map_info', LATCHED),
        [PlaceMatch.WARMING_UP] * (LENGTH - 1),
    )
    assert bench.state() == 'unconfigured'
    assert all('is unconfigured: configure it first' in message for message in rejections(bench))
    assert bench.until_diagnosed(
        'processing', DiagnosticStatus.OK, 'unconfigured: no image is processed'
    )

    configure(bench, map_file)
    assert bench.state() == 'inactive'
    bench.until(lambda: infos and infos[-1].state == 'loaded', 'the map')
    assert (infos[-1].places, infos[-1].path) == (60, map_file)
    assert bench.publisher.get_subscription_count() == 0
    assert 'in the window' in bench.call(Relocalize, 'relocalize').message
    bench.until_diagnosed('processing', DiagnosticStatus.OK, 'inactive: no image is processed')

    for first in (10, 20):  # both times with an empty window
        assert bench.transition('activate')
        assert bench.state() == 'active'
        bench.wait_for_node()
        assert statuses(bench, route[first : first + LENGTH - 1], first) == warming
        answer = bench.ask(image_message(route[first + LENGTH - 1], 99))
        assert (answer.status, answer.newest_index) == (PlaceMatch.MATCH, first + LENGTH - 1)
        bench.until_diagnosed('processing', DiagnosticStatus.OK, 'ms an image')

        assert bench.transition('deactivate')
        assert bench.state() == 'inactive'
        bench.wait_for_nobody()
        before = len(bench.answers)
        bench.publisher.publish(image_message(route[0], 50))
        assert bench.call(Relocalize, 'relocalize').success  # the window is kept
        assert len(bench.answers) == before

    assert bench.transition('cleanup')
    assert bench.state() == 'unconfigured'
    bench.until(lambda: infos[-1].state == 'none', 'the state without a map')
    assert infos[-1].places == 0
    assert all('is unconfigured' in message for message in rejections(bench))


def test_node_in_transitions_publishes_events(bench, node, receive, map_file):
    messages = receive(TransitionEvent, '/stavpr/transition_event')

    def events():
        return [(event.start_state.label, event.goal_state.label) for event in messages]

    def received():  # a discovered topic is not necessarily matched
        bench.transition('configure')
        bench.transition('cleanup')
        return bool(messages)

    bench.until(received, 'the first event')
    bench.until(lambda: events()[-1] == ('cleaningup', 'unconfigured'), 'the last event')
    messages.clear()
    configure(bench, map_file)
    for label in ('activate', 'deactivate', 'cleanup'):
        assert bench.transition(label)
    assert bench.set_parameter('map_path', '/nowhere/route.stavpr')[0]
    assert not bench.transition('configure')
    bench.until(lambda: len(messages) == 11, 'eleven events')
    assert events() == [
        ('unconfigured', 'configuring'),
        ('configuring', 'inactive'),
        ('inactive', 'activating'),
        ('activating', 'active'),
        ('active', 'deactivating'),
        ('deactivating', 'inactive'),
        ('inactive', 'cleaningup'),
        ('cleaningup', 'unconfigured'),
        ('unconfigured', 'configuring'),
        ('configuring', 'errorprocessing'),
        ('errorprocessing', 'unconfigured'),
    ]


def test_node_at_invalid_transitions_rejects_them(bench, node, map_file):
    steps = (None, 'configure', 'activate')
    invalid = (
        ('activate', 'deactivate', 'cleanup', 'teleport'),
        ('configure', 'deactivate', 'teleport'),
        ('configure', 'activate', 'cleanup', 'teleport'),
    )
    assert bench.set_parameter('map_path', map_file)[0]
    for step, labels, state in zip(steps, invalid, BACK, strict=True):
        assert step is None or bench.transition(step)
        for label in labels:
            assert not bench.transition(label), (state, label)
            assert bench.state() == state
        for number in (0, 77, Transition.TRANSITION_ON_CONFIGURE_SUCCESS):
            assert not bench.call(
                ChangeState, 'change_state', transition=Transition(id=number)
            ).success
        assert bench.state() == state
        assert f'from state {state}' in node.output()
    assert bench.call(
        ChangeState, 'change_state', transition=Transition(id=Transition.TRANSITION_DEACTIVATE)
    ).success
    assert 'Traceback' not in node.output()


def test_node_with_fixed_parameters_takes_them_when_unconfigured(
    bench, node, map_file, late_map_file, route
):
    configure(bench, map_file)
    done, reason = bench.set_parameter('sequence_length', 3)
    assert not done
    assert (
        'sequence_length can be set only while the node is unconfigured, it is inactive' in reason
    )
    assert bench.transition('activate')
    done, reason = bench.set_parameter('sequence_length', 3)
    assert not done
    assert 'it is active' in reason
    assert bench.transition('deactivate')
    assert bench.transition('cleanup')
    assert bench.set_parameter('sequence_length', 3) == (True, '')
    configure(bench, late_map_file, activate=True)
    assert statuses(bench, route[40:42]) == [PlaceMatch.WARMING_UP] * 2
    answer = bench.ask(image_message(route[42], 9))
    assert (answer.status, answer.newest_index) == (PlaceMatch.MATCH, 12)


def with_missing_model(whole: PlaceMap) -> PlaceMap:
    """Return a map whose network has no file."""
    network = settings_class('torchscript')(model='/nowhere/network.pt')
    settings = dataclasses.replace(whole.settings, kind='torchscript', backbone=network)
    return dataclasses.replace(
        whole, features=dataclasses.replace(whole.features, settings=settings)
    )


@pytest.mark.parametrize('fault', ['damaged', 'missing', 'model', 'xi'])
def test_node_after_a_failed_configuration_can_be_configured(
    bench, node, map_file, small_map, route, tmp_path, fault
):
    path = tmp_path / f'{fault}.stavpr'
    words = {
        'damaged': 'damaged or truncated',
        'missing': 'does not exist',
        'model': "'/nowhere/network.pt' cannot be read",
        'xi': 'xi = 8',
    }[fault]
    if fault == 'damaged':
        path.write_bytes(Path(map_file).read_bytes()[:5000])
    elif fault == 'model':
        save_map(with_missing_model(small_map), path)
    elif fault == 'xi':
        assert bench.set_parameter('xi', 8) == (True, '')  # W, 7, is known with the map only
        path = map_file
    assert bench.set_parameter('map_path', str(path)) == (True, '')
    log = len(node.output())
    assert not bench.transition('configure')
    assert bench.state() == 'unconfigured'
    assert 'cannot configure' in node.output()[log:]
    assert words in node.output()[log:]
    assert (
        'cannot configure' in bench.until_diagnosed('map', DiagnosticStatus.ERROR, words).message
    )
    assert all('cannot configure' in message and words in message for message in rejections(bench))
    assert not bench.transition('activate')
    assert bench.set_parameter('xi', 0)[0]
    configure(bench, map_file, activate=True)
    assert statuses(bench, route[:LENGTH])[-1] == PlaceMatch.MATCH
    bench.until_diagnosed('map', DiagnosticStatus.OK, '60 places of')
    assert 'Traceback' not in node.output()


def resident(process: Process) -> int:
    """Return the resident memory of a process [bytes]."""
    pages = Path(f'/proc/{process.popen.pid}/statm').read_text().split()[1]
    return int(pages) * os.sysconf('SC_PAGE_SIZE')


def test_node_without_its_map_frees_the_memory(bench, node, map_file, small_map, folder):
    """A map of 80 MB is freed by cleanup, after an error, and by another map."""
    features = small_map.features
    strips, weights = (x.repeat_interleave(800, 1) for x in (features.strips, features.weights))
    n = strips.shape[1]
    big = PlaceMap(
        dataclasses.replace(features, strips=strips, weights=weights),
        small_map.projection,
        small_map.stamps.repeat(800),
        ('',) * n,
    )
    save_map(big, folder / 'big.stavpr')
    for _ in range(2):
        configure(bench, str(folder / 'big.stavpr'))
        full = resident(node)
        assert bench.transition('cleanup')
        assert full - resident(node) > 70 * MEGABYTE
    empty = resident(node)
    assert bench.set_parameter('xi', 8)[0]
    assert not bench.transition('configure')  # after the map was read
    assert resident(node) - empty < 35 * MEGABYTE
    assert bench.set_parameter('xi', 0)[0]
    assert bench.transition('configure')
    full = resident(node)
    assert bench.call(LoadMap, 'load_map', path=map_file).success
    assert full - resident(node) > 70 * MEGABYTE


def test_node_with_a_late_subscriber_publishes_map_and_diagnostics(bench, node, map_file):
    configure(bench, map_file)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    late = rclpy.create_node('late', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(late)
    infos, reports = [], []
    late.create_subscription(MapInfo, '/stavpr/map_info', infos.append, LATCHED)
    late.create_subscription(DiagnosticArray, '/diagnostics', reports.append, 10)

    def received():
        executor.spin_once(timeout_sec=0.05)
        return infos and len(reports) >= 3

    bench.until(received, 'the latched map')
    assert [(info.state, info.places) for info in infos] == [('loaded', 60)]
    executor.shutdown()
    late.destroy_node()
    rclpy.shutdown(context=context)


def test_node_with_another_publisher_keeps_the_window(bench, node, map_file, route):
    configure(bench, map_file, activate=True)
    statuses(bench, route[:3])
    bench.node.destroy_publisher(bench.publisher)
    bench.until_diagnosed('input', DiagnosticStatus.WARN, 'no publisher')
    bench.publish_anew()
    bench.wait_for_node()
    assert statuses(bench, route[3:5], 4) == [PlaceMatch.WARMING_UP, PlaceMatch.MATCH]
    bench.until_diagnosed('recognition', DiagnosticStatus.OK, '1 of 1 image matched')
