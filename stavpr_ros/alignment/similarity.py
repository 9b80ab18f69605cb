# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cosine distances between one query image and all map images."""

import numpy as np
from stavpr_ros.errors import InputError


def _checked(query: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both as float32 arrays."""
    query, reference = np.asarray(query), np.asarray(reference)
    if query.dtype != np.float32 or reference.dtype != np.float32:
        raise InputError(f'query is {query.dtype}, reference {reference.dtype}: expected float32')
    if query.ndim != 2 or reference.ndim != 3:
        raise InputError(
            f'query has shape {query.shape}, reference {reference.shape}: '
            'expected (W, d) and (W, n, d)'
        )
    if query.shape[0] != reference.shape[0] or query.shape[1] != reference.shape[2]:
        raise InputError(
            f'query strips {query.shape} do not fit reference strips '
            f'{reference.shape}: W and d must be equal'
        )
    return query, reference


def strip_distances(query: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """
    Distances of every query strip to every strip of every map image: d[i, j] = 1 - <x_i, y_j>.

    A zero feature has the distance 1 to everything.

    :param query: unit-norm local features of one image, shape (W, d), float32.
    :param reference: those of the map, strip-major, shape (W, n, d), float32.
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
    if query_weights.shape != query.shape[:1] or reference_weights.shape != reference.shape[:2]:
        raise InputError(
            f'weights have shapes {query_weights.shape} and '
            f'{reference_weights.shape}: '
            f'expected {query.shape[:1]} and {reference.shape[:2]}'
        )
    weighted = query * query_weights[:, None]
    similarity = (reference @ weighted[:, :, None])[:, :, 0]
    distances: np.ndarray = 1 - (similarity * reference_weights).sum(axis=0)
    return distances
