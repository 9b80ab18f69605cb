# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Matchers: distances of images to all places of a map, whose features are on one backend."""

from typing import Any, TYPE_CHECKING

import numpy as np
from stavpr_ros.alignment.cpu import dot, int8
from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.alignment.spatial import adaptive_weights, image_distances, WINDOW
from stavpr_ros.checks import require_choice, require_shape
from stavpr_ros.devices import choose_backend
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.memory import aligned_empty, is_aligned
from stavpr_ros.prepare.blocks import convert_features, Int8Features
from stavpr_ros.prepare.centering import normalize
from stavpr_ros.prepare.route_features import RouteStrips

if TYPE_CHECKING:
    from stavpr_ros.prepare.device_matcher import DeviceMatcher
    import torch

PRECISIONS = ('float32', 'int8')


def make_matcher(
    features: LocalFeatures,
    spatial: SpatialSettings,
    backend: 'str | torch.device',
    precision: str,
) -> 'CpuMatcher | DeviceMatcher':
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
    if precision == 'int8' and not isinstance(features, Int8Features):
        features = convert_features(features, rounds=True)
    device = choose_backend(backend)
    if isinstance(device, str):
        return CpuMatcher(features, spatial)
    from stavpr_ros.prepare.device_matcher import DeviceMatcher

    return DeviceMatcher(features, spatial, device)


def cut_cells(strips: np.ndarray, cells: tuple[int, int]) -> np.ndarray:
    """
    Cut strips into their cells, unit norm each; zero cells stay zero.

    :param strips: shape (W, n, d); each is (channels, H, columns), flattened.
    :param cells: H and columns.
    :returns: shape (W H, n, channels * columns), strip by strip, each from the top.
    """
    W, n, d = strips.shape
    H, columns = cells
    cut = strips.reshape(W, n, d // (H * columns), H, columns).transpose(0, 3, 1, 2, 4)
    return normalize(cut.reshape(W * H, n, d // H).copy())


class CpuMatcher:
    """
    Image distances to every place of a map, in one pass over it for each image, on all cores.

    :param features: of the map; contiguous float32 ones whose memory begins with a cache
        line are shared, not copied.
    :param spatial: how two images are compared.

    Only shapes are checked: see :class:`stavpr_ros.method.PlaceRecognizer`.
    """

    _map: np.ndarray | tuple[np.ndarray, np.ndarray]
    _cells: tuple[int, int] | None = None
    _axes = 'W n d'  # of the strips of images

    def __init__(
        self,
        features: LocalFeatures,
        spatial: SpatialSettings,
    ) -> None:
        W, _, d = features.strips.shape
        self._prepare(W, spatial)
        self._cells = features.cells if spatial.vertical else None
        self._axes = f'{W} n {d}'
        self._weights, self._strips = features.weights, features.strips
        self.places = self._weights.shape[1]
        if isinstance(features, Int8Features):
            self._map = features.strips.kernel_arguments()
            return
        strips = features.strips
        if spatial.vertical:
            if features.cells is None:
                raise InputError(
                    'vertical alignment needs the cells of the strips: build the map again, '
                    'without projection'
                )
            strips = cut_cells(strips, features.cells)
            self._cell_a = adaptive_weights(features.cells[0], spatial, np.dtype(np.float32))
        if not (strips.flags.c_contiguous and is_aligned(strips)):
            aligned = aligned_empty(strips.shape)
            aligned[:] = strips
            strips = aligned
        self._map = strips

    def _prepare(self, W: int, spatial: SpatialSettings) -> None:
        self._spatial = spatial
        self._band, self._is_rigid = spatial.band(W), spatial.strategy == 'rigid'
        self._aligns_strips = spatial.aligns_strips
        self._a = adaptive_weights(W, spatial, np.dtype(np.float32))

    def strips_of(self, places: np.ndarray) -> np.ndarray:
        """Return the strips of places, (W, m, d), float32; in int8, rounded ones."""
        return np.ascontiguousarray(self._strips[:, places])

    def distances(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """
        Return the distances of one image to every place, (n,), float32.

        :param strips: its unit-norm local features, shape (W, d), float32.
        :param weights: norm of each strip over the norm of all, shape (W,), float32.
        """
        return self.distance_matrix(strips[:, None], weights[:, None])[0]

    def distance_matrix(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the distances of Q images, (W, Q, d) and (W, Q), to every place, (Q, n)."""
        _, Q, _ = require_shape('strips', strips, self._axes, 'float32')
        require_shape('weights', weights, f'{len(strips)} {Q}')
        out: np.ndarray = np.empty((Q, self.places), np.float32)
        if len(strips) == 1:  # one vector an image: its alignment is its cosine distance
            if isinstance(self._map, tuple):
                int8.cosine_distances(self._map, int8.tile(strips), out)
            else:
                dot.cosine_distances(self._map[0], np.ascontiguousarray(strips[0]), out)
            return out
        strips = strips if self._cells is None else cut_cells(strips, self._cells)
        queries = int8.tile(strips) if isinstance(self._map, tuple) else dot.tile(strips)
        if self._cells is not None:
            dot.vertical_image_distances(
                self._map, queries, self._cell_a, self._a, self._band, out
            )
        elif self._aligns_strips:
            dot.image_distances(self._map, queries, self._a, self._band, self._is_rigid, out)
        else:
            for x in range(len(out)):
                out[x] = self._without_dtw(queries, x, weights[:, x])
        return out

    def _without_dtw(self, queries: Any, x: int, weights: np.ndarray) -> np.ndarray:
        """Return the distances of image x by the other strategies, (n,)."""
        W, n = self._weights.shape
        d = np.empty((-(-W // int8.TILE) * int8.TILE, W, n), np.float32)
        dot.strip_distances(self._map, queries, x, d)
        if self._spatial.strategy == 'sliding_window':
            return image_distances(d[:W], self._spatial)
        similarity = 1 - d.diagonal()[:, :W]  # (n, W)
        return 1 - (similarity * self._weights.T) @ weights


class CpuRouteMatcher(CpuMatcher):
    """
    Compares an image with the oldest places of a route that grows.

    :param W: strips of an image.
    :param spatial: strategies that align strips.
    :raises SettingsError: xi > W.
    """

    def __init__(self, W: int, spatial: SpatialSettings) -> None:
        self._prepare(W, spatial)

    def to_oldest(self, strips: RouteStrips, newest: np.ndarray, places: int) -> np.ndarray:
        """
        Return the distances of an image to the oldest places, (places,).

        :param strips: of the route; newest: of the image, (W, 1, d), float32.
        """
        self._map = strips.kernel_arguments() if isinstance(strips, Int8Strips) else strips
        self.places = places
        return self.distances(newest[:, 0], newest[:, 0, 0])
