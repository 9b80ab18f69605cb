# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node that drives along a taught route: images and matches in, offsets and velocities out."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import fields
from functools import lru_cache
import math
import os
import threading
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from stavpr_msgs.action import Repeat
from stavpr_msgs.msg import Offset as OffsetMessage
from stavpr_msgs.msg import PlaceMatch
from stavpr_nav.driver import DEADMAN_AGE, Driver, Goal, Outcome
from stavpr_nav.evidence import ImageComparison, OdometryComparison
from stavpr_nav.follower import Command, FollowerSettings
from stavpr_nav.observation import Observation
from stavpr_nav.parameters import REPEAT
from stavpr_nav.taught_run import positions, read_velocities, taught_places, taught_run
from stavpr_ros.errors import ImageError, InputError, SettingsError, StavprError
from stavpr_ros.mapping import open_map
from stavpr_ros.mapping.camera import FORWARD
from stavpr_ros.relative_pose.expansion import Expansion
from stavpr_ros.relative_pose.offset import describe_columns, Offset, OffsetFilter
from stavpr_ros.ros.diagnostics import one_status
from stavpr_ros.ros.messages import camera_of, nanoseconds, pose_array
from stavpr_ros.ros.rclpy_workarounds import log_failure
from stavpr_ros.ros.sensors import camera_info_topic
from stavpr_ros.sources.encodings import decode_message
from stavpr_ros.units import SECOND
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

PARAMETERS = REPEAT
READ_ONLY = ParameterDescriptor(read_only=True)
PERIOD, FEEDBACK = 0.05, 4  # s of the control; its steps of one feedback
MAX_WAITING = 20  # images and matches that wait for each other
CLOCK_IS_STILL = 'the clock does not advance'
STATUSES = (  # SKIPPED: no keyframe, as of a robot at rest; it is at the expected place
    PlaceMatch.WARMING_UP,
    PlaceMatch.NO_MATCH,
    PlaceMatch.MATCH,
    SKIPPED := PlaceMatch.SKIPPED,
)


