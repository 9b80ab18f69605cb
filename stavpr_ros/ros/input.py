# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The subscription to images, and the worker: one thread does the heavy work."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, InvalidStateError, wait
from contextlib import suppress
from dataclasses import dataclass
import threading
import time
import traceback
from typing import Any, TypeVar

from rclpy.logging import get_logger
from rclpy.qos import qos_check_compatible, QoSCompatibility
from sensor_msgs.msg import CompressedImage, Image
from stavpr_ros.errors import StavprError
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.statistics import StampWatch, Statistics
from stavpr_ros.ros.output import nanoseconds
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.ros.subscriptions import AdaptiveSubscription, qos_remedy
from stavpr_ros.signals import time_left
from stavpr_ros.units import SECOND

STOP_TIMEOUT = 3.0  # seconds for the work in progress at the end
QUEUE = 10  # images in the middleware while the executor is busy
END_POLL = 0.2  # seconds until a waiting caller detects the end of the node

Result = TypeVar('Result')


@dataclass(frozen=True)
class InputStatus:
    """The topic of the images and its publishers."""

    topic: str = ''  # after remapping
    publishers: int = 0  # of any QoS and type
    incompatible: int = 0  # not received because of their QoS
    mistyped: str = ''  # other message types on the topic
    remedy: str = ''  # for the incompatible publishers
    loss_remedy: str = ''  # for lost images
    reliability: str = ''  # of the subscription, with the reason


class ImageInput:
    """
    The subscription to images.

    :param settings: transport, maximum rate, and the longest gap of stamps.
    :param statistics: counts images, gaps, jumps and losses.
    :param enqueue: called with a message and its time of arrival, seconds.
    :param reject: called with a message that exceeds ``max_rate``, and the reason.
    :param restart: called with the reason when the next images do not continue those before.

    ``topic`` is the resolved topic, ``remedy`` the remedy for the last incompatible publisher, ''
    = none.
    """

    def __init__(
        self,
        node: ManagedNode,
        settings: NodeSettings,
        statistics: Statistics,
        enqueue: Callable[[Any, float], None],
        reject: Callable[[Any, str], None],
        restart: Callable[[str], None],
    ) -> None:
        self._node, self._statistics = node, statistics
        self._enqueue, self._reject, self._restart = enqueue, reject, restart
        self.stamps = StampWatch(settings.max_stamp_gap)
        self.max_rate = settings.max_rate
        self.remedy = ''
        self._last: float | None = None  # seconds, of the last image within the rate
        self._lock = threading.Lock()  # close() waits for the image of another thread
        self._closed = False
        # as in image_transport, the compressed topic is below the one that `image` is remapped to
        compressed = node.resolve_topic_name('image') + '/compressed'
        kinds = {'raw': (Image, 'image'), 'compressed': (CompressedImage, compressed)}
        message_type, name = kinds[settings.image_transport]
        self._type = f'sensor_msgs/msg/{message_type.__name__}'
        self.topic = node.resolve_topic_name(name)  # before events, which come on another thread
        self._subscription = AdaptiveSubscription(
            node,
            message_type,
            name,
            QUEUE,
            self.on_image,
            lambda count: statistics.dropped('lost in transport', count),
            self._on_refused,
        )

    def status(self) -> InputStatus:
        """Return the topic and its publishers, for the diagnostics."""
        subscription = self._subscription
        subscription.follow()
        infos = self._node.get_publishers_info_by_topic(self.topic)
        incompatible = sum(
            qos_check_compatible(info.qos_profile, subscription.qos)[0] == QoSCompatibility.ERROR
            for info in infos
            if info.topic_type == self._type
        )
        # the middleware does not report other types
        mistyped = ', '.join(sorted({info.topic_type for info in infos} - {self._type}))
        return InputStatus(
            self.topic,
            len(infos),
            incompatible,
            mistyped,
            self.remedy,
            subscription.loss_remedy,
            subscription.choice,
        )

    def close(self) -> None:
        """Unsubscribe from images, including one that another thread has just taken."""
        with self._lock:
            self._closed = True
        self._subscription.close()

    def _on_refused(self, policy: str) -> None:
        self.remedy = qos_remedy(self.topic, policy)
        self._node.get_logger().error(f'images are not received: {self.remedy}')

    def on_image(self, message: Any) -> None:
        """Enqueue an image, or reject it for its rate; the callback of the subscription."""
        with self._lock:
            if self._closed:
                return
            arrival = time.monotonic()
            self._statistics.received()
            stamp = nanoseconds(message.header.stamp)
            ahead, missing = self.stamps.update(stamp)
            self._statistics.stepped(ahead, missing)
            if ahead < 0:
                self._last = None
                self._restart(f'the stamps of the images jumped back by {-ahead:.3f} s')
            if reason := self._exceeds_rate(stamp, arrival):
                self._reject(message, reason)
            else:
                self._enqueue(message, arrival)

    def _exceeds_rate(self, stamp: int, arrival: float) -> str:
        """Return why an image exceeds ``max_rate``, by stamps, or by arrival without them."""
        if not self.max_rate:
            return ''
        now, last = stamp / SECOND if stamp else arrival, self._last
        # a tolerance of a tenth of the period: a camera of exactly this rate has jitter; an image
        # that was overtaken in transport, and has an earlier stamp, must not restart the count
        if last is not None and abs(now - last) < 0.9 / self.max_rate:
            return (
                f'{now - last:.3f} s after the last image: exceeds max_rate = {self.max_rate:g} Hz'
            )
        self._last = now
        return ''


class Worker:
    """
    A thread that processes items; when the queue is full, the oldest item is dropped.

    Calls, such as a change of the map, run on the same thread before the next item: objects that
    the thread owns need no lock.

    :param ending: set when callers must not wait any longer.
    """

    def __init__(
        self, process: Callable[[Any], None], capacity: int, ending: threading.Event
    ) -> None:
        self._process, self._capacity, self._ending = process, capacity, ending
        self._items: deque[Any] = deque()
        self._calls: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._running: Future[Any] | None = None
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name='recognition', daemon=True)
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
