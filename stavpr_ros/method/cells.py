# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Cells that agree: whether the same parts of two images are at the same places.

The strips of several kinds of features are 7 x 7 cells of an image. A cell of the image and one of
the place **agree** if each is the nearest one of the other, at most one row apart; c is the number
of those that agree at one sideways shift, within one column. Unlike a distance, c is not changed
by what all cells share, such as light. The quantity of :mod:`stavpr_ros.method.evidence` is the
mean c along a path, less the same along its competitor, the nearest straight path elsewhere.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from stavpr_ros.compilation import kernel, reassociating_kernel
from stavpr_ros.features.registry import Cells
from stavpr_ros.method.model import FEW, MAX_SHIFT

SIDE = 7  # cells of a side of an image


class CellAgreement:
    """
    The cells of the images of a window, and how well they agree with cells of places.

    :param cells: where they are in a strip.
    :param strips_of: returns the strips of columns, (m,) to (7, m, d), float32.
    :param length: images of the window.
    """

    def __init__(
        self, cells: Cells, strips_of: Callable[[np.ndarray], np.ndarray], length: int
    ) -> None:
        self._cells, self._strips_of = cells, strips_of
        # the number, the cells, and c with columns, of each image
        self._images: deque[tuple[int, np.ndarray, dict[int, int]]] = deque(maxlen=length)

    def reset(self) -> None:
        """Drop all images."""
        self._images.clear()

    def push(self, strips: np.ndarray) -> None:
        """Add the newest image by its strips, (7, d)."""
        number = self._images[-1][0] + 1 if self._images else 0
        self._images.append((number, cells_of(strips[:, None], self._cells)[0], {}))

    def lead(self, path: np.ndarray, competitor: np.ndarray) -> float:
        """
        Return by how many cells a path agrees better than its competitor.

        :param path: column of each of the newest images, (m,); competitor: likewise, or empty.
        """
        images = list(self._images)[-len(path) :]
        if len(images) > FEW:
            even = [i for i, image in enumerate(images) if image[0] % 2 == 0]
            images, path = [images[i] for i in even], path[even]
            competitor = competitor[even] if len(competitor) else competitor
        elsewhere = self._mean(images, competitor) if len(competitor) else 0.0
        return self._mean(images, path) - elsewhere

    def _mean(self, images: Sequence[Any], path: np.ndarray) -> float:
        pairs = list(zip(images, path.tolist(), strict=True))
        new = [(image, column) for image, column in pairs if column not in image[2]]
        if new:
            strips = self._strips_of(np.array([column for _, column in new]))
            for (image, column), place in zip(new, cells_of(strips, self._cells), strict=True):
                image[2][column] = agreeing(image[1], place)
        return sum(image[2][column] for image, column in pairs) / len(pairs)


def cells_of(strips: np.ndarray, cells: Cells) -> np.ndarray:
    """Return the unit-norm cells of m images, (7, m, d) to (m, 49, C), row by row."""
    W, m, _ = strips.shape
    part = strips[:, :, cells.first : cells.first + cells.channels * cells.rows * cells.columns]
    shape = W, m, cells.channels, SIDE, cells.rows // SIDE, cells.columns
    cut = part.reshape(shape).transpose(1, 3, 0, 2, 4, 5).reshape(m, SIDE * W, -1)
    norms = np.linalg.norm(cut, axis=2, keepdims=True)
    return np.ascontiguousarray(cut / np.maximum(norms, np.float32(1e-9)))


@reassociating_kernel
def _products(a, b, out):  # type: ignore[no-untyped-def]
    """Multiply all rows of a (n, C) by all rows of b (n, C)."""
    for i in range(len(a)):
        for j in range(len(b)):
            total = np.float32(0)
            for t in range(a.shape[1]):
                total += a[i, t] * b[j, t]
            out[i, j] = total


@kernel
def agreeing(image: np.ndarray, place: np.ndarray) -> int:
    """Return c of two images by their cells, (49, C), float32 each."""
    n = len(image)
    products = np.empty((n, n), np.float32)
    _products(image, place, products)
    nearest, back = np.zeros(n, np.int64), np.zeros(n, np.int64)
    for i in range(n):
        for j in range(n):
            if products[i, j] > products[i, nearest[i]]:
                nearest[i] = j
            if products[j, i] > products[back[i], i]:
                back[i] = j
    counts = np.zeros(2 * SIDE + 1, np.int64)  # by the shift, with one more on either side
    for i in range(n):
        j = nearest[i]
        if back[j] == i and abs(j // SIDE - i // SIDE) <= 1:
            counts[SIDE + j % SIDE - i % SIDE] += 1
    best = 0
    for shift in range(SIDE - MAX_SHIFT, SIDE + MAX_SHIFT + 1):
        best = max(best, counts[shift - 1] + counts[shift] + counts[shift + 1])
    return best
