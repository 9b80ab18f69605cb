# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures are completed with their relative poses on a thread of its own, in order."""

from collections.abc import Callable
from dataclasses import dataclass
import threading
import traceback

from rclpy.logging import get_logger
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.relative_pose.edge import Edge, Source
from stavpr_ros.relative_pose.estimator import EdgeEstimator
from stavpr_ros.relative_pose.odometry import align
from stavpr_ros.relative_pose.pair import MatchedPair
from stavpr_ros.ros.input import Worker
from stavpr_ros.ros.output import relative_pose_message

MOST_WAITING = 64  # closures; while there are more, edges are aligned only


@dataclass(frozen=True)
class WaitingClosure:
    """A closure that waits for its edge; cameras: None = unknown."""

    message: LoopClosure
    pair: MatchedPair
    query_camera: Camera | None
    place_camera: Camera | None


@dataclass(frozen=True)
class EdgeCounts:
    """
    Edges since the start of the node.

    :param sources: number of edges of each source, in lower case.
    :param reason: why the last edge is not of PnP; '' = it is, or there was none.
    """

    sources: dict[str, int]
    reason: str = ''


class EdgePublisher:
    """
    Publishes loop closures in their order, each when its edge is ready; images never wait.

    :param method: parameter relative_pose.
    :param publish: called with each closure, on the thread.
    :param ending: set when the node ends.

    ``aligns``: edges may be aligned by odometry; ``counts``: the edges so far.
    """

    def __init__(
        self, method: str, publish: Callable[[LoopClosure], None], ending: threading.Event
    ) -> None:
        self._estimator, self._publish = EdgeEstimator(method), publish
        self.aligns = method in ('auto', 'aligned')
        self._worker = Worker(self._complete, 2**31, ending)
        self.counts = EdgeCounts({})

    def aligned(self, pair: MatchedPair) -> Edge:
        """Return the edge by odometry alone, at once, if the method permits it."""
        if self.aligns:
            return align(pair)
        return Edge(Source.NONE, f'parameter relative_pose is {self._estimator.method}')

    def put(self, closure: WaitingClosure) -> None:
        """Publish a closure when its edge is ready."""
        self._worker.put(closure)

    def flush(self) -> None:
        """Publish the waiting closures, aligned only."""

        def complete() -> None:
            for closure in self._worker.clear():
                self._complete(closure, in_time=False)

        self._worker.call(complete).result()

    def stop(self) -> bool:
        """End the thread; return whether it has ended."""
        return self._worker.stop()

    def _complete(self, closure: WaitingClosure, in_time: bool = True) -> None:
        in_time = in_time and self._worker.waiting < MOST_WAITING
        try:
            edge = self._estimator.estimate(
                closure.pair, closure.query_camera, closure.place_camera, in_time
            )
        except Exception as error:  # an edge less must not be a closure less
            get_logger('stavpr_edges').error(f'no edge: {traceback.format_exc()}')
            edge = Edge(Source.NONE, f'internal error: {type(error).__name__}: {error}')
        sources, name = self.counts.sources, edge.source.name.lower()
        self.counts = EdgeCounts({**sources, name: sources.get(name, 0) + 1}, edge.reason)
        message = closure.message
        message.has_relative_pose = edge.source is not Source.NONE
        message.relative_pose = relative_pose_message(edge, message, message.pose_child_frame)
        self._publish(message)
