# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start, spinning and end of every executable with a ROS node."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import os
import sys
from typing import TypeVar

import rclpy
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from stavpr_ros.errors import SettingsError
from stavpr_ros.ros.rclpy_workarounds import PromptExecutor
from stavpr_ros.signals import interrupted, signals_deferred

SPIN_SECONDS = 0.2  # until a signal is noticed
END_SECONDS = 4.0  # for running callbacks at the end; the node's worker takes 3 of them

AnyNode = TypeVar('AnyNode', bound=Node)


@contextmanager
def _ros_arguments_checked() -> Iterator[None]:
    try:
        yield
    except (
        rclpy_implementation.RCLError,
        rclpy_implementation.RCLInvalidROSArgsError,
        rclpy_implementation.UnknownROSArgsError,
    ) as error:
        raise SettingsError(f'the arguments after --ros-args are invalid: {error}') from error


def own_arguments(arguments: Sequence[str]) -> list[str]:
    """
    Return the arguments that are not for ROS.

    :raises SettingsError: those after ``--ros-args`` are invalid.
    """
    with _ros_arguments_checked():
        return list(remove_ros_args(arguments))


@contextmanager
def ros_node(make: Callable[[], AnyNode], arguments: Sequence[str] | None) -> Iterator[AnyNode]:
    """
    Initialize ROS, make a node, and shut both down at the end.

    rclpy's own signal handlers are not installed: they shut the context down at once (see
    ros2/rclpy#1287), while the worker may be publishing and before the node has saved its map.

    :param make: makes the node.
    :param arguments: without the program's name; the process's own if None.
    :raises SettingsError: the arguments after ``--ros-args`` are invalid.
    """
    with _ros_arguments_checked():
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    left_behind = False
    try:
        node = make()
        try:
            yield node
        finally:
            node.destroy_node()
            left_behind = getattr(node, 'left_behind', False)
    finally:
        rclpy.try_shutdown()
        if left_behind and interrupted():  # Python would wait for its threads without limit
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)


def spin_until(node: Node, done: Callable[[], bool] = lambda: False, threads: int = 1) -> None:
    """
    Spin until ``done`` returns True or the context is shut down.

    A signal raises KeyboardInterrupt.

    :param node: if it has an event ``ending``, that is set at the end.
    :param threads: for callbacks; 1 = all on this one.
    """
    executor: Executor = (
        SingleThreadedExecutor(context=node.context)
        if threads == 1
        else PromptExecutor(threads, context=node.context)
    )
    executor.add_node(node)
    try:
        while node.context.ok() and not done():
            with signals_deferred():
                executor.spin_once(timeout_sec=SPIN_SECONDS)
    except ExternalShutdownException:
        pass
    finally:
        if hasattr(node, 'ending'):
            node.ending.set()
        if isinstance(executor, PromptExecutor):
            executor.finish(
                END_SECONDS
            )  # shutdown takes the entities from under running callbacks
        executor.shutdown()
