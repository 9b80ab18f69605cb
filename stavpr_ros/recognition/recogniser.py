"""Frame by frame: the distances of the newest image, the window's best sequence, the verdict."""

import enum
import math
from dataclasses import dataclass, field, replace

import numpy as np

from stavpr_ros.alignment.path import aligned_index
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.alignment.similarity import holistic_distances, strip_distances
from stavpr_ros.alignment.spatial import image_distances
from stavpr_ros.alignment.temporal import SequenceMatch, best_match, match_padded, trace_sequence
from stavpr_ros.devices import choose_device
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition.window import DistanceWindow

NO_PATH = np.empty((0, 2), np.int32)


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

    :param place_map: the reference map; its features are kept on ``device``.
    :param settings: see :class:`RecognitionSettings`.
    :param device: where the products are computed, ``cpu`` or ``cuda``.
    :raises UnavailableError: no such device here.
    :raises SettingsError: settings that do not fit the map (xi > W).
    """

    def __init__(self, place_map: PlaceMap, settings: RecognitionSettings, device: str = 'cpu') -> None:
        device = choose_device(device)
        settings.spatial.band(place_map.settings.strips)
        self._features = place_map.features.to(device)
        self._settings = settings
        self.reset()

    @property
    def settings(self) -> RecognitionSettings:
        """The settings in force."""
        return self._settings

    @property
    def places(self) -> int:
        """Number of places n of the map."""
        return len(self._features)

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

    def reset(self) -> None:
        """Forget the images of the window."""
        sequence = self._settings.sequence
        self._window = DistanceWindow(sequence.length, self.places, sequence.k)

    def distances(self, features: LocalFeatures) -> np.ndarray:
        """
        Distances of one image to every place.

        :param features: those of one image, strips (W, 1, d), made with the settings of the map.
        :returns: shape (n,), float32.
        :raises FeatureMismatchError: made with other settings.
        :raises InputError: not one image, or features that are not finite.
        """
        features.require_same_settings(self._features.settings, 'the map')
        if len(features) != 1:
            raise InputError(f'features of {len(features)} images came: expected those of one')
        query = features.strips[:, 0]
        if self._settings.spatial.strategy == 'none':
            row = holistic_distances(
                query, features.weights[:, 0], self._features.strips, self._features.weights
            )
            distances = row.cpu().numpy()
        else:
            cosine = strip_distances(query, self._features.strips).cpu().numpy()
            distances = image_distances(cosine, self._settings.spatial)
        if not np.isfinite(distances).all():
            raise InputError(
                'image distances are not finite: the features of the image or of the map are damaged'
            )
        return distances

    def add(self, features: LocalFeatures) -> Recognition:
        """
        Take in the next image and answer for the window that ends with it.

        An error leaves the window as it was.

        :param features: those of one image, strips (W, 1, d).
        :raises FeatureMismatchError: made with other settings than the map's.
        :raises InputError: not one image, or features that are not finite.
        """
        self._window.push(self.distances(features))
        return self._answer()

    def _answer(self) -> Recognition:
        threshold, sequence = self._settings.threshold, self._settings.sequence
        if not self._window.full:
            reason = f'{len(self._window)} of {sequence.length} images in the window'
            return Recognition(Verdict.WARMING_UP, reason, None, NO_PATH, threshold)
        window = self._window.rows()
        matches = match_padded(window, self.places, sequence.k)
        nearest = best_match(matches, self._settings.neighbourhood)
        if nearest is None:
            return Recognition(Verdict.NO_MATCH, 'the map is empty', None, NO_PATH, threshold)
        path = trace_sequence(window[:, : self.places], nearest.first, sequence.k).path
        if nearest.distance < threshold:
            return Recognition(Verdict.MATCH, '', nearest, path, threshold)
        reason = f'nearest distance {nearest.distance:.4f} is not below the threshold {threshold:.4f}'
        return Recognition(Verdict.NO_MATCH, reason, nearest, path, threshold)
