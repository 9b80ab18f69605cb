# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Relays loop closures and makes a share of them wrong: a test of back ends."""

import argparse
import sys

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.qos import QoSProfile
from stavpr_lab.demonstration.false_places import FalsePlaces
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.ros.messages import nanoseconds
from stavpr_ros.ros.process import own_arguments, ros_node, spin_until


class FalseClosures(Node):
    """
    Relays ``stavpr/loop_closure`` to ``~/loop_closure``.

    :param share, coherent, seed: see :class:`FalsePlaces`.
    """

    def __init__(self, share: float, coherent: bool, seed: int) -> None:
        super().__init__('false_closures')
        self._false = FalsePlaces(share, coherent, seed)
        self._places: dict[int, Time] = {}
        qos = QoSProfile(depth=1000)
        self._publisher = self.create_publisher(LoopClosure, '~/loop_closure', qos)
        self.create_subscription(LoopClosure, 'stavpr/loop_closure', self._on_closure, qos)

    def _on_closure(self, message: LoopClosure) -> None:
        for pair in message.pairs:
            self._places[pair.query_index] = pair.query_stamp
            self._places[pair.place_index] = pair.place_stamp
        place = self._false.place(message.place_index, self._places)
        if place != message.place_index:
            message.place_index, message.place_stamp = place, self._places[place]
            if nanoseconds(message.relative_pose.place_stamp):
                message.relative_pose.place_index = place
                message.relative_pose.place_stamp = self._places[place]
        self._publisher.publish(message)


def main() -> None:
    """Relay until a signal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--share', type=float, required=True)
    parser.add_argument('--coherent', action='store_true')
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args(own_arguments(sys.argv[1:]))
    try:
        with ros_node(
            lambda: FalseClosures(options.share, options.coherent, options.seed), sys.argv[1:]
        ) as node:
            spin_until(node)
    except KeyboardInterrupt:
        pass


if __name__ == '__main__':
    main()
