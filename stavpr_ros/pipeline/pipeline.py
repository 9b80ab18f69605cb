# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pipeline: from one image message to one match; the map and the operation."""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
import math
import time
from typing import Any

import numpy as np
from stavpr_ros.errors import ImageError, InputError, StavprError
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import encode_thumbnail, GrowingMap, PlaceMap, thumbnail_of
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.journal import Base
from stavpr_ros.mapping.keyframes import KeyframeSelector
from stavpr_ros.mapping.place_map import THUMBNAIL_WIDTH
from stavpr_ros.mapping.stored_features import StoredFeatures
from stavpr_ros.mapping.trajectory import checked_pose
from stavpr_ros.pipeline.geometric_check import GeometricCheck
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.pipeline.save_state import MapSnapshot, OpenJournal, SaveState
from stavpr_ros.pipeline.settings import PipelineSettings
from stavpr_ros.pipeline.start import LoadedMap, Operation, start_operation
from stavpr_ros.pipeline.view_bank import ViewBank
from stavpr_ros.recognition import Status
from stavpr_ros.recognition.loop_closer import LoopCloser
from stavpr_ros.recognition.recognizer import SequenceRecognizer
from stavpr_ros.relative_pose.pair import matched_pair, MatchedPair
from stavpr_ros.sources.encodings import decode_message

NO_MAP = (
    "no map: call the service load_map, or set parameter 'map_path' before the node is configured"
)
NO_THRESHOLD = (
    "parameter 'threshold' is not set, which mode paper requires where the map suggests none: "
    "'ros2 param set /stavpr threshold VALUE', or build the map again"
)
NOT_A_KEYFRAME = 'not a keyframe'


