# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edges over ROS: loop closures with camera_info and odometry, and their source and frames."""

import threading
from types import SimpleNamespace

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
import pytest
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo
from stavpr_msgs.msg import LoopClosure, PlaceMatch, RelativePose
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping.camera import FORWARD, mount_of
from stavpr_ros.method.loop_closer import LoopCloser
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.relative_pose.estimator import EdgeEstimator
from stavpr_ros.relative_pose.pair import Edge, Source
from stavpr_ros.ros import edges
from stavpr_ros.ros.edges import EdgePublisher, MAX_WAITING, WaitingClosure
from stavpr_ros.ros.messages import camera_of

LAST = MAX_WAITING + 3  # of so many closures that three are dropped
MOUNT = '0.1 0 1.2 -1.5708 0 -1.5708'


def info(size=(640, 480), focal=300.0, **fields):
    """Return a message about a camera without distortion."""
    width, height = size
    k = [focal, 0.0, width / 2 - 0.5, 0.0, focal, height / 2 - 0.5, 0.0, 0.0, 1.0]
    return CameraInfo(width=width, height=height, k=k, **fields)


def test_mount_of_text_is_a_pose():
    result = np.array(mount_of(MOUNT))
    np.testing.assert_allclose(result[:3], (0.1, 0, 1.2))
    assert abs(result[3:] @ FORWARD[3:]) == pytest.approx(1)
    assert mount_of('1, 2, 3, 0, 0, 0, 1') == (1, 2, 3, 0, 0, 0, 1)
    assert mount_of(' ') is None
    for text in ('1 2 3', 'a b c d e f', '0 0 0 0 0 0 0', '0 0 nan 0 0 0'):
        with pytest.raises(SettingsError, match='x y z roll pitch yaw'):
            mount_of(text)


def test_camera_of_binned_and_cut_out_images():
    message = info(binning_x=2, binning_y=2)
    message.roi.x_offset, message.roi.y_offset = 100, 40
    message.roi.width, message.roi.height = 400, 300
    camera = camera_of(message, FORWARD)
    assert (camera.width, camera.height, camera.focal) == (200, 150, (150.0, 150.0))
    assert camera.center == ((320 - 100) / 2 - 0.5, (240 - 40) / 2 - 0.5)


@pytest.fixture
def closing(robot, start, route):
    """Return a function that drives two laps, and returns matches and closures on time."""

    def drive(camera_info=None, **parameters):
        closures = robot.listen(LoopClosure, '/stavpr/loop_closure', 1000)
        poses = robot.listen(PoseWithCovarianceStamped, '/stavpr/pose')
        start(
            operation='loop_closure',
            map_path='',
            exclude_places=10,
            keyframe_distance=0.001,
            **parameters,
        )
        robot.until(lambda: robot.odometry.get_subscription_count() > 0, 'odometry')
        if camera_info is not None:
            publisher = robot.node.create_publisher(
                CameraInfo, '/camera_info', QoSProfile(depth=1)
            )
            robot.until(lambda: publisher.get_subscription_count() > 0, 'camera_info')
            publisher.publish(camera_info)
        matches = [robot.show_at(i % 30, image) for i, image in enumerate((route[:30] * 2)[:45])]
        count = sum(match.status == PlaceMatch.MATCH for match in matches)

        def on_time():
            return [closure for closure in closures if not closure.is_late]

        robot.until(lambda: len(on_time()) >= count > 5, 'a closure for each match')
        robot.until(lambda: bool(poses), 'poses')
        assert {pose.header.frame_id for pose in poses} == {'wheels'}  # of the odometry
        return [match for match in matches if match.status == PlaceMatch.MATCH], on_time()

    return drive


def test_edges_that_are_off_leave_closures_as_they_were(closing, monkeypatch):
    monkeypatch.setattr(LoopCloser, 'window_columns', lambda *_: pytest.fail('copied'))
    matches, closures = closing(relative_pose='none')
    assert len(matches) == len(closures)
    for message in (*matches, *closures):
        assert not message.has_relative_pose
        assert message.relative_pose.reason == 'parameter relative_pose is none'


