# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Relays loop closures and makes a share of them wrong: a test of back ends."""

import argparse
import sys

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.ros.output import nanoseconds
from stavpr_ros.ros.process import own_arguments, ros_node, spin_until

RUN = 20  # successive closures that are wrong by the same number of places
NEAR = 30  # places that a wrong one is away at least


class FalseClosures(Node):
    """
    Relays ``stavpr/loop_closure`` to ``~/loop_closure``.

    :param share: of closures that are wrong, 0 to 1.
    :param coherent: wrong in runs that are consistent in themselves, as look-alike streets are.
    """

    def __init__(self, share: float, coherent: bool, seed: int) -> None:
        super().__init__('false_closures')
        self._share, self._coherent = share, coherent
        self._dice = np.random.default_rng(seed)
        self._places: dict[int, Time] = {}
        self._number, self._shift = 0, 0
        qos = QoSProfile(depth=1000)
        self._publisher = self.create_publisher(LoopClosure, '~/loop_closure', qos)
        self.create_subscription(LoopClosure, 'stavpr/loop_closure', self._on_closure, qos)

    def _on_closure(self, message: LoopClosure) -> None:
        for pair in message.pairs:
            self._places[pair.query_index] = pair.query_stamp
            self._places[pair.place_index] = pair.place_stamp
        if self._number % (RUN if self._coherent else 1) == 0:
            wrong = self._dice.random() < self._share
            known = sorted(self._places)
            away = [index for index in known if abs(index - message.place_index) > NEAR]
            chosen = int(self._dice.choice(away)) if wrong and away else message.place_index
            self._shift = chosen - message.place_index
        self._number += 1
        if self._shift:
            index = message.place_index + self._shift
            nearest = min(self._places, key=lambda place: abs(place - index))
            message.place_index, message.place_stamp = nearest, self._places[nearest]
            if nanoseconds(message.relative_pose.place_stamp):
                message.relative_pose.place_index = nearest
                message.relative_pose.place_stamp = self._places[nearest]
        self._publisher.publish(message)


def main() -> None:
    """Relay until a signal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--share', type=float, required=True)
    parser.add_argument('--coherent', action='store_true')
    parser.add_argument('--seed', type=int, default=0)
    given = parser.parse_args(own_arguments(sys.argv[1:]))
    try:
        with ros_node(
            lambda: FalseClosures(given.share, given.coherent, given.seed), sys.argv[1:]
        ) as node:
            spin_until(node)
    except KeyboardInterrupt:
        pass


if __name__ == '__main__':
    main()
