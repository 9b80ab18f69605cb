# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window whose nearest sequence is found by LM-DTW (section 4 of the paper)."""

import numpy as np
from stavpr_ros.alignment.lm_dtw import (
    best_match,
    match_padded,
    padded_width,
    trace_sequence,
)
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.match import in_places, Path, WindowMatch, WindowSequences
from stavpr_ros.method.query_window import BufferWindow, SequenceBuffer


class LmDtwWindow(BufferWindow):
    """
    LM-DTW on the CPU; its twin is in :mod:`stavpr_ros.method.device_windows`.

    :param sequence: l and k.
    :param places: number of places n.
    :param layout: of the places.
    :param normalizes, around: see :class:`stavpr_ros.method.query_window.QueryWindow`.
    """

    def __init__(
        self,
        sequence: SequenceSettings,
        places: int,
        layout: ColumnLayout | None = None,
        normalizes: bool = False,
        around: int = 0,
    ) -> None:
        layout = layout or ColumnLayout()
        buffer = SequenceBuffer(sequence.length, layout.width(places), sequence.k)
        super().__init__(buffer, layout, normalizes, around)

    def match(self, nms_radius: int) -> WindowMatch:
        """See :meth:`QueryWindow.match`."""
        buffer = self.buffer
        n, k, first = buffer.known, buffer.k, buffer.first
        # columns behind the known ones are +inf, as the padding that the kernel needs
        window = np.ascontiguousarray(buffer.rows()[:, : padded_width(n, k)])
        matches = match_padded(window, n, k)
        nearest = best_match(matches, nms_radius)
        if nearest is None:
            return WindowMatch()
        pairs = trace_sequence(window[:, :n], nearest.first, k)
        pairs[:, 1] += first  # counted from the first place ever, evicted ones included
        second = nearest.second_best_index
        path = Path(
            pairs,
            nearest.middle + first,
            nearest.distance,
            second_best=second + first if second >= 0 else -1,
            second_best_distance=nearest.second_best_distance,
        )
        match = WindowMatch(
            path, lambda: WindowSequences(matches.distances, matches.middles + first)
        )
        return in_places(match, self.layout, nms_radius)
