# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A thread that acts again and again, whatever the executor and the recognition are busy with."""

from collections.abc import Callable
import threading
import traceback

from rclpy.logging import get_logger


class Beat:
    """
    Calls a function every period, on the steady clock, from now on.

    :param period: seconds.
    :param name: of the thread.
    """

    def __init__(self, period: float, act: Callable[[], object], name: str) -> None:
        self._period, self._act = period, act
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
            except Exception:  # the next call may succeed
                get_logger('stavpr_beat').error(traceback.format_exc())
