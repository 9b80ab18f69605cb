# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Searches over a full window: the nearest sequence of the map, by LM-DTW or by velocity search."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from stavpr_ros.alignment.lm_dtw import (
    best_match,
    match_padded,
    padded_width,
    SequenceMatch,
    trace_sequence,
)
from stavpr_ros.alignment.path import NO_PATH
from stavpr_ros.alignment.settings import VelocitySettings
from stavpr_ros.alignment.velocity import best_velocity_match, match_scaled, trace_velocity
from stavpr_ros.recognition.robust.znorm import MIN_DEVIATION, ZNormalization
from stavpr_ros.recognition.sequence_buffer import SequenceBuffer

Sequences = tuple[np.ndarray, np.ndarray]


def _no_sequences() -> Sequences:
    return np.empty(0, np.float32), np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class WindowMatch:
    """
    The nearest sequence of a window, and all others.

    :param nearest: with the second best; None where no sequence is possible.
    :param path: its warping path, shape (m, 2), int32: position in the window, place.
    :param sequences: returns the costs of all sequences, shape (n,), float32, +inf where there is
        none, and their middle places, shape (n,); valid until the next search.
    """

    nearest: SequenceMatch | None = None
    path: np.ndarray = field(default_factory=lambda: NO_PATH)
    sequences: Callable[[], Sequences] = _no_sequences


Search = Callable[[int], WindowMatch]
"""Matches a full window; the argument is the radius in places of the non-maximum suppression."""


class LmDtwSearch:
    """
    LM-DTW on the CPU (section 4 of the paper).

    :param buffer: the window.
    :param znorm: applied to the distances.
    """

    def __init__(self, buffer: SequenceBuffer, znorm: ZNormalization) -> None:
        self.buffer, self._znorm = buffer, znorm

    def __call__(self, nms_radius: int) -> WindowMatch:
        buffer = self.buffer
        n, k, first = buffer.known, buffer.k, buffer.first
        window = buffer.rows().numpy()
        if self._znorm.reference or n < buffer.places:
            costs = np.full((buffer.length, padded_width(n, k)), np.inf, np.float32)
            costs[:, :n] = self._znorm.scaled(window[:, :n])
            window = costs
        matches = match_padded(window, n, k)
        nearest = best_match(matches, nms_radius)
        path = NO_PATH
        if nearest is not None:
            path = trace_sequence(window[:, :n], nearest.first, k).path
        return _renumbered(
            nearest, path, lambda: (matches.distances, matches.middles + first), first
        )


class VelocitySearch:
    """
    Search along lines of constant velocity (:mod:`stavpr_ros.alignment.velocity`), on the CPU.

    :param buffer: the window.
    :param znorm: applied to the distances. Without any z-normalization they are divided by the
        standard deviation of the window, since the penalty of the search is meant in deviations.
    :param settings: velocities and penalty.
    """

    def __init__(
        self,
        buffer: SequenceBuffer,
        znorm: ZNormalization,
        settings: VelocitySettings | None = None,
    ) -> None:
        self.buffer, self._znorm = buffer, znorm
        self._settings = settings or VelocitySettings()
        steps = self._settings.steps(buffer.length)
        self._reach = (
            int(steps.sum(axis=1).max()) + buffer.length
        )  # most places that a path passes

    def __call__(self, nms_radius: int) -> WindowMatch:
        rows, n, first = self.buffer.rows().numpy(), self.buffer.known, self.buffer.first
        shift, scale = self._znorm.shift_and_scale(n)
        if not (self._znorm.query or self._znorm.reference):
            known = rows[:, :n][np.isfinite(rows[:, :n])]
            scale = scale / np.float32(max(known.std() if known.size else 0, MIN_DEVIATION))
        matches = match_scaled(rows, shift, scale, self._settings)
        nearest = best_velocity_match(matches, nms_radius)
        path = NO_PATH
        if nearest is not None:
            near = slice(max(0, nearest.last - self._reach), nearest.last + 1)
            costs = (rows[:, near] - shift[near]) * scale[near]
            velocity = int(matches.speeds[nearest.last])
            path = trace_velocity(costs, nearest.last - near.start, velocity, self._settings)
            path[:, 1] += near.start
        return _renumbered(
            nearest, path, lambda: (matches.distances, matches.middles + first), first
        )


def _renumbered(
    nearest: SequenceMatch | None, path: np.ndarray, sequences: Callable[[], Sequences], first: int
) -> WindowMatch:
    """Return a match whose places are counted from the first place ever, evicted ones included."""
    if nearest is None or not first:
        return WindowMatch(nearest, path, sequences)
    path[:, 1] += first
    second_best = nearest.second_best_index
    moved = replace(
        nearest,
        first=nearest.first + first,
        last=nearest.last + first,
        middle=nearest.middle + first,
        second_best_index=second_best + first if second_best >= 0 else -1,
    )
    return WindowMatch(moved, path, sequences)
