# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The worst mistakes of a traverse, by hand."""

import numpy as np
import pytest
from stavpr_lab.evaluation.evaluate import evaluate_traverse, ReducedDistances, TraverseResults
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import ImageMatches, Ranking
from stavpr_lab.evaluation.report import worst_mistakes
from stavpr_ros.errors import InputError


def results_of(places, scores):
    matches = Ranking(np.asarray(places)[:, None], np.asarray(scores))
    reduced = ReducedDistances(np.zeros((1, 1)), (60, 60))
    accepted, unknown = matches.scores < 1, np.full(len(places), np.nan)
    published = ImageMatches.none(len(places)), np.arange(len(places))
    columns = accepted, unknown, published
    return TraverseResults(matches, matches, np.zeros(len(places)), (), reduced, *columns)


def test_worst_mistakes_are_ordered_and_apart():
    """Other places before near misses, then by distance; none near another one."""
    places, scores = np.arange(60), np.full(60, 0.05)
    mistakes = ((10, 40, 0.5), (12, 41, 0.6), (30, 33, 0.1), (50, 5, 0.2), (28, 6, np.inf))
    for image, place, score in mistakes:
        places[image], scores[image] = place, score
    results = results_of(places, scores)
    evaluation = evaluate_traverse(results, GroundTruth.identity(60, 60, 1), 20)
    assert worst_mistakes(evaluation, 9) == [50, 10, 30]
    assert worst_mistakes(evaluation, 1) == [50]
    assert evaluation.false_alarm_rates == {}
    with pytest.raises(InputError, match='59 images for 60'):
        evaluate_traverse(results, GroundTruth.identity(59, 59, 1), 20)
