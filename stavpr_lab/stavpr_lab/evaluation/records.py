# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Evaluation of the matches that a node published for one traverse, as ``record`` wrote them."""

from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np
from stavpr_lab.evaluation.metrics import ConfusionCounts, counts_at, image_matches, ImageMatches
from stavpr_ros.method import Match, Path, Status

IN_WINDOW = ('WARMING_UP', 'NO_MATCH', 'MATCH')  # statuses of images that enter the window


@dataclass(frozen=True)
class TraverseEvaluation:
    """
    The recorded matches of N images beside the ground truth.

    :param matches: place and distance of each image, windows assigned to their middle images.
    :param accepted: distance below the threshold, shape (N,), bool.
    :param true_places: shape (N,), -1 = not in the map; None = unknown.
    :param tolerance: places.
    :param counts: at the threshold; None without ground truth.
    :param seconds: between one match and the next, shape (N - 1,): the round trip of an image.
    """

    matches: ImageMatches
    accepted: np.ndarray
    true_places: np.ndarray | None
    tolerance: int
    counts: ConfusionCounts | None
    seconds: np.ndarray

    @property
    def quantity(self) -> str:
        """Return what decides on a match: the probability, or in mode paper the distance."""
        return 'probability' if np.isfinite(self.matches.probabilities).any() else 'distance'

    def amount(self, distances: Any) -> Any:
        """Return distances of matches as amounts of :attr:`quantity`."""
        return 1 - distances if self.quantity == 'probability' else distances

    @property
    def matched(self) -> np.ndarray:
        """Return the accepted place of each image, -1 = none, shape (N,)."""
        return np.where(self.accepted, self.matches.places, -1)

    @property
    def correct(self) -> np.ndarray | None:
        """Return which are accepted and within the tolerance, shape (N,), bool."""
        if self.true_places is None:
            return None
        return self.accepted & self.matches.within(self.true_places, self.tolerance)

    def summary(self) -> str:
        """Return the result in words, a line each."""
        lines = [f'{np.count_nonzero(self.accepted)} of {len(self.accepted)} images matched']
        if self.true_places is not None and self.counts is not None:
            c, unseen = self.counts, self.true_places < 0
            lines.append(f'precision {c.precision:.3f}   recall {c.recall:.3f}   F1 {c.f1:.3f}')
            lines.append(f'(correct: within {self.tolerance} places of the ground truth)')
            if unseen.any():
                wrong = np.count_nonzero(self.accepted & unseen)
                lines.append(
                    f'{wrong} of {np.count_nonzero(unseen)} images of places that are not in the '
                    'map were matched'
                )
        if len(self.seconds):
            median, slow = np.percentile(self.seconds, [50, 99]) * 1e3
            lines.append(
                f'{1 / self.seconds.mean():.1f} images per second, one after the other; from '
                f'image to match {median:.1f} ms (median), {slow:.1f} ms (99 %), replay and '
                'transport included'
            )
        return '\n'.join(lines)


def match_of(record: dict[str, Any]) -> Match:
    """Return the match of a record that the command ``record`` wrote."""
    pairs = [(pair['query_index'], pair['place_index']) for pair in record['path']]
    path = Path(
        np.array(pairs, np.int32).reshape(-1, 2),
        record['sequence_middle'],
        nan if record['distance'] is None else record['distance'],
        shares=np.array(record['path_probabilities'], float),
    )
    probability = nan if record['probability'] is None else record['probability']
    return Match(
        Status[record['status']],
        path=path,
        probability=probability,
        window_stamps=(0,) * len(pairs),
    )


def evaluate_records(
    records: list[dict[str, Any]],
    length: int,
    threshold: float,
    true_places: np.ndarray | None,
    tolerance: int,
) -> TraverseEvaluation:
    """
    Compare recorded matches with the ground truth.

    :param records: one an image, in order.
    :param length: images in a window, l.
    :param true_places: shape (N,), -1 = not in the map; None = unknown.
    :param tolerance: places.
    """
    # an image that was in no window (invalid, dropped) has no match
    in_window = np.array([record['status'] in IN_WINDOW for record in records], bool)
    window_matches = image_matches(
        [match_of(record) for record in records if record['status'] in IN_WINDOW], length
    )
    matches = ImageMatches.none(len(records))
    for name in ('places', 'distances', 'accepted', 'probabilities'):
        getattr(matches, name)[in_window] = getattr(window_matches, name)
    counts = None
    if true_places is not None:
        correct = matches.within(true_places, tolerance)
        counts = counts_at(threshold, matches.distances, correct, true_places >= 0)
    received = np.array([record['received'] for record in records], float) / 1e9
    return TraverseEvaluation(
        matches, matches.distances < threshold, true_places, tolerance, counts, np.diff(received)
    )
