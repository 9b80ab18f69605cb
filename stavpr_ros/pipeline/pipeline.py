"""The pipeline: the map, the operation, and one answer for one image message."""

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stavpr_ros.errors import ImageError, InputError, MapFileError, StavprError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import GrowingMap, PlaceMap, place_thumbnail, save_map
from stavpr_ros.mapping.keyframes import KeyframeSelector
from stavpr_ros.mapping.trajectory import checked_pose
from stavpr_ros.pipeline.operations import Observed, Operation
from stavpr_ros.pipeline.save_state import SaveState
from stavpr_ros.pipeline.settings import PipelineSettings
from stavpr_ros.pipeline.start import LoadedMap, begin
from stavpr_ros.pipeline.stopwatch import Stopwatch
from stavpr_ros.recognition import Match, Status
from stavpr_ros.recognition.match import Candidate
from stavpr_ros.recognition.verification import GeometricVerifier
from stavpr_ros.sources.encodings import decode_message

NO_MAP = "no map: set parameter 'map_path' to a file made by build_map, or call the service load_map"
NO_THRESHOLD = "parameter 'threshold' is not set: build_map suggests one, 'ros2 param set' sets it"
NOT_A_KEYFRAME = 'not a keyframe'


@dataclass(frozen=True)
class Snapshot:
    """A map to be written, what was known of its files, and by how many places it had grown."""

    places: PlaceMap
    save_state: SaveState
    grown: int


