"""Loop closure: the map is the route so far, without its latest images."""

import numpy as np
import torch

from stavpr_ros.alignment.kernels.cpu import products
from stavpr_ros.alignment.similarity import tiled
from stavpr_ros.alignment.spatial import adaptive_weights
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.recognition.calibrated_window import CalibratedWindow
from stavpr_ros.recognition.centring import without_mean
from stavpr_ros.recognition.cures import Track
from stavpr_ros.recognition.recogniser import Recognition, RecognitionSettings, answer, require_finite

ROOM = 256  # images that there is room for at first; doubled when they are full
GROWTH = 1.125
LEAST_PLACES = 5  # fewer distances have no mean and deviation worth the name


class LoopCloser:
    """
    Recognises places that the same drive has passed before, one image at a time.

    Every image becomes a place; an image is compared with those that came at least ``exclude`` images
    before it. Growing costs no rebuild: memory doubles when it is full, and the mean that is taken off the
    features (cure ``centring``) is brought up to date whenever the route is an eighth longer.

    :param settings: strategies ``adaptive`` and ``vanilla``.
    :param exclude: the latest images that are not part of the map, at least 1.
    :param feature_settings: how the features are made.
    :raises SettingsError: settings that do not do.
    """

    def __init__(
        self, settings: RecognitionSettings, exclude: int, feature_settings: FeatureSettings
    ) -> None:
        if exclude < 1:
            raise SettingsError(f'exclude = {exclude} must be at least 1 image')
        if settings.spatial.strategy not in ('adaptive', 'vanilla') or settings.spatial.vertical:
            raise SettingsError(
                f'strategy {settings.spatial.strategy!r}, vertical {settings.spatial.vertical}: '
                'take adaptive or vanilla, without vertical alignment'
            )
        cures = settings.applied_cures
        if cures.place_calibration and not cures.row_normalisation:
            raise SettingsError(
                'place_calibration without row_normalisation: a new place starts at mean 0 and deviation 1, '
                'which says nothing of distances as they are; take both or neither'
            )
        W = feature_settings.strips
        self._settings, self._exclude, self._feature_settings = settings, exclude, feature_settings
        self._band = settings.spatial.band(W)
        self._a = adaptive_weights(W, settings.spatial, np.dtype(np.float32))
        self._raw = self._centred = torch.zeros((W, 0, 0))  # (W, room, d): as they came, and less their mean
        self._mean = torch.zeros((W, 0))
        self._count, self._next_mean = 0, 1
        self._track = Track()
        self._window = CalibratedWindow(ROOM, settings.sequence, settings.applied_cures)

    def __len__(self) -> int:
        return self._count

    @property
    def window_fill(self) -> int:
        """Images in the window, up to l."""
        return len(self._window)

    def add(self, features: LocalFeatures) -> Recognition:
        """
        Take in the next image and answer for the window that ends with it; places are earlier images.

        An error leaves everything as it was.

        :param features: those of one image, strips (W, 1, d).
        :raises FeatureMismatchError: made with other settings.
        :raises InputError: not one image, or features that are not finite.
        """
        features.require_same_settings(self._feature_settings, 'the route so far')
        if len(features) != 1:
            raise InputError(f'features of {len(features)} images came: expected those of one')
        require_finite(features, 'the image')
        self._keep(features.strips.cpu())
        self._window.push(torch.from_numpy(self._distances()))
        return answer(self._window, self._settings, self._track)

    def newest_row(self) -> np.ndarray:
        """Distances of the newest image to all places that it may be matched with, as they are matched."""
        return self._window.newest_row()[: self._places]

    def candidates(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest places of the window answered last, nearest first, each once."""
        return self._window.candidates(count)

    @property
    def _places(self) -> int:
        return max(0, self._count - self._exclude)

    def _keep(self, strips: torch.Tensor) -> None:
        """Make the image a place."""
        if not self._count:
            self._raw = torch.zeros((strips.shape[0], ROOM, strips.shape[2]))
            self._centred = torch.zeros_like(self._raw)
        room = self._raw.shape[1]
        if self._count == room:
            self._raw, self._centred = (
                torch.cat([kept, torch.zeros_like(kept)], dim=1) for kept in (self._raw, self._centred)
            )
            self._window.grow(2 * room)
        self._raw[:, self._count] = strips[:, 0]
        self._count += 1
        if not self._settings.applied_cures.centring:
            self._centred[:, self._count - 1] = strips[:, 0]
        elif self._count >= self._next_mean:
            mean = self._raw[:, : self._count].mean(dim=1)
            self._mean, self._next_mean = mean, int(self._count * GROWTH) + 1
            self._centred[:, : self._count] = without_mean(self._raw[:, : self._count], mean)
        else:
            self._centred[:, self._count - 1] = without_mean(strips, self._mean)[:, 0]

    def _distances(self) -> np.ndarray:
        """Distances of the newest image to the places it may be matched with; none while they are few."""
        if self._places < LEAST_PLACES:
            return np.empty(0, np.float32)
        out = np.empty((1, self._places), np.float32)
        query = tiled(self._centred[:, self._count - 1 : self._count])
        products.image_distances(self._centred.numpy(), query, self._a, self._band, out)
        return out[0]
