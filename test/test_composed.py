# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node in a process of another program: its executor, its context, its end, its journal."""

import os
import random
import resource
import threading
import time

import cv2
from nav_msgs.msg import Odometry
import numba
import numpy as np
from processes import node_process, SECOND, TIMEOUT
import pytest
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from robot import image_message, PARAMETERS
from sensor_msgs.msg import Image
from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.errors import OutputError
from stavpr_ros.mapping import load_map
from stavpr_ros.mapping.journal_map import journals, recover
from stavpr_ros.pipeline import saving
from stavpr_ros.threads import limit_threads

SUCCESS = TransitionCallbackReturn.SUCCESS


def set_parameter(node, name, value):
    return node.set_parameters([Parameter(name, value=value)])[0]


def activate(node):
    assert node.trigger_configure() == node.trigger_activate() == SUCCESS
    return node


def enqueue(node, images):
    for i, image in enumerate(images, 1):
        node.runtime.intake.images.on_image(image_message(image, i * SECOND))


def until_processed(node, count):
    """Wait until so many images have a result or were dropped."""
    end = time.monotonic() + TIMEOUT
    while time.monotonic() < end:
        counts = node.statistics.counts()
        if counts.answered.count + counts.dropped.count == count:
            return counts
        node.runtime.worker.run(lambda: None)
    raise AssertionError(counts)


@pytest.mark.parametrize(
    ('act', 'cause'),
    [
        (lambda node: node.runtime.reset(), 'window reset'),
        (lambda node: node.trigger_deactivate(), 'deactivated'),
    ],
    ids=['reset', 'deactivate'],
)
def test_waiting_images_are_dropped(make_node, map_file, route, act, cause):
    """Images that came before a reset or the deactivation do not fill the window after it."""
    node = activate(make_node(map_path=map_file, queue_size=10))
    worker, free = node.runtime.worker, threading.Event()

    def run(function):
        future = worker.call(function)
        free.set()  # until then, images wait
        return future.result(TIMEOUT)

    worker.call(free.wait)
    enqueue(node, route[:3])
    worker.run = run
    act(node)
    assert until_processed(node, 3).dropped.total == {cause: 3}
    assert node.runtime.pipeline.operation.window_fill == 0


