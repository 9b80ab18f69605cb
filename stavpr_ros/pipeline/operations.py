# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The operations: a localizer, a mapper and a route closer; each turns a message into a result."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import replace
import math
import os
from pathlib import Path
import time
from typing import Any, NamedTuple, Protocol, runtime_checkable, TYPE_CHECKING

import numpy as np
from stavpr_ros import former
from stavpr_ros.errors import ImageError, InputError, SettingsError, StavprError
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.maintenance.same_places import SURE
from stavpr_ros.mapping import encode_thumbnail, GrowingMap, Map, thumbnail_of, verify_map
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.keyframes import image_change, KeyframeSelector, small_gray
from stavpr_ros.mapping.place_map import THUMBNAIL_WIDTH
from stavpr_ros.mapping.trajectory import normalize_pose
from stavpr_ros.method import Candidate, Match, PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.method.localizer import SequenceRecognizer
from stavpr_ros.method.loop_closer import LoopCloser
from stavpr_ros.method.match import Limits
from stavpr_ros.method.verification import GeometricCheck
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.pipeline.save_state import SaveState
from stavpr_ros.pipeline.settings import PipelineSettings
from stavpr_ros.relative_pose.pair import matched_pair, MatchedPair
from stavpr_ros.sources.encodings import decode_message
from stavpr_ros.sources.files import RANGE_IMAGES, RangeFinder, scale, ToBytes
from stavpr_ros.units import SECOND

NO_MAP = (
    'no map is loaded: call the service ~/load_map, or start the node with the parameter map_path'
)
NO_THRESHOLD = (
    "mode paper requires the parameter 'threshold', since the map has none: "
    "'ros2 param set /stavpr threshold VALUE', or build the map again"
)
NOT_A_KEYFRAME = 'not a keyframe'
BLANK_IMAGE = np.zeros((480, 640, 3), np.uint8)
WARM_IMAGES = 8  # besides a window, that are recognized before the first one of a drive


@runtime_checkable
class PartialMap(Protocol):
    """A map in a store: it recognizes with the places that it has fetched."""

    def recognizer(self, settings: RecognizerSettings) -> SequenceRecognizer:
        """Return a recognizer of the map; SettingsError for settings that it does not have."""


class WindowRow(NamedTuple):
    """An image of the window: stamp [ns], 0 = unknown; pose (7,) and thumbnail, None = unknown."""

    stamp: int
    pose: np.ndarray | None
    thumbnail: np.ndarray | None = None

    @property
    def jpeg(self) -> bytes:
        """Return the thumbnail, encoded; empty without one."""
        return b'' if self.thumbnail is None else encode_thumbnail(self.thumbnail)


