"""Spinning a node so that every signal ends it, and a second one does not spoil the end."""

import signal
from collections.abc import Callable

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

LONGEST_WAIT = 0.5  # seconds


def ignore_interrupts() -> None:
    """Be deaf to Ctrl-C from now on: ``ros2 launch`` sends a second one while the first is being obeyed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def spin_until_shutdown(node: Node, done: Callable[[], bool] = lambda: False) -> None:
    """
    Spin until a signal, a shutdown of the context, or until ``done`` says so.

    Never waits without a limit, as ``rclpy.spin`` does: after minutes at 30 images per second a node was
    seen to sleep through a SIGINT, woken too early to find its context shut down.
    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    try:
        while node.context.ok() and not done():
            executor.spin_once(timeout_sec=LONGEST_WAIT)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        executor.shutdown()
