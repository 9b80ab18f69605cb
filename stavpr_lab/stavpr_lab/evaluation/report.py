# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An evaluation and its surroundings: the numbers of a report, and the examples that it shows."""

from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any

import numpy as np
from stavpr_lab.evaluation.drive import Drive
from stavpr_lab.evaluation.evaluate import Evaluation, WindowDistances
from stavpr_lab.evaluation.metrics import accepted_counts, ConfusionCounts
from stavpr_lab.evaluation.protocol import error_rate_and_recall, Estimate
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import Map

METRICS = ('sequence', 'sequence_without_ends', 'single', 'single_without_ends')


@dataclass(frozen=True)
class Report:
    """
    An evaluation with the images and settings that it was made from.

    :param query: the query's places, with thumbnails if the report is to show them.
    :param reference: the map; the query itself for loop closures.
    :param title: names of both, a line.
    :param settings: everything that decides the numbers of the run.
    :param times: durations in the run, by name; seconds, or milliseconds where the name has them.
    :param drive: changes of the query, and places removed from the map.
    :param default_threshold: the mode's own, with which the recognizer ran; None = it has none.
    :param window: query image whose window is plotted; None = the worst mistake.
    """

    evaluation: Evaluation
    query: Map
    reference: Map
    title: str
    settings: dict[str, Any]
    times: dict[str, float]
    drive: Drive
    default_threshold: float | None = None
    window: int | None = None

    def to_json(self) -> dict[str, Any]:
        """Return all numbers for a JSON file; undefined ones are None."""
        numbers: dict[str, Any] = {'decision': self.decision()}
        if self.has_truth:
            numbers |= self._metrics()
        numbers |= {'images': len(self.query), 'places': len(self.reference)}
        numbers['map_id'] = self.reference.map_id
        numbers |= {'settings': self.settings, 'times': self.times}
        return jsonable(numbers)

    @property
    def quantity(self) -> str:
        """Return what decides on a match: the probability, or in mode paper the distance."""
        return 'distance' if self.default_threshold is None else 'probability'

    def amount(self, distances: Any) -> Any:
        """Return distances of matches as amounts of :attr:`quantity`."""
        return distances if self.default_threshold is None else 1 - distances

    @property
    def has_truth(self) -> bool:
        """Whether there is a ground truth, and the metrics are meaningful."""
        return bool(self.evaluation.ground_truth.kind)

    @cached_property
    def accepted(self) -> np.ndarray:
        """
        Return which matches a robot would get, shape (N,), bool.

        Matches that the recognizer accepts by default; in mode paper, which has no default,
        matches below the threshold of the best F1.
        """
        if self.default_threshold is None:
            return self.evaluation.best_accepted
        return self.evaluation.results.accepted

    @cached_property
    def counts(self) -> ConfusionCounts:
        """Return the counts of :attr:`accepted`, of the images whose truth is known."""
        return accepted_counts(*self._compared_columns)

    @cached_property
    def estimates(self) -> tuple[Estimate, Estimate]:
        """Return error rate and recall of :attr:`accepted`, with 95 % intervals."""
        return error_rate_and_recall(*self._compared_columns)

    @cached_property
    def _compared_columns(self) -> list[np.ndarray]:
        """Return accepted, correct and in the map, of the images whose truth is known."""
        truth = self.evaluation.ground_truth
        columns = self.accepted, self.evaluation.correct, truth.has_match
        return [column[truth.is_stated] for column in columns] if truth.kind else list(columns)

    def decision(self) -> dict[str, Any]:
        """
        Return how many images are matched, and by early matches; with ground truth, wrongly.

        Online, an image counts that has a match when it comes: a node publishes so many.
        """
        counts = self.counts
        decision: dict[str, Any] = {
            'rule': 'best F1' if self.default_threshold is None else 'default',
            'images': len(self.accepted),
            'matched': int(np.count_nonzero(self.accepted)),
        }
        matches, images = self.evaluation.results.published
        early = slice(len(self.accepted), None)
        decision['early_matched'] = len(images[early])
        decision['online_matched'] = len(self.evaluation.results.online)
        decision['first_matched'] = next(iter(self.evaluation.results.online.tolist()), None)
        if not self.has_truth:
            return decision
        truth = self.evaluation.ground_truth.select(images)
        wrong = truth.is_stated & ~truth.accepts(matches.places)
        return decision | {
            'images_with_truth': len(self._compared_columns[0]),
            'matched_with_truth': counts.accepted,
            'early_with_truth': int(np.count_nonzero(truth.is_stated[early])),
            'early_wrong': int(np.count_nonzero(wrong[early])),
            'wrongly_matched': counts.false_positives,
            'precision': counts.precision,
            'recall': counts.recall,
            'error_rate': self.estimates[0][0],
            'error_rate_interval': self.estimates[0][1:],
            'recall_interval': self.estimates[1][1:],
        }

    def unseen(self) -> list[dict[str, int]]:
        """Return, for each stretch removed from the map, its unseen images and those matched."""
        return [
            {
                'first': first,
                'last': last,
                'images': int(np.count_nonzero(mask)),
                'matched': int(np.count_nonzero(mask & self.accepted)),
            }
            for (first, last), mask in zip(self.drive.removed, self.drive.unseen(), strict=True)
        ]

    def _metrics(self) -> dict[str, Any]:
        """Return the numbers that compare the matches with the ground truth."""
        evaluation, calibration = self.evaluation, self.evaluation.calibration
        numbers: dict[str, Any] = {name: getattr(evaluation, name).to_json() for name in METRICS}
        numbers['recommended_threshold'] = evaluation.sequence.best.threshold
        if self.default_threshold is not None:
            numbers['default_threshold'] = self._at_default()
        numbers['unseen'] = self.unseen()
        numbers['calibration'] = None if calibration is None else calibration.to_json()
        if evaluation.unknown is not None:
            for kind, rate in evaluation.false_alarm_rates.items():
                numbers[kind]['false_alarm_rate'] = rate
            numbers['false_alarm_rate'] = evaluation.false_alarm_rates['sequence']
            numbers['unknown_images'] = len(evaluation.unknown.single)
        return numbers

    def _at_default(self) -> dict[str, Any]:
        counts, unknown = self.counts, self.evaluation.unknown
        numbers: dict[str, Any] = {'threshold': self.default_threshold}
        numbers |= {'precision': counts.precision, 'recall': counts.recall, 'f1': counts.f1}
        if unknown is not None:
            numbers['false_alarm_rate'] = float(np.mean(unknown.accepted))
        return numbers


