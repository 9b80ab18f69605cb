# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signal handling of every executable."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
import signal
import sys
import time
from types import FrameType
from typing import NoReturn

END_SECONDS = 3.5  # for all waits after a signal: `ros2 launch` escalates after 5


class _State:
    received = False
    deferred = False
    time = 0.0  # of the first one


def _on_signal(number: int, frame: FrameType | None) -> None:
    first, _State.received = not _State.received, True
    if first:
        _State.time = time.monotonic()
    if first and not _State.deferred:
        raise KeyboardInterrupt


def obey_signals() -> None:
    """
    Raise KeyboardInterrupt on the first SIGINT or SIGTERM, and ignore further ones.

    ``ros2 launch`` sends a second SIGINT during the shutdown. The handlers replace those
    inherited: a shell ignores SIGINT for background processes.
    """
    signal.signal(signal.SIGINT, _on_signal)
    signal.signal(signal.SIGTERM, _on_signal)


def run_until_signal(run: Callable[[], int]) -> int:
    """Return the exit code of ``run``; a signal ends the process when ``run`` has cleaned up."""
    obey_signals()
    code = 0
    try:
        code = run()
    except BaseException:  # an interrupt inside a foreign library may be raised as another one
        if not was_interrupted():
            raise
    if was_interrupted():
        end_process(code)
    return code


def was_interrupted() -> bool:
    """Return whether a signal was received."""
    return _State.received


def time_left(longest: float, shortest: float = 0.1) -> float:
    """Return how long to wait for something at the end: all waits share the time of a signal."""
    if not _State.received:
        return longest
    return min(longest, max(shortest, _State.time + END_SECONDS - time.monotonic()))


def end_process(code: int) -> NoReturn:
    """
    End the process now: Python would wait for its threads, and free torch and numba.

    Measured on a busy machine: 5 to 13 seconds.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


@contextmanager
def signals_deferred() -> Iterator[None]:
    """
    Raise the KeyboardInterrupt by a signal at the end of the block instead of within.

    For calls into rclpy: an exception within its C++ comes out as another one.
    """
    _State.deferred = True
    try:
        yield
    finally:
        _State.deferred = False
    if _State.received:
        raise KeyboardInterrupt
