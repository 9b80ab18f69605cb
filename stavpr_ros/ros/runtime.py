# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The configured node: the pipeline on its worker, the subscriptions and the publishers."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
import time
import traceback
from typing import Any

import numpy as np
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.mapping.camera import Camera, FORWARD, mount_of, yaw_of
from stavpr_ros.method import Match, Status
from stavpr_ros.pipeline import LoadedMap, NodeSettings, Pipeline, read_map
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.pipeline.saving import (
    close_journals,
    open_journal,
    recover_maps,
    save_recorded_map,
    take_up_earlier_drives,
)
from stavpr_ros.pipeline.statistics import Statistics, WAITING
from stavpr_ros.relative_pose.estimator import EdgeEstimator
from stavpr_ros.ros import REPORT_PERIOD
from stavpr_ros.ros.bond import Bond, make_bond
from stavpr_ros.ros.edges import EdgePublisher
from stavpr_ros.ros.health import Health
from stavpr_ros.ros.input import ImageInput, InputStatus
from stavpr_ros.ros.localized import LocalizedPublisher
from stavpr_ros.ros.map_loading import MapLoader
from stavpr_ros.ros.messages import map_info_message, nanoseconds, PoseFrames
from stavpr_ros.ros.navigation import Navigation
from stavpr_ros.ros.output import is_requested, Output
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.ros.sensors import CameraInput, OdometryInput
from stavpr_ros.ros.subgoal import SubgoalPublisher
from stavpr_ros.ros.visualization import Visualization
from stavpr_ros.ros.worker import STOP_TIMEOUT, Worker
from stavpr_ros.signals import time_left
from stavpr_ros.threads import limit_threads
from stavpr_ros.units import SECOND

MAX_SHORT_WINDOWS = 3  # one jump of a clock is no disorder
RECORDED = 'recorded.stavpr'  # in the maps folder, where no save_path is set
STAMP_JUMP = 3600.0  # seconds to an image of another recording
SKIP_SECONDS, SKIP_PERIOD = 5.0, 60.0  # of skipped images until a warning, and to the next one


@dataclass(frozen=True)
class _Item:
    """A waiting image: message, time of arrival (s), and the number of restarts before it."""

    message: Any
    arrival: float
    epoch: int


