"""One thread does the heavy work; callbacks only hand over."""

import threading
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from rclpy.logging import get_logger

PATIENCE = 3.0  # seconds for what is in work when the thread is stopped: `ros2 launch` loses its own after 5


class Worker:
    """
    A thread that works on items, newest kept: when the slot is full, the oldest item is dropped.

    Calls, such as using a map, are run by the same thread, before the next item: whatever the thread
    owns needs no lock.

    :param process: called with each item.
    :param capacity: items that may wait.
    """

    def __init__(self, process: Callable[[Any], None], capacity: int) -> None:
        self._process = process
        self._capacity = capacity
        self._items: deque[Any] = deque()
        self._calls: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._running: Future[Any] | None = None
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name='recognition', daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Items that wait."""
        return len(self._items)

    def put(self, item: Any) -> Any | None:
        """Hand over an item; return the item that was dropped for it, if any."""
        with self._changed:
            dropped = self._items.popleft() if len(self._items) >= self._capacity else None
            self._items.append(item)
            self._changed.notify()
        return dropped

    def clear(self) -> list[Any]:
        """Drop the items that wait, and return them."""
        with self._changed:
            items = list(self._items)
            self._items.clear()
        return items

    def call(self, function: Callable[[], Any]) -> Future[Any]:
        """Have the thread call a function; the future holds what came of it, cancelled after the end."""
        future: Future[Any] = Future()
        with self._changed:
            if self._stopping:
                future.cancel()
            else:
                self._calls.append((future, function))
                self._changed.notify()
        return future

    def stop(self) -> bool:
        """
        Finish what is in work, drop the rest, end the thread; what takes too long is left to itself.

        :returns: whether the thread has ended.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(PATIENCE)
        for future, _ in self._calls:
            future.cancel()
        if self._thread.is_alive() and self._running is not None and not self._running.done():
            self._running.set_exception(TimeoutError(f'the node ended; not done within {PATIENCE:g} s'))
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopping or self._items or self._calls)
                if self._stopping:
                    return
                call = self._calls.popleft() if self._calls else None
                item = None if call else self._items.popleft()
            if call is None:
                self._process_safely(item)
            else:
                self._call(*call)

    def _call(self, future: Future[Any], function: Callable[[], Any]) -> None:
        self._running = future
        try:
            result, error = function(), None
        except Exception as raised:  # handed to whoever asked
            result, error = None, raised
        self._running = None
        if future.done():  # given up meanwhile
            return
        if error is None:
            future.set_result(result)
        else:
            future.set_exception(error)

    def _process_safely(self, item: Any) -> None:
        """Nothing that one item does may end the thread, which would end all that come after."""
        try:
            self._process(item)
        except Exception:
            get_logger('stavpr_worker').error(f'an item was lost: {traceback.format_exc()}')
