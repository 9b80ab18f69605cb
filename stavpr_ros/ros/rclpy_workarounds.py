# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Workarounds for rclpy and rmw_fastrtps of ROS 2 Jazzy, each with the upstream change to wait for.

The tests of this module also show the failure of each without its workaround: such a test fails
when upstream is fixed, and the workaround can go.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, ExitStack, suppress
import os
from pathlib import Path
import sys
import threading
import time
import traceback
from typing import Any
import warnings

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import Executor, ShutdownException, TimeoutException
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, TransitionCallbackReturn
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service
from rclpy.subscription import Subscription
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.regular_file import home_folder

RECEIVER_POLL = 10**9  # nanoseconds until a receiver detects the end of the process
END_POLL = 0.01  # seconds until a receiver is noticed to call back
START_POLL = 0.0005  # seconds between two checks whether a thread has begun a callback
RESPONSE_LOST = 'failed to send response'  # part of rclpy's warning
RESPONSE_TIMEOUT = 3.5  # seconds of attempts; callbacks have a little more when the process ends
# seconds between attempts; an attempt takes 0.1 s and blocks all other threads
RESPONSE_PAUSE = 0.05


@contextmanager
def until_shutdown(node: Node) -> Iterator[None]:
    """Ignore errors of the middleware if ROS was shut down before the node."""
    try:
        yield
    except rclpy_implementation.RCLError:
        if node.context.ok():
            raise


@contextmanager
def ros_arguments_checked() -> Iterator[None]:
    """
    Raise invalid arguments after ``--ros-args`` as SettingsError, and a missing log directory.

    No upstream issue was found: rclpy has no public names for these exceptions.

    :raises UnavailableError: the log directory cannot be written.
    """
    try:
        yield
    except (
        rclpy_implementation.RCLError,
        rclpy_implementation.RCLInvalidROSArgsError,
        rclpy_implementation.UnknownROSArgsError,
    ) as error:
        if 'initialize logging' in str(error):
            raise UnavailableError(
                f'the log directory {_log_folder()} cannot be written: set ROS_LOG_DIR to a '
                'folder that can be'
            ) from error
        raise SettingsError(f'the arguments after --ros-args are invalid: {error}') from error


def _log_folder() -> Path:
    home = os.environ.get('ROS_HOME') or home_folder() / '.ros'
    return Path(os.path.expanduser(os.environ.get('ROS_LOG_DIR') or Path(home) / 'log'))


def with_log_files(arguments: list[str]) -> list[str]:
    """
    Return arguments of ``rclpy.init``; without files of a log where none can be written.

    No upstream issue was found: on a read-only system, ``rclpy.init`` raises a RuntimeError.
    """
    folder = _log_folder()
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    if os.access(folder, os.W_OK):
        return arguments
    print(f'no log is written to {folder}: set ROS_LOG_DIR to change it', file=sys.stderr)
    return [*arguments, '--ros-args', '--disable-external-lib-logs']


_warning_filters = threading.Lock()  # they belong to the process


class ReceivedGroup(CallbackGroup):
    """Group of the subscription of a :class:`Receiver`: no executor waits for it or its events."""

    def can_execute(self, entity: Any) -> bool:
        """Return whether an executor may call the callback of an entity."""
        return False


