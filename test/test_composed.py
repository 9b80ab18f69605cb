"""The node in a process of somebody else's: their executor, their context, their end."""

import threading
import time

import cv2
import pytest
import rclpy
import torch
from image_messages import image_message
from processes import DOMAIN, TIMEOUT
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter

from stavpr_ros.mapping import load_map, save_map
from stavpr_ros.ros.node import PlaceRecognitionNode
from stavpr_ros.threads import limit_threads

SUCCESS = TransitionCallbackReturn.SUCCESS


@pytest.fixture
def context():
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    yield context
    rclpy.try_shutdown(context=context)


@pytest.fixture
def make(context):
    """Make a node; it is destroyed with the test."""
    made = []

    def make(**parameters):
        values = {'autostart': False, 'threads': 1, 'sequence_length': 5, 'nms_radius': 5} | parameters
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        made.append(PlaceRecognitionNode(context=context, parameter_overrides=overrides))
        return made[-1]

    yield make
    for node in made:
        node.destroy_node()


def test_ros_may_be_shut_down_before_the_node_is_destroyed(make, context, route, tmp_path):
    """As with plain `rclpy.spin` and Ctrl-C: what has grown is written, and nothing is left running."""
    path = tmp_path / 'route.stavpr'
    node = make(operation='mapping', save_path=str(path), queue_size=100, keyframe_change=0.0)
    assert node.trigger_configure() == node.trigger_activate() == SUCCESS
    for i, image in enumerate(route[:20]):
        node.configured.images._on_image(image_message(image, i + 1))
    end = time.monotonic() + TIMEOUT
    while not len(node.configured.pipeline.places) and time.monotonic() < end:
        time.sleep(0.001)
    rclpy.shutdown(context=context)
    node.destroy_node()
    assert path.exists()
    assert 0 < len(load_map(path)) <= 20
    assert not [thread for thread in threading.enumerate() if thread.name == 'recognition']


def test_nobody_sees_the_services_of_a_node_that_is_destroyed(make, bench):
    node = make()

    def seen():
        return '/stavpr/get_state' in dict(bench.node.get_service_names_and_types())

    bench.until(seen, 'the node')
    node.destroy_node()
    bench.until(lambda: not seen(), 'the node to be gone')


def test_a_parameter_that_is_set_while_the_start_fails_starts_it_again(make, small_map, tmp_path):
    path = tmp_path / 'route.stavpr'
    save_map(small_map, path)
    node = make(autostart=True, map_path=str(tmp_path / 'missing.stavpr'))
    fail = node.on_configure

    def fails(state):
        result = fail(state)
        assert node.set_parameters([Parameter('map_path', value=str(path))])[0].successful
        return result

    node._callbacks = {key: fails if value == fail else value for key, value in node._callbacks.items()}
    node._on_start()
    assert node.state == 'unconfigured'
    assert not node._start.is_canceled()
    node._callbacks = {key: fail if value == fails else value for key, value in node._callbacks.items()}
    node._on_start()
    assert (node.state, len(node.configured.pipeline.places)) == ('active', 60)


def test_a_file_that_cannot_be_written_is_refused_before_the_drive(make, tmp_path):
    node = make(operation='mapping', save_path=str(tmp_path / 'missing' / 'route.stavpr'))
    assert node.trigger_configure() != SUCCESS
    assert (node.state, 'save_path' in node.problem) == ('unconfigured', True)
    for path, good in ((tmp_path, False), (tmp_path / 'missing' / 'x', False), (tmp_path / 'x', True)):
        result = node.set_parameters([Parameter('save_path', value=str(path))])[0]
        assert (result.successful, 'save_path' in result.reason) == (good, not good)
    assert node.trigger_configure() == SUCCESS


def test_the_limit_of_threads_can_be_taken_away_again(make):
    """OpenCV's is that of the process, torch's that of the worker."""
    limit_threads(0)
    before = torch.get_num_threads(), cv2.getNumThreads()
    node = make(threads=1)
    for threads, expected in ((1, (1, 1)), (0, before), (1, (1, 1)), (0, before)):
        assert node.set_parameters([Parameter('threads', value=threads)])[0].successful
        assert node.trigger_configure() == SUCCESS
        on_worker = node.configured._on_worker
        assert on_worker(lambda: (torch.get_num_threads(), cv2.getNumThreads())) == expected
        assert node.trigger_cleanup() == SUCCESS