def test_images_do_not_wait_for_edges(closing, monkeypatch):
    """Five closures come while PnP of the first waits; all are published, in order."""
    free = threading.Event()

    def slow(self, pair, query_camera, place_camera):
        free.wait(60)
        return Edge(Source.PNP, inliers=99, error=1.0, covariance=np.eye(6))

    monkeypatch.setattr(EdgeEstimator, '_pnp', slow)
    seen, put = [], EdgePublisher.put

    def noting(self, closure):
        seen.append(closure.query_camera)
        put(self, closure)
        if len(seen) == 5:
            free.set()

    monkeypatch.setattr(EdgePublisher, 'put', noting)
    matches, closures = closing(info(), camera_transform=MOUNT)
    assert [c.header.stamp for c in closures] == [m.header.stamp for m in matches]
    assert {closure.relative_pose.source for closure in closures} == {RelativePose.PNP}
    assert not any(match.has_relative_pose for match in matches)
    assert {m.relative_pose.source for m in matches} == {RelativePose.NONE}
    assert {m.relative_pose.reason for m in matches} == {
        'the loop closure of this header has it, by PnP'
    }
    assert {camera.focal for camera in seen if camera} == {(300.0, 300.0)}


class SlowEstimator(EdgeEstimator):
    """Its PnP waits until it is free."""

    def __init__(self):
        super().__init__()
        self.free, self.started = threading.Event(), threading.Event()

    def _pnp(self, pair, query_camera, place_camera):
        self.started.set()
        self.free.wait(60)
        return Edge(Source.PNP)


@pytest.fixture
def queue():
    """Return a publisher of edges whose first PnP waits, what it has published, and its counts."""
    estimator, ending = SlowEstimator(), threading.Event()
    free, started = estimator.free, estimator.started
    published, statistics, last = [], Statistics(), threading.Event()

    def publish(message):
        published.append(message)
        if message.query_index == LAST:
            last.set()

    publisher = EdgePublisher(estimator, publish, statistics, ending)
    camera = object()
    pair = SimpleNamespace(
        pose=lambda place: np.array([0, 0, 0, 0, 0, 0, 1.0]), place=0, query=object(),
        thumbnails={0: b'JPEG'}, source=object(), spacing=1e-9,
    )  # fmt: skip

    def put(number):
        message = LoopClosure(query_index=number)
        publisher.put(WaitingClosure(message, pair, camera, camera))
        assert number or started.wait(60)

    yield SimpleNamespace(
        put=put, free=free, publisher=publisher, published=published, statistics=statistics,
        last=last,
    )  # fmt: skip
    free.set()
    publisher.stop()


def test_oldest_closures_are_dropped_in_order_while_too_many_wait(queue):
    """Three more than may wait: the three oldest behind the one in process have no pose."""
    for number in range(LAST + 1):
        queue.put(number)
    queue.free.set()
    assert queue.last.wait(60)
    assert [message.query_index for message in queue.published] == list(range(LAST + 1))
    sources = [message.relative_pose.source for message in queue.published]
    dropped = [RelativePose.DROPPED] * 3
    assert sources[:5] == [RelativePose.PNP, *dropped, RelativePose.PNP]
    assert set(sources[5:]) == {RelativePose.PNP}
    result = queue.published[1]
    reason = f'PnP: dropped, {MAX_WAITING + 2} newer closures are waiting'
    assert result.relative_pose.reason == reason
    assert not result.has_relative_pose
    assert queue.statistics.counts().edges.total == {'pnp': MAX_WAITING + 1, 'dropped': 3}


@pytest.mark.parametrize(('seconds', 'source'), [(60.0, Source.PNP), (0.0, Source.DROPPED)])
def test_flush_publishes_waiting_closures_by_pnp_until_its_time_is_over(
    queue, set_constants, seconds, source
):
    set_constants(edges, FLUSH_TIME=seconds)
    for number in range(3):
        queue.put(number)
    worker, call = queue.publisher._worker, queue.publisher._worker.call
    worker.call = lambda do: (call(do), queue.free.set())[0]
    queue.publisher.flush()
    sources = [message.relative_pose.source for message in queue.published]
    assert sources == [Source.PNP, source, source]
    reasons = {message.relative_pose.reason for message in queue.published[1:]}
    assert reasons == {'PnP: dropped at deactivation' if source is Source.DROPPED else ''}
