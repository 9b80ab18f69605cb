"""How our processes begin, spin and end: the same for every executable with a ROS node."""

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import rclpy
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    SingleThreadedExecutor,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from stavpr_ros.errors import SettingsError
from stavpr_ros.ros.executor import ServiceThreadsExecutor
from stavpr_ros.signals import interrupted, signals_deferred

LONGEST_WAIT = 0.2  # seconds until a signal is noticed
LONGEST_CALLBACK = 4.0  # seconds that callbacks may go on at the end; the node's worker takes 3 of them

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
        raise SettingsError(f'the arguments after --ros-args do not do: {error}') from error


def own_arguments(arguments: Sequence[str]) -> list[str]:
    """
    Return the arguments that are not for ROS.

    :raises SettingsError: those after ``--ros-args`` do not do.
    """
    with _ros_arguments_checked():
        return list(remove_ros_args(arguments))


@contextmanager
def ros_node(make: Callable[[], AnyNode], arguments: Sequence[str] | None) -> Iterator[AnyNode]:
    """
    Make a node, in ROS, and take both down again.

    rclpy's own signal handlers stay out: they end the context at any moment, under a worker that is
    publishing, and ``rclpy.spin`` was seen to sleep through one of them.

    :param make: makes the node.
    :param arguments: without the program's name; the process's own if None.
    :raises SettingsError: the arguments after ``--ros-args`` do not do.
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
        if left_behind and interrupted():  # Python would wait for it, however long it takes
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)


def spin_until(node: Node, done: Callable[[], bool] = lambda: False, threads: int = 1) -> None:
    """
    Spin until ``done`` says so, or the context is shut down; a signal raises KeyboardInterrupt.

    :param threads: for services; 1 = everything on this one.
    """
    executor: Executor = (
        SingleThreadedExecutor(context=node.context)
        if threads == 1
        else ServiceThreadsExecutor(threads, context=node.context)
    )
    executor.add_node(node)
    try:
        while node.context.ok() and not done():
            with signals_deferred():
                executor.spin_once(timeout_sec=LONGEST_WAIT)
    except ExternalShutdownException:
        pass
    finally:
        if isinstance(executor, ServiceThreadsExecutor):
            _let_callbacks_end(executor, node)
        executor.shutdown()


def _let_callbacks_end(executor: ServiceThreadsExecutor, node: Node) -> None:
    """
    Wait for the callbacks that have been handed to other threads.

    rclpy's own shutdown waits for none, and takes from under them what they need.

    :param node: one with an event ``ending`` is told by it.
    """
    if hasattr(node, 'ending'):
        node.ending.set()
    end = time.monotonic() + LONGEST_CALLBACK
    while executor.busy and time.monotonic() < end:
        time.sleep(0.01)
