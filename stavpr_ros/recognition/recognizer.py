"""Frame by frame: the distances of the newest image, the window's best sequence, the status."""

import math
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import torch

from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.devices import choose_backend
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition.candidates import nearest_places, ranked_candidates
from stavpr_ros.recognition.match import Candidate, Match, Status
from stavpr_ros.recognition.matcher import make_matcher
from stavpr_ros.recognition.robust.centering import MeanCentering
from stavpr_ros.recognition.robust.options import (
    RobustOptions,
    Track,
    evidence,
    expected_second_best,
    options_of,
    relative_distance,
)
from stavpr_ros.recognition.robust.window import CalibratedWindow

PLACES_TO_START_FROM = 100  # whose distances to the map start the calibration


@dataclass(frozen=True)
class RecognizerSettings:
    """
    Settings of the recognizer.

    :param threshold: a window is matched when its distance is below it; > 0.
    :param spatial: how two images are compared.
    :param sequence: how a window is matched.
    :param nms_radius: the second best's midpoint is more than so many places from the nearest one's.
    :param mode: ``paper``, or ``robust``, with all robust_options of :class:`stavpr_ros.recognition.robust.options.RobustOptions`.
    :param robust_options: another choice of robust_options than the mode's.
    """

    threshold: float
    spatial: SpatialSettings = field(default_factory=SpatialSettings)
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    nms_radius: int = 20
    mode: str = 'paper'
    robust_options: RobustOptions | None = None

    def __post_init__(self) -> None:
        if not self.threshold > 0 or math.isnan(self.threshold):
            raise SettingsError(f'threshold = {self.threshold} must be above 0: nothing is nearer than 0')
        if self.nms_radius < 0:
            raise SettingsError(f'nms_radius = {self.nms_radius} must be at least 0 places')
        if options_of(self.mode).second_best_margin and self.robust_options is None and self.threshold > 1:
            raise SettingsError(
                f'threshold = {self.threshold}: distances of mode robust end at 1, which is chance'
            )

    @property
    def applied_options(self) -> RobustOptions:
        """The robust_options that are applied."""
        return options_of(self.mode) if self.robust_options is None else self.robust_options


