# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The way out: all publishers of a configured node."""

from collections.abc import Callable
from dataclasses import replace

from stavpr_ros.mapping import GrowingMap
from stavpr_ros.pipeline import NodeSettings, Operation
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.relative_pose.estimator import EdgeEstimator
from stavpr_ros.ros.edges import EdgePublisher
from stavpr_ros.ros.localized import LocalizedPublisher
from stavpr_ros.ros.messages import Outcome
from stavpr_ros.ros.navigation import Navigation
from stavpr_ros.ros.output import Output, Publishers
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.ros.subgoal import SubgoalPublisher
from stavpr_ros.ros.visualization import Visualization


class Publication:
    """
    Publishes the outcome of each image, ``~/match`` last; loop closures when they are ready.

    :param operation, on_subscriber: see :class:`stavpr_ros.ros.visualization.Visualization`.
    """

    def __init__(
        self,
        node: ManagedNode,
        settings: NodeSettings,
        statistics: Statistics,
        operation: Callable[[], Operation],
        on_subscriber: Callable[[], object],
    ) -> None:
        self._map_frame, self._operation = settings.map_frame, operation
        self.navigation = Navigation(node, settings)
        self.localized = LocalizedPublisher(node, settings)
        self.views = Visualization(node, operation, on_subscriber)
        self.output = Output(node, settings.queue_size)
        others = self.localized, SubgoalPublisher(node, settings), self.views
        self.all: tuple[Publishers, ...] = (self.navigation, *others, self.output)
        estimator = EdgeEstimator(settings.relative_pose)
        self.edges = EdgePublisher(estimator, self.output.publish_closure, statistics, node.ending)

    def publish(self, outcome: Outcome) -> Outcome:
        """Publish the outcome of an image; return it with the edge of its match."""
        edge, closures = self.edges.prepare(outcome, self._operation())
        outcome = replace(outcome, edge=edge)
        for publishers in self.all:
            publishers.publish(outcome)
        for closure in closures:
            self.edges.put(closure)
        return outcome

    def publish_route(self) -> None:
        """Publish the route for a new subscriber, in the frame of the last image if it grows."""
        places = self._operation().matched_places
        on_route = isinstance(places, GrowingMap)
        self.views.publish_route(places, self.views.frame if on_route else self._map_frame)

    def reset(self) -> None:
        """Let nothing before the next image count: the window was emptied."""
        for publishers in self.all:
            publishers.reset()

    def forget(self) -> None:
        """Let nothing before count: the node is deactivated."""
        self.reset()
        self.navigation.forget()

    def close(self) -> None:
        """Destroy the publishers."""
        for publishers in self.all:
            publishers.close()
