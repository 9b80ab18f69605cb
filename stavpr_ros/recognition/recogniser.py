"""Frame by frame: the distances of the newest image, the window's best sequence, the verdict."""

import enum
import math
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import torch

from stavpr_ros.alignment.path import aligned_index
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.alignment.temporal import SequenceMatch
from stavpr_ros.devices import choose_backend
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition.calibrated_window import CalibratedWindow
from stavpr_ros.recognition.candidates import Candidate, nearest_places, ranked_candidates
from stavpr_ros.recognition.centring import Centring
from stavpr_ros.recognition.cpu_matcher import NO_PATH
from stavpr_ros.recognition.cures import Cures, Track, cures_of, evidence, likely_rival, relative_distance
from stavpr_ros.recognition.matcher import make_matcher

PLACES_TO_START_FROM = 100  # whose distances to the map start the calibration


class Verdict(enum.Enum):
    """What is said of one window."""

    WARMING_UP = 'warming up'
    NO_MATCH = 'no match'
    MATCH = 'match'


@dataclass(frozen=True)
class RecognitionSettings:
    """
    Settings of the recogniser.

    :param threshold: a window is matched when its distance is below it; > 0.
    :param spatial: how two images are compared.
    :param sequence: how a window is matched.
    :param neighbourhood: the runner-up's midpoint is more than so many places from the nearest one's.
    :param mode: ``paper``, or ``robust``, with all cures of :class:`stavpr_ros.recognition.cures.Cures`.
    :param cures: another choice of cures than the mode's.
    """

    threshold: float
    spatial: SpatialSettings = field(default_factory=SpatialSettings)
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    neighbourhood: int = 20
    mode: str = 'paper'
    cures: Cures | None = None

    def __post_init__(self) -> None:
        if not self.threshold > 0 or math.isnan(self.threshold):
            raise SettingsError(f'threshold = {self.threshold} must be above 0: nothing is nearer than 0')
        if self.neighbourhood < 0:
            raise SettingsError(f'neighbourhood = {self.neighbourhood} must be at least 0 places')
        if cures_of(self.mode).contrast and self.cures is None and self.threshold > 1:
            raise SettingsError(
                f'threshold = {self.threshold}: distances of mode robust end at 1, which is chance'
            )

    @property
    def applied_cures(self) -> Cures:
        """The cures that are applied."""
        return cures_of(self.mode) if self.cures is None else self.cures


@dataclass(frozen=True)
class Recognition:
    """
    The answer to one image; indices are 0-based places of the map.

    :param verdict: only ``MATCH`` names a place.
    :param reason: why there is none, in words.
    :param nearest: the nearest sequence, accepted or not; None while warming up or if there is none.
    :param path: its warping path, shape (m, 2), int32: position in the window, place.
    :param threshold: the one that was used.
    :param relative: distances are relative to chance, 1 (:mod:`stavpr_ros.recognition.cures`).
    """

    verdict: Verdict
    reason: str
    nearest: SequenceMatch | None
    path: np.ndarray
    threshold: float
    relative: bool = False

    @property
    def place(self) -> int:
        """The matched place, the middle of the matched sequence; -1 unless matched."""
        return self.nearest.middle if self.nearest and self.verdict is Verdict.MATCH else -1

    @property
    def score(self) -> float:
        """Distance of the nearest sequence; +inf without one, or if it is no nearer than chance."""
        if self.nearest is None or (self.relative and self.nearest.distance >= 1):
            return math.inf
        return self.nearest.distance

    @property
    def newest(self) -> int:
        """The place aligned with the newest image; -1 unless matched."""
        return aligned_index(self.path, int(self.path[-1, 0])) if self.verdict is Verdict.MATCH else -1


