# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node in a process of another program: its executor, its context, its end."""

import threading
import time

import cv2
import numba
import numpy as np
from processes import SECOND, TIMEOUT
import pytest
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from robot import image_message
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import load_map
from stavpr_ros.threads import limit_threads

SUCCESS = TransitionCallbackReturn.SUCCESS


def set_parameter(node, name, value):
    return node.set_parameters([Parameter(name, value=value)])[0]


def activated(node):
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
def test_waiting_images_are_dropped(make_node, map_file, route, monkeypatch, act, cause):
    """Images that came before a reset or the deactivation do not fill the window after it."""
    node = activated(make_node(map_path=map_file, queue_size=10))
    worker, free = node.runtime.worker, threading.Event()

    def run(function):
        future = worker.call(function)
        free.set()  # until then, images wait
        return future.result(TIMEOUT)

    worker.call(free.wait)
    enqueue(node, route[:3])
    monkeypatch.setattr(worker, 'run', run)
    act(node)
    assert until_processed(node, 3).dropped.total == {cause: 3}
    assert node.runtime.pipeline.operation.window_fill == 0


def test_images_swapped_in_time_are_a_warning_and_one_jump_is_none(
    make_node, map_file, route, monkeypatch
):
    logged = []
    node = activated(make_node(map_path=map_file))
    monkeypatch.setattr(node.get_logger(), 'warning', lambda text, **_: logged.append(text))
    for tenths in (60, 61, 1, 2, 3):  # a clock is set
        node.runtime.intake.images.on_image(image_message(route[0], tenths * SECOND // 10))
    assert not [text for text in logged if 'reset' in text]
    for i in range(10):
        for tenths in (2 * i + 5, 2 * i + 4):
            node.runtime.intake.images.on_image(image_message(route[i], tenths * SECOND // 10))
    text = next(text for text in logged if 'reset' in text)
    assert 'reset 3 times in a row' in text
    assert 'jumped back by 0.100 s): publish the images in the order of their stamps' in text


def test_image_that_fails_by_a_defect_is_counted_and_the_next_is_processed(
    make_node, route, monkeypatch
):
    node = activated(make_node(operation='mapping'))
    with monkeypatch.context() as defect:
        defect.setattr(node.runtime.pipeline.operation.extractor, 'extract', lambda images: 1 / 0)
        enqueue(node, route[:1])
        assert until_processed(node, 1).dropped.total == {'internal error': 1}
    enqueue(node, route[:2])
    counts = until_processed(node, 3)
    assert (counts.received.count, counts.answered.total) == (3, {'mapped': 2})
    assert (counts.status, counts.place) == ('mapped', 1)
    stages = ['waiting', 'decoding', 'extraction', 'matching', 'publishing']
    assert list(counts.times) == ['total', 'work', *stages]
    assert min(longest for _, longest in counts.times.values()) > 0


def test_shutdown_of_ros_before_the_node_saves_the_map(make_node, context, route, tmp_path):
    """As with plain `rclpy.spin` and an interrupt; no thread is left."""
    path = tmp_path / 'route.stavpr'
    node = activated(make_node(operation='mapping', save_path=str(path), queue_size=100))
    enqueue(node, route[:20])
    while not len(node.runtime.pipeline.places):
        node.runtime.worker.run(lambda: None)
    rclpy.shutdown(context=context)
    node.destroy_node()
    assert 0 < len(load_map(path)) <= 20
    assert not [thread for thread in threading.enumerate() if thread.name == 'recognition']


def test_integer_where_a_number_is_expected_is_converted(make_node):
    """As in `threshold: 1` of a parameter file, and in `ros2 param set NODE threshold 1`."""
    node = make_node(mode='paper', threshold=1)
    assert repr(node.settings.pipeline.threshold) == '1.0'
    assert set_parameter(node, 'threshold', 2).successful
    assert repr(node.get_parameter('threshold').value) == '2.0'


@pytest.mark.parametrize(
    ('name', 'value', 'expected'),
    [
        ('threshold', 'high', "threshold = 'high' has the wrong type: expected a number"),
        ('queue_size', 4.5, 'queue_size = 4.5 has the wrong type: expected an integer'),
        ('publish_tf', 1, 'publish_tf = 1 has the wrong type: expected true or false'),
        ('robot_id', 2, 'robot_id = 2 has the wrong type: expected text'),
    ],
)
def test_parameter_of_the_wrong_type_is_rejected_by_name(make_node, name, value, expected):
    with pytest.raises(SettingsError, match=expected):
        make_node(**{name: value})
    result = set_parameter(make_node(), name, value)
    assert (result.successful, expected in result.reason) == (False, True)


def test_parameters_that_are_rejected_change_nothing(make_node, map_file):
    node = make_node(map_path=map_file)
    assert node.trigger_configure() == SUCCESS
    before = node.settings
    for name, value, words in (
        ('map_path', 'other.stavpr', 'call the service ~/load_map'),
        ('operation', 'mapping', 'call the service ~/set_operation'),
        ('nms_radius', 7, 'while the node is unconfigured'),
        ('threshold', 0.8, 'is of mode paper'),
        ('min_probability', 1.0, 'below 1'),
        ('save_path', '/missing/route.stavpr', 'save_path'),
        ('geometric_check', 'eye', 'take one of none'),
    ):
        result = set_parameter(node, name, value)
        assert (result.successful, words in result.reason) == (False, True)
        assert node.get_parameter(name).value != value
        assert node.settings is before
    assert set_parameter(node, 'map_path', map_file).successful  # the current value
    together = [Parameter('candidates', value=3), Parameter('min_probability', value=1.0)]
    assert not node.set_parameters_atomically(together).successful
    assert node.settings.pipeline.candidates == 10
    assert set_parameter(node, 'candidates', 3).successful
    assert node.runtime.pipeline.settings.candidates == 3


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
    node = activated(
        make_node(map_path=map_file, relative_pose='none', odometry_error=0.0, **topic)
    )
    assert set_parameter(node, 'keyframe_distance', 1.0).successful
    assert 'correct qos_overrides./odom.subscription' in node.runtime.intake.problem
    assert node.runtime.pipeline.settings.keyframes.distance == 1


def test_odometry_is_subscribed_while_it_is_needed(make_node, map_file):
    node = activated(make_node(map_path=map_file, relative_pose='none', odometry_error=0.0))
    assert node.count_subscribers('/odom') == 0
    for distance, count in ((1.0, 1), (2.0, 1), (0.0, 0)):
        assert set_parameter(node, 'keyframe_distance', distance).successful
        assert node.count_subscribers('/odom') == count
    node.set_operation('mapping')
    assert node.count_subscribers('/odom') == 1
    assert node.trigger_deactivate() == node.trigger_cleanup() == SUCCESS
    other = activated(make_node(relative_pose='aligned'))
    assert other.count_subscribers('/odom') == 0
    other.load_map(map_file)  # with poses: for edges
    assert other.count_subscribers('/odom') == 1


def test_restart_removes_the_poses_of_the_odometry(make_node, map_file):
    node = activated(make_node(map_path=map_file, keyframe_distance=1.0))
    trajectory = node.runtime.intake.odometry.trajectory
    trajectory.add(SECOND, np.array([0, 0, 0, 0, 0, 0, 1.0]))
    node.runtime.restart('the stamps jumped back')
    assert len(trajectory) == 0


def test_place_has_the_pose_at_the_stamp_of_its_image(make_node, route):
    node = activated(make_node(operation='mapping', keyframe_distance=0.1))
    for seconds in (1, 2):
        pose = np.array([10 * seconds, 0, 0, 0, 0, 0, 1.0])
        node.runtime.intake.odometry.trajectory.add(seconds * SECOND, pose)
    node.runtime.intake.images.on_image(image_message(route[0], SECOND * 5 // 4))
    until_processed(node, 1)
    assert node.runtime.pipeline.places.poses[0][0] == 12.5


def test_save_path_that_cannot_be_written_is_rejected(make_node, tmp_path):
    path = str(tmp_path / 'missing' / 'route.stavpr')
    node = make_node(operation='mapping', save_path=path, maps_folder=str(tmp_path))
    assert node.trigger_configure() != SUCCESS
    assert (node.state, 'save_path' in node.problem) == ('unconfigured', True)
    assert not set_parameter(node, 'save_path', str(tmp_path)).successful
    assert set_parameter(node, 'save_path', str(tmp_path / 'x')).successful
    assert node.trigger_configure() == SUCCESS


def test_limit_of_threads_can_be_removed(make_node):
    """The limit of OpenCV holds for the process, that of numba for the worker."""
    limit_threads(0)
    before = numba.get_num_threads(), cv2.getNumThreads()
    node = make_node(threads=1)
    for threads, expected in ((1, (1, 1)), (0, before)):
        assert set_parameter(node, 'threads', threads).successful
        assert node.trigger_configure() == SUCCESS
        counts = node.runtime.worker.run(lambda: (numba.get_num_threads(), cv2.getNumThreads()))
        assert counts == expected
        assert node.trigger_cleanup() == SUCCESS


@pytest.mark.parametrize(
    ('name', 'remedy'),
    [('sequence_lenght', 'did you mean sequence_length?'), ('beta', 'see `ros2 param list`')],
)
def test_unknown_parameter_is_logged_and_not_set(make_node, capfd, name, remedy):
    node = make_node(**{name: 5})
    words = f'parameter {name!r} is unknown: {remedy}'
    assert words in capfd.readouterr().err
    assert set_parameter(node, name, 5).reason == words


def test_lost_images_are_logged_once_with_their_remedy(make_node, capfd):
    node = make_node(diagnostics_period=0.1)
    node.statistics.add_drop('lost in transport', 3)
    published = threading.Event()
    publish, reports = node._diagnostics._publisher.publish, []

    def count(message):
        publish(message)
        reports.append(message)
        if len(reports) == 4:
            published.set()

    node._diagnostics._publisher.publish = count
    assert published.wait(TIMEOUT)
    assert capfd.readouterr().err.count('3 images lost in transport in the last 10 s: ') == 1
