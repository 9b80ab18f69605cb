# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The state of a place-recognition node for the monitor's page, and the commands to it."""

import base64
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
import math
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Path
import numpy as np
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import CompressedImage, Image
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_msgs.srv import SetOperation
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.qos import LATCHED
from std_srvs.srv import Trigger

MAX_SAMPLES = 3000  # samples: four minutes
SAMPLE_SECONDS = 0.08  # minimum time between two samples
STALE_SECONDS = 3.0  # without an answer of the node: its state is unknown
POLL_SECONDS = 0.5  # for the state of the node, and whether images are needed
ROUTE_POINTS = 1000  # points of the map's route that are drawn, at most
COLUMN_BYTES = 8  # bytes of a column of ``~/distances``: a distance and its place, float32
TIMEOUT = 30.0  # seconds for a command: configuring loads the map
STATUSES = (
    *('warming up', 'no match', 'match', 'invalid image'),
    *('not ready', 'dropped', 'skipped', 'mapped'),
)
"""Names of the constants of PlaceMatch; Status has them too, but imports numba."""
LEFT_OUT = ('dropped', 'skipped')  # statuses that say nothing on the place
WITH_ROW = {PlaceMatch.WARMING_UP, PlaceMatch.NO_MATCH, PlaceMatch.MATCH}
LEVELS = ('ok', 'warn', 'error', 'stale')


