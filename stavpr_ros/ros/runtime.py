"""What the node has while it is configured: the engine on its worker, the publishers, the inputs."""

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
from stavpr_ros.operation import Answer, Engine, Outcome
from stavpr_ros.operation.begin import LoadedMap, read_map
from stavpr_ros.ros.input import ImageInput, OdometryInput
from stavpr_ros.ros.lifecycle import ManagedNode
from stavpr_ros.ros.messages import candidate_messages, map_info_message, match_message, nanoseconds
from stavpr_ros.ros.output import Output
from stavpr_ros.ros.saving import write_at_the_end, write_map
from stavpr_ros.ros.settings import NodeSettings
from stavpr_ros.ros.statistics import WAITING, Statistics
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
        self._epoch = self._engine_epoch = 0
        self._explained: set[str] = set()
        self._last_match: PlaceMatch | None = None
        self.loading = ''  # the map that is being loaded
        self.problem = ''  # why the last map was not loaded
        self._one_load = threading.Lock()
        self.on_loading: Callable[[], None] = lambda: None  # called when that has changed
        self._worker = Worker(self._answer, settings.queue_size)
        self._output = Output(node, settings.queue_size)
        self._made: Engine | None = None
        try:
            self._made = self._on_worker(lambda: self._make_engine(settings))
            if settings.map_path:
                self.load(settings.map_path)
        except BaseException:
            self.close()
            raise

    def _make_engine(self, settings: NodeSettings) -> Engine:
        limit_threads(settings.threads)
        return Engine(settings.engine, settings.operation)

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
    def engine(self) -> Engine:
        """The engine; only the worker may change it."""
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
            s.max_gap,
            s.max_rate,
        )

    def deactivate(self) -> None:
        """Hear nothing more; images that wait are answered as dropped, what has grown is written."""
        self._hear_nothing()
        write_at_the_end(self.engine, self._on_worker, self._settings.save_path, self._node.get_logger())

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
                item.message, Answer.DROPPED, 'the node was deactivated before its turn', 'deactivated'
            )

    def _update_odometry(self, settings: NodeSettings) -> None:
        """Subscribe to odometry where it is asked for, and only there."""
        wanted = settings.wants_odometry
        if wanted and self._odometry is None:
            self._odometry = OdometryInput(self._node, settings.odometry_patience)
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
            loaded = read_map(path, settings.engine) if path else None
            if self._images is not None:
                self._update_odometry(settings)  # may fail, and is easily undone
            try:
                self._on_worker(lambda: self.engine.change(settings.engine, settings.operation, loaded))
            except BaseException:
                if self._images is not None:
                    self._update_odometry(self._settings)
                raise
        self._settings = settings
        if loaded is not None:
            self._tell(loaded)
        if self._images is not None:
            self._images.max_rate, self._images.stamps.gap = settings.max_rate, settings.max_gap

    def load(self, path: str) -> None:
        """
        Read a map on this thread, while images are matched with the one that is there; then use it.

        :raises StavprError: the file, the model or the settings do not do; the old map stays.
        """
        with self._loading(path):
            loaded = read_map(path, self._settings.engine)
            self._on_worker(lambda: self.engine.use(loaded))
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
        places, features = loaded.places, loaded.places.features
        self._node.get_logger().info(
            f'map {loaded.path}: {len(places)} places, features {places.settings.kind}, '
            f'{places.settings.strips} strips of {features.strips.shape[2]} dimensions'
        )

    def save(self, path: str, overwrite: bool) -> int:
        """Write the map; see :meth:`Engine.to_save`."""
        return write_map(self.engine, self._on_worker, path, overwrite)

    def relocalize(self, count: int) -> tuple[PlaceMatch, list[Candidate]]:
        """Return the answer for the window as it is, and candidates; see :meth:`Engine.relocalize`."""

        def ask() -> tuple[PlaceMatch, list[Candidate]]:
            # messages are made here, on the worker: a route may grow and forget before the next call
            outcome, ranked = self.engine.relocalize(count)
            header = self._last_match.header if self._last_match is not None else PlaceMatch().header
            listed = [] if outcome.places is None else candidate_messages(outcome.places, ranked)
            return match_message(header, outcome), listed

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
            self._engine_epoch = epoch
            self.engine.reset()

        self._on_worker(empty)

    # images

    def _hand_over(self, message: Any, arrival: float) -> None:
        dropped = self._worker.put(_Item(message, arrival, self._epoch))
        if dropped is not None:
            self._drop(dropped.message, Answer.DROPPED, 'newer images came before its turn', 'queue full')
            self._node.get_logger().warning(
                'images come faster than they can be matched, some are dropped: see /diagnostics',
                throttle_duration_sec=REPORT_PERIOD,
            )

    def _skip(self, message: Any, reason: str) -> None:
        self._drop(message, Answer.SKIPPED, reason, 'max_rate')

    def _drop(self, message: Any, answer: Answer, reason: str, cause: str) -> None:
        """Answer an image that is not looked at."""
        self._statistics.dropped(cause)
        self._output.publish(message.header, Outcome(answer, reason, self.engine.threshold))

    def _answer(self, item: _Item) -> None:
        """Answer one image, on the worker's thread."""
        if item.epoch < self._engine_epoch:
            self._drop(item.message, Answer.DROPPED, 'the window was emptied before its turn', 'window reset')
            return
        if item.epoch > self._engine_epoch:
            self._engine_epoch = item.epoch
            self.engine.reset()
        waited = time.monotonic() - item.arrival
        header = item.message.header
        stamp = nanoseconds(header.stamp)
        odometry = self._odometry  # another thread may take it away
        pose = odometry.trajectory.at(stamp) if odometry is not None else None
        # poses of a map are in the map's frame, those of a route that grows in the odometry's
        grows = odometry is not None and self.engine.operation != 'localization'
        frame = odometry.frame if grows and odometry is not None else self._settings.map_frame
        self.engine.ranking = self._output.wants_candidates
        try:
            outcome = self.engine.process(item.message, stamp, pose)
        except Exception as error:
            self._node.get_logger().error(f'an image could not be matched: {traceback.format_exc()}')
            reason = f'internal error: {type(error).__name__}: {error}'
            outcome = Outcome(Answer.INVALID_IMAGE, reason, cause='internal error')
        if outcome.answer is Answer.NOT_READY and self.loading:
            outcome = replace(outcome, reason=f'map {self.loading} is being loaded')
        self._publish(header, outcome, frame, waited)

    def _publish(self, header: Any, outcome: Outcome, frame: str, waited: float) -> None:
        began = time.monotonic()
        match = self._output.publish(header, outcome, frame)
        stages = {WAITING: waited, **outcome.stages, 'publishing': time.monotonic() - began}
        if outcome.cause:
            self._statistics.dropped(outcome.cause)
        self._explain(outcome)
        if outcome.recognition is not None or outcome.answer is Answer.MAPPED:
            self._last_match = match
            place = match.place_index if outcome.recognition is not None else match.newest_index
            self._statistics.answered(outcome.answer.name, outcome.reason, place, match.distance, stages)

    def _explain(self, outcome: Outcome) -> None:
        """Say what is wrong with an image, once for each kind of trouble."""
        if outcome.answer is Answer.INVALID_IMAGE and outcome.cause not in self._explained:
            self._explained.add(outcome.cause)
            self._node.get_logger().warning(
                f'image skipped: {outcome.reason} (said once; /diagnostics counts "{outcome.cause}")'
            )
        elif outcome.answer is Answer.NOT_READY:
            self._node.get_logger().warning(
                f'images arrive, but cannot be matched: {outcome.reason}',
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
        engine = self.engine
        return map_info_message(
            engine.operation,
            'loading' if self.loading else engine.map_state,
            engine.path,
            engine.places,
            engine.describer,
            self._node.get_clock().now().to_msg(),
        )
