"""A matcher keeps a map and a window of image distances on one backend; all backends answer alike."""

from typing import Protocol

import numpy as np
import torch

from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import LocalFeatures

PRECISIONS = ('float32', 'float16')


class Matcher(Protocol):
    """
    From a frame's local features to the nearest sequence of the map.

    Nothing is checked here: see :class:`stavpr_ros.recognition.PlaceRecognizer`.
    """

    @property
    def places(self) -> int:
        """Number of places n."""

    def __len__(self) -> int:
        """Rows in the window, up to l."""

    def distances(self, strips: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """
        Distances of one image to every place.

        :param strips: its unit-norm local features, shape (W, d), float32.
        :param weights: norm of each strip over the norm of all, shape (W,), float32.
        :returns: shape (n,), float32, on the matcher's device.
        """

    def distance_matrix(self, strips: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """
        Distances of Q images to every place, as :meth:`distances` but many at once.

        :param strips: shape (W, Q, d), float32.
        :param weights: shape (W, Q), float32.
        :returns: shape (Q, n), float32, on the matcher's device.
        """

    def push(self, row: torch.Tensor) -> None:
        """Take the distances of the newest image, shape (n,), into the window, and the oldest out of it."""

    def reset(self) -> None:
        """Empty the window."""

    def match(self, nms_radius: int) -> tuple[SequenceMatch | None, np.ndarray]:
        """
        Return the nearest sequence for a full window, with the second best, and its warping path.

        :param nms_radius: the second best's midpoint is more than so many places from the nearest one's.
        :returns: None and an empty path where no sequence is possible; else path (m, 2), int32: position
            in the window, place.
        """

    def sequences(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the sequences matched last.

        :returns: distances, shape (n,), float32, +inf where there is none, and middle places, shape (n,).
        """


def make_matcher(
    features: LocalFeatures,
    spatial: SpatialSettings,
    sequence: SequenceSettings,
    backend: str,
    precision: str,
) -> Matcher:
    """
    Put a map's features on a backend.

    :param backend: ``cpu`` or ``cuda``.
    :param precision: how the features are kept: ``float32``, or ``float16``, which takes half the memory
        and half the time to read it; sums are float32 in both. The query's features are rounded as well
        on ``cuda``. Given equal image distances, all backends answer alike, bit for bit; image distances
        differ by 1e-5 at most, but where a tie of two strips is decided otherwise.
    :raises SettingsError: no such precision, or settings that do not fit the map (xi > W) or the backend.
    :raises InputError: vertical alignment of features whose cells are not known.
    :raises UnavailableError: the backend is not there.
    """
    if precision not in PRECISIONS:
        raise SettingsError(f'precision {precision!r} is unknown: take one of {", ".join(PRECISIONS)}')
    spatial.band(features.settings.strips)
    if backend == 'cuda' and spatial.vertical:
        raise SettingsError("vertical alignment is not there on backend 'cuda': take 'cpu'")
    if backend == 'cuda':
        from stavpr_ros.recognition.cuda_matcher import CudaMatcher

        return CudaMatcher(features, spatial, sequence, precision)
    from stavpr_ros.recognition.cpu_matcher import CpuMatcher

    return CpuMatcher(features, spatial, sequence, precision)
