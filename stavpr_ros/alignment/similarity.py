# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cosine distances between one query image and all map images."""

import numpy as np
from stavpr_ros.checks import require_shape


def _checked(query: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both as float32 arrays."""
    query, reference = np.asarray(query), np.asarray(reference)
    W, d = require_shape('query strips', query, 'W d', 'float32')
    require_shape('reference strips', reference, f'{W} n {d}', 'float32')
    return query, reference


def strip_distances(query: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """
    Distances of every query strip to every strip of every map image: d[i, j] = 1 - <x_i, y_j>.

    A zero feature has the distance 1 to everything.

    :param query: unit-norm local features of one image, shape (W, d), float32.
    :param reference: features of the map, strip-major, shape (W, n, d), float32.
    :returns: shape (W, W, n), float32; d[i, j, y] is query strip i
        against strip j of map image y. Not clipped: after a random projection slightly outside [0,
        1].
    :raises InputError: shapes that do not fit.
    """
    query, reference = _checked(query, reference)
    W, n, _ = reference.shape
    from stavpr_ros.alignment.cpu import dot

    if W == 1:
        distances: np.ndarray = np.empty((1, 1, n), np.float32)
        vectors, vector = np.ascontiguousarray(reference[0]), np.ascontiguousarray(query)
        dot.cosine_distances(vectors, vector, distances[0])
        return distances
    rows = dot.tiled(query[:, None])[0]
    distances = np.empty((len(rows), W, n), np.float32)
    dot.strip_distances(np.ascontiguousarray(reference), rows, distances)
    return distances[:W]


def holistic_distances(
    query: np.ndarray,
    query_weights: np.ndarray,
    reference: np.ndarray,
    reference_weights: np.ndarray,
) -> np.ndarray:
    """
    Cosine distances without alignment, of the W strips of each image put together again.

    That is the whole feature map where its width is a multiple of W. Where it is not, strips leave
    columns out; a map made with W = 1 leaves none out.

    :param query: unit-norm local features, shape (W, d), float32.
    :param query_weights: norm of each strip over the norm of all, shape (W,).
    :param reference: shape (W, n, d).
    :param reference_weights: shape (W, n).
    :returns: shape (n,), float32.
    :raises InputError: shapes that do not fit.
    """
    query, reference = _checked(query, reference)
    query_weights, reference_weights = np.asarray(query_weights), np.asarray(reference_weights)
    W, n, _ = reference.shape
    require_shape('query weights', query_weights, f'{W}')
    require_shape('reference weights', reference_weights, f'{W} {n}')
    weighted_query = query * query_weights[:, None]
    similarity = (reference @ weighted_query[:, :, None])[:, :, 0]
    distances: np.ndarray = 1 - (similarity * reference_weights).sum(axis=0)
    return distances
