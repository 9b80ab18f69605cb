"""What the node has while it is configured: the pipeline on its worker, the publishers, the inputs."""

import math
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, wait
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from stavpr_msgs.msg import Candidate, MapInfo, PlaceMatch
from stavpr_ros.errors import StavprError
from stavpr_ros.pipeline import Pipeline
from stavpr_ros.pipeline.start import LoadedMap, read_map
from stavpr_ros.pipeline.statistics import WAITING, Statistics
from stavpr_ros.recognition import Match, Status
from stavpr_ros.ros.input import ImageInput, OdometryInput
from stavpr_ros.ros.lifecycle import ManagedNode
from stavpr_ros.ros.messages import candidate_messages, map_info_message, match_message, nanoseconds
from stavpr_ros.ros.output import Output
from stavpr_ros.ros.saving import write_at_the_end, write_map
from stavpr_ros.ros.settings import NodeSettings
from stavpr_ros.ros.worker import PATIENCE, Worker
from stavpr_ros.threads import limit_threads

REPORT_PERIOD = 10.0  # seconds between repeated warnings
NOTICE = 0.2  # seconds until it is noticed that the node ends

Result = TypeVar('Result')


@dataclass(frozen=True)
class _Item:
    """An image that waits: its message, when it came (seconds), and after how many restarts."""

    message: Any
    arrival: float
    epoch: int


