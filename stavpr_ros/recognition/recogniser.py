"""Frame by frame: the distances of the newest image, the window's best sequence, the verdict."""

import enum
import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from stavpr_ros.alignment.path import aligned_index
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.alignment.temporal import SequenceMatch
from stavpr_ros.devices import choose_backend
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition.cpu_matcher import NO_PATH
from stavpr_ros.recognition.matcher import make_matcher


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
    """

    threshold: float
    spatial: SpatialSettings = field(default_factory=SpatialSettings)
    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    neighbourhood: int = 20

    def __post_init__(self) -> None:
        if not self.threshold > 0 or math.isnan(self.threshold):
            raise SettingsError(f'threshold = {self.threshold} must be above 0: nothing is nearer than 0')
        if self.neighbourhood < 0:
            raise SettingsError(f'neighbourhood = {self.neighbourhood} must be at least 0 places')


@dataclass(frozen=True)
class Recognition:
    """
    The answer to one image; indices are 0-based places of the map.

    :param verdict: only ``MATCH`` names a place.
    :param reason: why there is none, in words.
    :param nearest: the nearest sequence, accepted or not; None while warming up or if there is none.
    :param path: its warping path, shape (m, 2), int32: position in the window, place.
    :param threshold: the one that was used.
    """

    verdict: Verdict
    reason: str
    nearest: SequenceMatch | None
    path: np.ndarray
    threshold: float

    @property
    def place(self) -> int:
        """The matched place, the midpoint of the matched sequence; -1 unless matched."""
        return self.nearest.middle if self.nearest and self.verdict is Verdict.MATCH else -1

    @property
    def newest(self) -> int:
        """The place aligned with the newest image; -1 unless matched."""
        return aligned_index(self.path, int(self.path[-1, 0])) if self.verdict is Verdict.MATCH else -1


class Recogniser:
    """
    Recognises places of one map, one image at a time.

    :param place_map: the reference map.
    :param settings: see :class:`RecognitionSettings`.
    :param backend: where it is computed: ``cpu``, ``cuda``, or ``auto``.
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
        _require_finite(place_map.features, 'the map')
        self._feature_settings = place_map.settings
        self._settings = settings
        self._matcher = make_matcher(
            place_map.features, settings.spatial, settings.sequence, choose_backend(backend), precision
        )

    @property
    def settings(self) -> RecognitionSettings:
        """The settings in force."""
        return self._settings

    @property
    def places(self) -> int:
        """Number of places n of the map."""
        return self._matcher.places

    @property
    def window_fill(self) -> int:
        """Images in the window, up to l."""
        return len(self._matcher)

    def set_threshold(self, threshold: float) -> None:
        """
        Change the threshold from the next image on.

        :raises SettingsError: not above 0.
        """
        self._settings = replace(self._settings, threshold=threshold)

    def reset(self) -> None:
        """Forget the images of the window."""
        self._matcher.reset()

    def distances(self, features: LocalFeatures) -> np.ndarray:
        """
        Distances of images to every place.

        :param features: those of Q images, strips (W, Q, d), made with the settings of the map.
        :returns: shape (Q, n), float32.
        :raises FeatureMismatchError: made with other settings.
        :raises InputError: features that are not finite.
        """
        self._check(features)
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
        self._matcher.push(self._matcher.distances(features.strips[:, 0], features.weights[:, 0]))
        return self._answer()

    def _check(self, features: LocalFeatures) -> None:
        features.require_same_settings(self._feature_settings, 'the map')
        _require_finite(features, 'the image')

    def _answer(self) -> Recognition:
        threshold, sequence = self._settings.threshold, self._settings.sequence
        if self.window_fill < sequence.length:
            reason = f'{self.window_fill} of {sequence.length} images in the window'
            return Recognition(Verdict.WARMING_UP, reason, None, NO_PATH, threshold)
        nearest, path = self._matcher.match(self._settings.neighbourhood)
        if nearest is None:
            return Recognition(Verdict.NO_MATCH, 'the map is empty', None, NO_PATH, threshold)
        if nearest.distance < threshold:
            return Recognition(Verdict.MATCH, '', nearest, path, threshold)
        reason = f'nearest distance {nearest.distance:.4f} is not below the threshold {threshold:.4f}'
        return Recognition(Verdict.NO_MATCH, reason, nearest, path, threshold)


def _require_finite(features: LocalFeatures, where: str) -> None:
    """Refuse NaN and infinite numbers, which no sum of unit-norm features hides."""
    if not bool(torch.isfinite(features.strips.sum())):
        raise InputError(f'features of {where} are not finite: they are damaged')
