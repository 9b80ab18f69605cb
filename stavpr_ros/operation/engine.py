"""The engine: the map, the operation, and one answer for one image message."""

import os
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stavpr_ros.errors import ImageError, InputError, MapFileError, StavprError
from stavpr_ros.features import Describer
from stavpr_ros.mapping import GrowingMap, PlaceMap, save_map
from stavpr_ros.mapping.keyframes import KeyframeSelector
from stavpr_ros.mapping.trajectory import checked_pose
from stavpr_ros.operation.begin import LoadedMap, begin
from stavpr_ros.operation.filing import Filing
from stavpr_ros.operation.operations import Observed, Operation
from stavpr_ros.operation.outcome import Answer, Outcome, place_picture
from stavpr_ros.operation.settings import EngineSettings
from stavpr_ros.operation.stopwatch import Stopwatch
from stavpr_ros.recognition import Recognition, Verdict
from stavpr_ros.recognition.candidates import Candidate
from stavpr_ros.recognition.geometry import GeometricCheck
from stavpr_ros.sources.encodings import decode_message

NO_MAP = "no map: set parameter 'map_path' to a file made by build_map, or call the service load_map"
NO_THRESHOLD = "parameter 'threshold' is not set: build_map suggests one, 'ros2 param set' sets it"
NOT_A_KEYFRAME = 'not a keyframe'
_ANSWERS = {
    Verdict.WARMING_UP: Answer.WARMING_UP,
    Verdict.NO_MATCH: Answer.NO_MATCH,
    Verdict.MATCH: Answer.MATCH,
}


@dataclass(frozen=True)
class Snapshot:
    """A map to be written, what was known of its files, and by how many places it had grown."""

    places: PlaceMap
    filing: Filing
    grown: int