class Pipeline:
    """
    Processes image messages. All calls except those of properties must come from one thread.

    :param operation: one of ``OPERATIONS``.
    :param open_journal: of recorded places; None = they are in memory only.
    :raises StavprError: invalid settings, or a missing model.

    ``operation`` and ``settings`` are those in force; :meth:`change` sets them.
    """

    def __init__(
        self,
        settings: PipelineSettings,
        operation: str = 'localization',
        open_journal: OpenJournal = lambda base, template: None,
    ) -> None:
        self.settings, self._open_journal = settings, open_journal
        # of localization, or of loop closure for its kind of features
        self._map: PlaceMap | None = None
        self._extractor: FeatureExtractor | None = None
        self._operation: Operation | None = None
        self.operation = operation
        self._keyframes = KeyframeSelector(settings.keyframes)
        self._check = GeometricCheck(settings.geometric) if settings.geometric else None
        self._last: ImageResult | None = None
        # thumbnail and pose of each image in the window; None = not needed, unknown
        self._window: deque[tuple[np.ndarray | None, np.ndarray | None]] = deque()
        self.save_state = SaveState()  # of the places in use
        # of the map, where loop closure has places of its own
        self._map_save_state = self.save_state
        self.contrast = math.nan  # of the last image
        self._start(operation, settings, None)

    @property
    def places(self) -> PlaceMap | GrowingMap | None:
        """Return the map, or the recorded route."""
        operation = self._operation  # once: other threads read this while the worker changes it
        return operation.places if operation else self._map

    @property
    def path(self) -> str:
        """Return the file that the places in use were loaded from or last saved to, '' = none."""
        return self.save_state.path

    @property
    def unsaved(self) -> int:
        """Return the number of places in use that are in no file."""
        return min(self.save_state.unsaved, len(self.places or ()))

    @property
    def extractor(self) -> FeatureExtractor | None:
        """Return the feature extractor."""
        operation = self._operation
        return operation.extractor if operation else self._extractor

    @property
    def _recognizer(self) -> SequenceRecognizer | None:
        updated = self._updated
        return updated.recognizer if isinstance(updated, ViewBank) else updated

    @property
    def _updated(self) -> SequenceRecognizer | ViewBank | None:
        """Return what the features of an image are given to."""
        operation = self._operation
        return (operation.views or operation.recognizer) if operation else None

    @property
    def view(self) -> str:
        """Return how images are compared, one of ``VIEWS``; empty without other views."""
        updated = self._updated
        return updated.view if isinstance(updated, ViewBank) else ''

    @property
    def map_state(self) -> str:
        """Return one of ``none``, ``loaded``, ``growing`` or ``full``."""
        if self.operation == 'localization':
            return 'loaded' if self._map is not None else 'none'
        return 'full' if self._is_full else 'growing'

    @property
    def threshold(self) -> float | None:
        """Return the distance below which a window is matched: as set, or the map's; or None."""
        recognizer = self._recognizer
        return recognizer.threshold if recognizer else self.settings.applied_threshold

    @property
    def window_fill(self) -> int:
        """Return the number of images in the window of the recognizer."""
        recognizer = self._recognizer
        return recognizer.window_fill if recognizer else 0

    @property
    def stages(self) -> str:
        """Return how a time budget is kept; empty without one."""
        recognizer = self._recognizer
        return recognizer.start_notes if recognizer and self.operation == 'localization' else ''

    @property
    def missing(self) -> str:
        """Return why no match is possible yet; empty when nothing is missing."""
        if self.operation == 'localization' and self._map is None:
            return NO_MAP
        if self.operation != 'mapping' and self.threshold is None:
            return NO_THRESHOLD
        return ''

    @property
    def problem(self) -> str:
        """Return why places, or the file, of the map cannot be reached; empty while they can."""
        place_map, recognizer = self._map, self._recognizer
        problem = recognizer.problem if recognizer else ''
        if place_map is not None and isinstance(place_map.features, StoredFeatures):
            problem = problem or place_map.features.file.problem
        return problem

    def change(
        self,
        settings: PipelineSettings | None = None,
        operation: str | None = None,
        loaded: LoadedMap | None = None,
    ) -> None:
        """
        Change settings, operation and map, all or nothing; None keeps the current one.

        A route that was recorded becomes the map of the next operation. Settings alone cannot fail
        when they differ in threshold, min_probability, max_error, keyframes, candidates and
        geometric check only.

        :param settings: other settings than these take effect with the next operation or map.
        :param loaded: the map to localize on, to extend, or (loop closure) whose kind of features
            to use.
        :raises InputError: unsaved places would be lost.
        :raises StavprError: an unknown operation, or invalid settings.
        """
        settings, name = settings or self.settings, operation or self.operation
        settings.require_operation(name)
        before = self.threshold
        if loaded is not None or name != self.operation:
            self._require_no_loss(name, loaded)
            self._start(name, settings, loaded)
        elif (updated := self._updated) is not None:
            updated.set_limits(settings.threshold, settings.min_probability, settings.max_error)
        self.settings = settings
        if before is None and self.threshold is not None:
            self.reset()  # images since then are not in the window
        self._keyframes.settings = settings.keyframes
        if settings.geometric != (self._check and self._check.settings):
            self._check = GeometricCheck(settings.geometric) if settings.geometric else None

    def snapshot(self) -> MapSnapshot:
        """
        Return the map, or the recorded route, to be written to a file.

        :raises InputError: there are no places.
        """
        place_map = self._places_as_map()
        if place_map is None:
            raise InputError(f'there is nothing to save yet: {self.missing or "no places"}')
        if place_map.partial:
            raise InputError(f'the map of a fleet stays where it is: {self.path}')
        state = self._map_save_state if place_map is self._map else self.save_state
        return MapSnapshot(place_map, state, state.recorded)

    def close_journals(self, delete_route: bool) -> list[str]:
        """
        Close the journals at the end; return those with unsaved places.

        :param delete_route: a route of loop closure is needed no longer.
        """
        kept = []
        for state in {self.save_state, self._map_save_state}:
            is_route = self.operation == 'loop_closure' and state is self.save_state
            path = str(state.journal.path) if state.journal and state.unsaved else ''
            state.close_journal(delete=delete_route and is_route)
            if path and not (delete_route and is_route):
                kept.append(path)
        return kept

    def reset(self) -> None:
        """Empty the window: the next images do not continue those before."""
        self._keyframes.reset()
        self._last = None
        self._window.clear()
        if self._check is not None:
            self._check.reset()
        if (updated := self._updated) is not None:
            updated.reset()

    def relocalize(self, count: int) -> ImageResult:
        """
        Return the result of the current window, with ``count`` candidates.

        :raises InputError: the window is not full, or no match is possible; names the reason.
        """
        if self.missing:
            raise InputError(self.missing)
        if self.operation == 'mapping':
            raise InputError(
                'operation mapping recognizes no places: set_operation localization first'
            )
        recognizer = self._recognizer
        if recognizer is None or self._last is None or self._last.status is Status.WARMING_UP:
            raise InputError(
                f'{self.window_fill} of {self.settings.sequence.length} images in the window'
            )
        return self._last.with_candidates(recognizer.ranked(count))

    def matched_pair(self, result: ImageResult, relative_pose: str = 'auto') -> MatchedPair | None:
        """
        Return the pair of the newest match, or of one of its late ones, for its edge.

        :param relative_pose: the parameter of this name.
        :returns: None without a match, or where the place of a map can have no edge.
        """
        places, recognizer, match = self.places, self._recognizer, result.match
        if not result.accepted or match is None or places is None or recognizer is None:
            return None
        place = result.place_index
        if self.operation == 'localization' and (
            relative_pose == 'none' or places.place(place).pose is None
        ):
            return None
        distances = recognizer.window_columns if relative_pose in ('auto', 'aligned') else None
        unknown = np.full(7, np.nan)
        poses = np.array([unknown if pose is None else pose for _, pose in self._window])
        query = self._window[match.position][0]
        if match.is_late and isinstance(places, GrowingMap):
            query = places.thumbnail(match.first_image_index + match.position)
            window = match.first_image_index - places.first + np.arange(len(poses))
            poses = places.poses[window]
            distances = distances and match.columns_of
        return matched_pair(match, place, places, query, poses, distances)

    def newest_distances(self) -> np.ndarray:
        """Return the distances of the newest image to its places, (n,), float32; none before."""
        recognizer = self._recognizer
        if recognizer is None or not recognizer.window_fill:
            return np.empty(0, np.float32)
        return recognizer.newest_row()

    def window_distances(self, places: np.ndarray) -> np.ndarray:
        """
        Return the distances of the images in the window to given places.

        :param places: shape (k,), int64.
        :returns: shape (m, k), float32, oldest image first, +inf for places not compared.
        """
        recognizer = self._recognizer
        assert recognizer is not None
        return recognizer.window_columns(places)

    def process(
        self,
        message: Any,
        stamp: int,
        pose: np.ndarray | None = None,
        camera: Camera | None = None,
        list_candidates: bool = True,
    ) -> ImageResult:
        """
        Process one image message, raw or compressed. An invalid image changes nothing.

        :param stamp: of the image, ns, 0 = unknown.
        :param pose: of the camera, from odometry, shape (7,), or None.
        :param camera: None = unknown: in localization, no thumbnail is kept for an edge.
        :param list_candidates: the match has its candidates.
        :raises InputError: an invalid pose; nothing is changed then.
        """
        threshold = math.nan if self.threshold is None else self.threshold
        pose = None if pose is None else checked_pose(pose)
        if self._operation is None or self.missing:
            return ImageResult(Status.NOT_READY, self.missing, threshold, cause='not ready')
        if reason := self._keyframes.too_soon(stamp, pose):
            blind = pose is None and self.settings.keyframes.needs_poses
            cause = 'no odometry' if blind else NOT_A_KEYFRAME
            return ImageResult(Status.SKIPPED, reason, threshold, cause=cause)
        stages: dict[str, float] = {}
        try:
            result = self._process(self._operation, stages, message, stamp, pose, camera)
        except StavprError as error:
            kind = error.kind if isinstance(error, ImageError) else type(error).__name__
            result = ImageResult(Status.INVALID_IMAGE, str(error), cause=f'invalid: {kind}')
        recognizer = self._recognizer
        if list_candidates and recognizer is not None and result.nearest_index >= 0:
            result = result.with_candidates(recognizer.ranked(self.settings.candidates))
        if math.isnan(result.threshold):  # none has applied
            result = replace(result, threshold=threshold)
        return replace(result, stages=stages)

    def _process(
        self,
        operation: Operation,
        stages: dict[str, float],
        message: Any,
        stamp: int,
        pose: np.ndarray | None,
        camera: Camera | None,
    ) -> ImageResult:
        width = self._thumbnail_width(camera)
        with _timed(stages, 'decoding'):
            image = decode_message(message, _needed_size(operation, width))
            self.contrast = _contrast(image)
            if reason := self._keyframes.too_alike(image):
                return ImageResult(Status.SKIPPED, reason, image=image, cause=NOT_A_KEYFRAME)
        if self._is_full:
            reason = f'the map is full: parameter max_places = {self.settings.max_places}'
            return ImageResult(Status.NOT_READY, reason, image=image, cause='map full')
        with _timed(stages, 'extraction'):
            images = operation.views.warped(image) if operation.views else [image]
            features = operation.extractor.extract(images)
        with _timed(stages, 'matching'):
            thumbnail = thumbnail_of(image, width) if width else None
            result = _update(operation, features, thumbnail, stamp, pose)
        self._window.append((thumbnail, pose))
        self._keyframes.accept(stamp, pose, image)
        if isinstance(operation.places, GrowingMap):
            operation.places.camera = operation.places.camera or camera
            self.save_state.record(operation.places, features, self._open_journal)
        if operation.recognizer is None:
            return replace(result, image=image)
        with _timed(stages, 'verification'):
            if self._check is not None:
                middle, _ = self._window[(len(self._window) - 1) // 2]
                is_robust = not math.isnan(result.probability)
                is_weighed = is_robust and self.operation == 'localization'
                result = self._check.checked(result, operation.places, middle, is_weighed)
            late = tuple(each for each in result.late if each.accepted)
        self._last = replace(result, image=image, late=late)
        return self._last

    def _thumbnail_width(self, camera: Camera | None) -> int:
        """Return the width of the thumbnails that are needed, 0 = none is."""
        width = self.settings.thumbnail_width
        if self.operation == 'localization':
            return (width or THUMBNAIL_WIDTH) if self._check or camera else 0
        return width

    def _start(self, name: str, settings: PipelineSettings, loaded: LoadedMap | None) -> None:
        """Start an operation; an error changes nothing."""
        place_map, extractor = self._places_as_map(), self.extractor
        save_state = self._map_save_state if place_map is self._map else self.save_state
        if loaded is not None:
            place_map, extractor = loaded.places, loaded.extractor
            save_state = SaveState(loaded.path, Base.of(loaded.path, loaded.places.stamps))
        operation = start_operation(name, settings, place_map, extractor)
        before = {self.save_state, self._map_save_state}
        # in mapping, it is part of the growing map
        self._map = None if name == 'mapping' else place_map
        self._operation, self.operation = operation, name
        self._window = deque(maxlen=settings.sequence.length)
        self._extractor = operation.extractor if operation is not None else extractor
        self._map_save_state = save_state
        self.save_state = SaveState() if name == 'loop_closure' else save_state
        for state in before - {self.save_state, save_state}:
            state.close_journal(delete=False)  # its places were discarded, but may be recovered
        self.reset()

    def _require_no_loss(self, name: str, loaded: LoadedMap | None) -> None:
        """Reject the loss of unsaved places; loading a map in localization discards them."""
        leaves = name == 'loop_closure' != self.operation  # its route replaces the recorded map
        replaces = loaded is not None and self.operation == 'mapping'
        if self.unsaved and (leaves or replaces):
            raise InputError(
                f'the map has {self.unsaved} places that are not saved: save_map first (or '
                'discard them by load_map, in operation localization)'
            )
        is_route = self.operation == name == 'loop_closure'
        if loaded is not None and is_route and len(self.places or ()):
            raise InputError(
                'the recorded route would be lost: save_map, then set_operation localization'
            )

    def _places_as_map(self) -> PlaceMap | None:
        """Return a copy of the recorded places, or the map; None without any."""
        places = self._operation.places if self._operation else None
        if places is None or not len(places):
            return self._map
        return places.snapshot() if isinstance(places, GrowingMap) else places

    @property
    def _is_full(self) -> bool:
        """Whether mapping stops here; a full route of loop closure evicts places instead."""
        places = self.places
        return self.operation == 'mapping' and isinstance(places, GrowingMap) and places.full


def _update(
    operation: Operation,
    features: LocalFeatures,
    thumbnail: np.ndarray | None,
    stamp: int,
    pose: np.ndarray | None,
) -> ImageResult:
    """Match the window that ends with an image, and add the image to growing places."""
    places, recognizer = operation.places, operation.recognizer
    jpeg = b''
    if isinstance(places, GrowingMap) and thumbnail is not None:
        # first, since it may fail: recognizer and route stay in step
        jpeg = encode_thumbnail(thumbnail)
    result = ImageResult(Status.MAPPED)
    if recognizer is not None:
        match = (operation.views or recognizer).update(features, stamp, pose)
        result = ImageResult.of_match(match)
    if not isinstance(places, GrowingMap):
        return result
    if isinstance(recognizer, LoopCloser):  # it evicts the oldest places
        places.forget(recognizer.first - places.first)
    index = places.add(features, stamp, pose=pose, thumbnail=jpeg)
    return replace(result, image_index=index)


def _needed_size(operation: Operation, thumbnail_width: int) -> tuple[int, int] | None:
    """Return the rows and columns of an image that have an effect; None = all."""
    backbone = operation.extractor.settings.backbone
    if backbone.resize != 'area':  # bilinear features are of single pixels
        return None
    return backbone.size, max(backbone.size, thumbnail_width)


def _contrast(image: np.ndarray) -> float:
    """Return the standard deviation of the green channel, of 255; from 32 rows or columns."""
    step = max(1, min(image.shape[:2]) // 32)
    return float(image[::step, ::step, 1].std())


@contextmanager
def _timed(stages: dict[str, float], name: str) -> Iterator[None]:
    """Record the duration of a stage, seconds."""
    began = time.perf_counter()
    try:
        yield
    finally:
        stages[name] = time.perf_counter() - began
