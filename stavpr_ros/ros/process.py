# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Transport, start, spinning, discovery and end of every executable with a ROS node."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
import os
from pathlib import Path
from shutil import disk_usage
import signal
import socket
import sys
import threading
import time
import traceback
from typing import Any, TypeVar

from ament_index_python.packages import get_package_share_directory, PackageNotFoundError
from rcl_interfaces.srv import GetParameters
import rclpy
from rclpy.client import Client
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args
from stavpr_ros.errors import SettingsError, StavprError, UnavailableError
from stavpr_ros.ros.rclpy_workarounds import (
    log_failure,
    PromptExecutor,
    ros_arguments_checked,
    with_log_files,
)
from stavpr_ros.signals import end_process, signals_deferred, time_left, was_interrupted

SIGNAL_POLL = 0.2  # seconds until a signal is noticed by an executor that it does not wake
LONG_POLL = 2.0  # seconds, by one that it wakes: each poll collects all entities of the node
CALLBACK_SECONDS = 2.0  # for running callbacks at the end
SERVICE_SECONDS = 2.0  # until a node shows its parameter service; tools may have none
# read by Fast DDS 2.14, which ignores the FASTDDS_ spelling of later versions
PROFILES_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
PROFILES_FILE = 'config/fastdds_large_images.xml'
SHARED_MEMORY, UDP_FILE = '/dev/shm', 'config/fastdds_udp.xml'
LARGE_SEGMENT, SEGMENT = 40_000_000, 1_000_000  # bytes of shared memory, with what belongs to it

AnyNode = TypeVar('AnyNode', bound=Node)


def prepare_transport(size: int = LARGE_SEGMENT, profiles_file: str = PROFILES_FILE) -> None:
    """
    Give this process shared memory for images; to be called before ``rclpy.init``.

    The default segment of 512 KiB is smaller than one 640x480 color image, and the publisher's
    segment is the one that counts. Without room, images are sent by UDP: Fast DDS would crash. A
    profile set by the user stays; other middlewares ignore it.

    :param size: of the room, bytes.
    :param profiles_file: the profile of shared memory, '' = the default.
    :raises UnavailableError: the package's share folder is not found.
    """
    if os.environ.get(PROFILES_VARIABLE):
        return
    if not os.access(SHARED_MEMORY, os.W_OK) or disk_usage(SHARED_MEMORY).free < size:
        profiles_file = UDP_FILE
        print(
            f'images are not shared in {SHARED_MEMORY} ({size / 1e6:.1f} MB cannot be written), '
            'but sent by UDP, which is slower: make room (docker run --shm-size)',
            file=sys.stderr,
        )
    if not profiles_file:
        return
    try:
        profiles = Path(get_package_share_directory('stavpr_ros')) / profiles_file
    except PackageNotFoundError as error:
        raise UnavailableError(
            'the package stavpr_ros is not installed (no entry in AMENT_PREFIX_PATH): expected '
            f'its share folder with {profiles_file}; build it, source local_setup.bash'
        ) from error
    if not profiles.is_file():
        raise UnavailableError(
            f'{profiles} is missing: expected it in the installed package; build again'
        )
    os.environ[PROFILES_VARIABLE] = str(profiles)


def own_arguments(arguments: Sequence[str]) -> list[str]:
    """
    Return the arguments that are not for ROS.

    :raises SettingsError: arguments after ``--ros-args`` are invalid.
    """
    with ros_arguments_checked():
        texts = _texts(arguments)
        originals = dict(zip(texts, arguments, strict=True))
        return [originals[text] for text in remove_ros_args(texts)]


def _texts(arguments: Sequence[str]) -> list[str]:
    """Return arguments as ROS takes them; bytes that are no UTF-8 are replaced."""
    return [word.encode(errors='surrogateescape').decode(errors='replace') for word in arguments]


@contextmanager
def ros_node(make: Callable[[], AnyNode], arguments: Sequence[str] | None) -> Iterator[AnyNode]:
    """
    Initialize ROS, make a node, and shut both down at the end.

    rclpy's own signal handlers are not installed: they shut the context down at once
    (ros2/rclpy#1287), while the worker may be publishing and before the node has saved its map.

    :param arguments: without the program's name; the process's own if None.
    :raises SettingsError: the arguments after ``--ros-args`` are invalid.
    """
    prepare_transport(SEGMENT, '')
    with ros_arguments_checked():
        texts = with_log_files(_texts(sys.argv[1:] if arguments is None else arguments))
        rclpy.init(args=texts, signal_handler_options=SignalHandlerOptions.NO)
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
        if left_behind and was_interrupted():
            end_process(int(getattr(node, 'failed', False)))


@contextmanager
def waking(executor: Executor) -> Iterator[float]:
    """
    Let signals wake an executor, on the main thread; yield the longest wait, seconds.

    Python's handlers run on the main thread, which a wait in C++ blocks.
    """
    if threading.current_thread() is not threading.main_thread():
        yield SIGNAL_POLL
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)

    def wake() -> None:
        while reader.recv(1):
            executor.create_task(lambda: None)

    before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    thread = threading.Thread(target=wake, name='signals', daemon=True)
    thread.start()
    try:
        yield LONG_POLL
    finally:
        signal.set_wakeup_fd(before)
        writer.close()
        thread.join()
        reader.close()


