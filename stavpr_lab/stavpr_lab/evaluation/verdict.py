# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The verdict on a drive: whether its places are recognized, what is missing, what to do."""

from dataclasses import dataclass

import numpy as np
from stavpr_lab.evaluation.plots import runs
from stavpr_lab.evaluation.report import Report
from stavpr_ros.units import SECOND

RECOGNIZED, PARTLY = 0.8, 0.1  # shares of the images, from which on a drive is called so
TOLERABLE = 0.05  # share of wrong matches, above which they are the verdict
GAPS, MIN_GAP = 3, 5  # the longest gaps that are listed; images of one at least
UNLIKELY, DOUBTFUL = 0.001, 0.05  # probabilities of a place that is not matched


@dataclass(frozen=True)
class Verdict:
    """
    What the numbers of a report mean.

    :param kind: ``recognized``, ``partly``, ``wrong`` (matches) or ``other`` (route).
    :param advice: sentences, the most helpful first.
    :param gaps: the longest runs of images without a match, in words.
    :param rejections: number of images without a match, by the cause.
    """

    kind: str
    text: str
    advice: list[str]
    gaps: list[str]
    rejections: dict[str, int]


def verdict_of(report: Report) -> Verdict:
    """Evaluate what the matches of a report mean."""
    truth, accepted = report.evaluation.ground_truth, report.accepted
    expected = truth.has_match if report.has_truth else np.ones(len(accepted), bool)
    count, matched = int(expected.sum()), int((accepted & expected).sum())
    counts, of_map = report.counts, ' of places in the map' if report.has_truth else ''
    share, numbers = matched / max(count, 1), f'{matched} of {count} images{of_map} are matched'
    if report.has_truth and counts.false_positives > TOLERABLE * counts.accepted:
        wrong = f'{counts.false_positives} of {counts.accepted} matches are wrong'
        kind, text = 'wrong', f'Wrong matches: {wrong}; {numbers}.'
    elif report.reference is report.query:
        kind, text = 'partly', f'{int(accepted.sum())} of {len(accepted)} images close a loop.'
    elif share >= RECOGNIZED:
        kind, text = 'recognized', f'Recognized: {numbers}.'
    elif share >= PARTLY:
        kind, text = 'partly', f'Partly recognized: {numbers}.'
    else:
        kind, text = 'other', f'Not recognized: {numbers}. This looks like another route.'
    return Verdict(kind, text, _advice(report, kind), _gaps(report, expected), _causes(report))


def _advice(report: Report, kind: str) -> list[str]:
    limit, calibration = report.default_threshold, report.evaluation.calibration
    probabilities, rejected = report.evaluation.results.probabilities, ~report.accepted
    if kind == 'other':
        return [
            'Compare the images of the pairs: the same road, in the same direction, with a camera '
            'of a similar view? If so, recognize the recording of the map itself on it; it must '
            'match everywhere.'
        ]
    advice = []
    if kind == 'recognized':
        advice.append('Nothing to tune: a node with the same settings recognizes this drive.')
    if kind == 'wrong' and limit is not None and calibration is not None:
        advice += [
            f'Raise min_probability to {level:g}: {counts.false_positives} of {counts.accepted} '
            f'matches would be wrong, the recall {counts.recall:.3f}.'
            for level, counts in calibration.levels.items()
            if level > 1 - limit and counts.accepted and counts.precision >= 1 - TOLERABLE
        ][:1]
    if kind == 'partly' and report.reference is not report.query:
        more = int(np.count_nonzero(rejected & (probabilities > DOUBTFUL)))
        if limit is not None and more > TOLERABLE * len(rejected):
            advice.append(
                f'Lower min_probability to {DOUBTFUL:g}: {more} images more would be matched, '
                'with more wrong matches.'
            )
        advice.append(
            'Look at the longest gaps: places that the map lacks, another direction, darkness, or '
            'a speed that differs by more than a factor of 2 to 3.'
        )
    if not report.has_truth:
        advice.append(
            'Mark pairs on the page as right or wrong, export them, and evaluate again with '
            '--truth pairs.csv --tolerance 3, which counts the wrong matches.'
        )
    return advice


def _gaps(report: Report, expected: np.ndarray) -> list[str]:
    """Return the longest runs of images without a match, in order, in words."""
    if report.reference is report.query and not report.has_truth:
        return []
    gaps = [gap for gap in runs(~report.accepted & expected) if gap[1] - gap[0] >= MIN_GAP]
    stamps, texts = report.query.stamps, []
    for first, end in sorted(sorted(gaps, key=lambda gap: gap[0] - gap[1])[:GAPS]):
        seconds = 0.0 if stamps is None else (stamps[end - 1] - stamps[first]) / SECOND
        time = f', {seconds:.1f} s' if seconds > 0 else ''
        texts.append(f'images {first} to {end - 1} ({end - first}{time})')
    return texts


def _causes(report: Report) -> dict[str, int]:
    """Count the images without a match by the cause."""
    results, rejected = report.evaluation.results, ~report.accepted
    probabilities = results.probabilities
    if report.default_threshold is None or np.isnan(probabilities).all():
        causes = {'the distance is not below the threshold': rejected}
    else:
        unlikely = rejected & ~(probabilities >= UNLIKELY)
        causes = {
            f'no stretch of the map is similar (probability below {UNLIKELY:g})': unlikely,
            'a stretch is similar, but not certain (probability '
            f'{UNLIKELY:g} to {1 - report.default_threshold:g})': rejected & ~unlikely,
        }
    return {cause: int(mask.sum()) for cause, mask in causes.items() if mask.any()}
