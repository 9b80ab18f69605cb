"""Precision, recall and F1 as the paper counts them (section 6 of the method)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stavpr_ros.alignment import aligned_index
from stavpr_ros.errors import InputError


@dataclass(frozen=True)
class Score:
    """
    Counts at one threshold: accepted and right (TP), accepted and wrong (FP), a true match rejected (FN).

    :param threshold: accepted means distance < threshold.
    """

    threshold: float
    true_positives: int
    false_positives: int
    false_negatives: int

    @property
    def precision(self) -> float:
        """TP / (TP + FP); 1 when nothing is accepted."""
        accepted = self.true_positives + self.false_positives
        return self.true_positives / accepted if accepted else 1.0

    @property
    def recall(self) -> float:
        """TP / (TP + FN); 0 when there is neither."""
        relevant = self.true_positives + self.false_negatives
        return self.true_positives / relevant if relevant else 0.0

    @property
    def f1(self) -> float:
        """2 TP / (2 TP + FP + FN)."""
        total = 2 * self.true_positives + self.false_positives + self.false_negatives
        return 2 * self.true_positives / total if total else 0.0


def _checked(
    distances: np.ndarray, correct: np.ndarray, has_match: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    distances, correct = np.asarray(distances, float), np.asarray(correct, bool)
    has_match = np.ones_like(correct) if has_match is None else np.asarray(has_match, bool)
    if not distances.shape == correct.shape == has_match.shape or distances.ndim != 1:
        raise InputError(
            f'distances {distances.shape}, correct {correct.shape}, has_match {has_match.shape}: '
            'expected one value a query each'
        )
    return distances, correct, has_match


def score_at(
    threshold: float, distances: np.ndarray, correct: np.ndarray, has_match: np.ndarray | None = None
) -> Score:
    """
    Count at one threshold.

    :param distances: of each query's answer, shape (N,); +inf or NaN = no answer.
    :param correct: the answer is within the tolerance of the truth, shape (N,), bool.
    :param has_match: the query's place is in the map, shape (N,), bool; None = all are.
    """
    distances, correct, has_match = _checked(distances, correct, has_match)
    accepted = distances < threshold
    return Score(
        float(threshold),
        int(np.count_nonzero(accepted & correct)),
        int(np.count_nonzero(accepted & ~correct)),
        int(np.count_nonzero(~accepted & has_match)),
    )


def sweep(distances: np.ndarray, correct: np.ndarray, has_match: np.ndarray | None = None) -> list[Score]:
    """Count at every threshold that changes something, from rejecting all to accepting all."""
    distances, correct, has_match = _checked(distances, correct, has_match)
    finite = np.unique(distances[np.isfinite(distances)])
    thresholds = [*finite, np.nextafter(finite[-1], np.inf)] if finite.size else [0.0]
    return [score_at(threshold, distances, correct, has_match) for threshold in thresholds]


def best_f1(distances: np.ndarray, correct: np.ndarray, has_match: np.ndarray | None = None) -> Score:
    """Return the counts at the threshold with the best F1 (the lowest on a tie); see :func:`score_at`."""
    return max(sweep(distances, correct, has_match), key=lambda score: score.f1)


@dataclass(frozen=True)
class WindowAnswer:
    """
    What was found for one window.

    :param middle: midpoint of the nearest sequence, a place of the map.
    :param distance: its distance.
    :param path: its warping path, shape (m, 2): position in the window, place.
    """

    middle: int
    distance: float
    path: np.ndarray


@dataclass(frozen=True)
class FrameAnswers:
    """
    The answer to each of N query images.

    :param places: shape (N,), int64; -1 where there is none.
    :param distances: shape (N,), float64; +inf where there is none.
    """

    places: np.ndarray
    distances: np.ndarray

    def within(self, truth: np.ndarray, tolerance: int) -> np.ndarray:
        """Tell which answers are within ``tolerance`` places of the truth (-1 = not in the map)."""
        truth = np.asarray(truth)
        return (self.places >= 0) & (truth >= 0) & (np.abs(self.places - truth) <= tolerance)


def frame_answers(windows: Sequence[WindowAnswer | None], length: int) -> FrameAnswers:
    """
    Give every image its answer: that of the window whose midpoint it is.

    Images before the first window's midpoint or after the last one's take theirs from that window's
    warping path, with its distance.

    :param windows: for each image in order, the answer of the window that ends with it; None without one.
    :param length: images in a window, l.
    """
    places = np.full(len(windows), -1, np.int64)
    distances = np.full(len(windows), np.inf)
    middle = (length - 1) // 2
    answered = [end for end, window in enumerate(windows) if window is not None]

    def fill(end: int, position: int, place: int) -> None:
        window = windows[end]
        image = end - (length - 1) + position
        if window is not None and image >= 0:
            places[image], distances[image] = place, window.distance

    for end in answered:
        fill(end, middle, windows[end].middle)  # type: ignore[union-attr]
    if answered:
        first, last = answered[0], answered[-1]
        for position in range(middle):
            fill(first, position, aligned_index(windows[first].path, position))  # type: ignore[union-attr]
        for position in range(middle + 1, length):
            fill(last, position, aligned_index(windows[last].path, position))  # type: ignore[union-attr]
    return FrameAnswers(places, distances)
