# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The bond to a lifecycle manager of Nav2, which takes a node without its heartbeats for crashed.

By the messages alone: ``bondpy`` of the ROS distribution refuses the second activation of a node
(ros/bond_core#113) and loses messages of its queue (#95), as of version 4.2.
"""

import threading
from typing import Any
import uuid

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from stavpr_ros.ros.rclpy_workarounds import until_shutdown
from stavpr_ros.ros.worker import Beat

TOPIC, TIMEOUT = 'bond', 4.0  # seconds, as nav2_util::LifecycleNode
PUBLISHED, RECEIVED = 5, 100  # depths of the queues, as bondcpp
END_TIMEOUT = 0.1  # seconds until the manager has acknowledged the end, as bondcpp


class Bond:
    """
    A bond with the name of the node, from now on until :meth:`close` or until the manager ends it.

    As in Nav2, only the manager takes the other side for crashed; its period may be another one.

    :param status: class of ``bond/msg/Status``.
    :param period: seconds between two heartbeats.
    """

    def __init__(self, node: Node, status: Any, period: float) -> None:
        self._node, self._status, self._period = node, status, period
        self._instance = str(uuid.uuid4())
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._has_manager = self._is_closed = False
        self._manager_ended = threading.Event()
        self._publisher = node.create_publisher(status, TOPIC, PUBLISHED)
        group = MutuallyExclusiveCallbackGroup()
        self._subscription = node.create_subscription(
            status, TOPIC, self._on_status, RECEIVED, callback_group=group
        )
        self._beat = Beat(node, period, self.beat, 'bond')
        self.beat()

    def beat(self) -> None:
        """Send a heartbeat, unless the bond has ended."""
        if not (self._is_closed or self._manager_ended.is_set()):
            self._send(True)

    def close(self) -> None:
        """End the bond, so that the manager does not take the node for crashed."""
        self._is_closed = True
        self._beat.stop()
        self._send(False)
        if self._has_manager and self._node.context.ok():
            self._manager_ended.wait(END_TIMEOUT)
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_publisher(self._publisher)

    def _on_status(self, message: Any) -> None:
        if message.id != self._node.get_name() or message.instance_id == self._instance:
            return  # of another node, or our own
        self._has_manager = True
        if not message.active:
            must_acknowledge = not (self._manager_ended.is_set() or self._is_closed)
            self._manager_ended.set()
            if must_acknowledge:
                self._send(False)

    def _send(self, active: bool) -> None:
        message = self._status(
            id=self._node.get_name(),
            instance_id=self._instance,
            active=active,
            heartbeat_timeout=TIMEOUT,
            heartbeat_period=self._period,
        )
        message.header.stamp = self._clock.now().to_msg()
        with until_shutdown(self._node):
            self._publisher.publish(message)


def make_bond(node: Node, period: float, is_managed: bool) -> Bond | None:
    """
    Make the bond of a node that is activated; None = off.

    :param period: parameter ``bond_heartbeat_period``, 0 = off.
    :param is_managed: the node does not start itself; then a missing package is a warning.
    """
    if not period:
        return None
    try:
        from bond.msg import Status
    except ImportError:
        if is_managed:
            node.get_logger().warning(
                'no bond, since the package bond is not installed: a lifecycle manager of Nav2 '
                'needs it (ros-jazzy-bond), or bond_timeout 0.0'
            )
        return None
    return Bond(node, Status, period)