class Engine:
    """
    Answers image messages. Belongs to one thread, which makes every call.

    :param settings: see :class:`EngineSettings`.
    :param operation: one of ``OPERATIONS``.
    :raises StavprError: settings that do not do, or a model that is not there.
    """

    def __init__(self, settings: EngineSettings, operation: str = 'localization') -> None:
        self._settings = settings
        self._map: PlaceMap | None = None
        self._describer: Describer | None = None
        self._operation: Operation | None = None
        self._name = operation
        self._keyframes = KeyframeSelector(settings.keyframes)
        self._check = GeometricCheck(settings.geometric) if settings.geometric else None
        self._window: deque[int] = deque(maxlen=settings.sequence.length)
        self._last: Outcome | None = None
        self.filing = Filing()  # of the places in use
        self._map_filing = self.filing  # of the map, where loop closure uses places of its own
        self.ranking = True  # tell the nearest places with every answer
        self._begin(operation, settings, None)

    @property
    def settings(self) -> EngineSettings:
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
        return self.filing.path

    @property
    def unsaved(self) -> int:
        """Places in use that are in no file."""
        return min(self.filing.unsaved, len(self.places or ()))

    @property
    def describer(self) -> Describer | None:
        """What describes images."""
        operation = self._operation
        return operation.describer if operation else self._describer

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
        Use a map from now on: to recognise, to go on with, or (loop closure) for its kind of features.

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
        settings: EngineSettings | None = None,
        operation: str | None = None,
        loaded: LoadedMap | None = None,
    ) -> None:
        """
        Change what may change while the engine runs, all of it or nothing; what is not given stays.

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
        self._check = GeometricCheck(settings.geometric) if settings.geometric else None

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

    def _begin(self, name: str, settings: EngineSettings, loaded: LoadedMap | None) -> None:
        """Begin an operation; on an error everything stays as it was."""
        place_map, describer = self.places_as_map(), self.describer
        filing = self._map_filing if place_map is self._map else self.filing
        if loaded is not None:
            place_map, describer, filing = loaded.places, loaded.describer, Filing(loaded.path)
        operation = begin(name, settings, place_map, describer)
        self._map = None if name == 'mapping' else place_map  # in mapping, the growing map holds it
        self._operation, self._name = operation, name
        self._describer = operation.describer if operation is not None else describer
        self._map_filing, self.filing = filing, Filing() if name == 'loop_closure' else filing
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
        filing = self._map_filing if place_map is self._map else self.filing
        return Snapshot(place_map, filing, filing.grown)

    def save(self, path: str, overwrite: bool) -> int:
        """Write the map, or the route so far, whole or not at all; return its number of places."""
        snapshot = self.to_save(path, overwrite)
        save_map(snapshot.places, path)
        self.saved(path, snapshot)
        return len(snapshot.places)

    def saved(self, path: str, snapshot: Snapshot) -> None:
        """Take note that a map was written to a file; places may have come since, even another map."""
        snapshot.filing.wrote(path, snapshot.grown)

    def reset(self) -> None:
        """Empty the window: the images that come now have nothing to do with those before."""
        self._window.clear()
        self._keyframes.reset()
        self._last = None
        if self._operation is not None:
            self._operation.reset()

    def relocalize(self, count: int) -> tuple[Outcome, list[Candidate]]:
        """
        Return the answer for the window as it is, and its nearest places.

        :raises InputError: there is no full window yet; says why.
        """
        if self.missing:
            raise InputError(self.missing)
        if self._name == 'mapping':
            raise InputError('operation mapping recognises nothing: set_operation localization first')
        if self._operation is None or self._last is None or self._last.answer is Answer.WARMING_UP:
            raise InputError(f'{len(self._window)} of {self._settings.sequence.length} images in the window')
        return self._last, self._operation.ranked(count)

    # what is done with an image

    def process(self, message: Any, stamp: int, pose: np.ndarray | None = None) -> Outcome:
        """
        Answer one image message, raw or compressed. One that is bad is answered as such, and changes nothing.

        :param stamp: of the image, ns, 0 = unknown.
        :param pose: of the camera, from odometry, shape (7,), or None.
        :raises InputError: a pose that is none; nothing is changed then.
        """
        threshold = self.threshold
        pose = None if pose is None else checked_pose(pose)
        if self._operation is None or self.missing:
            return Outcome(Answer.NOT_READY, self.missing, threshold, cause='not ready')
        if reason := self._keyframes.too_soon(stamp, pose):
            blind = pose is None and self._settings.keyframes.needs_poses
            cause = 'no odometry' if blind else NOT_A_KEYFRAME
            return Outcome(Answer.SKIPPED, reason, threshold, cause=cause)
        watch = Stopwatch()
        try:
            outcome = self._process(self._operation, watch, message, stamp, pose)
        except StavprError as error:
            cause = f'invalid: {error.kind if isinstance(error, ImageError) else type(error).__name__}'
            return Outcome(Answer.INVALID_IMAGE, str(error), threshold, stages=watch.stages, cause=cause)
        return replace(outcome, threshold=threshold, stages=watch.stages)

    def _process(
        self, operation: Operation, watch: Stopwatch, message: Any, stamp: int, pose: np.ndarray | None
    ) -> Outcome:
        with watch.stage('decoding'):
            image = decode_message(message)
            if reason := self._keyframes.too_alike(image):
                return Outcome(Answer.SKIPPED, reason, image=image, cause=NOT_A_KEYFRAME)
        if operation.full:
            reason = f'the map is full: parameter max_places = {self._settings.max_places}'
            return Outcome(Answer.NOT_READY, reason, image=image, cause='map full')
        with watch.stage('description'):
            features = operation.describer.describe([image])
        with watch.stage('matching'):
            observed = Observed(features, image, stamp, pose, self._settings.thumbnail_width)
            recognition = operation.add(observed)
        self._keyframes.accept(stamp, pose, image)
        self._window.append(stamp)
        self.filing.grown += operation.newest_place >= 0
        if recognition is None:
            return Outcome(Answer.MAPPED, newest=operation.newest_place, places=operation.places, image=image)
        with watch.stage('check'):
            recognition, inliers = self._checked(recognition, image, operation.places)
        self._last = self._outcome(operation, recognition, inliers, image)
        return self._last

    def _outcome(
        self, operation: Operation, recognition: Recognition, inliers: int, image: np.ndarray
    ) -> Outcome:
        newest = operation.newest_place
        count = self._settings.candidates
        return Outcome(
            _ANSWERS[recognition.verdict],
            recognition.reason,
            self.threshold,
            recognition,
            window=tuple(self._window),
            first_image=newest - len(self._window) + 1 if newest >= 0 else -1,
            newest=newest,
            places=operation.places,
            inliers=inliers,
            candidates=tuple(operation.ranked(count)) if self.ranking and recognition.nearest else (),
            image=image,
        )

    def _checked(
        self, recognition: Recognition, image: np.ndarray, places: PlaceMap | GrowingMap
    ) -> tuple[Recognition, int]:
        """Compare a match's newest image with the picture of its place; too few inliers make it none."""
        if self._check is None or recognition.verdict is not Verdict.MATCH:
            return recognition, -1
        picture = place_picture(places, recognition.newest)
        if picture is None:
            reason = 'geometric check: the map keeps no pictures; build it with thumbnails'
            return replace(recognition, verdict=Verdict.NO_MATCH, reason=reason), -1
        inliers, least = self._check.inliers(image, picture), self._check.settings.min_inliers
        if inliers >= least:
            return recognition, inliers
        reason = f'geometric check: {inliers} inliers are fewer than {least} (parameter min_inliers)'
        return replace(recognition, verdict=Verdict.NO_MATCH, reason=reason), inliers