class WindowAnswers:
    """The window answered last: what recognition on a map and on a route's own past can both tell of it."""

    _settings: RecognitionSettings
    _window: 'Window'
    _nearest: SequenceMatch | None  # as it was answered last

    @property
    def settings(self) -> RecognitionSettings:
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
        Rank places for the window answered last, no two of them neighbours, nearest first.

        The first is the answer's nearest place, matched or not, with its distance, the second its runner-up.

        :param count: most candidates, at least 0.
        :returns: none before the first full window.
        :raises InputError: count below 0.
        """
        settings = self._settings
        return ranked_candidates(
            self._nearest,
            self._window.sequences(),
            count,
            settings.neighbourhood,
            settings.applied_cures.contrast,
        )


class Recogniser(WindowAnswers):
    """
    Recognises places of one map, one image at a time.

    :param place_map: the reference map.
    :param settings: see :class:`RecognitionSettings`.
    :param backend: where it is computed: ``cpu``, ``cuda``, or ``auto``. With cures, image distances are
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
        settings: RecognitionSettings,
        backend: str = 'cpu',
        precision: str = 'float32',
    ) -> None:
        features, cures = place_map.features, settings.applied_cures
        require_finite(features, 'the map')
        self._feature_settings = place_map.settings
        self._settings = settings
        self._centring = Centring(features) if cures.centring else None
        if self._centring is not None:
            features = self._centring.places(features)
        self._matcher = make_matcher(
            features, settings.spatial, settings.sequence, choose_backend(backend), precision
        )
        self._window = self._matcher
        self._newest_row = torch.empty(0)
        self._track = Track()
        self._nearest = None
        if cures.any:
            self._window = window = CalibratedWindow(self.places, settings.sequence, cures)
            window.calibration.start_from(self._distances_to_itself(features))

    def _distances_to_itself(self, features: LocalFeatures) -> np.ndarray:
        """Distances of some places to all but their neighbours, which are NaN, shape (m, n)."""
        n = len(features)
        some = np.unique(np.linspace(0, max(n - 1, 0), min(n, PLACES_TO_START_FROM)).astype(int))
        if not n:
            return np.empty((0, 0), np.float32)
        rows = self._matcher.distance_matrix(features.strips[:, some], features.weights[:, some])
        near = np.abs(np.arange(n) - some[:, None]) <= self._settings.neighbourhood
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
        if self._centring is not None:
            self._centring.reset()

    def distances(self, features: LocalFeatures) -> np.ndarray:
        """
        Distances of images to every place; centred, if at all, by the map's mean.

        :param features: those of Q images, strips (W, Q, d), made with the settings of the map.
        :returns: shape (Q, n), float32.
        :raises FeatureMismatchError: made with other settings.
        :raises InputError: features that are not finite.
        """
        self._check(features)
        if self._centring is not None:
            features = self._centring.places(features)
        return self._matcher.distance_matrix(features.strips, features.weights).cpu().numpy()

    def add(self, features: LocalFeatures) -> Recognition:
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
        if self._centring is not None:
            strips = self._centring.next_query(strips)
        self._newest_row = self._matcher.distances(strips, features.weights[:, 0])
        self._window.push(self._newest_row)
        recognition = answer(self._window, self._settings, self._track)
        self._nearest = recognition.nearest
        return recognition

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

    def match(self, neighbourhood: int) -> tuple[SequenceMatch | None, np.ndarray]: ...

    def sequences(self) -> tuple[np.ndarray, np.ndarray]: ...


def answer(window: Window, settings: RecognitionSettings, track: Track) -> Recognition:
    """Match a window, if it is full, and give the verdict."""
    threshold, length = settings.threshold, settings.sequence.length
    if len(window) < length:
        reason = f'{len(window)} of {length} images in the window'
        return Recognition(Verdict.WARMING_UP, reason, None, NO_PATH, threshold)
    nearest, path = window.match(settings.neighbourhood)
    if nearest is None:
        return Recognition(Verdict.NO_MATCH, 'the map is empty', None, NO_PATH, threshold)
    relative = settings.applied_cures.contrast
    if relative:
        rivals = _count_rivals(window, nearest, settings.neighbourhood)
        nearest = _relative_to_chance(
            nearest, rivals, track if settings.applied_cures.persistence else Track()
        )
    if nearest.distance < threshold:
        return Recognition(Verdict.MATCH, '', nearest, path, threshold, relative)
    reason = f'nearest distance {nearest.distance:.4f} is not below the threshold {threshold:.4f}'
    return Recognition(Verdict.NO_MATCH, reason, nearest, path, threshold, relative)


def _count_rivals(window: Window, nearest: SequenceMatch, neighbourhood: int) -> int:
    """Count the sequences outside the neighbourhood of the nearest."""
    costs, places = window.sequences()
    return int(np.count_nonzero(np.isfinite(costs) & (np.abs(places - nearest.middle) > neighbourhood)))


def _relative_to_chance(nearest: SequenceMatch, rivals: int, track: Track) -> SequenceMatch:
    """Judge the sequence and its rival by their evidence instead of their costs."""
    cost, other = nearest.distance, nearest.runner_up_distance
    seen = track.follow(nearest.middle, evidence(cost, likely_rival(other, rivals)))
    rival = other if math.isnan(other) else relative_distance(evidence(other, cost))
    return replace(nearest, distance=relative_distance(seen), runner_up_distance=rival)


def require_finite(features: LocalFeatures, where: str) -> None:
    """Refuse NaN and infinite numbers, which no sum of unit-norm features hides."""
    if not bool(torch.isfinite(features.strips.sum())):
        raise InputError(f'features of {where} are not finite: they are damaged')
