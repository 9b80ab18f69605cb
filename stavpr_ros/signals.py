# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Signal handling of every executable."""

from collections.abc import Iterator
from contextlib import contextmanager
import signal
from types import FrameType


class _State:
    received = False
    deferred = False


def _on_signal(number: int, frame: FrameType | None) -> None:
    first, _State.received = not _State.received, True
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


def interrupted() -> bool:
    """Return whether a signal was received."""
    return _State.received


@contextmanager
def signals_deferred() -> Iterator[None]:
    """
    Raise the KeyboardInterrupt of a signal at the end of the block instead of within.

    For calls into rclpy: an exception within its C++ comes out as another one.
    """
    _State.deferred = True
    try:
        yield
    finally:
        _State.deferred = False
    if _State.received:
        raise KeyboardInterrupt
