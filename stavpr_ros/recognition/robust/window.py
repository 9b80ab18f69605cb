"""The window of mode robust: rows of distances, calibrated when they are matched."""

from dataclasses import replace

import numpy as np
import torch

from stavpr_ros.alignment.lm_dtw import (
    SequenceMatch,
    best_match,
    match_padded,
    padded_width,
    trace_sequence,
)
from stavpr_ros.alignment.path import NO_PATH
from stavpr_ros.alignment.settings import SequenceSettings, VelocitySettings
from stavpr_ros.alignment.velocity import best_velocity_match, match_velocities, trace_velocity
from stavpr_ros.recognition.robust.options import RobustOptions
from stavpr_ros.recognition.robust.znorm import FLAT, Calibration
from stavpr_ros.recognition.sequence_buffer import DistanceWindow


class CalibratedWindow:
    """
    The last l rows of distances to n places, and their match.

    Places are numbered from the first one ever, also when the oldest have been forgotten.

    :param places: most places there will be at a time.
    :param sequence: l, and k for LM-DTW.
    :param robust_options: which of them apply.
    :param speeds: for the option of that name.
    """

    def __init__(
        self, places: int, sequence: SequenceSettings, robust_options: RobustOptions, speeds: VelocitySettings | None = None
    ) -> None:
        self._sequence, self._options = sequence, robust_options
        self._speeds = speeds or VelocitySettings()
        self.calibration = Calibration(places, robust_options.query_znorm, robust_options.reference_znorm)
        self._window = DistanceWindow(sequence.length, places, sequence.k)
        self._places, self._first = places, 0
        self._known = 0  # places that any row in the window knows
        self._answer: tuple[np.ndarray, np.ndarray] = (np.empty(0), np.empty(0, int))

    def __len__(self) -> int:
        return len(self._window)

    def reset(self) -> None:
        """Empty the window and forget what was learned from its rows."""
        self.calibration.reset()
        self.clear()

    def clear(self) -> None:
        """Empty the window; what was learned of the places stays."""
        self._window = DistanceWindow(self._sequence.length, self._places, self._sequence.k)
        self._known = 0

    @property
    def first(self) -> int:
        """The first place that is not forgotten: as many are."""
        return self._first

    def grow(self, places: int) -> None:
        """Make room for more places; the rows in the window do not know them."""
        self.calibration.grow(places)
        self._places = places
        self._window = self._window.widened(places)

    def forget(self, count: int) -> None:
        """Forget the oldest places; as many new ones have room then."""
        self.calibration.forget(count)
        self._window.forget(count)
        self._known = max(0, self._known - count)
        self._first += count

    def push(self, row: torch.Tensor) -> None:
        """
        Take in the distances of the newest image.

        :param row: shape (m,), float32, of the first m <= n places that are not forgotten; the others may not
            be matched with it.
        """
        normalized = self.calibration.normalized(row.cpu().numpy())
        self._known = max(self._known, len(normalized))
        self.calibration.observe(normalized)
        self._window.push(normalized)

    def newest_row(self) -> np.ndarray:
        """Return the newest row as it is matched, from place ``first``, shape (n,), float32; low is near."""
        shift, scale = self.calibration.shift_and_scale(self._places)
        return (self._window.rows()[-1, : self._places] - shift) * scale

    def match(self, nms_radius: int) -> tuple[SequenceMatch | None, np.ndarray]:
        """Return the nearest sequence of a full window and its warping path; distances in deviations."""
        by = self._match_at_speeds if self._options.velocity_search else self._match_by_dtw
        nearest, path = by(*self.calibration.shift_and_scale(self._known), nms_radius)
        if nearest is None or not self._first:
            return nearest, path
        path[:, 1] += self._first
        return _moved(nearest, self._first), path

    def _match_at_speeds(
        self, shift: np.ndarray, scale: np.ndarray, nms_radius: int
    ) -> tuple[SequenceMatch | None, np.ndarray]:
        rows = self._window.rows()[:, : self._known]
        if not (self._options.query_znorm or self._options.reference_znorm):
            known = rows[np.isfinite(rows)]  # the penalty is meant in deviations
            scale = scale / np.float32(max(known.std() if known.size else 0, FLAT))
        matches = match_velocities(rows, self._speeds, shift, scale)
        self._answer = matches.distances, matches.middles + self._first
        nearest = best_velocity_match(matches, nms_radius)
        if nearest is None:
            return None, NO_PATH
        near = slice(max(0, nearest.last - self._reach), nearest.last + 1)
        costs = (rows[:, near] - shift[near]) * scale[near]
        path = trace_velocity(costs, nearest.last - near.start, int(matches.speeds[nearest.last]), self._speeds)
        path[:, 1] += near.start
        return nearest, path

    @property
    def _reach(self) -> int:
        """Most places that a path goes on."""
        l = self._sequence.length
        return int(self._speeds.steps(l).sum(axis=1).max()) + l

    def _match_by_dtw(
        self, shift: np.ndarray, scale: np.ndarray, nms_radius: int
    ) -> tuple[SequenceMatch | None, np.ndarray]:
        n, k = self._known, self._sequence.k
        costs = np.full((self._sequence.length, padded_width(n, k)), np.inf, np.float32)
        costs[:, :n] = (self._window.rows()[:, :n] - shift) * scale
        matches = match_padded(costs, n, k)
        self._answer = matches.distances, matches.middles + self._first
        nearest = best_match(matches, nms_radius)
        if nearest is None:
            return None, NO_PATH
        return nearest, trace_sequence(costs[:, :n], nearest.first, k).path

    def sequences(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances of all sequences matched last, +inf where there is none, and their places."""
        return self._answer


def _moved(match: SequenceMatch, by: int) -> SequenceMatch:
    """Return the same sequence where places are numbered from another one."""
    second_best = match.second_best_index
    return replace(
        match,
        first=match.first + by,
        last=match.last + by,
        middle=match.middle + by,
        second_best_index=second_best + by if second_best >= 0 else -1,
    )
