# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration of declared probabilities: reliability, expected calibration error."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from stavpr_lab.evaluation.metrics import accepted_counts, ConfusionCounts, sweep

EDGES = np.arange(11) / 10  # bins: each includes its lower edge, the last one 1 as well
LEVELS = (0.5, 0.8, 0.9, 0.95, 0.99)  # declared probabilities from which matches are accepted


@dataclass(frozen=True)
class Calibration:
    """
    Declared probabilities of matches beside the share of correct ones.

    :param images: images with a probability in each bin, shape (10,), int64.
    :param declared: their mean probability, shape (10,); NaN where there are none.
    :param right: the share of them whose match is correct, shape (10,); NaN where there are none.
    :param levels: counts if matches of at least a probability are accepted, by that probability.
    :param best: counts at the probability with the best F1 (its threshold is 1 - probability).
    :param recall_at_full_precision: largest recall with precision 1, by descending probability.
    """

    images: np.ndarray
    declared: np.ndarray
    right: np.ndarray
    levels: dict[float, ConfusionCounts]
    best: ConfusionCounts
    recall_at_full_precision: float

    @property
    def expected_error(self) -> float:
        """Return the mean distance of declared probability and share of correct matches."""
        has_images = self.images > 0
        gaps = np.abs(self.declared - self.right)[has_images]
        return float(np.average(gaps, weights=self.images[has_images]))

    def to_json(self) -> dict[str, Any]:
        """Return the numbers for a JSON file."""
        columns = (EDGES[:-1], EDGES[1:], self.images, self.declared, self.right)
        return {
            'images': int(self.images.sum()),
            'expected_calibration_error': self.expected_error,
            'recall_at_100_precision': self.recall_at_full_precision,
            'f1': self.best.f1,
            'bins': [
                dict(zip(('from', 'to', 'images', 'declared', 'right'), row, strict=True))
                for row in zip(*(column.tolist() for column in columns), strict=True)
            ],
            'levels': [
                {
                    'probability': level,
                    'matched': counts.accepted,
                    'precision': counts.precision if counts.accepted else None,
                    'recall': counts.recall,
                }
                for level, counts in self.levels.items()
            ],
        }


def calibrate(
    probabilities: np.ndarray, correct: np.ndarray, has_match: np.ndarray
) -> Calibration | None:
    """
    Compare declared probabilities with the ground truth.

    :param probabilities: that a query's match is right, shape (N,); NaN = none declared.
    :param correct: the match is right, shape (N,), bool.
    :param has_match: the query's place is in the map, shape (N,), bool.
    :returns: None if none is declared.
    """
    is_known = np.isfinite(probabilities)
    if not is_known.any():
        return None
    bins = np.digitize(probabilities[is_known], EDGES[1:-1])

    def in_bins(weights: np.ndarray | None = None) -> np.ndarray:
        return np.bincount(bins, weights, minlength=len(EDGES) - 1)

    images = in_bins()
    with np.errstate(invalid='ignore'):
        declared = in_bins(probabilities[is_known]) / images
        right = in_bins(correct[is_known].astype(float)) / images
    counts = sweep(np.where(is_known, 1 - probabilities, np.inf), correct, has_match)
    levels = {
        level: accepted_counts(probabilities >= level, correct, has_match) for level in LEVELS
    }
    best = max(counts, key=lambda c: c.f1)
    full = max(c.recall for c in counts if c.precision == 1)
    return Calibration(images, declared, right, levels, best, full)
