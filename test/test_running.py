# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node as users run it: renamed, with parameters changed under load, and ended at any time."""

import os
import shutil
import signal

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from image_messages import image_message
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
from processes import Bench, node_process, Process, RELIABLE, TAKEN_RELIABLY
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_msgs.srv import LoadMap
from stavpr_ros.mapping import save_map

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture(scope='module')
def bench():
    bench = Bench(RELIABLE)
    yield bench
    bench.close()


@pytest.fixture
def run(bench, tmp_path):
    """Start a node; it is ended with the test."""
    started = []

    def run(**parameters):
        values = {
            'sequence_length': 5,
            'nms_radius': 5,
            'keyframe_change': 0.0,
            'diagnostics_period': 0.1,
        }
        started.append(node_process(tmp_path / 'node.log', **values | TAKEN_RELIABLY | parameters))
        return started[0]

    yield run
    started[0].end()
    bench.wait_for_nobody()


def ends_well(process, number):
    """Send a signal; the process must end, and without errors."""
    assert process.stop(number) == 0
    output = process.output()
    assert 'images received' in output
    for word in ('Traceback', 'Exception', 'exception', 'ERROR', 'terminate'):
        assert word not in output, output
    return True


@pytest.mark.parametrize(
    ('labels', 'number'),
    [
        ([], signal.SIGTERM),
        (['configure'], signal.SIGINT),
        (['configure', 'activate'], signal.SIGTERM),
        (['shutdown'], signal.SIGINT),
        (['configure', 'shutdown'], signal.SIGTERM),
        (['configure', 'activate', 'shutdown'], signal.SIGINT),
    ],
)
def test_node_after_a_signal_in_any_state_ends(bench, run, map_file, labels, number):
    process = run(autostart=False, map_path=map_file)
    states = {'configure': 'inactive', 'activate': 'active', 'shutdown': 'finalized'}
    for label in labels:
        assert bench.transition(label)
        assert bench.state() == states[label]
    if not labels:
        assert bench.state() == 'unconfigured'
    if labels[-1:] == ['shutdown']:
        bench.wait_for_nobody()
        bench.until_diagnosed(
            'processing', DiagnosticStatus.OK, 'finalized: no image is processed'
        )
        answer = bench.call(LoadMap, 'load_map', path=map_file)
        assert not answer.success
        assert 'the node is finalized' in answer.message
        assert process.popen.poll() is None
    assert ends_well(process, number)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_node_after_a_signal_during_an_image_ends(bench, run, map_file, route, number):
    process = run(map_path=map_file, queue_size=1000)
    bench.wait_for_node()
    before, images = len(bench.answers), 400
    for i in range(images):
        bench.publisher.publish(image_message(route[i % 60], 7000 + i))
    bench.until(lambda: len(bench.answers) > before + 2, 'some answers')
    assert ends_well(process, number)
    assert len(bench.answers) < before + images  # the signal came before the last image


def test_node_after_a_signal_during_compilation_ends(bench, run, map_file, tmp_path, monkeypatch):
    """Compilation takes ten seconds and cannot be interrupted; the node does not wait for it."""
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'cache'))
    process = run(autostart=False, map_path=map_file)
    configure, futures = Transition(label='configure'), []

    def begun():
        return 'backend cpu' in process.output()

    with bench.request(futures, ChangeState, 'change_state', begun, transition=configure):
        assert not any(future.done() for future in futures)
        assert ends_well(process, signal.SIGINT)
    assert 'compil' in process.output()  # the thread was abandoned


@pytest.mark.parametrize('how', ['load_map', 'load_map again', 'configure'])
def test_node_after_a_signal_while_a_map_is_read_ends(bench, run, map_file, tmp_path, how):
    """The file is a pipe without a writer: reading it does not end."""
    pipe = tmp_path / 'pipe.stavpr'
    os.mkfifo(pipe)
    if how == 'load_map again':  # the map in use, whose file has changed
        pipe.unlink()
        shutil.copy(map_file, pipe)
    process = run(map_path=map_file if how == 'load_map' else pipe)
    if how != 'configure':
        bench.wait_for_node()
        pipe.unlink()
        os.mkfifo(pipe)
        futures = []

        def loading():
            return f'loading {pipe}' in bench.diagnostics['map'].message

        with bench.request(futures, LoadMap, 'load_map', loading, path=str(pipe)):
            assert not any(future.done() for future in futures)
        answer = bench.ask(image_message(np.zeros((96, 128, 3), np.uint8), 1))  # meanwhile
        assert answer.status == PlaceMatch.WARMING_UP
    else:
        bench.until_diagnosed('processing', DiagnosticStatus.OK, 'configuring')
        bench.until_diagnosed('map', DiagnosticStatus.OK, f'loading {pipe}')
        assert bench.state() == 'configuring'  # during the transition
        assert not bench.transition('cleanup')
        assert 'another is under way' in process.output()
    assert ends_well(process, signal.SIGINT)


