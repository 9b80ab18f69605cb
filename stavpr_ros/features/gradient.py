# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Oriented-gradient features: no weights, no training, the default without a network.

Histograms of gradient orientation on a regular grid of overlapping cells, each normalized by the
four 2 x 2 blocks around it (after Dalal and Triggs, "Histograms of Oriented Gradients for Human
Detection", CVPR 2005; one channel an orientation, the mean over the four normalizations). The
gradients are computed from log(1 + 32 I), intensity I in 0..1: contrast ratios, which a change of
light leaves as they are. A compiled kernel computes them image by image; there is none for GPUs.

The kernel's arithmetic on pixels runs over rows in SIMD lanes: without look-up and scatter. A
pixel's share in every orientation is computed, also where it is zero: that is a subtraction and a
maximum, and costs less than finding the two orientations with a share. Cells overlap by half and
are two cells wide, so an image is summed once over *chunks*, a cell wide and half a cell off the
grid; a cell is two by two of them. No ``fastmath``: the features are equal on every machine.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from stavpr_ros.checks import require_choice
from stavpr_ros.compilation import kernel
from stavpr_ros.devices import DEVICES
from stavpr_ros.features.area import cells, shrink
from stavpr_ros.features.extractor import resize_square
from stavpr_ros.features.registry import GradientSettings
from stavpr_ros.simd import LANES
from stavpr_ros.threads import thread_count

FLOOR = 1e-4  # squared gradient (intensities 0..1) below which a block counts as flat
F = np.float32
# atan(t) / (2 pi) = t P(t^2) for t in 0..1: minimax polynomial, within 4e-7 radian in float32
P0, P1, P2, P3, P4, P5, P6 = (
    F(0.159154324),
    F(-0.0530262382),
    F(0.0315251176),
    F(-0.021061518),
    F(0.0126725008),
    F(-0.00534827745),
    F(0.00108413043),
)
FULL_SCALE = F(255)
DARK = 32  # the logarithm is linear far below 1 / DARK of the full intensity
_I = np.arange(256) / 255
LOGARITHM = np.rint(255 * np.log1p(DARK * _I) / np.log1p(DARK)).astype(np.uint8)
LINEAR = np.arange(256, dtype=np.uint8)
PER_THREAD = 8  # images at least: starting a thread costs as much as one or two images


class Gradient:
    """Feature maps of ``orientations`` channels, ``cells`` x ``cells``; on the CPU in any case."""

    def __init__(self, settings: GradientSettings, device: str = 'cpu') -> None:
        self.settings = settings
        require_choice('device', device, DEVICES)
        self._shape = settings.orientations, settings.cells, settings.cells

    def feature_maps(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """
        Compute the feature maps of a batch of images, on several threads.

        :param images: RGB, each (h, w, 3) uint8, of any size.
        :returns: shape (n, orientations, cells, cells), float32, values >= 0.
        """
        s = self.settings
        maps: np.ndarray = np.empty((len(images), *self._shape), np.float32)

        def extract(i: int) -> None:
            _feature_maps(
                self._prepare(images[i]), s.cell, F(1.0 if s.signed else 0.5), F(FLOOR), maps[i]
            )

        _on_threads(extract, len(images))
        return maps

    def _prepare(self, image: np.ndarray) -> np.ndarray:
        """Return an image in gray, with a border, (size + 2, size + 2), uint8."""
        size, table = self.settings.size, LOGARITHM if self.settings.logarithm else LINEAR
        height, width = image.shape[:2]
        is_whole = not (height % size or width % size)  # OpenCV adds up integers then
        is_small = height < size or width < max(size, LANES)
        if self.settings.resize != 'area' or is_small or is_whole:
            gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            small = cv2.LUT(resize_square(gray, size, self.settings.resize), table)
            return np.asarray(cv2.copyMakeBorder(small, 1, 1, 1, 1, cv2.BORDER_REPLICATE))
        padded = np.empty((size + 2, size + 2), np.uint8)
        shrink(image, *cells(width, size), *cells(height, size), table, padded)
        return padded


def _on_threads(work: Callable[[int], None], count: int) -> None:
    """Call work(0) .. work(count - 1), which release the GIL, on several threads."""
    threads = count // PER_THREAD
    threads = threads if threads < 2 else min(threads, thread_count())
    if threads < 2:
        for i in range(count):
            work(i)
        return

    def part(first: int) -> None:
        for i in range(first, count, threads):
            work(i)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(part, range(threads)))  # the list re-raises errors of the threads


@kernel
def _feature_maps(padded: np.ndarray, cell: int, period: F, floor: F, maps: np.ndarray) -> None:
    """
    Compute the feature maps of one image.

    :param padded: shape (size + 2, size + 2), uint8.
    :param period: what the orientations cover: 1 turn, or half of it.
    :param maps: output, shape (orientations, cells, cells), float32.
    """
    orientations, cells = maps.shape[:2]
    chunks = np.empty((cells + 1, orientations, cells + 1), F)
    _sum_over_chunks(padded, cell, period, chunks)
    # with a border of one cell, equal to its neighbor
    energy = np.empty((cells + 2, cells + 2), F)
    _chunks_to_cells(chunks, F(1) / (FULL_SCALE * F(4 * cell * cell)), maps, energy)
    _normalize(maps, energy, floor)


@kernel
def _sum_over_chunks(padded: np.ndarray, cell: int, period: F, chunks: np.ndarray) -> None:
    """Sum the gradients of each chunk by orientation; chunks: (rows, orientations, columns)."""
    size, orientations = padded.shape[0] - 2, chunks.shape[1]
    position, magnitude = np.empty(size, F), np.empty(size, F)
    columns = np.empty((orientations, size), F)
    per_turn = F(orientations) / period
    for row in range(chunks.shape[0]):
        columns[:] = 0
        first, end = _chunk(row, cell, size)
        for y in range(first, end):
            _to_polar(
                padded[y], padded[y + 1], padded[y + 2], period, per_turn, position, magnitude
            )
            _share_out(position, magnitude, columns)
        for b in range(orientations):
            for column in range(chunks.shape[2]):
                first, end = _chunk(column, cell, size)
                total = F(0)
                for x in range(first, end):
                    total += columns[b, x]
                chunks[row, b, column] = total


@kernel
def _chunk(index: int, cell: int, size: int) -> tuple[int, int]:
    """Return the first pixel of a chunk and the one after its last, cut at the border."""
    start = index * cell - cell // 2
    return max(0, start), min(size, start + cell)


@kernel
def _to_polar(
    above: np.ndarray,
    here: np.ndarray,
    below: np.ndarray,
    period: F,
    per_turn: F,
    position: np.ndarray,
    magnitude: np.ndarray,
) -> None:
    """
    Turn a row of pixels (size + 2,) into the gradients' orientations and lengths (size,).

    Orientations are counted in bins, 0..orientations; lengths in gray levels, central differences.
    """
    for x in range(position.shape[0]):
        dx = F(here[x + 2]) - F(here[x])
        dy = F(below[x + 1]) - F(above[x + 1])
        width, height = abs(dx), abs(dy)
        longer = width if width > height else height
        shorter = height if width > height else width
        # whole numbers: longer is 0 or at least 1
        t = shorter / (longer if longer > F(1) else F(1))
        u = t * t
        turn = t * (P0 + u * (P1 + u * (P2 + u * (P3 + u * (P4 + u * (P5 + u * P6))))))
        turn = F(0.25) - turn if height > width else turn
        turn = F(0.5) - turn if dx < F(0) else turn
        turn = period - turn if dy < F(0) else turn  # -a is 2 pi - a, and pi - a if unsigned
        position[x] = turn * per_turn
        magnitude[x] = np.sqrt(dx * dx + dy * dy)


@kernel
def _share_out(position: np.ndarray, magnitude: np.ndarray, columns: np.ndarray) -> None:
    """Add each gradient to its two orientations, linearly; columns is (orientations, size)."""
    last = F(columns.shape[0] - 1)
    column = columns[0]
    for x in range(position.shape[0]):  # from the last orientation round to the first
        share = position[x] - last
        column[x] += magnitude[x] * (share if share > F(0) else F(0))
    for b in range(columns.shape[0]):
        column, center = columns[b], F(b)
        for x in range(position.shape[0]):
            share = F(1) - abs(position[x] - center)
            column[x] += magnitude[x] * (share if share > F(0) else F(0))


@kernel
def _chunks_to_cells(chunks: np.ndarray, factor: F, maps: np.ndarray, energy: np.ndarray) -> None:
    """Average the chunks over cells, intensities 0..1; energy: the squared norm of each cell."""
    cells = maps.shape[1]
    for i in range(cells):
        for j in range(cells):
            total = F(0)
            for b in range(maps.shape[0]):
                upper = chunks[i, b, j] + chunks[i, b, j + 1]
                lower = chunks[i + 1, b, j] + chunks[i + 1, b, j + 1]
                mean = (upper + lower) * factor
                maps[b, i, j] = mean
                total += mean * mean
            energy[i + 1, j + 1] = total
    for j in range(cells + 2):
        energy[0, j], energy[cells + 1, j] = energy[1, j], energy[cells, j]
    for i in range(cells + 2):
        energy[i, 0], energy[i, cells + 1] = energy[i, 1], energy[i, cells]


@kernel
def _normalize(maps: np.ndarray, energy: np.ndarray, floor: F) -> None:
    """Multiply each cell by the mean of 1 / norm over the four 2 x 2 blocks around it."""
    cells = maps.shape[1]
    scale = energy  # in place: a block is read from its first cell on
    for i in range(cells + 1):
        for j in range(cells + 1):
            block = energy[i, j] + energy[i, j + 1] + energy[i + 1, j] + energy[i + 1, j + 1]
            scale[i, j] = F(1) / np.sqrt(block + floor)
    for i in range(cells):
        for j in range(cells):
            mean = F(0.25) * (
                scale[i, j] + scale[i, j + 1] + scale[i + 1, j] + scale[i + 1, j + 1]
            )
            for b in range(maps.shape[0]):
                maps[b, i, j] *= mean