def spin_until(node: Node, is_done: Callable[[], bool] = lambda: False, threads: int = 1) -> None:
    """
    Spin until ``is_done`` returns True or the context is shut down.

    A signal raises KeyboardInterrupt. Errors of callbacks are logged, except errors of this
    package, which are raised.

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
        with waking(executor) if threads > 1 else nullcontext(SIGNAL_POLL) as poll:
            while node.context.ok() and not is_done():
                try:
                    with signals_deferred():
                        executor.spin_once(timeout_sec=poll)
                except (StavprError, ExternalShutdownException):
                    raise
                except Exception:
                    if was_interrupted():  # a foreign library may raise it as another error
                        raise
                    log_failure(traceback.format_exc())
    except ExternalShutdownException:
        pass
    finally:
        if hasattr(node, 'ending'):
            node.ending.set()
        if isinstance(executor, PromptExecutor):
            # shutdown takes the entities from under running callbacks
            executor.finish(time_left(CALLBACK_SECONDS))
        executor.shutdown()


def require_ros_arguments(arguments: Sequence[str], parameters: Iterable[str] = ()) -> None:
    """
    Reject arguments that are not for ROS, for a node that has no others.

    :param parameters: names of the node's parameters.
    :raises SettingsError: names the arguments, and the form to write them in.
    """
    words, of_ros = [], False
    for word in arguments:
        if word in ('--ros-args', '--'):
            of_ros = word == '--ros-args'
        elif not of_ros:
            words.append(word)
    # rcl takes NAME:=VALUE alone as a remapping, of a parameter without effect
    names = {word.partition(':=')[0] for word in words}
    if not own_arguments(arguments) and names.isdisjoint(parameters):
        return
    raise SettingsError(
        f'nothing reads the arguments {" ".join(words)!r}: write --ros-args -p NAME:=VALUE with a '
        'NAME that --help lists, or --ros-args -r image:=TOPIC (parameters and remappings are '
        'arguments of ROS)'
    )


def run_node(
    make: Callable[[], AnyNode], arguments: Sequence[str] | None, parameters: Iterable[str] = ()
) -> int:
    """
    Run a node until a signal stops the process; return the exit code.

    :param make: returns the node; it has ``THREADS`` for callbacks, 1 by default, and ``failed``
        if its end may lose something.
    :param arguments: without the program's name; the process's own if None. All are for ROS.
    :param parameters: names of the node's parameters; an argument NAME:=VALUE is rejected.
    """
    node = None
    try:
        require_ros_arguments(sys.argv[1:] if arguments is None else arguments, parameters)
        with ros_node(make, arguments) as node:
            spin_until(node, threads=getattr(node, 'THREADS', 1))
    except (StavprError, ParameterException) as error:
        get_logger('stavpr').fatal(f'cannot start: {error}')
        return 1
    except BaseException:  # an interrupt inside a foreign library may be raised as another one
        if not was_interrupted():
            raise
    return int(getattr(node, 'failed', False))


class Discovery:
    """
    Finds out when the nodes at the other end of our topics have discovered us.

    A matched endpoint on our side does not imply a matched one on theirs, and DDS does not report
    it. But endpoints are announced in order, so a request's come after earlier ones: a node
    that responds to a request has discovered our topics. Nodes serve parameter requests by
    default.

    :param node: ours, with its publishers and subscriptions made; the caller spins it.
    :param endpoints: returns the other endpoints, as ``get_publishers_info_by_topic`` does.
    :param timeout: seconds after which discovery counts as done.
    """

    def __init__(
        self, node: Node, endpoints: Callable[[], list[Any]], timeout: float = 10.0
    ) -> None:
        self._node, self._endpoints = node, endpoints
        self._timeout = max(SERVICE_SECONDS, timeout)
        self._clients: dict[str, Client] = {}
        self._responses: dict[str, Future] = {}
        self._start: float | None = None

    def restart(self) -> None:
        """Request new responses."""
        self._responses.clear()
        self._start = None

    def done(self) -> bool:
        """Return whether all nodes have responded, or need not; to be called while spinning."""
        if self._start is None:
            self._start = time.monotonic()
        names = {
            f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            for info in self._endpoints()
            if not info.node_name.startswith('_NODE_NAME_UNKNOWN')
        }
        for name in names - self._responses.keys():
            if name not in self._clients:
                service = f'{name}/get_parameters'
                self._clients[name] = self._node.create_client(GetParameters, service)
            if self._clients[name].service_is_ready():
                self._responses[name] = self._clients[name].call_async(GetParameters.Request())
        responses = [self._responses[name] for name in names if name in self._responses]
        seconds = time.monotonic() - self._start
        if not all(response.done() for response in responses):
            return seconds > self._timeout
        return (bool(names) and len(responses) == len(names)) or seconds > SERVICE_SECONDS