class Runtime:
    """
    Everything between the configuration of the node and its clean-up.

    :param node: the node.
    :param settings: its parameters; what is live is changed by :meth:`change`.
    :param statistics: where it is counted.
    :raises StavprError: the map, the model or the settings do not do.
    """

    def __init__(self, node: ManagedNode, settings: NodeSettings, statistics: Statistics) -> None:
        self._node, self._settings, self._statistics = node, settings, statistics
        self._images: ImageInput | None = None
        self._odometry: OdometryInput | None = None
        self._epoch = self._pipeline_epoch = 0
        self._explained: set[str] = set()
        self._last_match: PlaceMatch | None = None
        self.loading = ''  # the map that is being loaded
        self.problem = ''  # why the last map was not loaded
        self._one_load = threading.Lock()
        self.on_loading: Callable[[], None] = lambda: None  # called when that has changed
        self._worker = Worker(self._answer, settings.queue_size)
        self._output = Output(node, settings.queue_size)
        self._made: Pipeline | None = None
        try:
            self._made = self._on_worker(lambda: self._make_pipeline(settings))
            if settings.map_path:
                self.load(settings.map_path)
        except BaseException:
            self.close()
            raise

    def _make_pipeline(self, settings: NodeSettings) -> Pipeline:
        limit_threads(settings.threads)
        return Pipeline(settings.pipeline, settings.operation)

    def _on_worker(self, function: Callable[[], Result]) -> Result:
        """Have the worker call a function; give up when the node ends meanwhile."""
        future = self._worker.call(function)
        while not future.done():
            wait([future], NOTICE)
            if self._node.ending.is_set() and not future.done():
                raise StavprError('the node ends')
        try:
            return future.result()
        except CancelledError:
            raise StavprError('the node is no longer configured') from None

    @property
    def pipeline(self) -> Pipeline:
        """The pipeline; only the worker may change it."""
        assert self._made is not None
        return self._made

    # the life cycle

    def activate(self) -> None:
        """Hear images, with an empty window: the camera may have been moved meanwhile."""
        self.reset()
        s = self._settings
        self._update_odometry(s)
        self._images = ImageInput(
            self._node,
            s.image_transport,
            self._statistics,
            self._hand_over,
            self._skip,
            self.restart,
            s.max_stamp_gap,
            s.max_rate,
        )

    def deactivate(self) -> None:
        """Hear nothing more; images that wait are answered as dropped, what has grown is written."""
        self._hear_nothing()
        write_at_the_end(self.pipeline, self._on_worker, self._settings.save_path, self._node.get_logger())

    def close(self) -> None:
        """Hear, say and do nothing more."""
        try:
            self._hear_nothing()
            self.write_at_the_end()
        finally:
            if not self._worker.stop():
                self._node.left_behind = True
            self._output.close()

    def write_at_the_end(self) -> None:
        """Write what has grown, unless the worker is busy with what may take for ever; that is said then."""
        if self._made is None:
            return

        def on_worker(function: Callable[[], Result]) -> Result:
            return self._worker.call(function).result(PATIENCE)

        write_at_the_end(self._made, on_worker, self._settings.save_path, self._node.get_logger())

    def _hear_nothing(self) -> None:
        for heard in (self._images, self._odometry):
            if heard is not None:
                heard.close()
        self._images = self._odometry = None
        for item in self._worker.clear():
            self._drop(
                item.message, Status.DROPPED, 'the node was deactivated before its turn', 'deactivated'
            )

    def _update_odometry(self, settings: NodeSettings) -> None:
        """Subscribe to odometry where it is asked for, and only there."""
        wanted = settings.wants_odometry
        if wanted and self._odometry is None:
            self._odometry = OdometryInput(self._node, settings.odometry_timeout)
        elif not wanted and self._odometry is not None:
            self._odometry.close()
            self._odometry = None

    # what may change

    def change(self, settings: NodeSettings) -> None:
        """
        Take over live parameters, all or nothing; the map comes first, since it is what may fail.

        :raises StavprError: they do not do; everything stays as it was.
        """
        path = settings.map_path if settings.map_path != self._settings.map_path else ''
        with self._loading(path) if path else nullcontext():
            loaded = read_map(path, settings.pipeline) if path else None
            if self._images is not None:
                self._update_odometry(settings)  # may fail, and is easily undone
            try:
                self._on_worker(lambda: self.pipeline.change(settings.pipeline, settings.operation, loaded))
            except BaseException:
                if self._images is not None:
                    self._update_odometry(self._settings)
                raise
        self._settings = settings
        if loaded is not None:
            self._tell(loaded)
        if self._images is not None:
            self._images.max_rate, self._images.stamps.gap = settings.max_rate, settings.max_stamp_gap

    def load(self, path: str) -> None:
        """
        Read a map on this thread, while images are matched with the one that is there; then use it.

        :raises StavprError: the file, the model or the settings do not do; the old map stays.
        """
        with self._loading(path):
            loaded = read_map(path, self._settings.pipeline)
            self._on_worker(lambda: self.pipeline.use(loaded))
        self._tell(loaded)

    @contextmanager
    def _loading(self, path: str) -> Iterator[None]:
        """Tell that a map is being loaded, if one is."""
        with self._one_load:
            self.loading, self.problem = path, ''
            self.on_loading()
            try:
                yield
            except Exception as error:
                self.problem = f'cannot load {path}: {error}'
                raise
            finally:
                self.loading = ''
                self.on_loading()

    def _tell(self, loaded: LoadedMap) -> None:
        places = loaded.places
        self._node.get_logger().info(
            f'map {loaded.path}: {len(places)} places, features {places.settings.kind}, '
            f'{places.settings.strips} strips of {places.dimension} dimensions'
        )

    def save(self, path: str, overwrite: bool) -> int:
        """Write the map; see :meth:`Pipeline.to_save`."""
        return write_map(self.pipeline, self._on_worker, path, overwrite)

    def relocalize(self, count: int) -> tuple[PlaceMatch, list[Candidate]]:
        """Return the answer for the window as it is, and candidates; see :meth:`Pipeline.relocalize`."""

        def ask() -> tuple[PlaceMatch, list[Candidate]]:
            # messages are made here, on the worker: a route may grow and forget before the next call
            match, ranked = self.pipeline.relocalize(count)
            places = self.pipeline.places
            header = self._last_match.header if self._last_match is not None else PlaceMatch().header
            listed = [] if places is None else candidate_messages(places, ranked)
            return match_message(header, match, places), listed

        return self._on_worker(ask)

    def restart(self, reason: str) -> None:
        """Begin a new window with the images that come from now on."""
        self._node.get_logger().info(f'the window is emptied: {reason}')
        self._epoch += 1
        odometry = self._odometry  # another thread may take it away
        if odometry is not None:
            odometry.trajectory.clear()

    def reset(self) -> None:
        """Empty the window now; images that wait belong to none any more."""
        self._epoch += 1
        epoch = self._epoch

        def empty() -> None:
            self._pipeline_epoch = epoch
            self.pipeline.reset()

        self._on_worker(empty)

    # images

    def _hand_over(self, message: Any, arrival: float) -> None:
        dropped = self._worker.put(_Item(message, arrival, self._epoch))
        if dropped is not None:
            self._drop(dropped.message, Status.DROPPED, 'newer images came before its turn', 'queue full')
            self._node.get_logger().warning(
                'images come faster than they can be matched, some are dropped: see /diagnostics',
                throttle_duration_sec=REPORT_PERIOD,
            )

    def _skip(self, message: Any, reason: str) -> None:
        self._drop(message, Status.SKIPPED, reason, 'max_rate')

    def _drop(self, message: Any, status: Status, reason: str, cause: str) -> None:
        """Answer an image that is not looked at."""
        self._statistics.dropped(cause)
        threshold = self.pipeline.threshold
        threshold = math.nan if threshold is None else threshold
        self._output.publish(message.header, Match(status, reason, threshold))

    def _answer(self, item: _Item) -> None:
        """Answer one image, on the worker's thread."""
        if item.epoch < self._pipeline_epoch:
            self._drop(item.message, Status.DROPPED, 'the window was emptied before its turn', 'window reset')
            return
        if item.epoch > self._pipeline_epoch:
            self._pipeline_epoch = item.epoch
            self.pipeline.reset()
        waited = time.monotonic() - item.arrival
        header = item.message.header
        stamp = nanoseconds(header.stamp)
        odometry = self._odometry  # another thread may take it away
        pose = odometry.trajectory.at(stamp) if odometry is not None else None
        # poses of a map are in the map's frame, those of a route that grows in the odometry's
        grows = odometry is not None and self.pipeline.operation != 'localization'
        frame = odometry.frame if grows and odometry is not None else self._settings.map_frame
        self.pipeline.ranking = self._output.wants_candidates
        try:
            match = self.pipeline.process(item.message, stamp, pose)
        except Exception as error:
            self._node.get_logger().error(f'an image could not be matched: {traceback.format_exc()}')
            reason = f'internal error: {type(error).__name__}: {error}'
            match = Match(Status.INVALID_IMAGE, reason, cause='internal error')
        if match.status is Status.NOT_READY and self.loading:
            match = replace(match, reason=f'map {self.loading} is being loaded')
        self._publish(header, match, frame, waited)

    def _publish(self, header: Any, match: Match, frame: str, waited: float) -> None:
        began = time.monotonic()
        message = self._output.publish(header, match, self.pipeline.places, frame)
        stages = {WAITING: waited, **match.stages, 'publishing': time.monotonic() - began}
        if match.cause:
            self._statistics.dropped(match.cause)
        self._explain(match)
        mapped = match.status is Status.MAPPED
        if match.status in (Status.WARMING_UP, Status.NO_MATCH, Status.MATCH) or mapped:
            self._last_match = message
            place = message.newest_index if mapped else message.place_index
            self._statistics.answered(match.status.name, match.reason, place, message.distance, stages)

    def _explain(self, match: Match) -> None:
        """Say what is wrong with an image, once for each kind of trouble."""
        if match.status is Status.INVALID_IMAGE and match.cause not in self._explained:
            self._explained.add(match.cause)
            self._node.get_logger().warning(
                f'image skipped: {match.reason} (said once; /diagnostics counts "{match.cause}")'
            )
        elif match.status is Status.NOT_READY:
            self._node.get_logger().warning(
                f'images arrive, but cannot be matched: {match.reason}',
                throttle_duration_sec=REPORT_PERIOD,
            )

    # what is told of it

    @property
    def images(self) -> ImageInput | None:
        """The subscription of images, while active."""
        return self._images

    @property
    def odometry(self) -> OdometryInput | None:
        """The subscription of odometry, where it is asked for, while active."""
        return self._odometry

    @property
    def waiting(self) -> int:
        """Images that wait."""
        return self._worker.waiting

    def map_info(self) -> MapInfo:
        """Describe the map that is in use."""
        pipeline = self.pipeline
        return map_info_message(
            pipeline.operation,
            'loading' if self.loading else pipeline.map_state,
            pipeline.path,
            pipeline.places,
            pipeline.extractor,
            self._node.get_clock().now().to_msg(),
        )