class Operation(ABC):
    """
    Base of the operations: from one image message to one result; the window of the images.

    Properties aside, all calls must come from one thread.

    :param place_map: the map to localize on or to extend; loop closure has a route of its own.
    :param extractor: of the map; None = of the settings, for growing maps.
    :param save_state: of the places.
    :raises StavprError: invalid settings, a map that cannot be used, or a missing model.

    ``places`` is a map, a growing one, or None while localization waits for one; ``recognizer``
    is None without a map.
    """

    name = ''

    def __init__(
        self,
        settings: PipelineSettings,
        place_map: Map | None,
        extractor: FeatureExtractor | None,
        save_state: SaveState,
    ) -> None:
        self.settings, self.extractor, self.save_state = settings, extractor, save_state
        self.drives: list[GrowingMap] = []  # which may update the map; empty = none is recorded
        self.places: Map | GrowingMap | None = place_map
        self.reference = place_map  # that images are matched with; None = the recorded route
        self.recognizer: SequenceRecognizer | None = None
        self._start(place_map)
        self._to_bytes: ToBytes | None = None
        if self.extractor is not None:
            of_map = scale(self.extractor.settings.value_range)
            self._to_bytes = RangeFinder() if self.extractor.is_new else of_map
        image_change(*[small_gray(BLANK_IMAGE)] * 2)  # compiles what keyframes need
        self._keyframes = KeyframeSelector(settings.keyframes)
        self._check = GeometricCheck(settings.geometric) if settings.geometric else None
        self._last: ImageResult | None = None
        self._window: deque[WindowRow] = deque(maxlen=settings.sequence.length)
        self._image: np.ndarray | None = None  # the last one

    def _begin_drive(self) -> None:
        assert self.extractor is not None
        limit, settings = self.settings.max_places, self.extractor.settings
        self.drives.append(GrowingMap(settings, self.extractor.projection, limit))

    @abstractmethod
    def _start(self, place_map: Map | None) -> None:
        """Make the places and their recognizer: all that may fail or takes long."""

    @abstractmethod
    def _update(self, features: LocalFeatures, row: WindowRow) -> tuple[Match, int]:
        """Return the match of the window with an image, and the image's own place, -1 = none."""

    @property
    def matched_places(self) -> Map | GrowingMap | None:
        """Return the places that matches are of: the map, or the recorded route."""
        return self.places if self.reference is None else self.reference

    @property
    def contrast(self) -> float:
        """Return the deviation of the last image's green channel, of 255 (32 rows or columns)."""
        image = self._image  # once: other threads read this while the worker changes it
        if image is None:
            return math.nan
        step = max(1, min(image.shape[:2]) // 32)
        return float(image[::step, ::step, 1].std())

    @property
    def map_state(self) -> str:
        """Return one of ``none``, ``loaded``, ``growing`` or ``full``."""
        places = self.places
        if not isinstance(places, GrowingMap):
            return 'none' if places is None else 'loaded'
        # a full route evicts places instead
        return 'full' if places.full and self.name == 'mapping' else 'growing'

    @property
    def threshold(self) -> float | None:
        """Return the distance below which a window is matched: as set, or the map's; or None."""
        if (recognizer := self.recognizer) is None:
            return self.settings.applied_threshold
        return recognizer.threshold

    @property
    def missing(self) -> str:
        """Return why no match is possible yet; empty when nothing is missing."""
        if self.places is None:
            return NO_MAP
        is_open = self.recognizer is not None and self.threshold is None
        return NO_THRESHOLD if is_open else ''

    @property
    def window_fill(self) -> int:
        """Return the number of images in the window of the recognizer."""
        return 0 if (recognizer := self.recognizer) is None else recognizer.window_fill

    def take_drives(self) -> list[GrowingMap]:
        """Return the recorded drives, which belong to the caller now; another one begins."""
        drives = [drive for drive in self.drives if len(drive)]
        self.drives = [drive for drive in self.drives if not len(drive)]
        if drives and not self.drives:
            self._begin_drive()
        return drives

    def return_drives(self, drives: list[GrowingMap]) -> None:
        """Take drives back that are in no file."""
        self.drives[:0] = drives

    def apply(self, settings: PipelineSettings) -> None:
        """
        Apply the limits, keyframes, candidates and geometric check of other settings.

        :raises SettingsError: limits out of range; nothing is changed then.
        """
        before, check = self.threshold, settings.geometric
        if self.recognizer is not None:
            self.recognizer.set_limits(
                settings.threshold, settings.min_probability, settings.max_error
            )
        self.settings, self._keyframes.settings = settings, settings.keyframes
        if before is None and self.threshold is not None:
            self.reset()  # images since then are not in the window
        if check != (self._check and self._check.settings):
            self._check = GeometricCheck(check) if check else None

    def reset(self) -> None:
        """Empty the window: the next images do not continue those before."""
        self._last = None
        self._window.clear()
        for part in (self._keyframes, self._check, self.recognizer):
            if part is not None:
                part.reset()

    def process(
        self,
        message: Any,
        stamp: int,
        pose: np.ndarray | None = None,
        camera: Camera | None = None,
        list_candidates: bool = True,
        yaw: Callable[[], float] | None = None,
    ) -> ImageResult:
        """
        Process one image message, raw or compressed. An invalid image changes nothing.

        :param stamp: of the image, ns, 0 = unknown.
        :param pose: of the camera, from odometry, shape (7,), or None.
        :param camera: None = unknown: in localization, no thumbnail is kept for an edge.
        :param list_candidates: the result has its candidates.
        :param yaw: returns the yaw of the camera in the base of the robot, radians to the left;
            None = unknown. Called only where the map states the mounting of its own camera.
        :raises InputError: an invalid pose; nothing is changed then.
        """
        pose = None if pose is None else normalize_pose(pose)
        if self.missing:
            return self.unmatched(Status.NOT_READY, self.missing, 'not ready')
        if reason := self._keyframes.too_soon(stamp, pose):
            blind = pose is None and self.settings.keyframes.needs_poses
            return self.unmatched(
                Status.SKIPPED, reason, 'no odometry' if blind else NOT_A_KEYFRAME
            )
        stages: dict[str, float] = {}
        try:
            with _Timed(stages, 'decoding'):
                image = self._decode(message, camera)
                if refusal := self._refusal(image):
                    return self.unmatched(*refusal, image=image, stages=stages)
            match, index = self._process(stages, image, WindowRow(stamp, pose), camera)
        except StavprError as error:
            kind = error.kind if isinstance(error, ImageError) else type(error).__name__
            cause = f'invalid: {kind}'
            return self.unmatched(Status.INVALID_IMAGE, str(error), cause, stages=stages)
        candidates: list[Candidate] = []
        sessions: tuple[float, ...] = ()
        if list_candidates and self.recognizer is not None and match.path.place >= 0:
            candidates = self.recognizer.ranked(self.settings.candidates, match)
            sessions = self._session_probabilities()
        self._last = ImageResult(
            match,
            '',
            index,
            tuple(candidates),
            sessions,
            self._relative_yaw(match, yaw),
            image,
            stages,
        )
        return self._last

    def unmatched(
        self, status: Status, reason: str, cause: str = '', **others: Any
    ) -> ImageResult:
        """Return the result of an image that is in no window; cause: see :class:`ImageResult`."""
        threshold = math.nan if self.threshold is None else self.threshold
        return ImageResult(Match(status, reason, Limits(threshold)), cause, **others)

    def _decode(self, message: Any, camera: Camera | None) -> np.ndarray:
        """Return the image of a message, RGB, as small as it may be."""
        assert self.extractor is not None
        size = self.extractor.needed_size(self._thumbnail_width(camera))
        self._image = decode_message(message, size, self._to_bytes)
        return self._image

    def _refusal(self, image: np.ndarray) -> tuple[Status, str, str] | None:
        """Return status, reason and cause where an image is not for the window, else None."""
        assert self.extractor is not None
        if self.extractor.is_new and (reason := self._find_range()):
            return Status.NOT_READY, reason, 'not ready'
        if reason := self._keyframes.too_alike(image):
            return Status.SKIPPED, reason, NOT_A_KEYFRAME
        if self.map_state == 'full':
            reason = f'the map is full: parameter max_places = {self.settings.max_places}'
            return Status.NOT_READY, reason, 'map full'
        return None

    def _process(
        self, stages: dict[str, float], image: np.ndarray, row: WindowRow, camera: Camera | None
    ) -> tuple[Match, int]:
        """Add an image to the window; return its match, and the place that it has become."""
        assert self.extractor is not None
        width = self._thumbnail_width(camera)
        with _Timed(stages, 'extraction'):
            features = self.extractor.extract([image])
        with _Timed(stages, 'matching'):
            row = row._replace(thumbnail=thumbnail_of(image, width) if width else None)
            match, index = self._update(features, row)
        self._window.append(row)
        self._keyframes.accept(row.stamp, row.pose, image)
        if isinstance(self.places, GrowingMap):
            self.places.camera = self.places.camera or camera
            self.save_state.record(self.places, features)
        if self.recognizer is not None:
            with _Timed(stages, 'verification'):
                match = self._check_match(match, index)
        return match, index

    def _session_probabilities(self) -> tuple[float, ...]:
        """Return the probability of each session of the map, by the newest image."""
        places, recognizer = self.reference, self.recognizer
        if places is None or places.session_index is None or recognizer is None:
            return ()
        by_place = recognizer.place_probabilities()
        if len(by_place) != len(places):
            return ()
        sums = np.bincount(places.session_index, by_place, len(places.sessions))
        return tuple(sums.tolist())

    def _relative_yaw(self, match: Match, yaw: Callable[[], float] | None) -> float:
        """Return the yaw by the mountings, where the map states the mounting of its camera."""
        places = self.matched_places
        if yaw is None or not (match.accepted and isinstance(places, Map)):
            return 0.0
        session = places.session(match.place)
        if session is None or session.yaw is None:
            return 0.0
        return math.remainder(session.yaw - yaw(), 2 * math.pi)

    def _find_range(self) -> str:
        """Find the range of 16 bits by the first images of a new map; return why it lacks one."""
        finder, extractor = self._to_bytes, self.extractor
        assert isinstance(finder, RangeFinder)
        assert extractor is not None
        images = finder.images
        if not 0 < images < RANGE_IMAGES:
            extractor.set_value_range(finder.value_range)
            self._to_bytes = scale(extractor.settings.value_range)
            if images:
                self._start(None)  # with these settings
        return f'images of 16 bits, {images} of {RANGE_IMAGES} for their range' if images else ''

    def _check_match(self, match: Match, index: int) -> Match:
        """Return a match, and its late ones that are matches, after the geometric check."""
        check, places = self._check, self.matched_places
        if check is None or places is None:
            return match
        is_weighed = self.reference is not None and not math.isnan(match.probability)
        late = [check.check(row, places, self._query(row), False) for row in match.late]
        match = check.check(match, places, self._query(match), is_weighed)
        return replace(match, late=tuple(row for row in late if row.accepted))

    def _query(self, match: Match) -> np.ndarray | None:
        """Return the thumbnail of the image that a match is of; None = unknown."""
        places = self.places
        if match.is_late and isinstance(places, GrowingMap):
            return places.thumbnail(match.first_image + match.position)
        return self._window[match.position - len(match.window_stamps)].thumbnail

    def _thumbnail_width(self, camera: Camera | None) -> int:
        """Return the width of the thumbnails that are needed, 0 = none is."""
        width = self.settings.thumbnail_width
        if isinstance(self.places, GrowingMap):
            return width
        return (width or THUMBNAIL_WIDTH) if self._check or camera else 0

    def relocalize(self, count: int) -> ImageResult:
        """
        Return the result of the current window, with ``count`` candidates.

        :raises InputError: the window is not full, or no match is possible; names the reason.
        """
        if self.missing:
            raise InputError(self.missing)
        if self.recognizer is None:
            raise InputError(
                f'operation {self.name} recognizes no places: set_operation localization first'
            )
        last, length = self._last, self.settings.sequence.length
        if last is None or (last.match.path.place < 0 and self.window_fill < length):
            raise InputError(f'{self.window_fill} of {length} images in the window')
        candidates = tuple(self.recognizer.ranked(count, last.match))
        return ImageResult(last.match, candidates=candidates, relative_yaw=last.relative_yaw)

    def matched_pair(
        self, match: Match, relative_pose: str = 'auto', relative_yaw: float = 0.0
    ) -> MatchedPair | None:
        """
        Return the pair of the newest match, or of one of its late ones, for its edge.

        :param relative_pose: the parameter of this name.
        :param relative_yaw: see :class:`ImageResult`.
        :returns: None without a match, or where the place of a map can have no edge.
        """
        places, recognizer = self.matched_places, self.recognizer
        if not match.accepted or places is None or recognizer is None:
            return None
        if isinstance(places, Map) and (
            relative_pose == 'none' or places.place(match.place).pose is None
        ):
            return None
        count, distances = len(match.window_stamps), None
        if relative_pose in ('auto', 'aligned'):
            columns = recognizer.window_columns
            distances = match.columns.at if match.columns else lambda k: columns(k)[-count:]
        if match.is_late and isinstance(places, GrowingMap):
            poses = places.poses[match.first_image - places.first + np.arange(count)]
        else:
            rows, unknown = list(self._window)[-count:], np.full(7, np.nan)
            poses = np.array([unknown if row.pose is None else row.pose for row in rows])
        return matched_pair(match, places, self._query(match), poses, distances, relative_yaw)


class LocalizationOperation(Operation):
    """
    Recognizes the places of a map; without one, it waits for it.

    With ``update_map``, it records its drives, each from one reset to the next.
    """

    name = 'localization'

    def _start(self, place_map: Map | None) -> None:
        settings = self.settings
        if self.extractor is None or place_map is None:
            return
        if settings.update_map and os.path.isfile(self.save_state.path):
            self._begin_drive()
        self.recognizer = _map_recognizer(settings, self.name, place_map, self.extractor)

    def _update(self, features: LocalFeatures, row: WindowRow) -> tuple[Match, int]:
        assert self.recognizer is not None
        jpeg = row.jpeg if self.drives else b''
        match = self.recognizer.update(features, row.stamp, row.pose)
        if self.drives and sum(map(len, self.drives)) < self.settings.max_places:
            self.drives[-1].add(features, row.stamp, pose=row.pose, thumbnail=jpeg)
        return match, -1

    def _thumbnail_width(self, camera: Camera | None) -> int:
        return (
            super()._thumbnail_width(camera) or bool(self.drives) * self.settings.thumbnail_width
        )

    def reset(self) -> None:
        """Empty the window; another drive begins."""
        super().reset()
        if self.drives and len(self.drives[-1]):
            self._begin_drive()


class Mapper(Operation):
    """
    Records places, of a new map or of one that it extends by a session.

    On a map, each image is matched with the places that were there at the start, and related to
    the place that it shows.
    """

    name = 'mapping'
    places: GrowingMap

    def _start(self, place_map: Map | None) -> None:
        limit = self.settings.max_places
        self.extractor = extractor = self.extractor or self.settings.extractor()
        extractor.extract([BLANK_IMAGE])
        if place_map is None:
            self.places = GrowingMap(extractor.settings, extractor.projection, limit)
            return
        if place_map.partial:
            raise SettingsError(
                'operation mapping does not extend the map of a fleet: record a map of its own, '
                'without map_path'
            )
        if os.path.isdir(path := self.save_state.path):
            raise SettingsError(
                f'operation mapping does not extend the folder {path}: name one of its maps, or '
                'make one map of them, `stavpr map merge`'
            )
        verify_map(place_map)  # damage would be saved again, with correct hashes
        self.places = GrowingMap.from_map(place_map, limit)
        if len(place_map):
            self.places.begin_session(Path(path).stem or 'recorded')
            self.recognizer = _map_recognizer(self.settings, self.name, place_map, extractor)

    @property
    def missing(self) -> str:
        """Return why no image can be recorded; without a threshold, none is matched."""
        return ''

    def _update(self, features: LocalFeatures, row: WindowRow) -> tuple[Match, int]:
        jpeg, recognizer = row.jpeg, self.recognizer  # first, since it may fail
        if recognizer is None:
            match = self.unmatched(Status.MAPPED, '').match
        else:
            match = recognizer.update(features, row.stamp, row.pose)
        return match, self.places.add(features, row.stamp, pose=row.pose, thumbnail=jpeg)

    def _check_match(self, match: Match, index: int) -> Match:
        """Return a match after the geometric check; without one, it is of a place only."""
        match = super()._check_match(match, index)
        if not match.accepted:
            return replace(match, status=Status.MAPPED, reason='')
        self._relate(match, index)
        return match

    def _relate(self, match: Match, index: int) -> None:
        """Relate the images of a full window that is certain to the places that they show."""
        count = len(match.window_stamps)
        if count < self.settings.sequence.length or not match.probability > SURE:
            return
        first = index - count + 1
        for image, place in match.path.pairs.tolist():
            self.places.relate(first + image, place, replaces=image >= match.position)
        self.places.relate(first + match.position, match.place)


class RouteCloser(Operation):
    """Records a route and recognizes its earlier places; a full route evicts its oldest ones."""

    name = 'loop_closure'
    places: GrowingMap

    def _start(self, place_map: Map | None) -> None:
        settings, self.reference = self.settings, None
        self.extractor = extractor = self.extractor or settings.extractor()
        self.recognizer = self._closer = _loop_closer(settings, settings.exclude_places, extractor)
        # a closer that excludes next to nothing needs few images to warm up, on a second lap
        lap = _noise(extractor.extract([BLANK_IMAGE]), settings.sequence.length + WARM_IMAGES)
        closer = _loop_closer(settings, 1, extractor)
        for _ in range(2):
            _warm_up(closer, lap)
        self.places = GrowingMap(
            extractor.settings,
            extractor.projection,
            settings.max_places,
            held_features=self._closer.features,
        )

    def _update(self, features: LocalFeatures, row: WindowRow) -> tuple[Match, int]:
        jpeg = row.jpeg  # first, since it may fail: recognizer and route stay in step
        match = self._closer.update(features, row.stamp, row.pose)
        self.places.forget(self._closer.first - self.places.first)  # it evicts the oldest places
        return match, self.places.add(features, row.stamp, pose=row.pose, thumbnail=jpeg)


CLASSES = {operation.name: operation for operation in (LocalizationOperation, Mapper, RouteCloser)}
if not TYPE_CHECKING:
    __getattr__ = former.classes(__name__)


def _map_recognizer(
    settings: PipelineSettings, operation: str, place_map: Map, extractor: FeatureExtractor
) -> SequenceRecognizer:
    """Return the recognizer of a map, compiled and with an empty window."""
    recognizer: SequenceRecognizer
    if place_map.partial:
        recognizer = _partial_recognizer(settings, place_map)
    else:
        backend = settings.matching_backend(operation)
        recognizer = PlaceRecognizer(place_map, settings, backend, settings.precision)
    count, of_map = settings.sequence.length + WARM_IMAGES, None
    images = _noise(extractor.extract([BLANK_IMAGE]), count)
    if isinstance(recognizer, PlaceRecognizer):  # images of the map match it
        images, of_map = place_map.features[:count], place_map
    _warm_up(recognizer, images, of_map)
    return recognizer


def _partial_recognizer(settings: PipelineSettings, place_map: Map) -> SequenceRecognizer:
    others = settings.precision, settings.direction
    if settings.backend == 'cuda' or others[0] == 'int8' or others[1] != 'forward':
        raise SettingsError(
            f'backend {settings.backend}, precision {settings.precision}, direction '
            f'{settings.direction}: the map of a fleet is matched on the CPU in float32; take '
            'backend auto or cpu, precision auto or float32, and direction forward'
        )
    assert isinstance(place_map, PartialMap)
    return place_map.recognizer(settings)


def _loop_closer(
    settings: PipelineSettings, exclude: int, extractor: FeatureExtractor
) -> LoopCloser:
    return LoopCloser(
        settings,
        exclude,
        extractor.settings,
        limit=settings.max_places,
        exclude_seconds=settings.exclude_seconds,
        precision=settings.precision,
    )


def _noise(features: LocalFeatures, count: int) -> LocalFeatures:
    """Return features of images that all differ, shaped as of one image."""
    shape = len(features.strips), count, features.strips.shape[2]
    strips = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    strips /= np.linalg.norm(strips, axis=2, keepdims=True)
    return replace(features, strips=strips, weights=np.repeat(features.weights, count, axis=-1))


def _warm_up(
    recognizer: SequenceRecognizer, images: LocalFeatures, place_map: Map | None = None
) -> None:
    """Compile and allocate everything by images; of a map, by its first places with poses."""
    for i in range(len(images)):
        pose = None if place_map is None else place_map.pose(i)
        recognizer.update(images[i : i + 1], (i + 1) * SECOND // 10, pose)
    recognizer.ranked(2)
    recognizer.reset()


class _Timed:
    """Records the duration of a stage, seconds; costs less than a generator."""

    def __init__(self, stages: dict[str, float], name: str) -> None:
        self._stages, self._name = stages, name

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *error: object) -> None:
        self._stages[self._name] = time.perf_counter() - self._began
