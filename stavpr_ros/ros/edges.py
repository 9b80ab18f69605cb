# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures are completed with their relative poses on a thread of its own, in order."""

from collections.abc import Callable
from dataclasses import dataclass
import threading
import time
import traceback

import numpy as np
from rclpy.logging import get_logger
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.pipeline.operations import Operation
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.relative_pose.estimator import EdgeEstimator
from stavpr_ros.relative_pose.pair import Edge, MatchedPair, Source
from stavpr_ros.ros.messages import loop_closure_message, Outcome, relative_pose_message
from stavpr_ros.ros.worker import Worker
from stavpr_ros.signals import time_left

MAX_WAITING = 40  # closures; while there are more, the oldest goes without a relative pose
UNLIMITED = 2**31  # closures; the thread itself drops the pose of the oldest
NO_POSE = Edge(Source.NONE, 'the place has no pose: record maps and routes with odometry')
FLUSH_TIME = 2.0  # seconds of PnP at deactivation, less than the end of the node waits


@dataclass(frozen=True)
class WaitingClosure:
    """A closure that waits for its edge; cameras: None = unknown."""

    message: LoopClosure
    pair: MatchedPair
    query_camera: Camera | None
    place_camera: Camera | None


class EdgePublisher:
    """
    Publishes loop closures in their order, each when its edge is ready; images never wait.

    :param estimator: makes the edges, on the thread.
    :param publish: called with each closure, on the thread.
    :param statistics: counts the edges by source.
    :param ending: set when the node ends.
    """

    def __init__(
        self,
        estimator: EdgeEstimator,
        publish: Callable[[LoopClosure], None],
        statistics: Statistics,
        ending: threading.Event,
    ) -> None:
        self._estimator, self._publish, self._statistics = estimator, publish, statistics
        self._worker = Worker(self._complete, UNLIMITED, ending, 'edges')

    def prepare(
        self, outcome: Outcome, operation: Operation
    ) -> tuple[Edge | None, list[WaitingClosure]]:
        """
        Copy all that edges need, on the thread of the pipeline: the next image changes it.

        :returns: the edge for the message of the match, None without a match; the closures of the
            match and of its late ones.
        """
        newest, camera, place_map = outcome.match, outcome.about.camera, outcome.place_map
        edge: Edge | None = None
        closures: list[WaitingClosure] = []
        if not newest.accepted:
            return edge, closures
        # a route has the camera of the query
        place_camera = camera if place_map is None else place_map.camera_of(newest.place)
        for match in (newest, *newest.late):
            yaw = outcome.result.relative_yaw  # of a map, where no match is late
            pair = operation.matched_pair(match, self._estimator.method, yaw)
            if match is newest:
                edge = self._immediate(pair, camera, place_camera)
            if pair is None:
                continue
            pose = None if np.isnan(pair.query_pose).any() else pair.query_pose
            message = loop_closure_message(outcome, match, pose)
            if message is not None:
                closures.append(WaitingClosure(message, pair, camera, place_camera))
        return edge, closures

    def _immediate(
        self, pair: MatchedPair | None, query_camera: Camera | None, place_camera: Camera | None
    ) -> Edge:
        """Return the edge of a match, which waits for nothing: by odometry, or without a pose."""
        if self._estimator.method == 'none':
            return Edge(Source.NONE, 'parameter relative_pose is none')
        if pair is None:
            return NO_POSE
        edge = self._estimator.without_pnp(pair, query_camera, place_camera)
        return edge or Edge(Source.NONE, 'the loop closure of this header has it, by PnP')

    def put(self, closure: WaitingClosure) -> None:
        """Publish a closure when its edge is ready."""
        self._worker.put(closure)

    def flush(self) -> None:
        """Publish the waiting closures, after ``FLUSH_TIME`` seconds without PnP."""

        def complete() -> None:
            end = time.monotonic() + time_left(FLUSH_TIME)
            for closure in self._worker.clear():
                late = time.monotonic() >= end
                self._complete(closure, 'dropped at deactivation' if late else '')

        self._worker.call(complete).result()

    def stop(self) -> bool:
        """End the thread; return whether it has ended."""
        return self._worker.stop()

    def _complete(self, closure: WaitingClosure, obstacle: str = '') -> None:
        if (waiting := self._worker.waiting) >= MAX_WAITING:
            obstacle = f'dropped, {waiting} newer closures are waiting'
        try:
            edge = self._estimator.estimate(
                closure.pair, closure.query_camera, closure.place_camera, obstacle
            )
        except Exception as error:  # a failed edge must not lose its closure
            get_logger('stavpr_edges').error(f'no edge: {traceback.format_exc()}')
            edge = Edge(Source.NONE, f'internal error: {type(error).__name__}: {error}')
        self._statistics.add_edge(edge.source.name, edge.reason)
        message = closure.message
        message.has_relative_pose = edge.has_pose
        message.relative_pose = relative_pose_message(edge, message, message.pose_child_frame)
        self._publish(message)