class Receiver(threading.Thread):
    """
    Calls the callbacks of a subscription, until it is destroyed.

    No upstream change is known: each wake-up of an executor collects all entities of its nodes
    again, three times for a message, and each message wakes it up that waits for an event of the
    subscription. The wait set of this thread has the subscription, its events, and the end.

    :param subscription: in a :class:`ReceivedGroup`. Errors of its callbacks are logged.
    """

    def __init__(self, subscription: Subscription, context: Context) -> None:
        super().__init__(name='receiver', daemon=True)
        self._subscription, self._context = subscription, context
        self._guard = GuardCondition(None, None, context=context)
        self._ended = self._calls = False
        self._destroy, subscription.destroy = subscription.destroy, self.end
        context.on_shutdown(self._guard.trigger)
        self.start()

    def end(self) -> None:
        """Destroy the subscription, after a callback in progress, which is not waited for."""
        self._ended = True
        self._destroy()  # deferred until the thread has ended
        self._guard.trigger()
        while self.is_alive() and not self._calls:
            self.join(END_POLL)

    def run(self) -> None:
        """Wait for messages and events."""
        context, handle = self._context, self._subscription.handle
        kind, events = self._subscription.msg_type, self._subscription.event_handlers
        callback = self._subscription.callback
        if self._subscription._callback_type is Subscription.CallbackType.MessageOnly:
            callback = lambda message, info: self._subscription.callback(message)  # noqa: E731
        with suppress(rclpy_implementation.InvalidHandle), ExitStack() as stack:
            for entity in (handle, self._guard.handle, *events, context.handle):
                stack.enter_context(entity)  # it may be destroyed already
            wait_set = rclpy_implementation.WaitSet(1, 1, 0, 0, 0, len(events), context.handle)
            # an interpreter that ends must not meet this thread in a call of C++
            while not self._ended and context.ok() and threading.main_thread().is_alive():
                wait_set.clear_entities()
                wait_set.add_subscription(handle)
                wait_set.add_guard_condition(self._guard.handle)
                for event in events:
                    event.add_to_wait_set(wait_set)
                wait_set.wait(RECEIVER_POLL)
                for event in events:
                    if event.is_ready(wait_set) and (data := event.take_data()):
                        self._call(event.callback, data)
                if not self._ended and (message := handle.take_message(kind, False)):
                    self._call(callback, *message)
                    del message  # an image, until the next one

    def _call(self, callback: Callable[..., None], *arguments: Any) -> None:
        self._calls = True
        try:
            callback(*arguments)
        except Exception:
            log_failure(traceback.format_exc())
        self._calls = False


