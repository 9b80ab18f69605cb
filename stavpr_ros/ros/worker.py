# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Threads of a node: the worker does the heavy work, behind a queue that drops its oldest item.

A beat acts again and again, whatever the executor and the recognition are busy with.
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, InvalidStateError, wait
from contextlib import suppress
import threading
import traceback
from typing import Any, TypeVar

from rclpy.logging import get_logger
from rclpy.node import Node
from stavpr_ros.errors import StavprError
from stavpr_ros.ros import REPORT_PERIOD
from stavpr_ros.signals import time_left

STOP_TIMEOUT = 3.0  # seconds for the work in progress at the end
END_POLL = 0.2  # seconds until a waiting caller detects the end of the node

Result = TypeVar('Result')


class Worker:
    """
    A thread that processes items; when the queue is full, the oldest item is dropped.

    Calls, such as a change of the map, run on the same thread before the next item: objects that
    the thread owns need no lock.

    :param ending: set when callers must not wait any longer.
    :param name: of the thread.
    """

    def __init__(
        self,
        process: Callable[[Any], None],
        capacity: int,
        ending: threading.Event,
        name: str = 'recognition',
    ) -> None:
        self._process, self._capacity, self._ending = process, capacity, ending
        self._items: deque[Any] = deque()
        self._calls: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._running: Future[Any] | None = None
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Return the number of waiting items."""
        return len(self._items)

    def put(self, item: Any) -> Any | None:
        """Enqueue an item; return the item that was dropped for it, if any."""
        with self._changed:
            dropped = self._items.popleft() if len(self._items) >= self._capacity else None
            self._items.append(item)
            self._changed.notify()
        return dropped

    def clear(self) -> list[Any]:
        """Remove the waiting items and return them."""
        with self._changed:
            items = list(self._items)
            self._items.clear()
        return items

    def call(self, function: Callable[[], Any]) -> Future[Any]:
        """Call a function on the thread; after :meth:`stop`, the future is cancelled."""
        future: Future[Any] = Future()
        with self._changed:
            if self._stopping:
                future.cancel()
            else:
                self._calls.append((future, function))
                self._changed.notify()
        return future

    def run(self, function: Callable[[], Result]) -> Result:
        """
        Call a function on the thread and return its result.

        :raises StavprError: the thread was stopped, or the node ends, before the call is done.
        """
        future = self.call(function)
        while not future.done():
            wait([future], END_POLL)
            if self._ending.is_set() and not future.done():
                raise StavprError('the node ends')
        try:
            return future.result()
        except CancelledError:
            raise StavprError('the node is no longer configured') from None
        except TimeoutError as error:  # abandoned by stop()
            raise StavprError(str(error)) from error

    def stop(self) -> bool:
        """
        Finish the work in progress, cancel the rest, and end the thread or abandon it.

        :returns: whether the thread has ended.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(time_left(STOP_TIMEOUT))
        for future, _ in self._calls:
            future.cancel()
        if self._thread.is_alive() and self._running is not None and not self._running.done():
            self._running.set_exception(
                TimeoutError(f'the node ended; not done within {STOP_TIMEOUT:g} s')
            )
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopping or self._items or self._calls)
                if self._stopping:
                    return
                call = self._calls.popleft() if self._calls else None
                item = None if call else self._items.popleft()
            if call is not None:
                self._call(*call)
                call = None  # its result may be a map, and nothing may come for long
                continue
            try:
                self._process(item)
            except Exception:  # must not end the thread, and with it all later items
                get_logger('stavpr_worker').error(f'an item was lost: {traceback.format_exc()}')

    def _call(self, future: Future[Any], function: Callable[[], Any]) -> None:
        self._running = future
        with suppress(InvalidStateError):  # stop() has abandoned the call
            try:
                future.set_result(function())
            except Exception as error:
                future.set_exception(error)
        self._running = None


class Beat:
    """
    Calls a function every period, on the steady clock, from now on: a paused bag does not stop it.

    :param node: it logs errors; the next call may succeed.
    :param period: seconds.
    :param name: of the thread, and of what an error prevents.
    """

    def __init__(self, node: Node, period: float, act: Callable[[], object], name: str) -> None:
        self._node, self._period, self._act = node, period, act
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread, after a call in progress."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(self._period):
            try:
                self._act()
            except Exception as error:
                self._node.get_logger().error(
                    f'no {self._thread.name}: {type(error).__name__}: {error}',
                    throttle_duration_sec=REPORT_PERIOD,
                )
