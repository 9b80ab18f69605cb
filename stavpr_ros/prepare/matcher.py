# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Matchers: distances of images to all places of a map, whose features are on one backend."""

from typing import Any, Protocol, TYPE_CHECKING

import numpy as np
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.alignment.spatial import WINDOW
from stavpr_ros.checks import require_choice
from stavpr_ros.devices import choose_backend
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.prepare.blocks import Int8Features, rounded

if TYPE_CHECKING:
    import torch

PRECISIONS = ('float32', 'int8')
INT8_PLACES = 2_000  # from which on `auto` is int8: faster, a quarter of the memory


class Matcher(Protocol):
    """
    Image distances to every place of a map.

    Nothing is checked here: see :class:`stavpr_ros.method.PlaceRecognizer`.
    """

    @property
    def places(self) -> int:
        """Return the number of places n."""

    def strips_of(self, places: np.ndarray) -> np.ndarray:
        """Return the strips of places, (W, m, d), float32; in int8, rounded ones."""

    def distances(self, strips: np.ndarray, weights: np.ndarray) -> Any:
        """
        Return the distances of one image to every place.

        :param strips: its unit-norm local features, shape (W, d), float32.
        :param weights: norm of each strip over the norm of all, shape (W,), float32.
        :returns: shape (n,), float32; a NumPy array, or a tensor on the backend's device.
        """

    def distance_matrix(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """
        Return the distances of Q images to every place, as :meth:`distances` of each.

        :param strips: shape (W, Q, d), float32.
        :param weights: shape (W, Q), float32.
        :returns: shape (Q, n), float32.
        """


def precision_of(precision: str, places: int, rounds: bool) -> str:
    """
    Return the precision that is applied.

    :param precision: ``auto``, or one that is returned as it is.
    :param rounds: whether rounding was measured for this method and backend.
    """
    if precision != 'auto':
        return precision
    return 'int8' if rounds and places >= INT8_PLACES else 'float32'


def make_matcher(
    features: LocalFeatures | Int8Features,
    spatial: SpatialSettings,
    backend: 'str | torch.device',
    precision: str,
) -> Matcher:
    """
    Put a map's features on a backend.

    :param backend: see :func:`stavpr_ros.devices.choose_backend`.
    :param features: of the map; rounded already, for ``int8``, or not.
    :param precision: of the map's features in memory: ``float32``; image distances of the backends
        differ by 1e-5 at most, except where a tie of two strips is decided otherwise. ``int8``: a
        quarter of the memory, the query's features rounded as well
        (:mod:`stavpr_ros.alignment.cpu.int8`); strip distances of the backends are equal.
    :raises SettingsError: no such precision, or settings that do not fit the map (xi > W), the
        backend or the precision.
    :raises InputError: vertical alignment of features whose cells are not known, or fewer strips
        than the sliding window has.
    :raises UnavailableError: the backend is not available.
    """
    require_choice('precision', precision, PRECISIONS)
    W = features.settings.strips
    spatial.band(W)
    if spatial.strategy == 'sliding_window' and W < WINDOW:
        raise InputError(f'W = {W} strips: the sliding window needs at least {WINDOW}')
    if backend != 'cpu' and spatial.vertical:
        raise SettingsError(f"backend '{backend}' has no vertical alignment: take 'cpu'")
    if precision == 'int8' and spatial.vertical:
        raise SettingsError("precision 'int8' has no vertical alignment: take float32")
    if precision == 'int8' and isinstance(features, LocalFeatures):
        features = rounded(features, lambda block: block)
    device = choose_backend(backend)
    if isinstance(device, str):
        from stavpr_ros.prepare.cpu_matcher import CpuMatcher

        return CpuMatcher(features, spatial)
    from stavpr_ros.prepare.device_matcher import DeviceMatcher

    return DeviceMatcher(features, spatial, device)
