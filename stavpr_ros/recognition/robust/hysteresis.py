# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The score of mode robust: second-best margin and hysteresis.

A sequence is scored by its mean z-normalized distance and its margin to the second best, both in
standard deviations. With hysteresis the score has memory: strong evidence of earlier windows
lasts, fading, while the matched place moves on steadily. Successive scores are therefore
correlated.
"""

import math

# The evidence that windows from unknown places show as well, in deviations: at most one in thirty
# of them shows more on every pair of data sets that was tried.
CHANCE = -2.2
# The best of few sequences is far away: on a short map, or at the start of a route, every window
# would have a large margin. The second best is then taken to be at least as near as the best of
# many in windows from unknown places.
FEW_SEQUENCES = 20
USUAL_SECOND_BEST = -0.8
FADING = 0.05  # deviations that evidence loses with each image
BACK, AHEAD = 1, 3  # places that the matched place may move with each image of a track


def evidence(cost: float, other: float) -> float:
    """
    Return the cost of a sequence plus its margin to another one, in deviations; lower is better.

    :param cost: mean z-normalized distance of the sequence.
    :param other: that of the nearest sequence elsewhere; NaN if there is none.
    """
    return 2 * cost - (0.0 if math.isnan(other) else other)


def expected_second_best(other: float, sequences: int) -> float:
    """
    Return the cost that a second best should be expected to have.

    :param other: that of the nearest sequence elsewhere; NaN if there is none.
    :param sequences: number of sequences elsewhere.
    """
    if sequences >= FEW_SEQUENCES:
        return other
    return USUAL_SECOND_BEST if math.isnan(other) else min(other, USUAL_SECOND_BEST)


def score(value: float) -> float:
    """
    Map evidence to 0 (certain) .. 1 (chance level), the same scale on every route.

    1 is as near as windows from unknown places come; beyond it nothing is distinguished.
    """
    return min(1.0, math.exp(min(value - CHANCE, 0) / 2))


class Hysteresis:
    """Evidence with memory: the best of the last windows, fading, while the matched place moves on."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Drop the track."""
        self._middle: int | None = None
        self._evidence = math.inf

    def follow(self, middle: int, value: float) -> float:
        """
        Return the evidence for the place of the newest window, that of its track included.

        :param middle: the place.
        :param value: the evidence of this window alone.
        """
        if self._middle is not None and -BACK <= middle - self._middle <= AHEAD:
            value = min(value, self._evidence + FADING)
        self._middle, self._evidence = middle, value
        return value
