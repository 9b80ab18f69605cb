# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The nearest sequence of the map by LM-DTW, on the CPU."""

from dataclasses import replace

import numpy as np
from stavpr_ros.alignment.lm_dtw import (
    best_match,
    match_padded,
    padded_width,
)
from stavpr_ros.alignment.path import NO_PATH, trace_sequence
from stavpr_ros.recognition.sequence_search import SequenceBuffer, WindowMatch


class LmDtwSearch:
    """
    LM-DTW on the CPU (section 4 of the paper).

    :param buffer: the window.
    """

    def __init__(self, buffer: SequenceBuffer) -> None:
        self.buffer = buffer

    def __call__(self, nms_radius: int) -> WindowMatch:
        buffer = self.buffer
        n, k, first = buffer.known, buffer.k, buffer.first
        window = buffer.rows().numpy()
        if n < buffer.places:
            costs = np.full((buffer.length, padded_width(n, k)), np.inf, np.float32)
            costs[:, :n] = window[:, :n]
            window = costs
        matches = match_padded(window, n, k)
        nearest = best_match(matches, nms_radius)
        path = NO_PATH
        if nearest is not None:
            path = trace_sequence(window[:, :n], nearest.first, k)
            path[:, 1] += first  # counted from the first place ever, evicted ones included
            second_best = nearest.second_best_index
            nearest = replace(
                nearest,
                first=nearest.first + first,
                last=nearest.last + first,
                middle=nearest.middle + first,
                second_best_index=second_best + first if second_best >= 0 else -1,
            )
        return WindowMatch(nearest, path, lambda: (matches.distances, matches.middles + first))
