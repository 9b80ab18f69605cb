"""An executor that is never held up: services run on threads of their own, all else where it spins."""

import time
import traceback
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import Executor, ShutdownException, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import get_logger
from rclpy.service import Service

START = 0.0005  # seconds between two looks whether a thread has begun


class SlowCallbackGroup(MutuallyExclusiveCallbackGroup):
    """Callbacks that take their time, and get a thread."""


class ServiceThreadsExecutor(Executor):
    """
    Calls services, and callbacks of a :class:`SlowCallbackGroup`, on threads; everything else on its own.

    rclpy's MultiThreadedExecutor hands every callback over, and hands it over again and again until a
    thread has begun it: with images at the pace of their answers, answers took 100 to 900 ms instead of 2.

    :param threads: for what takes its time.
    """

    def __init__(self, threads: int, **options: Any) -> None:
        super().__init__(**options)
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix='service')
        self._running: set[Future[None]] = set()

    @property
    def busy(self) -> bool:
        """Something is under way on a thread."""
        self._running = {future for future in self._running if not future.done()}
        return bool(self._running)

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run the next callback, if one is ready in time."""
        try:
            task, entity, _ = self.wait_for_ready_callbacks(timeout_sec)
        except (ShutdownException, TimeoutException, rclpy_implementation.InvalidHandle):
            return  # the last: a thread has destroyed something just now, and rclpy stumbles over it
        group = getattr(entity, 'callback_group', None)
        if not (isinstance(entity, Service) or isinstance(group, SlowCallbackGroup)):
            _run(task)
            return
        future = self._pool.submit(_run, task)
        self._running = {other for other in self._running if not other.done()} | {future}
        while not (task.executing() or future.done()):  # else it would come again
            time.sleep(START)


def _run(task: Any) -> None:
    task()
    error = task.exception() if task.done() else None
    if error is not None:
        said = ''.join(traceback.format_exception(error))
        get_logger('stavpr_executor').error(f'a callback failed: {said}')
