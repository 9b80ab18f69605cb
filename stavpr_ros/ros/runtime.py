# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The configured node: the pipeline on its worker, the subscriptions and the publishers."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
import time
import traceback
from typing import Any

from stavpr_msgs.msg import MapInfo
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import GrowingMap
from stavpr_ros.method import Match, Status
from stavpr_ros.pipeline import LoadedMap, NodeSettings, Pipeline, read_map
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.pipeline.saving import (
    open_journal,
    recover_maps,
    save_recorded_map,
    take_up_earlier_drives,
)
from stavpr_ros.pipeline.statistics import Statistics, WAITING
from stavpr_ros.ros import REPORT_PERIOD
from stavpr_ros.ros.bond import Bond, make_bond
from stavpr_ros.ros.intake import Intake
from stavpr_ros.ros.map_loading import MapLoader
from stavpr_ros.ros.messages import map_info_message, nanoseconds, Outcome, Surroundings
from stavpr_ros.ros.publication import Publication
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.ros.reports import Reports
from stavpr_ros.ros.worker import STOP_TIMEOUT, Worker
from stavpr_ros.signals import time_left
from stavpr_ros.threads import limit_threads

RECORDED = 'recorded.stavpr'  # in the maps folder, where no save_path is set


@dataclass(frozen=True)
class _Item:
    """A waiting image: message, time of arrival (s), and the number of restarts before it."""

    message: Any
    arrival: float
    epoch: int


