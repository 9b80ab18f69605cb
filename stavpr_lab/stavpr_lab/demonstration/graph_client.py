# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fetches the result of a running pose-graph node."""

from collections.abc import Callable
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from stavpr_msgs.srv import SaveMap
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.process import ros_node, spin_until
from stavpr_ros.ros.qos import LATCHED
from visualization_msgs.msg import MarkerArray

NAME = 'pose_graph'


def fetch_graph(
    files: list[str], closures: int, timeout: float = 60.0
) -> tuple[dict[str, str], list[np.ndarray]]:
    """
    Save a pose graph when it has received all loop closures; return its diagnostics and edges.

    :param files: names in its maps folder.
    :param closures: number of loop closures that it must have received.
    :returns: the values of the diagnostics, and x y z of the ends of the accepted and of the
        rejected edges, each of shape (m, 2, 3).
    :raises StavprError: not in time, or the node cannot save.
    """
    values: dict[str, str] = {}
    markers: list[MarkerArray] = []

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == f'{NAME}: graph':
                values.clear()
                values.update({row.key: row.value for row in status.values})

    def wait_until(done: Callable[[], bool], event: str) -> None:
        end = time.monotonic() + timeout
        spin_until(node, lambda: done() or time.monotonic() > end)
        if not done():
            raise StavprError(f'pose_graph: {event} not in {timeout:g} s')

    with ros_node(lambda: rclpy.create_node('graph_client'), []) as node:
        node.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, 10)
        wait_until(lambda: int(values.get('closures', 0)) >= closures, f'{closures} closures')
        client = node.create_client(SaveMap, f'{NAME}/save')
        wait_until(client.service_is_ready, 'its services')
        for file in files:
            future = client.call_async(SaveMap.Request(path=file, overwrite=True))
            wait_until(future.done, f'{file} saved')
            response: Any = future.result()
            if not response.success:
                raise StavprError(f'pose_graph: {response.message}')
        values.clear()
        node.create_subscription(MarkerArray, f'{NAME}/edges', markers.append, LATCHED)
        wait_until(lambda: bool(values and markers), 'diagnostics and edges')
    ends = {marker.id: marker.points for marker in markers[-1].markers}
    points = [[(p.x, p.y, p.z) for p in ends.get(i, [])] for i in (0, 1)]
    return values, [np.array(rows, float).reshape(-1, 2, 3) for rows in points]
