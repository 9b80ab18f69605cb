# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fewer dimensions for the features of a map, by the principal components of its places."""

from dataclasses import replace

import numpy as np
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import LocalFeatures, Projection
from stavpr_ros.features.extractor import normalize
from stavpr_ros.mapping.place_map import Map

BLOCK_PLACES = 1024  # at a time: features of an opened map stay in its file
STRIPS_A_DIRECTION = 3  # with fewer, directions follow chance (docs/performance.md)


def with_principal_components(place_map: Map, dimension: int) -> Map:
    """
    Project a map's features to the directions in which they vary most around their mean.

    The directions are the same for all strips, and learned from all places. They stay as they are
    when the map grows: images are projected by the matrix of the map.

    :param dimension: at least 1, below the features' dimension, and so small that the map has
        ``STRIPS_A_DIRECTION`` strips for each.
    :raises SettingsError: another dimension.
    """
    features = place_map.features
    d, W, n = place_map.dimension, place_map.settings.strips, len(place_map)
    if not 1 <= dimension < d:
        raise SettingsError(
            f'{dimension} principal components of features of {d} dimensions: take 1 to {d - 1}'
        )
    if dimension * STRIPS_A_DIRECTION > W * n:
        raise SettingsError(
            f'{dimension} principal components of {W * n} strips ({n} places): '
            f'{STRIPS_A_DIRECTION} are needed for a direction: take at most '
            f'{W * n // STRIPS_A_DIRECTION}, or add places'
        )
    basis = _directions(features, d)[:, -dimension:].astype(np.float32)
    matrix, name = basis, f'principal components {d} -> {dimension} of {n} places'
    if before := place_map.projection:
        matrix, name = before.matrix @ matrix, f'{before.name}, {name}'
    projection = Projection(np.ascontiguousarray(matrix), name)
    strips: np.ndarray = np.empty((W, n, dimension), np.float32)
    for low in range(0, n, BLOCK_PLACES):
        strips[:, low : low + BLOCK_PLACES], _ = normalize(
            features[low : low + BLOCK_PLACES].strips @ basis
        )
    settings = replace(place_map.settings, projection=projection.identity)
    return replace(
        place_map,
        features=LocalFeatures(strips, features.weights, settings),
        projection=projection,
        threshold=None,
        map_id='',
        error_risks=None,
    )


def _directions(features: LocalFeatures, d: int) -> np.ndarray:
    """Return the principal directions, (d, m), float64, the largest variance last."""
    W, n = features.weights.shape
    if W * n < d:  # the products of fewer strips than dimensions
        strips = features[:].strips.astype(np.float64)
        centered = (strips - strips.mean(axis=1, keepdims=True)).reshape(W * n, d)
        _, vectors = np.linalg.eigh(centered @ centered.T)
        directions = vectors.T @ centered
        norms = np.linalg.norm(directions, axis=1, keepdims=True)
        return (directions / norms.clip(1e-9)).T
    total, squares = np.zeros((W, d)), np.zeros((d, d))
    for low in range(0, n, BLOCK_PLACES):
        strips = features[low : low + BLOCK_PLACES].strips
        rows = strips.reshape(-1, d)
        total += strips.sum(axis=1)
        squares += rows.T @ rows
    return np.linalg.eigh(squares - total.T @ total / max(n, 1))[1]
