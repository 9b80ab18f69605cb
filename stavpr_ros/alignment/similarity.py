# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cosine distances between one query image and all map images, as products on the map's device."""

import numpy as np
from stavpr_ros.errors import InputError
import torch


def _checked(
    query: np.ndarray | torch.Tensor, reference: np.ndarray | torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return both as float32 tensors on the reference's device."""
    reference = torch.as_tensor(reference)
    query = torch.as_tensor(query).to(reference.device)
    if query.dtype != torch.float32 or reference.dtype != torch.float32:
        raise InputError(f'query is {query.dtype}, reference {reference.dtype}: expected float32')
    if query.ndim != 2 or reference.ndim != 3:
        raise InputError(
            f'query has shape {tuple(query.shape)}, reference {tuple(reference.shape)}: '
            'expected (W, d) and (W, n, d)'
        )
    if query.shape[0] != reference.shape[0] or query.shape[1] != reference.shape[2]:
        raise InputError(
            f'query strips {tuple(query.shape)} do not fit reference strips '
            f'{tuple(reference.shape)}: W and d must be equal'
        )
    return query, reference


def strip_distances(
    query: np.ndarray | torch.Tensor, reference: np.ndarray | torch.Tensor
) -> torch.Tensor:
    """
    Distances of every query strip to every strip of every map image: d[i, j] = 1 - <x_i, y_j>.

    A zero feature has the distance 1 to everything.

    :param query: unit-norm local features of one image, shape (W, d), float32.
    :param reference: those of the map, strip-major, shape (W, n, d), float32.
    :returns: shape (W, W, n), float32, on the reference's device; d[i, j, y] is query strip i
        against strip j of map image y. Not clipped: after a random projection slightly outside [0,
        1].
    :raises InputError: shapes that do not fit.
    """
    query, reference = _checked(query, reference)
    W, n, d = reference.shape
    if reference.is_cuda:
        similarity = torch.nn.functional.linear(query, reference.reshape(W * n, d))
        return similarity.neg_().add_(1).view(W, W, n)
    from stavpr_ros.alignment.cpu import dot

    if W == 1:
        distances = np.empty((1, 1, n), np.float32)
        vector = query.contiguous().numpy()
        dot.cosine_distances(reference[0].contiguous().numpy(), vector, distances[0])
        return torch.from_numpy(distances)
    rows = dot.tiled(query[:, None])[0]
    distances = np.empty((len(rows), W, n), np.float32)
    dot.strip_distances(reference.contiguous().numpy(), rows, distances)
    return torch.from_numpy(distances[:W])


def holistic_distances(
    query: np.ndarray | torch.Tensor,
    query_weights: np.ndarray | torch.Tensor,
    reference: np.ndarray | torch.Tensor,
    reference_weights: np.ndarray | torch.Tensor,
) -> torch.Tensor:
    """
    Cosine distances without alignment, of the W strips of each image put together again.

    That is the whole feature map where its width is a multiple of W. Where it is not, strips leave
    columns out; a map made with W = 1 leaves none out.

    :param query: unit-norm local features, shape (W, d), float32.
    :param query_weights: norm of each strip over the norm of all, shape (W,).
    :param reference: shape (W, n, d).
    :param reference_weights: shape (W, n).
    :returns: shape (n,), float32, on the reference's device.
    :raises InputError: shapes that do not fit.
    """
    query, reference = _checked(query, reference)
    query_weights = torch.as_tensor(query_weights).to(reference.device)
    reference_weights = torch.as_tensor(reference_weights).to(reference.device)
    if query_weights.shape != query.shape[:1] or reference_weights.shape != reference.shape[:2]:
        raise InputError(
            f'weights have shapes {tuple(query_weights.shape)} and '
            f'{tuple(reference_weights.shape)}: '
            f'expected {tuple(query.shape[:1])} and {tuple(reference.shape[:2])}'
        )
    weighted = query * query_weights[:, None]
    similarity = torch.bmm(reference, weighted[:, :, None])[:, :, 0]
    return 1 - (similarity * reference_weights).sum(dim=0)