def test_images_swapped_in_time_are_a_warning_and_one_jump_is_none(
    make_node, map_file, route, capfd
):
    node = activate(make_node(map_path=map_file))
    for tenths in (60, 61, 1, 2, 3):  # a clock is set
        node.runtime.intake.images.on_image(image_message(route[0], tenths * SECOND // 10))
    assert 'in a row' not in capfd.readouterr().err
    for i in range(10):
        for tenths in (2 * i + 5, 2 * i + 4):
            node.runtime.intake.images.on_image(image_message(route[i], tenths * SECOND // 10))
    text = capfd.readouterr().err
    assert 'reset 3 times in a row' in text
    assert 'jumped back by 0.100 s): publish the images in the order of their stamps' in text


def test_image_that_fails_by_a_defect_is_counted_and_the_next_is_processed(make_node, route):
    node = activate(make_node(operation='mapping'))
    extractor = node.runtime.pipeline.operation.extractor
    extractor.extract = lambda images: 1 / 0
    enqueue(node, route[:1])
    assert until_processed(node, 1).dropped.total == {'internal error': 1}
    del extractor.extract
    enqueue(node, route[:2])
    counts = until_processed(node, 3)
    assert (counts.received.count, counts.answered.total) == (3, {'mapped': 2})
    assert (counts.status, counts.place) == ('mapped', 1)
    stages = ['waiting', 'decoding', 'extraction', 'matching', 'publishing']
    assert list(counts.times) == ['total', 'work', *stages]
    assert min(longest for _, longest in counts.times.values()) > 0


def test_shutdown_of_ros_before_the_node_saves_the_map(make_node, context, route, tmp_path):
    """As with plain `rclpy.spin` and an interrupt; no thread is left."""
    path, before = tmp_path / 'route.stavpr', set(threading.enumerate())
    node = activate(make_node(operation='mapping', save_path=str(path), queue_size=100))
    enqueue(node, route[:20])
    while not len(node.runtime.pipeline.places):
        node.runtime.worker.run(lambda: None)
    rclpy.shutdown(context=context)
    node.destroy_node()
    assert 0 < len(load_map(path)) <= 20
    left = set(threading.enumerate()) - before
    assert not [thread for thread in left if thread.name == 'recognition']


def test_operation_of_the_service_lasts_until_the_next_configuration(make_node, map_file):
    node = make_node(map_path=map_file)
    assert node.trigger_configure() == SUCCESS
    node.set_operation('mapping')
    assert set_parameter(node, 'candidates', 3).successful
    assert node.settings.operation == node.runtime.pipeline.operation.name == 'mapping'
    assert node.trigger_cleanup() == node.trigger_configure() == SUCCESS
    assert node.settings.operation == node.runtime.pipeline.operation.name == 'localization'


def test_failed_odometry_subscription_is_the_problem(make_node, map_file):
    """Live parameters are applied; the error is logged and in the diagnostics."""
    topic = {'qos_overrides./odom.subscription.reliability': 'certain'}
    node = activate(
        make_node(map_path=map_file, relative_pose='none', odometry_error=0.0, **topic)
    )
    assert set_parameter(node, 'keyframe_distance', 1.0).successful
    assert 'correct qos_overrides./odom.subscription' in node.runtime.intake.problem
    assert node.runtime.pipeline.settings.keyframes.distance == 1


def test_odometry_is_subscribed_while_it_is_needed(make_node, map_file):
    node = activate(make_node(map_path=map_file, relative_pose='none', odometry_error=0.0))
    assert node.count_subscribers('/odom') == 0
    for distance, count in ((1.0, 1), (2.0, 1), (0.0, 0)):
        assert set_parameter(node, 'keyframe_distance', distance).successful
        assert node.count_subscribers('/odom') == count
    node.set_operation('mapping')
    assert node.count_subscribers('/odom') == 1
    assert node.trigger_deactivate() == node.trigger_cleanup() == SUCCESS
    other = activate(make_node(relative_pose='aligned'))
    assert other.count_subscribers('/odom') == 0
    other.load_map(map_file)  # with poses: for edges
    assert other.count_subscribers('/odom') == 1


def test_place_has_the_pose_at_the_stamp_of_its_image_until_a_restart(make_node, route):
    node = activate(make_node(operation='mapping', keyframe_distance=0.1))
    trajectory = node.runtime.intake.odometry.trajectory
    for seconds in (1, 2):
        trajectory.add(seconds * SECOND, np.array([10 * seconds, 0, 0, 0, 0, 0, 1.0]))
    node.runtime.intake.images.on_image(image_message(route[0], SECOND * 5 // 4))
    until_processed(node, 1)
    assert node.runtime.pipeline.places.poses[0][0] == 12.5
    node.runtime.restart('the stamps jumped back')
    assert len(trajectory) == 0


def test_save_path_that_cannot_be_written_is_rejected(make_node, tmp_path):
    path = str(tmp_path / 'missing' / 'route.stavpr')
    node = make_node(operation='mapping', save_path=path, maps_folder=str(tmp_path))
    assert node.trigger_configure() != SUCCESS
    assert (node.state, 'save_path' in node.problem) == ('unconfigured', True)
    assert not set_parameter(node, 'save_path', str(tmp_path)).successful
    assert set_parameter(node, 'save_path', str(tmp_path / 'x')).successful
    assert node.trigger_configure() == SUCCESS


def test_limit_of_threads_can_be_removed(make_node):
    """A limit of OpenCV is for the process, one of numba for the worker."""
    limit_threads(0)
    before = numba.get_num_threads(), cv2.getNumThreads()
    node = make_node(threads=1)
    for threads, expected in ((1, (1, 1)), (0, before)):
        assert set_parameter(node, 'threads', threads).successful
        assert node.trigger_configure() == SUCCESS
        counts = node.runtime.worker.run(lambda: (numba.get_num_threads(), cv2.getNumThreads()))
        assert counts == expected
        assert node.trigger_cleanup() == SUCCESS


@pytest.fixture
def make(make_node, tmp_path):
    """Make and activate a node that records into the maps folder."""

    def make(**parameters):
        values = {'operation': 'mapping', 'maps_folder': str(tmp_path)}
        node = make_node(**values | parameters)
        assert node.trigger_configure() == node.trigger_activate() == SUCCESS
        return node

    return make


def record(node, images, first=0):
    """Show images to a node, and wait until they are processed."""
    for i, image in enumerate(images, first + 1):
        node.runtime.intake.images.on_image(image_message(image, i * SECOND))
        node.runtime.worker.run(lambda: None)
    while node.runtime.worker.waiting:
        node.runtime.worker.run(lambda: None)
    node.runtime.worker.run(lambda: None)


def end(node):
    node.destroy_node()
    return node.failed


def test_node_states_at_the_end_what_it_left_out(make, route, capfd):
    node = make()
    node.runtime.intake.odometry._on_odometry(Odometry())
    node.runtime.intake.images.on_image(Image(encoding='rgb8'))
    record(node, route[:1])
    assert not end(node)
    expected = (
        'images with a size that their encoding cannot have: 1; messages of odometry without'
    )
    assert f'left out: {expected} a valid pose: 1\n' in capfd.readouterr().err


def test_node_without_save_path_continues_its_recording_at_the_next_start(make, route, tmp_path):
    node = make()
    record(node, route[:12])
    assert not end(node)
    assert os.listdir(tmp_path) == ['recorded.stavpr.journal']
    node = make()
    assert node.runtime.map_info().path == str(tmp_path / 'recorded.stavpr')
    assert journals(tmp_path / 'recorded.stavpr') == []
    record(node, route[12:14], first=12)  # as a session of its own
    assert len(node.runtime.pipeline.places) == 14
    assert not end(node)
    node = make(operation='localization')  # recognizes what was recorded
    record(node, route[:12], first=20)
    assert len(node.runtime.pipeline.places) == 14
    assert node.runtime.pipeline.operation.relocalize(0).match.newest == 11


def test_localization_on_another_map_names_the_journal_and_leaves_it(
    make, route, map_file, tmp_path, capfd
):
    node = make()
    record(node, route[:5])
    end(node)
    assert not end(make(operation='localization', map_path=map_file))
    assert os.listdir(tmp_path) == ['recorded.stavpr.journal']
    assert 'recorded.stavpr.journal has places of another recording' in capfd.readouterr().err
    assert len(make(operation='mapping').runtime.pipeline.places) == 5


def test_node_whose_last_save_fails_keeps_the_journal_and_reports_failure(
    make, route, tmp_path, monkeypatch
):
    path = tmp_path / 'route.stavpr'
    node = make(save_path=str(path))
    record(node, route[:5])
    with monkeypatch.context() as disk:

        def fail(*_):
            raise OutputError('the disk is full')

        disk.setattr(saving, 'save_map', fail)
        assert end(node)
    assert os.listdir(tmp_path) == ['route.stavpr.journal']
    make(save_path=str(path))
    assert len(load_map(path)) == 5


@pytest.mark.parametrize('operation', ['mapping', 'loop_closure'])
def test_node_that_ends_without_a_loss_deletes_the_journal(make, route, tmp_path, operation):
    """Its map is saved, or its route is not to be saved."""
    files = ['route.stavpr'] if operation == 'mapping' else []
    node = make(operation=operation, save_path=''.join(str(tmp_path / name) for name in files))
    record(node, route[:5])
    assert [name for name in os.listdir(tmp_path) if name.endswith('.journal')]
    assert not end(node)
    assert os.listdir(tmp_path) == files


def test_node_that_cannot_write_a_journal_records_all_the_same(make, route, tmp_path):
    (tmp_path / 'file').touch()
    node = make(maps_folder=str(tmp_path / 'file'))
    record(node, route[:5])
    assert len(node.runtime.pipeline.places) == 5


# -------------------------------------------------------------------------------------- processes


@pytest.fixture
def recording(robot, tmp_path, request):
    """Start a node process that records to a file; it ends with the test."""

    def start():
        files = {'save_path': tmp_path / 'route.stavpr', 'maps_folder': tmp_path}
        values = PARAMETERS | {'operation': 'mapping', 'queue_size': 1000} | files
        process = node_process(tmp_path / 'log', **values)
        request.addfinalizer(process.end)
        # a killed node stays in the graph for a while: wait for the log of the new one
        robot.until(lambda: 'backend' in process.output(), 'the node')
        robot.wait_for_node()
        return process

    return start


def places_of(robot):
    """Return the stamps of the images that were published as places."""
    recorded = PlaceMatch.MAPPED, PlaceMatch.MATCH
    places = [match for match in robot.answers if match.status in recorded]
    return {match.header.stamp.sec * SECOND for match in places}


@pytest.mark.parametrize('kills', [2, pytest.param(20, marks=pytest.mark.long)])
def test_node_killed_at_a_random_moment_loses_no_published_place(
    recording, robot, route, tmp_path, kills
):
    """
    The next start makes a map of the journal, which the recording continues.

    A node that is killed before its first place leaves no journal: the next one begins a new map,
    which gets a numbered name.
    """
    path, random_ = tmp_path / 'route.stavpr', random.Random(0)
    published, begin = set(), robot.stamp
    for _ in range(kills):
        process, first = recording(), robot.stamp + SECOND
        published |= places_of(robot)  # of the killed node, received late
        robot.forget()
        for image in route[: random_.randrange(1, 20)]:
            robot.stamp += SECOND
            robot.publisher.publish(image_message(image, robot.stamp))
        count = random_.randrange(1, 1 + (robot.stamp - first) // SECOND + 1)
        robot.until(lambda count=count: len(places_of(robot)) >= count, 'some places')
        process.popen.kill()
        process.wait()
        published |= places_of(robot)
    assert sum(recover(journal).recorded for journal in journals(path)) > 0
    stamps = [load_map(file).stamps.tolist() for file in sorted(tmp_path.glob('route*.stavpr'))]
    assert {stamp for stamp in published if stamp > begin} <= set().union(*stamps)
    assert all(times == sorted(set(times)) for times in stamps)
    assert [name for name in os.listdir(tmp_path) if name.startswith('.')] == []


def test_node_on_a_full_disk_ends_with_an_error_and_names_the_journal(
    recording, robot, route, tmp_path
):
    path = tmp_path / 'route.stavpr'
    process = recording()
    robot.drive(route[:10])
    robot.until(lambda: bool(journals(path)), 'the journal')
    resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE, (40_000, resource.RLIM_INFINITY))
    robot.drive(route[10:15])
    assert process.stop() == 1
    output = process.output()
    assert 'the map is not saved: ' in output
    assert f'unsaved places stay in {path}.journal' in output
    assert 10 <= recover(journals(path)[0]).places <= 15