class RepeatNode(Node):
    """
    Serves the action ``repeat``, and publishes ~/offset of each image whose place is known.

    One thread registers images against their places; callbacks hand over, and a timer of the
    steady clock publishes the velocities while there is a goal.

    :raises StavprError: an invalid parameter, map or run.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('repeat', **options)
        values = {
            name: self.declare_parameter(name, default, READ_ONLY).value
            for name, (default, _) in PARAMETERS.items()
        }
        self._settings = FollowerSettings(
            **{field.name: float(values[field.name]) for field in fields(FollowerSettings)}
        )
        if not (math.isfinite(values['give_up_after']) and values['give_up_after'] >= 0):
            raise SettingsError(f'give_up_after = {values["give_up_after"]}: expected 0 or more s')
        transport = values['image_transport'] or 'raw'
        if transport not in ('raw', 'compressed'):
            raise SettingsError(f'image_transport = {transport!r}: expected raw or compressed')
        self._give_up_after = float(values['give_up_after'])
        self._needs_deadman, self._base = values['require_deadman'], values['base_frame']
        self._load(*map(os.path.expanduser, (values['map_path'], values['run_path'])))
        self._columns = lru_cache(32)(self._columns_of)
        self._expansion = Expansion(self._columns, self._run.distances)
        self._filter, self._focal = OffsetFilter(), math.nan
        blank = describe_columns(np.zeros((48, 64, 3), np.uint8))
        self._filter.update(blank, blank)  # compiles its kernels
        self._filter.reset()
        self._lock = threading.Condition()
        self._images: dict[int, Any] = {}
        self._matches: dict[int, PlaceMatch] = {}
        self._next: tuple[Any, PlaceMatch] | None = None
        self._driver: Driver | None = None
        self._is_blocked = False  # the last drive ended without evidence of motion
        self._comparison = ImageComparison()
        self._odometry: OdometryComparison | None = None
        self._clock_times: deque[float] = deque(maxlen=1 + round(DEADMAN_AGE / PERIOD))
        self._handle: Any = None
        self._ended: Future | None = None
        self._steps, self.is_ending = 0, False
        self.counts: Counter[str] = Counter()
        kind: Any = TwistStamped if values['stamped'] else Twist
        self._velocity = self.create_publisher(kind, 'cmd_vel', 10)
        self._offset = self.create_publisher(OffsetMessage, '~/offset', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._subscribe(values, transport)
        self._worker = threading.Thread(target=self._work, daemon=True, name='offset')
        self._worker.start()
        self._server = ActionServer(
            self, Repeat, 'repeat', self._execute,
            goal_callback=self._on_goal, cancel_callback=self._on_cancel,
            handle_accepted_callback=self._on_accepted,
        )  # fmt: skip
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD, self._control, clock=steady)
        self.create_timer(1.0, self._publish_diagnostics, clock=steady)
        self.get_logger().info(
            f'{len(self._taught)} places, {self._run.distances[-1]:.0f} m'
            f'{", closed" if self._run.seam is not None else ""}: waiting for a goal'
        )

    def _load(self, map_path: str, run_path: str) -> None:
        """Read the map and the taught run."""
        self._map = open_map(map_path)
        if not self._map.thumbnails:
            raise InputError(f'{map_path} has no thumbnails: expected images of places')
        velocities, session = read_velocities(run_path) if run_path else (None, '')
        # places of the map by position along the run, and the reverse
        self._taught = taught_places(self._map, velocities, session)
        self._positions = positions(self._map, self._taught)
        self._run = taught_run(self._map, velocities, self._taught)

    def _subscribe(self, values: Mapping[str, Any], transport: str) -> None:
        images: tuple[Any, str] = (Image, 'image')
        if transport == 'compressed':
            images = CompressedImage, 'image/compressed'
        best_effort = qos_profile_sensor_data  # receives from reliable publishers as well
        self.create_subscription(*images, self._on_image, best_effort)
        self.create_subscription(PlaceMatch, values['match_topic'], self._on_match, 10)
        self.create_subscription(CameraInfo, camera_info_topic(self), self._on_camera, best_effort)
        self.create_subscription(Bool, 'deadman', self._on_deadman, best_effort)
        if values['use_odometry']:
            self._odometry = OdometryComparison(self._settings.max_speed)
            self.create_subscription(Odometry, 'odom', self._on_odometry, best_effort)
        self.create_service(Trigger, '~/start', self._on_start)

    def destroy_node(self) -> None:
        """Stop the robot, and end."""
        with self._lock:
            self.is_ending = True
            self._lock.notify()
            if self._driver is not None:
                self._driver = None
                self._publish(Command(0.0, 0.0))
        self._worker.join()
        self._server.destroy()
        super().destroy_node()

    def _now(self) -> float:
        return self.get_clock().now().nanoseconds / SECOND

    # images

    def _on_image(self, message: Any) -> None:
        self._pair(self._images, message)

    def _on_match(self, message: PlaceMatch) -> None:
        if message.status not in STATUSES:
            return
        if message.map_id != self._map.map_id:
            self.counts['matches on another map'] += 1
            self.get_logger().error(
                f'matches are on map {message.map_id}, this node has {self._map.map_id}: start '
                'both with the same file',
                throttle_duration_sec=10.0,
            )
            return
        self._pair(self._matches, message)

    def _pair(self, waiting: dict[int, Any], message: Any) -> None:
        """Hand an image and its match to the worker as soon as both are there."""
        stamp = nanoseconds(message.header.stamp)
        with self._lock:
            waiting[stamp] = message
            if stamp in self._images and stamp in self._matches:
                self.counts['replaced'] += self._next is not None
                self._next = self._images.pop(stamp), self._matches.pop(stamp)
                self._lock.notify()
            while len(waiting) > MAX_WAITING:
                waiting.pop(next(iter(waiting)))

    def _on_camera(self, message: CameraInfo) -> None:
        try:
            camera = camera_of(message, FORWARD)
        except InputError as error:
            self.get_logger().warning(f'camera_info is not used: {error}', once=True)
            return
        self._focal = camera.focal[0] / camera.width

    def _work(self) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._next is not None or self.is_ending)
                if self.is_ending:
                    return
                assert self._next is not None
                (image, match), self._next = self._next, None
            try:
                observation = self._observation(image, match)
            except StavprError as error:
                self.counts['invalid images'] += 1
                self.get_logger().warning(
                    f'an image is not used: {error}', throttle_duration_sec=10.0
                )
                continue
            except Exception:  # the robot stops, and the next image may be good
                self.counts['failed images'] += 1
                log_failure(traceback.format_exc())
                continue
            self.counts['processed'] += 1
            with self._lock:
                if self._driver is not None:
                    self._driver.observe(observation, self._now())

    def _observation(self, image: Any, match: PlaceMatch) -> Observation:
        """Return what an image shows; publish its offset where the place is known."""
        place, probability, offset = match.newest_index, match.probability, None
        pixels = decode_message(image)
        is_new = self._comparison.is_new(pixels)
        if match.status == PlaceMatch.MATCH:  # -1 = beside the taught run
            place = int(self._positions[place]) if 0 <= place < len(self._map) else -1
        else:
            probability = math.nan
        with self._lock:
            if self._driver is None:
                place = -1 if math.isnan(probability) else place
            elif math.isnan(probability) or not (is_new or self._driver.is_at_rest):
                place = self._driver.expected_place(is_new)
        if 0 <= place < len(self._taught):
            columns = describe_columns(pixels)
            offset = self._filter.update(columns, self._columns(place))
            lateral = self._expansion.lateral(offset, place, self._focal)
            index = self._place(place)
            self._offset.publish(offset_message(offset, lateral, image.header, self._focal, {
                'map_id': self._map.map_id, 'place_index': index, 'place_id': self._map.ids[index],
            }))  # fmt: skip
        else:
            place = -1
            self._filter.reset()
        stamp, is_compared = nanoseconds(image.header.stamp) / SECOND, match.status != SKIPPED
        return Observation(stamp, place, probability, offset, is_new, is_compared)

    def _columns_of(self, place: int) -> np.ndarray:
        thumbnail = self._map.thumbnail(self._place(place))
        if thumbnail is None:
            raise ImageError(f'place {place} has no thumbnail', kind='damaged')
        return describe_columns(thumbnail)

    # goals

    def _on_deadman(self, message: Bool) -> None:
        with self._lock:
            if self._driver is not None and message.data:
                self._driver.press(self._now())
            elif self._driver is not None:
                self._driver.release()

    def _on_start(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        with self._lock:
            answer.success = self._is_blocked if self._driver is None else self._driver.restart()
            self._is_blocked = False
        answer.message = 'the robot may go on' if answer.success else 'no stop waits for a start'
        return answer

    def _on_odometry(self, message: Odometry) -> None:
        assert self._odometry is not None
        stamp, pose = nanoseconds(message.header.stamp) / SECOND, pose_array(message.pose.pose)
        try:
            with self._lock:
                self._odometry.take(message.header.frame_id, stamp, pose, self._now())
        except InputError as error:
            self.get_logger().warning(f'odometry is not used: {error}', throttle_duration_sec=10.0)

    def _on_goal(self, goal: Repeat.Goal) -> GoalResponse:
        """Take a goal unless there is one already, or it is not on the route."""
        try:
            if self._driver is not None:
                raise InputError('another goal is driven to: cancel it')
            place, start = map(self._position, (goal.place_index, goal.start_index))
            if goal.place_id:
                if goal.place_id not in self._map.ids:
                    raise InputError(f'no place has the identifier {goal.place_id!r}')
                place = self._position(self._map.ids.index(goal.place_id))
            self._require_one_type()
            self._driver = Driver(
                self._run, Goal(place, goal.laps, start), self._now(), self._settings,
                self._needs_deadman, self._give_up_after, self._is_blocked, self._odometry,
            )  # fmt: skip
        except InputError as error:
            self.get_logger().error(f'the goal is rejected: {error}')
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _position(self, place: int) -> int:
        """Return the position of a place of the map along the taught run; -1 stays."""
        if place == -1:
            return place
        position = int(self._positions[place]) if 0 <= place < len(self._map) else -1
        if position < 0:
            raise InputError(f'place {place} is not on the taught run, of {len(self._taught)}')
        return position

    def _place(self, position: int) -> int:
        """Return the place of the map at a position along the taught run; -1 stays."""
        return position if position < 0 else int(self._taught[position])

    def _require_one_type(self) -> None:
        """Raise an InputError where a subscriber of the velocities expects another type."""
        kind, topic = self._velocity.msg_type, self._velocity.topic_name
        own = f'geometry_msgs/msg/{kind.__name__}'
        for subscriber in self.get_subscriptions_info_by_topic(topic):
            if subscriber.topic_type != own:
                raise InputError(
                    f'{subscriber.node_name} subscribes to {topic} as {subscriber.topic_type}, '
                    f'this node publishes {own}: set the parameter stamped to {kind is Twist}'
                )

    def _on_accepted(self, handle: Any) -> None:
        self._handle, self._ended = handle, Future()
        handle.execute()

    def _on_cancel(self, _: Any) -> CancelResponse:
        return CancelResponse.ACCEPT

    async def _execute(self, handle: Any) -> Repeat.Result:
        driver, future = self._driver, self._ended
        assert driver is not None
        assert future is not None
        await future
        assert driver.outcome is not None
        text = driver.command.reason
        if driver.outcome is Outcome.REACHED:
            handle.succeed()
        elif driver.outcome is Outcome.CANCELED:
            handle.canceled()
        else:
            handle.abort()
        self.get_logger().info(f'{driver.outcome.name.lower()} after {driver.distance:.1f} m')
        return Repeat.Result(
            code=int(driver.outcome), message=text, place_index=self._place(driver.place),
            laps=driver.laps, distance=driver.distance,
        )  # fmt: skip

    def _control(self) -> None:
        """Publish the velocities of the goal; zero at its end, and nothing without one."""
        handle = self._handle
        with self._lock:
            driver = self._driver
            if driver is None or handle is None:
                return
            now = self._now()
            if handle.is_cancel_requested:
                driver.end(Outcome.CANCELED, now)
            self._clock_times.append(now)
            if self._clock_times.count(now) > DEADMAN_AGE / PERIOD:
                command = driver.halt(now, CLOCK_IS_STILL)
            else:
                command = driver.step(now)
            if not driver.is_waiting or driver.outcome is not None:
                self._publish(command)
            if driver.outcome is not None:
                self._is_blocked = driver.is_blocked
                self._driver = self._handle = None
        self._steps += 1
        if driver.outcome is not None:
            assert self._ended is not None
            self._ended.set_result(None)
        elif self._steps % FEEDBACK == 0:
            handle.publish_feedback(feedback_of(driver, self._place(driver.place)))

    def _publish(self, command: Command) -> None:
        twist = Twist()
        twist.linear.x, twist.angular.z = command.speed, command.turn
        if self._velocity.msg_type is Twist:
            self._velocity.publish(twist)
            return
        message = TwistStamped(twist=twist)
        message.header.stamp, message.header.frame_id = self.get_clock().now().to_msg(), self._base
        self._velocity.publish(message)

    def _publish_diagnostics(self) -> None:
        driver = self._driver
        level, text = DiagnosticStatus.OK, 'no goal' if driver is None else 'driving'
        if driver is not None and driver.command.reason:
            level, text = DiagnosticStatus.WARN, driver.command.reason
        values = {name.replace(' ', '_'): count for name, count in self.counts.items()}
        self._diagnostics.publish(one_status(self, 'repeat', level, text, values))


def offset_message(
    offset: Offset,
    lateral: tuple[float, float],
    header: Any,
    focal: float,
    place: Mapping[str, Any],
) -> OffsetMessage:
    """
    Return the message of an offset.

    :param lateral: meters to the left of the path, and their deviation.
    :param focal: focal length in widths of the image; NaN = unknown.
    """
    return OffsetMessage(
        header=header, **place, is_valid=offset.is_valid,
        heading=offset.heading(focal), heading_deviation=offset.deviation / focal,
        shift=offset.shift, shift_deviation=offset.deviation, parallax=offset.parallax,
        lateral=lateral[0], lateral_deviation=lateral[1], similarity=offset.similarity,
    )  # fmt: skip


def feedback_of(driver: Driver, place: int) -> Repeat.Feedback:
    """Return the feedback of a drive; place: of the map."""
    newest, command = driver.newest, driver.command
    offset = newest.offset if newest is not None else None
    return Repeat.Feedback(
        place_index=place,
        probability=newest.probability if newest is not None else math.nan,
        shift=offset.shift if offset is not None and offset.is_valid else math.nan,
        speed=command.speed, turn=command.turn, distance_to_go=driver.distance_to_go,
        laps=driver.laps, reason=command.reason,
    )  # fmt: skip