class Pipeline:
    """
    Answers image messages. Belongs to one thread, which makes every call.

    :param settings: see :class:`PipelineSettings`.
    :param operation: one of ``OPERATIONS``.
    :raises StavprError: settings that do not do, or a model that is not there.
    """

    def __init__(self, settings: PipelineSettings, operation: str = 'localization') -> None:
        self._settings = settings
        self._map: PlaceMap | None = None
        self._extractor: FeatureExtractor | None = None
        self._operation: Operation | None = None
        self._name = operation
        self._keyframes = KeyframeSelector(settings.keyframes)
        self._verifier = GeometricVerifier(settings.geometric) if settings.geometric else None
        self._last: Match | None = None
        self.save_state = SaveState()  # of the places in use
        self._map_save_state = self.save_state  # of the map, where loop closure uses places of its own
        self.ranking = True  # tell the nearest places with every answer
        self._begin(operation, settings, None)

    @property
    def settings(self) -> PipelineSettings:
        """The settings in force."""
        return self._settings

    @property
    def operation(self) -> str:
        """The name of the operation."""
        return self._name

    @property
    def threshold(self) -> float | None:
        """The threshold in force, None = not set."""
        return self._settings.applied_threshold(self._name)

    @property
    def places(self) -> PlaceMap | GrowingMap | None:
        """The map, or the route so far."""
        operation = self._operation  # once: others may look while the worker changes it
        return operation.places if operation else self._map

    @property
    def path(self) -> str:
        """File that the places in use came from, or were written to last, '' = none."""
        return self.save_state.path

    @property
    def unsaved(self) -> int:
        """Places in use that are in no file."""
        return min(self.save_state.unsaved, len(self.places or ()))

    @property
    def extractor(self) -> FeatureExtractor | None:
        """What describes images."""
        operation = self._operation
        return operation.extractor if operation else self._extractor

    @property
    def map_state(self) -> str:
        """``none``, ``loaded``, ``growing`` or ``full``."""
        operation = self._operation
        if self._name == 'localization':
            return 'loaded' if self._map is not None else 'none'
        return 'full' if operation is not None and operation.full else 'growing'

    @property
    def window_fill(self) -> int:
        """Images in the window."""
        operation = self._operation
        return operation.window_fill if operation else 0

    @property
    def missing(self) -> str:
        """Why there can be no match yet, in words; empty when everything is there."""
        if self._name == 'localization' and self._map is None:
            return NO_MAP
        if self._name != 'mapping' and self.threshold is None:
            return NO_THRESHOLD
        return ''

    # what the node is asked to do

    def use(self, loaded: LoadedMap) -> None:
        """
        Use a map from now on: to recognize, to go on with, or (loop closure) for its kind of features.

        :raises StavprError: see :meth:`change`.
        """
        self.change(loaded=loaded)

    def set_operation(self, name: str) -> None:
        """
        Change the operation. A route that has grown is the map from then on.

        :raises StavprError: see :meth:`change`.
        """
        self.change(operation=name)

    def change(
        self,
        settings: PipelineSettings | None = None,
        operation: str | None = None,
        loaded: LoadedMap | None = None,
    ) -> None:
        """
        Change what may change while the pipeline runs, all of it or nothing; what is not given stays.

        :param settings: threshold, keyframes, candidates and check may differ from those in force.
        :raises InputError: places that are not saved would be lost.
        :raises StavprError: no such operation, or settings that do not do.
        """
        settings, name = settings or self._settings, operation or self._name
        threshold, was = settings.applied_threshold(name), self.threshold
        if loaded is not None or name != self._name or (self._operation is None and threshold is not None):
            self._refuse_loss(name, loaded)
            self._begin(name, settings, loaded)
        elif self._operation is not None and threshold is not None:
            if was is None and name != 'mapping':
                self.reset()  # images were not looked at meanwhile
            self._operation.set_threshold(threshold)
        self._settings = settings
        self._keyframes.settings = settings.keyframes
        self._verifier = GeometricVerifier(settings.geometric) if settings.geometric else None

    def _refuse_loss(self, name: str, loaded: LoadedMap | None) -> None:
        """Refuse to begin anew where that would lose places that nobody has given up."""
        leaves = name == 'loop_closure' != self._name  # its route will take the map's place
        replaces = loaded is not None and self._name == 'mapping'
        if self.unsaved and (leaves or replaces):
            raise InputError(
                f'the map has {self.unsaved} places that are not saved: save_map first (or give them up by '
                'load_map, in operation localization)'
            )
        if loaded is not None and self._name == name == 'loop_closure' and len(self.places or ()):
            raise InputError(
                'the route so far would be lost: save_map, then set_operation localization first'
            )

    def _begin(self, name: str, settings: PipelineSettings, loaded: LoadedMap | None) -> None:
        """Begin an operation; on an error everything stays as it was."""
        place_map, extractor = self.places_as_map(), self.extractor
        save_state = self._map_save_state if place_map is self._map else self.save_state
        if loaded is not None:
            place_map, extractor, save_state = loaded.places, loaded.extractor, SaveState(loaded.path)
        operation = begin(name, settings, place_map, extractor)
        self._map = None if name == 'mapping' else place_map  # in mapping, the growing map holds it
        self._operation, self._name = operation, name
        self._extractor = operation.extractor if operation is not None else extractor
        self._map_save_state, self.save_state = save_state, SaveState() if name == 'loop_closure' else save_state
        self.reset()

    def places_as_map(self) -> PlaceMap | None:
        """Return the places as a map, None without any."""
        if self._operation is None or not len(self._operation.places):
            return self._map
        return self._operation.map()

    def to_save(self, path: str, overwrite: bool) -> Snapshot:
        """
        Return the map, or the route so far, to be written to a file; tell :meth:`saved` when it is.

        :raises MapFileError: a file is there already, or its folder is not.
        :raises InputError: there is nothing to save.
        """
        place_map = self.places_as_map()
        if place_map is None:
            raise InputError(f'there is nothing to save yet: {self.missing or "no places"}')
        if os.path.exists(path) and not overwrite:
            raise MapFileError(f'{path} is there already: ask to overwrite it, or take another name')
        if not Path(path).absolute().parent.is_dir():
            raise MapFileError(f'the folder of {path} does not exist: make it first')
        save_state = self._map_save_state if place_map is self._map else self.save_state
        return Snapshot(place_map, save_state, save_state.grown)

    def save(self, path: str, overwrite: bool) -> int:
        """Write the map, or the route so far, whole or not at all; return its number of places."""
        snapshot = self.to_save(path, overwrite)
        save_map(snapshot.places, path)
        self.saved(path, snapshot)
        return len(snapshot.places)

    def saved(self, path: str, snapshot: Snapshot) -> None:
        """Take note that a map was written to a file; places may have come since, even another map."""
        snapshot.save_state.wrote(path, snapshot.grown)

    def reset(self) -> None:
        """Empty the window: the images that come now have nothing to do with those before."""
        self._keyframes.reset()
        self._last = None
        if self._operation is not None:
            self._operation.reset()

    def relocalize(self, count: int) -> tuple[Match, list[Candidate]]:
        """
        Return the answer for the window as it is, and its nearest places.

        :raises InputError: there is no full window yet; says why.
        """
        if self.missing:
            raise InputError(self.missing)
        if self._name == 'mapping':
            raise InputError('operation mapping recognizes nothing: set_operation localization first')
        if self._operation is None or self._last is None or self._last.status is Status.WARMING_UP:
            raise InputError(f'{self.window_fill} of {self._settings.sequence.length} images in the window')
        return self._last, self._operation.ranked(count)

    # what is done with an image

    def process(self, message: Any, stamp: int, pose: np.ndarray | None = None) -> Match:
        """
        Answer one image message, raw or compressed. One that is bad is answered as such, and changes nothing.

        :param stamp: of the image, ns, 0 = unknown.
        :param pose: of the camera, from odometry, shape (7,), or None.
        :raises InputError: a pose that is none; nothing is changed then.
        """
        threshold = math.nan if self.threshold is None else self.threshold
        pose = None if pose is None else checked_pose(pose)
        if self._operation is None or self.missing:
            return Match(Status.NOT_READY, self.missing, threshold, cause='not ready')
        if reason := self._keyframes.too_soon(stamp, pose):
            blind = pose is None and self._settings.keyframes.needs_poses
            cause = 'no odometry' if blind else NOT_A_KEYFRAME
            return Match(Status.SKIPPED, reason, threshold, cause=cause)
        watch = Stopwatch()
        try:
            match = self._process(self._operation, watch, message, stamp, pose)
        except StavprError as error:
            cause = f'invalid: {error.kind if isinstance(error, ImageError) else type(error).__name__}'
            match = Match(Status.INVALID_IMAGE, str(error), cause=cause)
        return replace(match, threshold=threshold, stages=watch.stages)

    def _process(
        self, operation: Operation, watch: Stopwatch, message: Any, stamp: int, pose: np.ndarray | None
    ) -> Match:
        with watch.stage('decoding'):
            image = decode_message(message)
            if reason := self._keyframes.too_alike(image):
                return Match(Status.SKIPPED, reason, image=image, cause=NOT_A_KEYFRAME)
        if operation.full:
            reason = f'the map is full: parameter max_places = {self._settings.max_places}'
            return Match(Status.NOT_READY, reason, image=image, cause='map full')
        with watch.stage('extraction'):
            features = operation.extractor.extract([image])
        with watch.stage('matching'):
            observed = Observed(features, image, stamp, pose, self._settings.thumbnail_width)
            match = operation.update(observed)
        self._keyframes.accept(stamp, pose, image)
        self.save_state.grown += operation.newest_place >= 0
        match = replace(match, image_index=operation.newest_place, image=image)
        if match.status is Status.MAPPED:
            return match
        with watch.stage('verification'):
            match = self._verified(match, image, operation.places)
        listed = self.ranking and match.sequence is not None
        self._last = replace(
            match,
            candidates=tuple(operation.ranked(self._settings.candidates)) if listed else (),
        )
        return self._last

    def _verified(self, match: Match, image: np.ndarray, places: PlaceMap | GrowingMap) -> Match:
        """Compare a match's newest image with the thumbnail of its place; reject it with few inliers."""
        if self._verifier is None or not match.accepted:
            return match
        thumbnail = place_thumbnail(places, match.newest_index)
        if thumbnail is None:
            reason = 'geometric check: the map has no thumbnails; build it with thumbnails'
            return replace(match, status=Status.NO_MATCH, reason=reason)
        inliers, least = self._verifier.inliers(image, thumbnail), self._verifier.settings.min_inliers
        if inliers >= least:
            return replace(match, inliers=inliers)
        reason = f'geometric check: {inliers} inliers are fewer than {least} (parameter min_inliers)'
        return replace(match, status=Status.NO_MATCH, reason=reason, inliers=inliers)