def test_node_with_changing_parameters_publishes_one_match_per_image(
    bench, run, small_map, map_file, route, tmp_path
):
    other = str(tmp_path / 'other.stavpr')
    save_map(small_map, other)
    run(map_path=map_file)
    bench.wait_for_node()
    before, images, futures = len(bench.answers), 150, []
    changes = [
        ('threshold', (0.1, 0.3)),
        ('max_rate', (10.0, 0.0)),
        ('verbosity', ('warn', 'info')),
        ('map_path', (other, map_file)),
    ]

    def stream():
        i = len(futures)
        if i < images:
            bench.publisher.publish(image_message(route[i % 60], 10**9 + i * 10**9 // 30))
            name, values = changes[i % 4]
            value = Parameter(name, value=values[i // 4 % 2]).to_parameter_msg()
            futures.append(client.call_async(SetParameters.Request(parameters=[value])))

    def done():
        return len(futures) == images and all(future.done() for future in futures)

    first = []
    with bench.request(
        first, SetParameters, 'set_parameters', lambda: any(f.done() for f in first)
    ) as client:
        clock = bench.node.create_timer(1 / 30, stream)
        bench.until(done, 'all changes')
        bench.until(lambda: len(bench.answers) >= before + images, 'all answers')
        bench.node.destroy_timer(clock)
    assert all(result.successful for future in futures for result in future.result().results)
    assert bench.set_parameter('max_rate', 0.0)[0]
    last = bench.ask(image_message(route[0], 100 * 10**9))  # the last of all
    assert last is bench.answers[-1]
    stamps = [
        answer.header.stamp.sec * 10**9 + answer.header.stamp.nanosec for answer in bench.answers
    ]
    assert sorted(stamps[before:-1]) == [10**9 + i * 10**9 // 30 for i in range(images)]
    assert {PlaceMatch.WARMING_UP, PlaceMatch.SKIPPED} <= {
        a.status for a in bench.answers[before:]
    }


@pytest.mark.parametrize('verbosity', ['default', 'info'])
def test_node_with_a_log_level_option_keeps_it_unless_a_parameter_is_set(
    bench, verbosity, tmp_path
):
    process = Process(
        tmp_path / 'quiet.log',
        'node',
        '--ros-args',
        '--log-level',
        'error',
        '-p',
        f'verbosity:={verbosity}',
    )
    try:
        bench.wait_for_node()
        assert process.stop() == 0
        bench.wait_for_nobody()
        assert ('[INFO]' in process.output()) == (verbosity == 'info')
    finally:
        process.end()


def test_node_with_another_name_and_namespace_uses_them_everywhere(
    bench, map_file, route, tmp_path
):
    """
    In topics, services and diagnostics; a misspelled parameter is logged with the right name.
    """
    arguments = ('-r', '__ns:=/robot', '-r', '__node:=places', '-r', 'image:=front/camera')
    values = (
        '-p',
        f'map_path:={map_file}',
        '-p',
        'sequence_lenght:=5',
        '-p',
        'diagnostics_period:=0.1',
    )
    matches, infos = (
        bench.listen(PlaceMatch, '/robot/places/match'),
        bench.listen(MapInfo, '/robot/places/map_info', LATCHED),
    )
    reports = bench.listen(DiagnosticArray, '/diagnostics')
    publisher = bench.node.create_publisher(Image, '/robot/front/camera', RELIABLE)
    process = Process(tmp_path / 'robot.log', 'node', '--ros-args', *arguments, *values)
    try:
        bench.until(lambda: publisher.get_subscription_count() > 0, 'the subscription')

        def answered():
            publisher.publish(image_message(route[0], 1 + len(matches)))
            return bool(matches)

        bench.until(answered, 'an answer')
        bench.until(lambda: infos and infos[-1].places == 60, 'the map')

        def names():
            return {status.name for report in reports for status in report.status}

        parts = ('input', 'map', 'recognition', 'processing')
        bench.until(
            lambda: names() >= {f'robot/places: {part}' for part in parts}, 'the diagnostics'
        )

        def topics():
            return {
                value.value
                for report in reports
                for status in report.status
                for value in status.values
                if (status.name, value.key) == ('robot/places: input', 'topic')
            }

        bench.until(lambda: '/robot/front/camera' in topics(), 'the topic in the diagnostics')
        services = dict(bench.node.get_service_names_and_types())
        assert {f'/robot/places/{name}' for name in ('load_map', 'reset', 'change_state')} <= set(
            services
        )
        warning = "parameter 'sequence_lenght' is not one of this node: was sequence_length meant?"
        assert warning in process.output()
        assert ends_well(process, signal.SIGINT)
    finally:
        process.end()
        bench.node.destroy_publisher(publisher)