class Runtime:
    """
    Everything between the configuration of the node and its cleanup.

    :param on_map_change: called when the map, or its loading state, has changed.
    :raises StavprError: invalid settings, or an invalid map or model.

    ``problem`` is the error of the last subscription to odometry, '' = none. ``images`` and
    ``odometry`` are subscriptions while the node is active. ``settings`` are those in force.
    """

    def __init__(
        self,
        node: ManagedNode,
        settings: NodeSettings,
        statistics: Statistics,
        on_map_change: Callable[[], None],
    ) -> None:
        self._node, self.settings, self._statistics = node, settings, statistics
        self.on_map_change = on_map_change
        self.images: ImageInput | None = None
        self.odometry: OdometryInput | None = None
        self.camera: CameraInput | None = None
        self._epoch = self._pipeline_epoch = 0
        self._since_restart = self._short_windows = 0  # images; restarts in a row before a window
        self._logged_reasons: set[str] = set()
        # stamp and time of the first image since the last keyframe [s]
        self._skipped_since: tuple[float, float] | None = None
        self._last_reason = ''  # why the last image is in no window
        self._may_lack_map = False  # active since the end of a recording was last logged
        self.last_match = PlaceMatch()  # published for the last image in the window
        self.last_frame = ''  # of the poses of its places
        self.problem = ''
        self._maps = MapLoader(
            node,
            lambda path: read_map(path, self.settings.pipeline),
            self._use_map,
            lambda: self.pipeline.places,
            on_map_change,
        )
        self._bond: Bond | None = None
        self._navigation: Navigation | None = None
        if settings.publish_tf or settings.publish_initialpose:
            self._navigation = Navigation(node, settings)
        self._localized = LocalizedPublisher(node, settings)
        self._subgoal = SubgoalPublisher(node, settings)
        self.worker = Worker(self._process, settings.queue_size, node.ending)
        self._output = Output(node, settings.queue_size, settings.robot_id)
        self._edges = EdgePublisher(
            EdgeEstimator(settings.relative_pose),
            settings.robot_id,
            self._output.publish_closure,
            self._statistics,
            node.ending,
        )
        self._pipeline: Pipeline | None = None
        self._views = Visualization(node, lambda: self.worker.call(self._publish_route))
        try:
            # a node that only localizes on a map that is named has recorded nothing
            is_own = settings.operation != 'localization' or not settings.map_path
            is_own = is_own or bool(settings.save_path)
            recovered = recover_maps(self._journaled, node.get_logger(), is_own)
            self._pipeline = self.worker.run(self._make_pipeline)
            # a route of loop closure does not continue a map
            continued = recovered if settings.operation != 'loop_closure' else ''
            if map_path := settings.map_path or continued:
                if self.updates_map:
                    take_up_earlier_drives(map_path, node.get_logger())
                self.load(map_path)
        except BaseException:
            self.close()
            raise

    @property
    def pipeline(self) -> Pipeline:
        """Return the pipeline; only the worker may change it."""
        assert self._pipeline is not None
        return self._pipeline

    def _make_pipeline(self) -> Pipeline:
        limit_threads(self.settings.threads)
        log = self._node.get_logger()
        return Pipeline(
            self.settings.pipeline,
            self.settings.operation,
            lambda base, template: open_journal(self._journaled, base, template, log),
        )

    @property
    def updates_map(self) -> bool:
        """Whether the drives of this operation update its map."""
        settings = self.settings
        return settings.pipeline.update_map and settings.operation == 'localization'

    @property
    def _journaled(self) -> Path:
        """Return the file whose name the journal of recorded places has."""
        return Path(self.settings.save_path or self.settings.maps_path / RECORDED)

    # life cycle

    def activate(self) -> None:
        """Subscribe, with an empty window: the camera may have been moved since the last image."""
        self.reset()
        self._skipped_since, self._last_reason, self._may_lack_map = None, '', True
        self._update_odometry()
        if self.settings.relative_pose in ('auto', 'pnp'):
            self.camera = CameraInput(self._node, self.settings.camera_transform)
        self.images = ImageInput(
            self._node,
            self.settings,
            self._statistics,
            self._enqueue,
            lambda message, reason: self._drop(message, Status.SKIPPED, reason, 'max_rate'),
            self.restart,
        )
        settings = self.settings
        self._bond = make_bond(self._node, settings.bond_heartbeat_period, not settings.autostart)

    def deactivate(self) -> None:
        """Unsubscribe; publish waiting images as dropped, and waiting closures; save a map."""
        self._unsubscribe()
        self.worker.run(self._edges.flush)  # after the image in process
        self.worker.run(self._forget)
        self._save(self.worker.run)
        self._end_bond()

    def _end_bond(self) -> None:
        if self._bond is not None:
            self._bond.close()
        self._bond = None

    def close(self) -> None:
        """Unsubscribe, save a recorded map, and end the worker and the publishers."""
        try:
            self._unsubscribe()
            self.save_at_end()
        finally:
            if not (self.worker.stop() & self._edges.stop()):
                self._node.left_behind = True
            self._maps.stop()
            if self._pipeline is not None:
                delete_route = not self.settings.save_path
                close_journals(self._pipeline, delete_route, self._node.get_logger())
            self._output.close()
            self._end_bond()
            self._views.close()
            self._localized.close()
            self._subgoal.close()
            if self._navigation is not None:
                self._navigation.close()

    def save_at_end(self) -> None:
        """Save a recorded map, unless the worker stays busy."""
        self._save(lambda function: self.worker.call(function).result(time_left(STOP_TIMEOUT, 1)))

    def _save(self, on_worker: Callable[[Callable[[], Any]], Any]) -> None:
        if self._pipeline is not None:
            log, path = self._node.get_logger(), self.settings.save_path
            if not save_recorded_map(self._pipeline, on_worker, path, log):
                self._node.failed = True
            places = self._pipeline.save_state.recorded
            if self._may_lack_map and self.settings.operation == 'mapping' and not places:
                log.warning(f'no map written, because {self._why_no_place()}')
            self._may_lack_map = False

    def _why_no_place(self) -> str:
        """Return why no image became a place."""
        counts = self._statistics.counts()
        if not counts.received.count:
            topic = self._node.resolve_topic_name('image')
            return f'no image was received on {topic}: compare `ros2 topic list`, set image:=TOPIC'
        causes = ', '.join(f'{n} {cause}' for cause, n in counts.dropped.total.most_common())
        text = f'none of {counts.received.count} images became a place ({causes})'
        return f'{text}; the last one: {self._last_reason}' if self._last_reason else text

    def _unsubscribe(self) -> None:
        for subscription in (self.images, self.odometry, self.camera):
            if subscription is not None:
                subscription.close()
        self.images = self.odometry = self.camera = None
        self._drop_waiting('the node was deactivated', 'deactivated')

    def _drop_waiting(self, event: str, cause: str) -> None:
        for item in self.worker.clear():
            reason = f'{event} before it was processed'
            self._drop(item.message, Status.DROPPED, reason, cause)

    def _update_odometry(self) -> None:
        """Subscribe to odometry while it is needed."""
        places, settings = self.pipeline.places, self.settings
        is_compared = settings.pipeline.compares_odometry
        needs_odometry = settings.needs_odometry or (  # edges to places of a map, and their paths
            (settings.relative_pose in ('auto', 'aligned') or is_compared)
            and isinstance(places, PlaceMap)
            and places.has_poses
        )
        if needs_odometry and self.odometry is None:
            self.odometry = OdometryInput(
                self._node,
                self.settings.odometry_timeout,
                self._statistics.add_odometry_rejected,
            )
        elif not needs_odometry and self.odometry is not None:
            self.odometry.close()
            self.odometry = None

    # changes

    def change(self, settings: NodeSettings) -> None:
        """
        Apply live parameters, or another operation.

        A subscription to odometry that fails is logged and kept in ``problem``; everything else is
        applied.

        :raises StavprError: the operation cannot be changed; nothing is changed then.
        """
        self.worker.run(lambda: self.pipeline.change(settings.pipeline, settings.operation))
        self.settings = settings
        if self.images is not None:
            self.images.max_rate = settings.max_rate
            self.images.stamps.gap = settings.max_stamp_gap
            try:
                self._update_odometry()
                self.problem = ''
            except SettingsError as error:
                self.problem = str(error)
                self._node.get_logger().error(self.problem)

    def load(
        self, path: str, lock: AbstractContextManager[Any] | None = None, verify: bool = False
    ) -> None:
        """
        Load a map and use it; meanwhile the old one stays in use.

        :param lock, verify: see :meth:`stavpr_ros.ros.map_loading.MapLoader.load`.
        :raises StavprError: an invalid file, model or setting, or a file that takes too long; the
            old map stays in use.
        """
        self._maps.load(path, lock, verify)
        self.worker.call(self._publish_route)
        recognizer = self.pipeline.operation.recognizer
        if recognizer is not None and recognizer.start_notes:
            self._node.get_logger().info(recognizer.start_notes)

    def _use_map(self, loaded: LoadedMap) -> None:
        self.worker.run(lambda: self.pipeline.change(loaded=loaded))
        if self.images is not None:
            self._update_odometry()

    def restart(self, reason: str) -> None:
        """Empty the window before the images that arrive from now on."""
        log, length = self._node.get_logger(), self.settings.pipeline.sequence.length
        log.info(f'window reset: {reason}')
        self._epoch += 1
        self._short_windows = self._short_windows + 1 if self._since_restart < length else 0
        if self._short_windows >= MAX_SHORT_WINDOWS:
            log.warning(
                f'the window was reset {self._short_windows} times in a row before it was full, '
                f'so that few images match ({reason}): publish the images in the order of their '
                'stamps, and by one publisher',
                throttle_duration_sec=REPORT_PERIOD,
            )
        self._since_restart = 0
        if (odometry := self.odometry) is not None:  # another thread may unsubscribe
            odometry.trajectory.clear()

    def reset(self) -> None:
        """Empty the window now, and drop waiting images."""
        self._drop_waiting('the window was reset', 'window reset')
        self.worker.run(self._reset_window)

    def _reset_window(self) -> None:
        self.pipeline.operation.reset()
        self._localized.reset()

    def _forget(self) -> None:
        self._localized.reset()
        if self._navigation is not None:
            self._navigation.forget()

    def map_info(self) -> MapInfo:
        """Return the description of the map in use."""
        pipeline = self.pipeline
        return map_info_message(
            pipeline.operation.name,
            'loading' if self._maps.path else pipeline.operation.map_state,
            pipeline.save_state.path,
            pipeline.places,
            pipeline.operation.extractor,
            self._node.get_clock().now().to_msg(),
            self.settings.robot_id,
        )

    def complete(self, health: Health) -> Health:
        """Return the health of the node with the queue, the window and the subscriptions."""
        pipeline, images, odometry = self.pipeline, self.images, self.odometry
        camera = self.camera
        return replace(
            health,
            problem=health.problem or self._maps.problem or self.problem or pipeline.problem,
            loading=self._maps.path,
            input=InputStatus() if images is None else images.status(),
            odometry='' if odometry is None else odometry.freshness(),
            queue=self.worker.waiting,
            window=pipeline.operation.window_fill,
            missing=pipeline.operation.missing,
            camera='not needed' if camera is None else camera.state,
            odometry_fault='' if odometry is None else odometry.fault(),
            contrast=pipeline.operation.contrast,
            applied_threshold=pipeline.operation.threshold,
            oddities=self._oddities(),
            localized=self._localized.is_localized,
            sends_transform=self._navigation is not None and self._navigation.sends_transform,
        )

    def _oddities(self) -> tuple[str, ...]:
        """Return what is odd about the inputs; log each kind once."""
        inputs = (each for each in (self.images, self.odometry, self.camera) if each is not None)
        texts = tuple(text for each in inputs for text in each.oddities())
        for text in texts:
            kind = ''.join(filter(str.isalpha, text))
            if kind not in self._logged_reasons:
                self._logged_reasons.add(kind)
                self._node.get_logger().warning(text)
        return texts

    # images

    def _enqueue(self, message: Any, arrival: float) -> None:
        self._since_restart += 1
        dropped = self.worker.put(_Item(message, arrival, self._epoch))
        if dropped is not None:
            reason = 'newer images arrived before it was processed'
            self._drop(dropped.message, Status.DROPPED, reason, 'queue full')
            self._node.get_logger().warning(
                'images arrive faster than they are processed, and are dropped: see /diagnostics',
                throttle_duration_sec=REPORT_PERIOD,
            )

    def _drop(self, message: Any, status: Status, reason: str, cause: str) -> None:
        """Publish the status of an image that is not processed."""
        self._statistics.add_drop(cause)
        result = self.pipeline.operation.unmatched(status, reason)
        self._output.publish(message.header, result, self.pipeline.places)

    def _process(self, item: _Item) -> None:
        """Process one image, on the worker."""
        if item.epoch != self._pipeline_epoch:
            self._pipeline_epoch = item.epoch
            self._reset_window()
        operation, waiting = self.pipeline.operation, time.monotonic() - item.arrival
        header, places = item.message.header, operation.matched_places
        pose, frames = self._pose_at(nanoseconds(header.stamp))
        camera_input = self.camera  # another thread may unsubscribe
        camera = camera_input.camera(frames.child, header.frame_id) if camera_input else None

        def yaw() -> float:
            if camera_input is None:
                return yaw_of(mount_of(self.settings.camera_transform) or FORWARD)
            return camera_input.yaw(frames.child, header.frame_id)

        result = self._match(item.message, pose, camera, yaw)
        began = time.monotonic()
        if self._navigation is not None:
            self._navigation.publish(header, result, places, pose, frames.odometry)
        self._localized.publish(result, places, pose)
        self._subgoal.publish(header, result, places)
        self._views.publish(header, result, operation, frames.frame, pose)
        edge, closures = self._edges.prepare(header, result, operation, frames, camera)
        message = self._output.publish(header, result, places, frames, edge)
        for closure in closures:
            self._edges.put(closure)
        stages = {WAITING: waiting, **result.stages, 'publishing': time.monotonic() - began}
        if result.cause:
            self._statistics.add_drop(result.cause)
            self._log_cause(result)
            if result.match.status is Status.SKIPPED:
                self._log_skips(result, nanoseconds(header.stamp))
            return
        self._skipped_since = None
        self.last_match, self.last_frame = message, frames.frame
        self._statistics.add_match(
            result.match.status.name,
            message.reason,
            message.newest_index,
            message.distance,
            stages,
        )

    def _pose_at(self, stamp: int) -> tuple[np.ndarray | None, PoseFrames]:
        """Return the pose of the robot at a stamp (ns), and the frames; None = unknown."""
        map_frame, odometry = self.settings.map_frame, self.odometry
        if odometry is None:
            return None, PoseFrames(map_frame)
        # places of a route have the poses of the odometry
        on_route = isinstance(self.pipeline.operation.matched_places, GrowingMap)
        frame = odometry.frame if on_route else map_frame
        return odometry.trajectory.at(stamp), PoseFrames(
            frame, odometry.child_frame, odometry.frame
        )

    def _match(
        self,
        message: Any,
        pose: np.ndarray | None,
        camera: Camera | None,
        yaw: Callable[[], float],
    ) -> ImageResult:
        """Process an image; an internal error is logged, and invalidates this image only."""
        candidates = (
            is_requested(self._node, self._output.candidates) or self._views.needs_candidates
        )
        stamp = nanoseconds(message.header.stamp)
        try:
            operation = self.pipeline.operation
            result = operation.process(message, stamp, pose, camera, candidates, yaw)
        except Exception as error:
            self._node.get_logger().error(
                f'an image could not be processed: {traceback.format_exc()}'
            )
            reason = f'internal error: {type(error).__name__}: {error}'
            return ImageResult(Match(Status.INVALID_IMAGE, reason), 'internal error')
        if result.match.status is Status.NOT_READY and (path := self._maps.path):
            return operation.unmatched(
                Status.NOT_READY, f'map {path} is being loaded', result.cause, image=result.image
            )
        return result

    def _publish_route(self) -> None:
        """Publish the route for a new subscriber, in the frame of the last image if it grows."""
        if self._pipeline is not None:  # a subscriber may come first
            places = self.pipeline.operation.matched_places
            on_route = isinstance(places, GrowingMap)
            frame = self._views.frame if on_route else self.settings.map_frame
            self._views.publish_route(places, frame)

    def _log_skips(self, result: ImageResult, stamp: int) -> None:
        """Log that a rule of keyframes skips every image, and the remedy."""
        self._last_reason, now = result.match.reason, (stamp / SECOND, time.monotonic())
        began = self._skipped_since or now
        began = self._skipped_since = began if 0 <= now[0] - began[0] < STAMP_JUMP else now
        # the stamps count too: a replay may be faster than the camera
        if not any(SKIP_SECONDS <= now[i] - began[i] < SKIP_PERIOD for i in range(2)):
            return
        if result.cause == 'no odometry':
            fault = self.odometry.fault() if self.odometry is not None else ''
            topic = self._node.resolve_topic_name('odom')
            remedy = fault or f"publish it on {topic}, with stamps of the camera's clock"
            remedy += '; or set keyframe_distance and keyframe_angle_deg to 0'
        else:
            rules = asdict(self.settings.pipeline.keyframes).items()
            names = ' or '.join(f'keyframe_{name}' for name, value in rules if value)
            remedy = f'right for a camera at rest, otherwise lower {names}'
        self._node.get_logger().warning(
            f'every image is skipped: {result.match.reason}; {remedy}',
            throttle_duration_sec=SKIP_PERIOD,
        )

    def _log_cause(self, result: ImageResult) -> None:
        """Log why an image is in no window: an invalid one once for each cause."""
        if (
            result.match.status is Status.INVALID_IMAGE
            and result.cause not in self._logged_reasons
        ):
            self._logged_reasons.add(result.cause)
            self._node.get_logger().warning(
                f'invalid image: {result.match.reason} (logged once; /diagnostics counts '
                f'"{result.cause}")'
            )
        elif result.match.status is Status.NOT_READY:
            self._node.get_logger().warning(
                f'images arrive, but cannot be matched: {result.match.reason}',
                throttle_duration_sec=REPORT_PERIOD,
            )
