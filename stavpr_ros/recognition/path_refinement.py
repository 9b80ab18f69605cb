# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The places of a window's images near a path of the place filter.

The speeds of the filter are few, and before the middle of the window its path is a straight line.
The offset of each image's place from the path is a hidden Markov model: it changes little from
image to image, and the evidence is the filter's, at the path's level. The forward-backward
algorithm gives the probability of each offset by all images of the window.
"""

import numpy as np
from stavpr_ros.compilation import kernel

BAND = 5  # places to either side of the filter's path
START_DEVIATION = 3.0  # places, of the path at the oldest image of the window
STEPS = np.array([0.03, 0.12, 0.7, 0.12, 0.03])  # probability of 2 places less than the path, ...
OFFSETS = np.arange(-BAND, BAND + 1)


def offset_probabilities(
    z: np.ndarray, path: np.ndarray, exponents: np.ndarray, images: np.ndarray, n: int
) -> np.ndarray:
    """
    Return the probability of each offset from a path, by all images of the window.

    :param z: z-normalized distances of each image to the places near the path, (l, S).
    :param path: place of each image, (l,).
    :param exponents: of their likelihoods: alpha times the mean of right places, (l,).
    :param images: the filter's number of each, (l,): equal ones are of a camera at rest.
    :param n: places.
    :returns: shape (l, S); each row sums to 1.
    """
    likelihoods, moves = np.empty(z.shape), np.empty((len(path), len(STEPS)))
    _window_likelihoods(z, path, exponents, images, n, likelihoods, moves)
    masses = np.empty(z.shape)
    masses[0] = np.exp(-0.5 * (OFFSETS / START_DEVIATION) ** 2)
    smooth(likelihoods, moves, masses)
    return masses


@kernel
def _window_likelihoods(
    z: np.ndarray, path: np.ndarray, exponents: np.ndarray, images: np.ndarray, n: int,
    likelihoods: np.ndarray, moves: np.ndarray,
) -> None:  # fmt: skip
    """Write the input of :func:`smooth`; parameters: see :func:`offset_probabilities`."""
    for i in range(len(path)):
        for s in range(z.shape[1]):
            inside = 0 <= path[i] + s - BAND < n and np.isfinite(z[i, s])
            likelihoods[i, s] = np.exp(exponents[i] * z[i, s]) if inside else 0
        step = path[i] - path[i - 1] if i else 0
        moves[i] = np.where(np.arange(step - 2, step + 3) >= 0, STEPS, 0)
        if i and images[i] == images[i - 1]:
            moves[i] = 0, 0, 1, 0, 0


@kernel
def smooth(likelihoods: np.ndarray, moves: np.ndarray, masses: np.ndarray) -> None:
    """
    Write the probability of each offset at each image, by the forward-backward algorithm.

    Images that no offset explains give no evidence.

    :param likelihoods: of each image at each offset, (l, S).
    :param moves: probability that the offset becomes 2 less, ..., 2 more before an image, (l, 5).
    :param masses: (l, S), written; its first row contains the probabilities before all images.
    """
    l, S = likelihoods.shape
    for i in range(l):
        for s in range(S):
            if i:
                masses[i, s] = 0
                for d in range(max(-2, s - S + 1), min(2, s) + 1):
                    masses[i, s] += masses[i - 1, s - d] * moves[i, d + 2]
            masses[i, s] *= likelihoods[i, s]
        total = masses[i].sum()
        if total > 0:
            masses[i] /= total
        else:
            masses[i] = 1 / S
    later, weighed = np.ones(S), np.empty(S)
    for i in range(l - 2, -1, -1):
        weighed[:] = later * likelihoods[i + 1]
        for s in range(S):
            later[s] = 0
            for d in range(max(-2, -s), min(2, S - 1 - s) + 1):
                later[s] += moves[i + 1, d + 2] * weighed[s + d]
        total = later.sum()
        later[:] = later / total if total > 0 else np.ones(S)
        combined = masses[i] * later
        if combined.sum() > 0:
            masses[i] = combined / combined.sum()
