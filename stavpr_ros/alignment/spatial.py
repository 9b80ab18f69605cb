# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Spatial alignment: distances of strips, and distances of images from them (section 2)."""

import numpy as np
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.checks import float_array, no_nan, require_shape
from stavpr_ros.errors import InputError, SettingsError

WINDOW = 4  # strips in the sliding window, as in the paper's comparison


def strip_distances(query: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """
    Compute the distances of query strips to strips of map images: d[i, j] = 1 - <x_i, y_j>.

    A zero feature has the distance 1 to everything.

    :param query: unit-norm local features of one image, shape (W, d), float32.
    :param reference: features of the map, strip-major, shape (W, n, d), float32.
    :returns: shape (W, W, n), float32; d[i, j, y] is query strip i
        against strip j of map image y. Not clipped: after a random projection slightly outside [0,
        1].
    :raises InputError: shapes that do not fit.
    """
    query, reference = np.asarray(query), np.asarray(reference)
    W, d = require_shape('query strips', query, 'W d', 'float32')
    _, n, _ = require_shape('reference strips', reference, f'{W} n {d}', 'float32')
    from stavpr_ros.alignment.cpu import dot

    if W == 1:
        distances: np.ndarray = np.empty((1, 1, n), np.float32)
        vectors, vector = np.ascontiguousarray(reference[0]), np.ascontiguousarray(query)
        dot.cosine_distances(vectors, vector, distances[0])
        return distances
    rows = dot.tile(query[:, None])
    distances = np.empty((rows.shape[1], W, n), np.float32)
    dot.strip_distances(np.ascontiguousarray(reference), rows, 0, distances)
    return distances[:W]


def adaptive_weights(W: int, settings: SpatialSettings, dtype: np.dtype) -> np.ndarray:
    """
    Return the weights a = sqrt(1 + sigma x) for the viewpoint changes x = 0 .. W-1.

    In the arithmetic of the kernel: of type ``dtype``.
    """
    if settings.strategy != 'adaptive':
        return np.ones(W, dtype)
    return np.sqrt(dtype.type(1) + dtype.type(settings.sigma) * np.arange(W).astype(dtype))


def image_distances(d: np.ndarray, settings: SpatialSettings) -> np.ndarray:
    """
    Compute the distances of one query image to n map images.

    :param d: strip distances, shape (W, W, n), float32 or float64; row = query strip. +inf bans a
        pair.
    :param settings: any strategy but ``none``, which compares whole images: it is no
        function of d.
    :returns: shape (n,), of d's type.
    :raises InputError: wrong shape or type, NaN, fewer strips than the sliding window has.
    :raises SettingsError: xi > W, or the strategy ``none``.
    """
    from stavpr_ros.alignment.cpu import dtw
    from stavpr_ros.simd import LANES

    d = no_nan(float_array(d, 'strip distances', 'W W n'), 'strip distances')
    W, _, n = d.shape
    band = settings.band(W)
    if settings.strategy == 'none':
        raise SettingsError("strategy 'none' compares whole images, not strips: take another")
    if settings.strategy == 'sliding_window':
        if W < WINDOW:
            raise InputError(f'W = {W} strips: the sliding window needs at least {WINDOW}')
        out = np.empty(n, d.dtype)
        dtw.sliding_window(d, WINDOW, band, out)
        return out
    if n < LANES:
        padded = np.zeros((W, W, LANES), d.dtype)
        padded[:, :, :n] = d
        d = padded
    out = np.empty(d.shape[2], d.dtype)
    weights = adaptive_weights(W, settings, d.dtype)
    dtw.spatial_dtw(d, weights, band, settings.strategy == 'rigid', out)
    return out[:n]
