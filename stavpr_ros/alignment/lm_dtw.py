# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Temporal alignment of a window with every place of the map, LM-DTW (section 4); its path."""

from dataclasses import dataclass

import numpy as np
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.checks import float_array, no_nan, require_shape
from stavpr_ros.errors import InputError

NO_PATH = np.empty((0, 2), np.int32)


@dataclass(frozen=True)
class SequenceDistances:
    """
    The best sequence from every start.

    :param distances: q_m of each start, shape (n,); +inf where no sequence is possible.
    :param lengths: its number of map images m, shape (n,), int32; it spans s .. s + m - 1. 0 where
        none.
    """

    distances: np.ndarray
    lengths: np.ndarray

    @property
    def middles(self) -> np.ndarray:
        """Return floor((first + last) / 2) of each start's sequence, shape (n,), int64."""
        starts = np.arange(len(self.lengths))
        return (2 * starts + self.lengths - 1) // 2


@dataclass(frozen=True)
class SequenceMatch:
    """
    The nearest sequence of the map, indices 0-based.

    :param first: its first map image.
    :param last: its last map image.
    :param middle: the matched place: floor((first + last) / 2), or in mode robust the place of
        the window's middle image.
    :param distance: its q_m.
    :param second_best_index: midpoint of the nearest sequence outside the nms_radius; -1 if none.
    :param second_best_distance: its distance; NaN if none.
    """

    first: int
    last: int
    middle: int
    distance: float
    second_best_index: int
    second_best_distance: float


def padded_width(n: int, k: int) -> int:
    """Return the kernel's columns for n starts: whole vectors, and the last start's k images."""
    from stavpr_ros.simd import LANES

    return -(-n // LANES) * LANES + k - 1


def match_padded(window: np.ndarray, n: int, k: int) -> SequenceDistances:
    """
    Match a window that lies ready for the kernel; nothing is checked (see :func:`match_sequence`).

    :param window: shape (l, padded_width(n, k)), C-contiguous, +inf in the columns from n on.
    """
    from stavpr_ros.alignment.cpu.lm_dtw import lm_dtw

    starts = window.shape[1] - k + 1
    distances, lengths = np.empty(starts, window.dtype), np.empty(starts, np.int32)
    lm_dtw(window, k, distances, lengths)
    return SequenceDistances(distances[:n], lengths[:n])


def match_sequence(distances: np.ndarray, settings: SequenceSettings) -> SequenceDistances:
    """
    Find the best map sequence from every start.

    :param distances: image distances D, shape (l, n), float32 or float64; row = query image,
        oldest first. +inf bans a pair.
    :returns: distance and length for each of the n starts.
    :raises InputError: wrong shape or type, NaN.
    """
    D = float_array(distances, 'image distances', f'{settings.length} n')
    l, n = no_nan(D, 'image distances').shape
    window = np.full((l, padded_width(n, settings.k)), np.inf, D.dtype)
    window[:, :n] = D
    return match_padded(window, n, settings.k)


def best_match(matches: SequenceDistances, nms_radius: int) -> SequenceMatch | None:
    """
    Return the nearest sequence and its second best.

    :param nms_radius: the second best's midpoint is more than so many places from the nearest
        one's.
    :returns: the lowest start on a tie; None if there is no sequence.
    """
    from stavpr_ros.alignment.cpu.lm_dtw import nearest_elsewhere

    distances = matches.distances
    require_shape('lengths', matches.lengths, f'{len(distances)}')
    if distances.size == 0:
        return None
    start = int(np.argmin(distances))
    if not np.isfinite(distances[start]):
        return None
    middles = matches.middles
    second = nearest_elsewhere(distances, matches.lengths, middles[start], nms_radius)
    return SequenceMatch(
        first=start,
        last=start + int(matches.lengths[start]) - 1,
        middle=int(middles[start]),
        distance=float(distances[start]),
        second_best_index=int(middles[second]) if second >= 0 else -1,
        second_best_distance=float(distances[second]) if second >= 0 else float('nan'),
    )


def trace_sequence(window: np.ndarray, start: int, k: int) -> np.ndarray:
    """
    Trace the path of one start in a checked window: to the first end with the smallest S / C.

    :param window: image distances D, shape (l, n).
    :param k: map images a start searches.
    :returns: the cells from the first to the last, shape (m, 2), int32: (query index, map index),
        both 0-based, the map index counted from the map's start.
    """
    from stavpr_ros.alignment.cpu import dtw

    d = np.ascontiguousarray(window[:, start : start + k])
    S, C, step = np.empty_like(d), np.empty_like(d), np.empty(d.shape, np.int8)
    dtw.accumulate(d, S, C, step)
    path = np.empty((sum(d.shape), 2), np.int32)
    count = dtw.backtrack(step, len(d) - 1, int(np.argmin(S[-1] / C[-1])), path)
    path[:, 1] += start
    return path[:count][::-1].copy()


def aligned_index(path: np.ndarray, query_index: int) -> int:
    """
    Return the map index aligned with one query image: the middle one (floor) of several.

    :param path: a warping path, shape (m, 2).
    :param query_index: 0-based row of the path.
    :raises InputError: the path has no such row.
    """
    columns = path[path[:, 0] == query_index, 1]
    if not columns.size:
        raise InputError(
            f'query index {query_index} is not on the path, which has rows 0 to {path[:, 0].max()}'
        )
    return int(columns[0] + columns[-1]) // 2
