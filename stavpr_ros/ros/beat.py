# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A thread that acts again and again, whatever the executor and the recognition are busy with."""

from collections.abc import Callable
import threading

from rclpy.node import Node
from stavpr_ros.ros import REPORT_PERIOD


class Beat:
    """
    Calls a function every period, on the steady clock, from now on: a paused bag does not stop it.

    :param node: it logs errors; the next call may succeed.
    :param period: seconds.
    :param name: of the thread, and of what an error prevents.
    """

    def __init__(self, node: Node, period: float, act: Callable[[], object], name: str) -> None:
        self._node, self._period, self._act = node, period, act
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread, after a call in progress."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(self._period):
            try:
                self._act()
            except Exception as error:
                self._node.get_logger().error(
                    f'no {self._thread.name}: {type(error).__name__}: {error}',
                    throttle_duration_sec=REPORT_PERIOD,
                )
