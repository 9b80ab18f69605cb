# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The time of a replay, with pause and step."""

from collections.abc import Callable
import math
import time

from stavpr_ros.units import SECOND


class Playback:
    """
    Maps the time of recording to the time of this machine; it can be paused and stepped.

    :param rate: recorded seconds per second, above 0; None = items are due at once, and the last
        item determines the time.
    :param steady: returns seconds; replaced in tests.
    """

    def __init__(
        self, rate: float | None, paused: bool, steady: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate, self._steady = rate, steady
        self.paused = paused
        self._steps = 0
        self._position: int | None = None  # recorded time at the anchor, ns
        self._anchor = 0.0

    def start(self, time_ns: int) -> None:
        """Start at a recorded time, or start again."""
        self._position, self._anchor = time_ns, self._steady()

    @property
    def started(self) -> bool:
        """Whether :meth:`start` was called."""
        return self._position is not None

    def now_ns(self) -> int:
        """Return the recorded time, ns; 0 before the start."""
        if self._position is None:
            return 0
        if self.paused or self._rate is None:
            return self._position
        return self._position + round((self._steady() - self._anchor) * self._rate * SECOND)

    def seconds_until(self, time_ns: int) -> float:
        """Return the seconds until an item of a recorded time is due; inf while paused."""
        if self.paused:
            return 0.0 if self._steps else math.inf
        return 0.0 if self._rate is None else (time_ns - self.now_ns()) / SECOND / self._rate

    def passed(self, time_ns: int, is_step: bool) -> None:
        """Note that an item was published; while paused, time follows the items."""
        if self.paused or self._rate is None:
            self._position = max(self._position or 0, time_ns)
        if is_step and self._steps:
            self._steps -= 1

    def pause(self, paused: bool) -> None:
        """Pause, or resume."""
        if self._position is not None:
            self._position, self._anchor = self.now_ns(), self._steady()
        self.paused, self._steps = paused, 0

    def step(self) -> bool:
        """Make the items up to the next image due; return whether it is paused, as it must be."""
        self._steps += self.paused
        return self.paused