class Runtime:
    """
    Everything between the configuration of the node and its cleanup: the recognition.

    :param on_map_change: called when the map, or its loading state, has changed.
    :raises StavprError: invalid settings, or an invalid map or model.

    Images come in by ``intake``; all that is published of them goes out by ``publication``, and
    ``reports`` log what keeps them out of the window. ``settings`` are those in force; ``last`` is
    the outcome of the last image in the window, None = none.
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
        self._epoch = self._pipeline_epoch = 0
        self._may_lack_map = False  # active since the end of a recording was last logged
        self.last: Outcome | None = None
        self._bond: Bond | None = None
        self._pipeline: Pipeline | None = None
        self.intake = Intake(node, statistics, self._enqueue, self._reject, self.restart)
        self._reports = Reports(node, statistics, self.intake.odometry_fault)
        self._maps = MapLoader(
            node,
            lambda path: read_map(path, self.settings.pipeline),
            self._use_map,
            lambda: self.pipeline.places,
            on_map_change,
        )
        self.worker = Worker(self._process, settings.queue_size, node.ending)
        try:
            self._publication = Publication(
                node,
                settings,
                statistics,
                lambda: self.pipeline.operation,
                lambda: self.worker.call(self._publish_route),
            )
        except BaseException:
            self.worker.stop()
            raise
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def _begin(self) -> None:
        """Recover maps, make the pipeline, and load the map."""
        settings, log = self.settings, self._node.get_logger()
        # a node that only localizes on a map that is named has recorded nothing
        is_own = settings.operation != 'localization' or not settings.map_path
        recovery = recover_maps(self._journal_target, log, is_own or bool(settings.save_path))
        self._pipeline = self.worker.run(self._make_pipeline)
        # a route of loop closure does not continue a map
        start_map = recovery if settings.operation != 'loop_closure' else ''
        if map_path := settings.map_path or start_map:
            if self.updates_map:
                take_up_earlier_drives(map_path, log)
            self.load(map_path)

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
            lambda base, template: open_journal(self._journal_target, base, template, log),
        )

    @property
    def updates_map(self) -> bool:
        """Whether the drives of this operation update its map."""
        settings = self.settings
        return settings.pipeline.update_map and settings.operation == 'localization'

    @property
    def _journal_target(self) -> Path:
        """Return the file whose name the journal of recorded places has."""
        return Path(self.settings.save_path or self.settings.maps_path / RECORDED)

    # life cycle

    def activate(self) -> None:
        """Subscribe, with an empty window: the camera may have been moved since the last image."""
        self.reset()
        self._reports.begin()
        self._may_lack_map, settings = True, self.settings
        self.intake.open(settings, self.pipeline.places)
        self._bond = make_bond(self._node, settings.bond_heartbeat_period, not settings.autostart)

    def deactivate(self) -> None:
        """Unsubscribe; publish waiting images as dropped, and waiting closures; save a map."""
        self._unsubscribe()
        self.worker.run(self._publication.edges.flush)  # after the image in process
        self.worker.run(self._publication.forget)
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
            if not (self.worker.stop() & self._publication.edges.stop()):
                self._node.left_behind = True
            self._maps.stop()
            if self._pipeline is not None:
                for path in self._pipeline.close_journals(not self.settings.save_path):
                    self._node.get_logger().warning(
                        f'unsaved places stay in {path}: the next start of the node makes a map '
                        'of them, or `stavpr map recover`'
                    )
            self._end_bond()
            self._publication.close()

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
                log.warning(f'no map written, because {self._reports.why_no_place()}')
            self._may_lack_map = False

    def _unsubscribe(self) -> None:
        self.intake.close()
        self._drop_waiting('the node was deactivated', 'deactivated')

    def _drop_waiting(self, event: str, cause: str) -> None:
        for item in self.worker.clear():
            reason = f'{event} before it was processed'
            self._drop(item.message, Status.DROPPED, reason, cause)

    # changes

    def change(self, settings: NodeSettings) -> None:
        """
        Apply live parameters, or another operation.

        A subscription to odometry that fails is logged and kept in ``intake.problem``; everything
        else is applied.

        :raises StavprError: the operation cannot be changed; nothing is changed then.
        """
        self._change(settings=settings.pipeline, operation=settings.operation)
        self.settings = settings
        self.intake.change(settings, self.pipeline.places)

    def load(
        self, path: str, lock: AbstractContextManager[Any] | None = None, verify: bool = False
    ) -> None:
        """Load a map, :meth:`stavpr_ros.ros.map_loading.MapLoader.load`, and publish its route."""
        self._maps.load(path, lock, verify)
        self.worker.call(self._publish_route)
        recognizer = self.pipeline.operation.recognizer
        if recognizer is not None and recognizer.start_notes:
            self._node.get_logger().info(recognizer.start_notes)

    def _change(self, **changes: Any) -> None:
        """Change the pipeline; with another operation, its last outcome, and its map, are gone."""

        def change() -> None:
            operation = self.pipeline.operation
            self.pipeline.change(**changes)
            if self.pipeline.operation is not operation:
                self.last = None

        self.worker.run(change)

    def _use_map(self, loaded: LoadedMap) -> None:
        # diagnostics warn of missing thumbnails: less is checked; without poses, nothing is sent
        if unmet := self.settings.unmet(loaded.places.has_poses, has_thumbnails=True):
            raise SettingsError(unmet)
        self._change(loaded=loaded)
        if self.intake.images is not None:
            self.intake.follow_odometry(self.settings, self.pipeline.places)

    def _publish_route(self) -> None:
        if self._pipeline is not None:  # a subscriber may come first
            self._publication.publish_route()

    def restart(self, reason: str) -> None:
        """Empty the window before the images that arrive from now on."""
        self._epoch += 1
        self._reports.log_restart(reason, self.settings.pipeline.sequence.length)
        self.intake.clear()

    def reset(self) -> None:
        """Empty the window now, and drop waiting images."""
        self._drop_waiting('the window was reset', 'window reset')
        self.worker.run(self._reset_window)

    def _reset_window(self) -> None:
        self.pipeline.operation.reset()
        self._publication.reset()

    # status

    def map_info(self) -> MapInfo:
        """Return the description of the map in use."""
        stamp = self._node.get_clock().now().to_msg()
        info = map_info_message(self.pipeline, self.settings.robot_id, stamp)
        if self._maps.path:
            info.state = 'loading'
        return info

    def state(self) -> dict[str, Any]:
        """Return the fields of :class:`stavpr_ros.ros.health.Health` of a configured node."""
        pipeline, operation, inputs = self.pipeline, self.pipeline.operation, self.intake.state()
        self._reports.log_oddities(inputs['oddities'])
        return inputs | {
            'problem': self._maps.problem or self.intake.problem or pipeline.problem,
            'loading': self._maps.path,
            'queue': self.worker.waiting,
            'window': operation.window_fill,
            'missing': operation.missing,
            'contrast': operation.contrast,
            'applied_threshold': operation.threshold,
            'localized': self._publication.localized.state.is_localized,
            'sends_transform': self._publication.navigation.sends_transform,
        }

    # images

    def _enqueue(self, message: Any, arrival: float) -> None:
        self._reports.note_arrival()
        dropped = self.worker.put(_Item(message, arrival, self._epoch))
        if dropped is not None:
            reason = 'newer images arrived before it was processed'
            self._drop(dropped.message, Status.DROPPED, reason, 'queue full')
            self._node.get_logger().warning(
                'images arrive faster than they are processed, and are dropped: see /diagnostics',
                throttle_duration_sec=REPORT_PERIOD,
            )

    def _reject(self, message: Any, reason: str) -> None:
        self._drop(message, Status.SKIPPED, reason, 'max_rate')

    def _drop(self, message: Any, status: Status, reason: str, cause: str) -> None:
        """Publish the status of an image that is not processed."""
        self._statistics.add_drop(cause)
        pipeline, robot_id = self.pipeline, self.settings.robot_id
        result = pipeline.operation.unmatched(status, reason)
        outcome = Outcome(message.header, result, pipeline.places, robot_id=robot_id)
        self._publication.output.publish(outcome)

    def _process(self, item: _Item) -> None:
        """Process one image, on the worker."""
        if item.epoch != self._pipeline_epoch:
            self._pipeline_epoch = item.epoch
            self._reset_window()
        header, waiting = item.message.header, time.monotonic() - item.arrival
        places = self.pipeline.operation.matched_places
        on_route = isinstance(places, GrowingMap)
        about = self.intake.surroundings(header, self.settings, on_route)
        result = self._match(item.message, about)
        began = time.monotonic()
        outcome = self._publication.publish(
            Outcome(header, result, places, about, self.settings.robot_id)
        )
        stages = {WAITING: waiting, **result.stages, 'publishing': time.monotonic() - began}
        self._reports.log_result(result, nanoseconds(header.stamp), self.settings)
        if result.cause:
            self._statistics.add_drop(result.cause)
        else:
            self.last = outcome
            match = result.match
            self._statistics.add_match(
                match.status.name, match.reason, result.own_place, match.distance, stages
            )

    def _match(self, message: Any, about: Surroundings) -> ImageResult:
        """Process an image; an internal error is logged, and invalidates this image only."""
        operation, stamp = self.pipeline.operation, nanoseconds(message.header.stamp)
        out = self._publication
        candidates = out.output.needs_candidates or out.views.needs_candidates
        try:
            result = operation.process(
                message,
                stamp,
                about.pose,
                about.camera,
                candidates,
                lambda: self.intake.yaw(about.child, message.header.frame_id, self.settings),
            )
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
