# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cosine distances between one query image and all map images."""

import numpy as np
from stavpr_ros.checks import require_shape


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
    query, reference = np.asarray(query), np.asarray(reference)
    W, d = require_shape('query strips', query, 'W d', 'float32')
    _, n, _ = require_shape('reference strips', reference, f'{W} n {d}', 'float32')
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
