"""How our processes take signals."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
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
    Make the first SIGINT or SIGTERM raise KeyboardInterrupt, and the process deaf to further ones.

    ``ros2 launch`` sends a second SIGINT while the first is being obeyed. What the parent process had in
    mind for the signals (a shell ignores SIGINT for what it starts in the background) does not count.
    """
    signal.signal(signal.SIGINT, _on_signal)
    signal.signal(signal.SIGTERM, _on_signal)


def interrupted() -> bool:
    """Tell whether a signal has come."""
    return _State.received


@contextmanager
def signals_deferred() -> Iterator[None]:
    """
    Note signals instead of raising KeyboardInterrupt, which is raised at the end.

    For calls into rclpy: an exception in the middle of its C++ comes out as another one.
    """
    _State.deferred = True
    try:
        yield
    finally:
        _State.deferred = False
    if _State.received:
        raise KeyboardInterrupt
