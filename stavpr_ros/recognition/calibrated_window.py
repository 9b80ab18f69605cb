"""The window of mode robust: rows of distances, calibrated when they are matched."""

import numpy as np
import torch

from stavpr_ros.alignment.settings import SequenceSettings, SpeedSettings
from stavpr_ros.alignment.speeds import best_speed_match, match_speeds, trace_speed
from stavpr_ros.alignment.temporal import SequenceMatch, best_match, match_padded, trace_sequence
from stavpr_ros.recognition.calibration import FLAT, Calibration
from stavpr_ros.recognition.cpu_matcher import NO_PATH, nearest_places
from stavpr_ros.recognition.cures import Cures
from stavpr_ros.recognition.window import DistanceWindow


class CalibratedWindow:
    """
    The last l rows of distances to n places, and their match.

    :param places: most places there will be.
    :param sequence: l, and k for LM-DTW.
    :param cures: which of them apply.
    :param speeds: for the cure of that name.
    """

    def __init__(
        self, places: int, sequence: SequenceSettings, cures: Cures, speeds: SpeedSettings | None = None
    ) -> None:
        self._sequence, self._cures = sequence, cures
        self._speeds = speeds or SpeedSettings()
        self.calibration = Calibration(places, cures.row_normalisation, cures.place_calibration)
        self._window = DistanceWindow(sequence.length, places, sequence.k)
        self._places = places
        self._answer: tuple[np.ndarray, np.ndarray] = (np.empty(0), np.empty(0, int))

    def __len__(self) -> int:
        return len(self._window)

    def reset(self) -> None:
        """Empty the window and forget what was learned from its rows."""
        self.calibration.reset()
        self._window = DistanceWindow(self._sequence.length, self._places, self._sequence.k)

    def grow(self, places: int) -> None:
        """Make room for more places; the rows in the window do not know them."""
        self.calibration.grow(places)
        self._places = places
        self._window = self._window.widened(places)

    def push(self, row: torch.Tensor) -> None:
        """
        Take in the distances of the newest image.

        :param row: shape (m,), float32, of the first m <= n places; the others may not be matched with it.
        """
        normalised = self.calibration.normalised(row.cpu().numpy())
        self.calibration.observe(normalised)
        self._window.push(normalised)

    def newest_row(self) -> np.ndarray:
        """Return the newest row as it is matched, shape (n,), float32; lower is nearer."""
        shift, scale = self.calibration.shift_and_scale(self._places)
        return (self._window.rows()[-1, : self._places] - shift) * scale

    def match(self, neighbourhood: int) -> tuple[SequenceMatch | None, np.ndarray]:
        """Return the nearest sequence of a full window and its warping path; distances in deviations."""
        n = self._places
        shift, scale = self.calibration.shift_and_scale(n)
        rows = self._window.rows()
        if not self._cures.speeds:
            return self._match_by_dtw(rows, shift, scale, neighbourhood)
        if not (self._cures.row_normalisation or self._cures.place_calibration):
            known = rows[np.isfinite(rows)]  # the penalty is meant in deviations
            scale = scale / np.float32(max(known.std() if known.size else 0, FLAT))
        matches = match_speeds(rows[:, :n], self._speeds, shift, scale)
        self._answer = matches.distances, matches.middles
        nearest = best_speed_match(matches, neighbourhood)
        if nearest is None:
            return None, NO_PATH
        near = slice(max(0, nearest.last - self._reach), nearest.last + 1)
        costs = (rows[:, near] - shift[near]) * scale[near]
        path = trace_speed(costs, nearest.last - near.start, int(matches.speeds[nearest.last]), self._speeds)
        path[:, 1] += near.start
        return nearest, path

    @property
    def _reach(self) -> int:
        """Most places that a path goes on."""
        l = self._sequence.length
        return int(self._speeds.steps(l).sum(axis=1).max()) + l

    def _match_by_dtw(
        self, rows: np.ndarray, shift: np.ndarray, scale: np.ndarray, neighbourhood: int
    ) -> tuple[SequenceMatch | None, np.ndarray]:
        n = self._places
        costs = rows.copy()  # its padding with it
        costs[:, :n] = (rows[:, :n] - shift) * scale
        matches = match_padded(costs, n, self._sequence.k)
        self._answer = matches.distances, matches.middles
        nearest = best_match(matches, neighbourhood)
        if nearest is None:
            return None, NO_PATH
        return nearest, trace_sequence(costs[:, :n], nearest.first, self._sequence.k).path

    def candidates(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest places of the last match and their distances, nearest first."""
        return nearest_places(*self._answer, count)
