# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Lower bounds: minimum time of a stage, by its bytes, operations and the machine's peaks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from stavpr_ros.features.registry import Cells
from stavpr_ros.method.cells import SIDE
from stavpr_ros.method.model import FEW, MODEL

ITEM_BYTES = {'float32': 4, 'int8': 1}

# Operations of one inner cell. LM-DTW: three sums x + S, two minima, two selections of the path's
# length, its increment. Image distance: the factor of the diagonal besides. A comparison that also
# selects counts once, index arithmetic does not count: fewer operations make a stricter bound.
SEQUENCE_CELL, SPATIAL_CELL = 8, 9
BORDER_CELL = 2  # one predecessor: S + x, C + 1
SPEEDS, STEPS = len(MODEL.speeds), int(np.count_nonzero(MODEL.steps()))  # steps of all speeds
MIXED = 5  # a change of speed: two products, two sums, and the birth


@dataclass(frozen=True)
class Sizes:
    """
    Sizes of one problem, in the paper's symbols.

    :param n: places.
    :param d: dimensions of a local feature.
    :param W: strips of an image.
    :param l: images of the window.
    :param k: map images within reach of a start of LM-DTW.
    """

    n: int
    d: int = 512
    W: int = 7
    l: int = 20
    k: int = 40


@dataclass(frozen=True)
class Work:
    """
    Work of one stage.

    :param bytes: read at least once.
    :param operations: an addition and a multiplication count as two.
    """

    bytes: float
    operations: float


@dataclass(frozen=True)
class Peaks:
    """
    Peaks of the machine, measured in the same run.

    :param bytes_per_s: read bandwidth.
    :param operations_per_s: rate of the large matrix product in float32.
    """

    bytes_per_s: float
    operations_per_s: float


def bound_seconds(works: Sequence[Work], peaks: Peaks) -> float:
    """Return the sum, over the works, of the longer of reading bytes and doing operations."""
    return sum(
        max(work.bytes / peaks.bytes_per_s, work.operations / peaks.operations_per_s)
        for work in works
    )


def product(sizes: Sizes, precision: str, frames: int = 1) -> Work:
    """
    Product of all pairs of strips of ``frames`` images with the map.

    In int8, reading the map alone: torch has no product whose rate could be a bound.
    """
    operations = 2 * frames * sizes.W**2 * sizes.n * sizes.d if precision == 'float32' else 0
    return Work(sizes.W * sizes.n * sizes.d * ITEM_BYTES[precision], operations)


def spatial_alignment(sizes: Sizes, frames: int = 1) -> Work:
    """Spatial alignment; it may read the similarities where the product left them: no bytes."""
    border = 2 * (sizes.W - 1)
    inner = sizes.W**2 - 1 - border
    return Work(0, frames * sizes.n * (inner * SPATIAL_CELL + border * BORDER_CELL + 1))


def mean_centering(sizes: Sizes) -> Work:
    """Sum, mean, difference, norm and division of one image's strips; the sum is float64."""
    return Work(12 * sizes.W * sizes.d, 6 * sizes.W * sizes.d)


def query_znorm(sizes: Sizes) -> Work:
    """Mean (1), deviation (3) and normalization (2) of a row of distances."""
    return Work(4 * sizes.n, 6 * sizes.n)


def window_push(sizes: Sizes) -> Work:
    """Copy of a row into the window, and the sum that finds NaN."""
    return Work(4 * sizes.n, sizes.n)


def filter_update(sizes: Sizes) -> Work:
    """
    Advance the filter: states and row are read once; states, sums and the row are written once.

    A likelihood takes a minimum, a product, a difference and an exponential (1). A state moves (2
    a step), changes its speed, is weighed, and counts in three sums.
    """
    per_place = 4 + 2 * STEPS + SPEEDS * (MIXED + 4)
    return Work(sizes.n * (12 + 8 * SPEEDS), sizes.n * per_place)


def smoothing(sizes: Sizes, columns: int) -> Work:
    """Advance the states of a region again, and go back; both move, change speed, are weighed."""
    per_column = 2 * (2 * STEPS + SPEEDS * (MIXED + 1)) + 3 * SPEEDS  # the belief, and the sum
    return Work(4 * columns * (SPEEDS + sizes.l), sizes.l * columns * per_column)


def straight_paths(sizes: Sizes, speeds: int) -> Work:
    """Read the z of a window once; the least of three, a sum for each speed, its minimum."""
    per_place = 2 * sizes.l + speeds * (sizes.l + 1)
    return Work(4 * sizes.l * sizes.n, sizes.n * per_place)


def cells(sizes: Sizes, cells: Cells) -> Work:
    """Compare the cells of images with the cells of a competitor's places, all pairs."""
    C = cells.channels * cells.rows * cells.columns // SIDE
    return Work(4 * FEW * sizes.W * sizes.d, 2 * FEW * (SIDE * sizes.W) ** 2 * C)


def lm_dtw(sizes: Sizes) -> Work:
    """LM-DTW: the window is read once; a division and a minimum for each end."""
    l, k = sizes.l, sizes.k
    per_place = (l - 1) * (k - 1) * SEQUENCE_CELL + (l + k - 2) * BORDER_CELL + 2 * k
    return Work(4 * l * sizes.n, sizes.n * per_place)


def selection(sizes: Sizes) -> Work:
    """Best and second best: distance and middle (or length) of each sequence are read once."""
    return Work(8 * sizes.n, 6 * sizes.n)


def path_trace(l: int, width: int) -> Work:
    """Recursion on the columns that a path can reach: a cost, two more predecessors a cell."""
    return Work(4 * l * width, 7 * l * width)