class History:
    """
    The data of the page, each part with the number of its last change; any thread may use it.

    :param sample_seconds: minimum time between two samples.
    """

    def __init__(self, sample_seconds: float = SAMPLE_SECONDS) -> None:
        self._changed = threading.Condition()
        self._version = 0
        self._parts: dict[str, tuple[int, Any]] = {}
        self._samples: deque[tuple[int, dict[str, Any]]] = deque(maxlen=MAX_SAMPLES)
        self._sample_seconds, self._last = sample_seconds, -math.inf
        self.image = b''  # the last match image, JPEG
        self.viewers = 0  # pages that are open
        self.closed = False

    @contextmanager
    def viewer(self) -> Iterator[None]:
        """Count a page while the block runs."""
        with self._changed:
            self.viewers += 1
        try:
            yield
        finally:
            with self._changed:
                self.viewers -= 1

    def set(self, name: str, value: Any) -> None:
        """Replace a part if it has changed."""
        value = for_json(value)
        with self._changed:
            if name not in self._parts or self._parts[name][1] != value:
                self._version += 1
                self._parts[name] = self._version, value
                self._changed.notify_all()

    def add(self, sample: dict[str, Any]) -> None:
        """Add a sample, unless the last one was just before, of an image that was matched too."""
        with self._changed:
            now, last = time.monotonic(), self._samples[-1][1] if self._samples else {}
            is_hidden = last.get('status') in LEFT_OUT and sample.get('status') not in LEFT_OUT
            if is_hidden or now - self._last >= self._sample_seconds:
                self._last = now
                self._version += 1
                self._samples.append((self._version, for_json(sample)))
                self._changed.notify_all()

    def show(self, image: bytes) -> None:
        """Replace the match image; its part is when it arrived."""
        self.image = image
        self.set('image', time.monotonic())

    def since(self, version: int, timeout: float) -> tuple[int, dict[str, Any]]:
        """Return the newest version and all changes since one; wait until there are any."""
        with self._changed:
            self._changed.wait_for(lambda: self._version > version or self.closed, timeout)
            changes: dict[str, Any] = {
                name: value for name, (number, value) in self._parts.items() if number > version
            }
            changes['samples'] = [sample for number, sample in self._samples if number > version]
            return self._version, changes

    def close(self) -> None:
        """Wake all that wait."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()


class Monitor:
    """
    Subscribes to the topics of a place-recognition node and calls its services.

    :param node: node of this process, spun by the caller.
    :param name: name of the place-recognition node; relative names are in the namespace.
    """

    def __init__(self, node: Node, name: str, history: History) -> None:
        self._node, self._name, self.history = node, name, history
        self._full_name = node.resolve_topic_name(name)
        self._row = ''  # distances of the last image
        self._span = 0.0, 1.0  # place at the start of its first column, and at the end of the last
        self._places = 0
        self._images: Subscription | None = None
        self._state_request: tuple[Future, float] | None = None
        reliable = QoSProfile(depth=50)
        for kind, topic, receive, qos in (
            (PlaceMatch, f'{name}/match', self._on_match, reliable),
            (Image, f'{name}/distances', self._on_distances, reliable),
            (MapInfo, f'{name}/map_info', self._on_map_info, LATCHED),
            (Path, f'{name}/map_path', self._on_route, LATCHED),
            (PoseWithCovarianceStamped, f'{name}/pose', self._on_pose, reliable),
            (DiagnosticArray, '/diagnostics', self._on_diagnostics, reliable),
        ):
            node.create_subscription(kind, topic, receive, qos)
        self._get_state = node.create_client(GetState, f'{name}/get_state')
        self._change_state = node.create_client(ChangeState, f'{name}/change_state')
        self._set_operation = node.create_client(SetOperation, f'{name}/set_operation')
        self._reset = node.create_client(Trigger, f'{name}/reset')
        history.set('node', self._full_name)
        history.set('state', 'not found')
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # also without /clock
        node.create_timer(POLL_SECONDS, self._poll, clock=steady)

    # commands, on threads of the server

    def command(self, name: str, value: str) -> str:
        """
        Run a command of the page: ``start``, ``stop``, ``reset``, or ``operation`` with a value.

        :returns: a message for the user.
        :raises StavprError: it failed; the reason.
        """
        if name == 'start':
            if self._state() == 'unconfigured':
                self._transition(Transition.TRANSITION_CONFIGURE, 'configure')
            return self._transition(Transition.TRANSITION_ACTIVATE, 'activate')
        if name == 'stop':
            return self._transition(Transition.TRANSITION_DEACTIVATE, 'deactivate')
        if name == 'reset':
            return self._call(self._reset, Trigger.Request())
        if name == 'operation':
            return self._call(self._set_operation, SetOperation.Request(operation=value))
        raise StavprError(f'command {name!r}: expected start, stop, reset or operation')

    def _state(self) -> str:
        return str(self._response(self._get_state, GetState.Request()).current_state.label)

    def _transition(self, number: int, name: str) -> str:
        request = ChangeState.Request(transition=Transition(id=number))
        if not self._response(self._change_state, request).success:
            raise StavprError(f'{name} failed: see the diagnostics for the reason')
        return f'{name}: done'

    def _call(self, client: Client, request: Any) -> str:
        response = self._response(client, request)
        if not response.success:
            raise StavprError(response.message)
        return str(response.message)

    def _response(self, client: Client, request: Any) -> Any:
        if not client.service_is_ready():
            raise StavprError(f'{self._full_name} is not running: no service {client.srv_name}')
        event, future = threading.Event(), client.call_async(request)
        future.add_done_callback(lambda _: event.set())
        if not event.wait(TIMEOUT):
            client.remove_pending_request(future)
            raise StavprError(f'{client.srv_name} did not respond within {TIMEOUT:g} s')
        return future.result()

    # topics, on the executor

    def _poll(self) -> None:
        """Request the state of the node; subscribe to images while somebody looks."""
        is_watched = self.history.viewers > 0
        if is_watched and self._images is None:
            self._images = self._node.create_subscription(
                CompressedImage, f'{self._name}/match_image/compressed', self._on_image, 1
            )
        elif not is_watched and self._images is not None:
            self._node.destroy_subscription(self._images)
            self._images = None
        if not self._get_state.service_is_ready():
            self.history.set('state', 'not found')
            return
        if self._state_request is not None:
            future, began = self._state_request
            if not future.done() and time.monotonic() - began < TIMEOUT:
                if time.monotonic() - began > STALE_SECONDS:
                    self.history.set('state', 'no answer')
                return
            self._get_state.remove_pending_request(future)
        future = self._get_state.call_async(GetState.Request())
        future.add_done_callback(self._on_state)
        self._state_request = future, time.monotonic()

    def _on_state(self, future: Future) -> None:
        if (response := future.result()) is not None:
            self.history.set('state', response.current_state.label)

    def _on_match(self, message: PlaceMatch) -> None:
        self.history.add(
            {
                'time': time.monotonic(),
                'status': dict(enumerate(STATUSES)).get(message.status, 'unknown'),
                'reason': message.reason,
                'place': message.newest_index,
                'nearest': message.sequence_middle,
                'probability': message.probability,
                'distance': message.distance,
                'threshold': message.threshold,
                'places': self._places,
                # of the image before, where the messages have overtaken each other
                'row': self._row if message.status in WITH_ROW else '',
                'span': self._span,
            }
        )

    def _on_distances(self, message: Image) -> None:
        size = len(message.data)
        if not size or size % COLUMN_BYTES:
            return
        distances, places = np.frombuffer(message.data, np.float32).reshape(-1, 2).T
        self._row, self._span = encode_row(distances), span_of(places)

    def _on_map_info(self, message: MapInfo) -> None:
        self._places = message.places
        names = ('operation', 'state', 'path', 'places', 'features')
        self.history.set('map', {name: getattr(message, name) for name in names})

    def _on_route(self, message: Path) -> None:
        step = math.ceil(len(message.poses) / ROUTE_POINTS) or 1
        points = [stamped.pose.position for stamped in message.poses[::step]]
        self.history.set('route', [[round(p.x, 3), round(p.y, 3)] for p in points])

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        position, turn = message.pose.pose.position, message.pose.pose.orientation
        yaw = math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
        self.history.set('pose', [position.x, position.y, yaw, time.monotonic()])

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        own = [
            {
                'name': status.name,
                'level': LEVELS[min(ord(status.level), 3)],
                'message': status.message,
                'values': [[pair.key, pair.value] for pair in status.values],
            }
            for status in message.status
            if self._full_name.strip('/') in status.name
        ]
        if own:
            self.history.set('diagnostics', {'time': time.monotonic(), 'statuses': own})

    def _on_image(self, message: CompressedImage) -> None:
        self.history.show(bytes(message.data))


def span_of(places: np.ndarray) -> tuple[float, float]:
    """Return where a row begins and ends, from the first place of each column."""
    first, last = float(places[0]), float(places[-1])
    return first, last + max((last - first) / max(len(places) - 1, 1), 1)


def encode_row(row: np.ndarray) -> str:
    """
    Return distances as base64 of bytes: 0 = the least, 255 = the median, or above, or none.

    :param row: shape (m,), float32.
    """
    finite = row[np.isfinite(row)]
    if not finite.size:
        return base64.b64encode(bytes([255]) * row.size).decode()
    low, middle = finite.min(), np.median(finite)
    levels = np.clip((row - low) / max(middle - low, 1e-9), 0, 1) * 255
    return base64.b64encode(levels.astype(np.uint8)).decode()


def for_json(value: Any) -> Any:
    """Return a value for JSON, which has no NaN and no infinity: None instead."""
    if isinstance(value, dict):
        return {key: for_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [for_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