class PromptExecutor(Executor):
    """
    Multi-threaded executor that takes the next callback when a thread has begun the last one.

    Waits for ros2/rclpy#1547 (merged for later distributions): ``MultiThreadedExecutor`` submits a
    callback again and again until a thread has begun it, and does not wait for events meanwhile.
    Measured on two cores with images of 230 KB: at most 55 and 71 ms per result with
    ``MultiThreadedExecutor``, 12 and 13 ms here. A single thread would be as fast, but a service
    that loads a map would stop the images.

    Waits also for ros2/rclpy#1590 (issue #1355): an entity that another thread destroys while
    the executor collects its entities raises ``InvalidHandle`` out of ``spin_once``.

    Callbacks that raise are logged; upstream ends the process.

    :param threads: callbacks that may run at once.
    """

    def __init__(self, threads: int, **options: Any) -> None:
        super().__init__(**options)
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix='callback')
        self._running: set[Future[None]] = set()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Begin the next callback, if one is ready in time."""
        try:
            task, _, _ = self.wait_for_ready_callbacks(timeout_sec)
        except (ShutdownException, TimeoutException, rclpy_implementation.InvalidHandle):
            return
        future = self._pool.submit(_run, task)
        self._running = {other for other in self._running if not other.done()} | {future}
        while not (task.executing() or future.done()):
            time.sleep(START_POLL)

    def finish(self, timeout: float) -> None:
        """Wait for the callbacks that have begun, at most so many seconds."""
        wait(self._running, timeout)


def _run(task: Any) -> None:
    task()
    if task.done() and (error := task.exception()) is not None:
        log_failure(''.join(traceback.format_exception(error)))


def log_failure(text: str) -> None:
    """Log the traceback of a callback."""
    get_logger('stavpr_executor').error(f'a callback failed: {text}')


def repeat_responses(service: Service) -> None:
    """
    Make a service repeat a response until its client is matched.

    Waits for ros2/rmw_fastrtps#418: a request may arrive before the middleware has discovered the
    client's reader. rmw_fastrtps then drops the response after 0.1 s, and the client waits
    forever. A longer ``max_blocking_time`` in the profile (ros2/rmw_fastrtps#704) is no
    substitute: rclpy keeps the interpreter lock meanwhile.
    """
    send = service.send_response

    def send_repeatedly(response: Any, header: Any) -> None:
        end = time.monotonic() + RESPONSE_TIMEOUT
        while time.monotonic() < end:
            with _warning_filters, warnings.catch_warnings():
                warnings.filterwarnings('error', RESPONSE_LOST, RuntimeWarning)
                try:
                    return send(response, header)
                # the latter from C++, caused by the former
                except (RuntimeWarning, SystemError) as error:
                    if RESPONSE_LOST not in str(error.__cause__ or error):
                        raise
            time.sleep(RESPONSE_PAUSE)
        return send(response, header)  # rclpy warns if it fails again

    service.send_response = send_repeatedly


def respond_to_unreadable_parameters(service: Service) -> None:
    """
    Make the parameter services respond to values that rclpy cannot read, such as an unknown type.

    No upstream issue was found: the error leaves the callback, and the client waits forever.
    """
    upstream = service.callback
    if service.srv_type not in (SetParameters, SetParametersAtomically):
        return

    def callback(request: Any, response: Any) -> Any:
        try:
            return upstream(request, response)
        except Exception as error:
            reason = f'not set, nor any parameter after it ({type(error).__name__}: {error})'
            result = SetParametersResult(successful=False, reason=reason)
        if service.srv_type is SetParametersAtomically:
            response.result = result
        else:  # those before it are set
            response.results += [result] * (len(request.parameters) - len(response.results))
        return response

    service.callback = callback


class ManagedNode(LifecycleNodeMixin, Node):
    """
    Lifecycle node that rejects invalid transitions instead of ending the process.

    Waits for ros2/rclpy#1319 (issue #1209; merged for later distributions): a transition that the
    current state does not have raises out of the service and out of ``trigger_...``.

    Its services are reentrant, so that the state can be read during a transition; hence the lock
    against two transitions at once. ``LifecycleNode`` has no option for their callback group.
    """

    def __init__(self, name: str, **options: Any) -> None:
        Node.__init__(self, name, **options)
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        self._in_transition = threading.Lock()
        self.ending = threading.Event()  # set when the process ends: waits are given up
        self.left_behind = False  # work was still running when the node was destroyed
        self.failed = False  # something was not saved: the exit code is not 0
        self._destroyed = False
        service = self._service_change_state
        self._upstream_change_state = service.callback
        service.callback = self._change_or_reject
        for service in self.services:
            repeat_responses(service)
            respond_to_unreadable_parameters(service)

    @property
    def state(self) -> str:
        """Return the label of the life-cycle state; a destroyed node is finalized."""
        # the state machine of a destroyed node must not be read: the process would crash
        return 'finalized' if self._destroyed else str(self._state_machine.current_state[1])

    @property
    def parameter_overrides(self) -> dict[str, Parameter]:
        """
        Return the parameters that were given, declared or not, by name.

        No upstream issue was found: rclpy ignores those that no one declares, and has no public
        function that lists them.
        """
        return dict(self._parameter_overrides)

    def advance(self, trigger: Callable[[], TransitionCallbackReturn]) -> bool:
        """
        Make a transition, such as ``trigger_configure``; return whether it succeeded.

        An invalid one, or one during another, is logged and not made.
        """
        return self._run_transition(
            trigger.__name__, lambda: trigger() == TransitionCallbackReturn.SUCCESS
        )

    def destroy_node(self) -> None:
        """
        Destroy the node and the services of its life cycle.

        No upstream issue was found: rclpy leaves these services to the garbage collector, and
        until then other nodes discover them and send requests that nobody answers.
        """
        self._destroyed = True
        if not self.left_behind:  # otherwise a transition may still be running
            self._state_machine.destroy_when_not_in_use()
        super().destroy_node()

    def _change_or_reject(self, request: Any, response: Any) -> Any:
        transition = request.transition.label or request.transition.id
        response.success = self._run_transition(
            transition, lambda: self._upstream_change_state(request, response).success
        )
        return response

    def _run_transition(self, transition: str | int, change: Callable[[], bool]) -> bool:
        if self._destroyed:  # a timer may have been due; the state machine must not be used
            return False
        if not self._in_transition.acquire(blocking=False):
            self.get_logger().warning(
                f'transition {transition!r} rejected: another is under way ({self.state})'
            )
            return False
        try:
            return change()
        except rclpy_implementation.RCLError as error:
            self.get_logger().error(
                f'no transition {transition!r} from state {self.state}: {error}'
            )
            return False
        finally:
            self._in_transition.release()
