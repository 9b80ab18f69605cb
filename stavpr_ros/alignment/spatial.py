# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Spatial alignment: the distance of two images from those of their strips (section 2)."""

import numpy as np
from stavpr_ros.alignment.path import Alignment, trace
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.checks import float_array, no_nan
from stavpr_ros.errors import InputError, SettingsError

WINDOW = 4  # strips in the sliding window, as in the paper's comparison


def adaptive_weights(W: int, settings: SpatialSettings, dtype: np.dtype) -> np.ndarray:
    """
    Return the weights a = sqrt(1 + sigma x) for the viewpoint changes x = 0 .. W-1.

    In the arithmetic of the kernel: of type ``dtype``.
    """
    if settings.strategy != 'adaptive':
        return np.ones(W, dtype)
    return np.sqrt(dtype.type(1) + dtype.type(settings.sigma) * np.arange(W).astype(dtype))


def _checked(d: np.ndarray, ndim: int) -> np.ndarray:
    d = float_array(d, 'strip distances', ndim)
    if d.shape[0] != d.shape[1] or d.shape[0] == 0:
        raise InputError(
            f'strip distances have shape {d.shape}: expected W x W with W >= 1 on the first axes'
        )
    return no_nan(d, 'strip distances')


def image_distances(d: np.ndarray, settings: SpatialSettings) -> np.ndarray:
    """
    Distances of one query image to n map images.

    :param d: strip distances, shape (W, W, n), float32 or float64; row = query strip. +inf bans a
        pair.
    :param settings: strategy ``adaptive``, ``vanilla`` or ``sliding_window``. ``none`` is no
        function of d: see :func:`stavpr_ros.alignment.holistic_distances`.
    :returns: shape (n,), of d's type.
    :raises InputError: wrong shape or type, NaN, fewer strips than the sliding window has.
    :raises SettingsError: xi > W, or the strategy ``none``.
    """
    from stavpr_ros.alignment.cpu import dtw
    from stavpr_ros.alignment.cpu.simd import LANES

    d = _checked(d, 3)
    W, _, n = d.shape
    band = settings.band(W)
    if settings.strategy == 'none':
        raise SettingsError("strategy 'none' compares whole images: call holistic_distances")
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
    dtw.spatial_dtw(d, adaptive_weights(W, settings, d.dtype), band, out)
    return out[:n]


def align_images(d: np.ndarray, settings: SpatialSettings) -> Alignment:
    """
    Align the strips of two images and return the path (strategies ``adaptive`` and ``vanilla``).

    :param d: strip distances of one pair, shape (W, W), row = query strip.
    :raises InputError: wrong shape or type, NaN.
    :raises SettingsError: xi > W, or a strategy without a path.
    """
    d = _checked(d, 2)
    W = d.shape[0]
    band = settings.band(W)
    if settings.strategy not in ('adaptive', 'vanilla'):
        raise SettingsError(
            f'strategy {settings.strategy!r} has no warping path: take adaptive or vanilla'
        )
    c = (W + 1) // 2 - 1  # the central strip, ceil(W / 2), 0-based
    low, high = max(0, c - band + 1), min(W, c + band)
    nearest = low + int(np.argmin(d[c, low:high]))
    return trace(d, adaptive_weights(W, settings, d.dtype)[abs(nearest - c)], band)