class WindowAnswers:
    """The window answered last: what recognition on a map and on a route's own past can both tell of it."""

    _settings: RecognizerSettings
    _window: 'Window'
    _nearest: SequenceMatch | None  # as it was answered last

    @property
    def settings(self) -> RecognizerSettings:
        """The settings in force."""
        return self._settings

    @property
    def window_fill(self) -> int:
        """Images in the window, up to l."""
        return len(self._window)

    def set_threshold(self, threshold: float) -> None:
        """
        Change the threshold from the next image on.

        :raises SettingsError: not above 0.
        """
        self._settings = replace(self._settings, threshold=threshold)

    def candidates(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the nearest places of the window answered last, nearest first, each once.

        :returns: places, int64, and the distances of their sequences, at most ``count`` of each.
        """
        return nearest_places(*self._window.sequences(), count)

    def ranked(self, count: int) -> list[Candidate]:
        """
        Rank places for the window answered last, no two of them neighbors, nearest first.

        The first is the answer's nearest place, matched or not, with its distance, the second its second best.

        :param count: most candidates, at least 0.
        :returns: none before the first full window.
        :raises InputError: count below 0.
        """
        settings = self._settings
        return ranked_candidates(
            self._nearest,
            self._window.sequences(),
            count,
            settings.nms_radius,
            settings.applied_options.second_best_margin,
        )


class PlaceRecognizer(WindowAnswers):
    """
    Recognizes places of one map, one image at a time.

    :param place_map: the reference map.
    :param settings: see :class:`RecognizerSettings`.
    :param backend: where it is computed: ``cpu``, ``cuda``, or ``auto``. With robust_options, image distances are
        computed there and sequences on the CPU.
    :param precision: how the map's features are kept, ``float32`` or ``float16``; see
        :func:`stavpr_ros.recognition.matcher.make_matcher`.
    :raises UnavailableError: no such backend here.
    :raises SettingsError: settings that do not fit the map (xi > W).
    :raises InputError: features of the map are not finite.
    """

    def __init__(
        self,
        place_map: PlaceMap,
        settings: RecognizerSettings,
        backend: str = 'cpu',
        precision: str = 'float32',
    ) -> None:
        features, robust_options = place_map.features, settings.applied_options
        require_finite(features, 'the map')
        self._feature_settings = place_map.settings
        self._settings = settings
        self._centering = MeanCentering(features) if robust_options.mean_centering else None
        if self._centering is not None:
            features = self._centering.places(features)
        self._matcher = make_matcher(
            features, settings.spatial, settings.sequence, choose_backend(backend), precision
        )
        self._window = self._matcher
        self._newest_row = torch.empty(0)
        self._track = Track()
        self._nearest = None
        if robust_options.any:
            self._window = window = CalibratedWindow(self.places, settings.sequence, robust_options)
            window.calibration.start_from(self._distances_to_itself(features))

    def _distances_to_itself(self, features: LocalFeatures) -> np.ndarray:
        """Distances of some places to all but their neighbors, which are NaN, shape (m, n)."""
        n = len(features)
        some = np.unique(np.linspace(0, max(n - 1, 0), min(n, PLACES_TO_START_FROM)).astype(int))
        if not n:
            return np.empty((0, 0), np.float32)
        rows = self._matcher.distance_matrix(features.strips[:, some], features.weights[:, some])
        near = np.abs(np.arange(n) - some[:, None]) <= self._settings.nms_radius
        return np.where(near, np.float32(np.nan), rows.cpu().numpy())

    @property
    def places(self) -> int:
        """Number of places n of the map."""
        return self._matcher.places

    def reset(self) -> None:
        """Forget the images of the window, and what was learned from them and those before."""
        self._window.reset()
        self._track = Track()
        self._nearest = None
        if self._centering is not None:
            self._centering.reset()

    def distances(self, features: LocalFeatures) -> np.ndarray:
        """
        Distances of images to every place; centered, if at all, by the map's mean.

        :param features: those of Q images, strips (W, Q, d), made with the settings of the map.
        :returns: shape (Q, n), float32.
        :raises FeatureMismatchError: made with other settings.
        :raises InputError: features that are not finite.
        """
        self._check(features)
        if self._centering is not None:
            features = self._centering.places(features)
        return self._matcher.distance_matrix(features.strips, features.weights).cpu().numpy()

    def update(self, features: LocalFeatures) -> Match:
        """
        Take in the next image and answer for the window that ends with it.

        An error leaves the window as it was.

        :param features: those of one image, strips (W, 1, d).
        :raises FeatureMismatchError: made with other settings than the map's.
        :raises InputError: not one image, or features that are not finite.
        """
        self._check(features)
        if len(features) != 1:
            raise InputError(f'features of {len(features)} images came: expected those of one')
        strips = features.strips[:, 0]
        if self._centering is not None:
            strips = self._centering.next_query(strips)
        self._newest_row = self._matcher.distances(strips, features.weights[:, 0])
        self._window.push(self._newest_row)
        match = answer(self._window, self._settings, self._track)
        self._nearest = match.sequence
        return match

    def newest_row(self) -> np.ndarray:
        """Distances of the newest image to every place as they are matched, shape (n,), float32."""
        if isinstance(self._window, CalibratedWindow):
            return self._window.newest_row()
        return self._newest_row.cpu().numpy()

    def _check(self, features: LocalFeatures) -> None:
        features.require_same_settings(self._feature_settings, 'the map')
        require_finite(features, 'the image')


class Window(Protocol):
    """What holds the last l images' distances and matches them: a matcher, or a calibrated window."""

    def __len__(self) -> int: ...

    def reset(self) -> None: ...

    def push(self, row: torch.Tensor) -> None: ...

    def match(self, nms_radius: int) -> tuple[SequenceMatch | None, np.ndarray]: ...

    def sequences(self) -> tuple[np.ndarray, np.ndarray]: ...


def answer(window: Window, settings: RecognizerSettings, track: Track) -> Match:
    """Match a window, if it is full, and give the status."""
    threshold, length = settings.threshold, settings.sequence.length
    if len(window) < length:
        reason = f'{len(window)} of {length} images in the window'
        return Match(Status.WARMING_UP, reason, threshold)
    nearest, path = window.match(settings.nms_radius)
    if nearest is None:
        return Match(Status.NO_MATCH, 'the map is empty', threshold)
    relative = settings.applied_options.second_best_margin
    if relative:
        rivals = _count_rivals(window, nearest, settings.nms_radius)
        nearest = _relative_to_chance(
            nearest, rivals, track if settings.applied_options.hysteresis else Track()
        )
    status, reason = Status.MATCH, ''
    if not nearest.distance < threshold:
        status = Status.NO_MATCH
        reason = f'nearest distance {nearest.distance:.4f} is not below the threshold {threshold:.4f}'
    return Match(status, reason, threshold, nearest, path, relative)


def _count_rivals(window: Window, nearest: SequenceMatch, nms_radius: int) -> int:
    """Count the sequences outside the nms_radius of the nearest."""
    costs, places = window.sequences()
    return int(np.count_nonzero(np.isfinite(costs) & (np.abs(places - nearest.middle) > nms_radius)))


def _relative_to_chance(nearest: SequenceMatch, rivals: int, track: Track) -> SequenceMatch:
    """Judge the sequence and its rival by their evidence instead of their costs."""
    cost, other = nearest.distance, nearest.second_best_distance
    seen = track.follow(nearest.middle, evidence(cost, expected_second_best(other, rivals)))
    rival = other if math.isnan(other) else relative_distance(evidence(other, cost))
    return replace(nearest, distance=relative_distance(seen), second_best_distance=rival)


def require_finite(features: LocalFeatures, where: str) -> None:
    """Refuse NaN and infinite numbers, which no sum of unit-norm features hides."""
    if not bool(torch.isfinite(features.strips.sum())):
        raise InputError(f'features of {where} are not finite: they are damaged')