def jsonable(value: Any) -> Any:
    """Replace NaN and infinities, which JSON lacks, by None, and NumPy's numbers by Python's."""
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def worst_mistakes(evaluation: Evaluation, count: int) -> list[int]:
    """
    Choose wrong matches, a window off or more first, then by distance, half a window apart.

    :returns: up to ``count`` images, the worst first; none without ground truth.
    """
    if not evaluation.ground_truth.kind:
        return []
    matches, true = evaluation.results.sequence, evaluation.ground_truth.middles
    wrong = ~evaluation.correct & evaluation.ground_truth.is_stated & np.isfinite(matches.scores)
    near = (true >= 0) & (np.abs(matches.best - true) < evaluation.sequence_length)
    apart = evaluation.sequence_length // 2
    images: list[int] = []
    for image in np.lexsort((matches.scores, near)).tolist():
        if wrong[image] and all(abs(image - other) > apart for other in images):
            images.append(image)
            if len(images) == count:
                break
    return images


def chosen_window(evaluation: Evaluation, image: int | None) -> WindowDistances | None:
    """
    Return the window around an image, by default around the worst mistake, or the middle one.

    :raises SettingsError: no window is centered on that image.
    """
    windows = evaluation.results.windows
    if image is not None:
        for window in windows:
            if window.image == image:
                return window
        raise SettingsError(
            f'no window is centered on image {image}: choose one of '
            f'{evaluation.centered.start} .. {evaluation.centered.stop - 1}'
        )
    if not windows:
        return None
    mistakes = worst_mistakes(evaluation, 1)
    middle = mistakes[0] if mistakes else windows[len(windows) // 2].image
    return min(windows, key=lambda window: abs(window.image - middle))
