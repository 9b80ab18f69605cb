# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Evaluation of a traverse by hand: matches, reduced distances, the worst mistakes."""

import numpy as np
import pytest
from stavpr_lab.evaluation import evaluate as module
from stavpr_lab.evaluation.evaluate import (
    evaluate_traverse,
    recognize_traverse,
    ReducedDistances,
    TraverseResults,
)
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import Ranking
from stavpr_lab.evaluation.report import worst_mistakes
from stavpr_ros.alignment import SequenceMatch, SequenceSettings
from stavpr_ros.errors import InputError
from stavpr_ros.recognition import Match, RecognizerSettings, Status


class Scripted:
    """A recognizer with windows of three and prepared results."""

    def __init__(self, rows, paths, candidates):
        self.rows, self.paths, self.listed, self.at = rows, paths, candidates, -1
        self.buffer, self.stamps = np.empty(6, np.float32), []

    def update(self, features, stamp=0, pose=None):
        assert len(features) == 1
        self.stamps.append(stamp)
        self.at += 1
        if self.paths[self.at] is None:
            return Match(Status.WARMING_UP)
        path = np.array(self.paths[self.at], np.int32)
        places = path[:, 1].tolist()
        nearest = SequenceMatch(places[0], places[-1], places[1], 0.25, -1, float('nan'))
        return Match(Status.MATCH, sequence=nearest, path=path, distance=0.25)

    def newest_row(self):
        """Return a view that the next image overwrites."""
        row = self.buffer[: len(self.rows[self.at])]
        row[:] = self.rows[self.at]
        return row

    def candidates(self, count):
        listed = self.listed[self.at][:count]
        return np.array(listed), np.zeros(len(listed))


def test_recognize_traverse_of_four_images_by_hand(small_map):
    """Windows of three: middles are images 1 and 2; images 0 and 3 come from the paths."""
    online = Scripted(
        rows=[[1, 5, 5, 5, 5, 5], [9, 2, 3, 4, 5, 6], [9, 9, 1, 9, np.inf, 9], [7, 7, 7, 7, 7, 0]],
        paths=[None, None, [(0, 0), (1, 1), (2, 3)], [(0, 2), (1, 4), (2, 5)]],
        candidates=[None, None, [1, 5, 0], [3, 4]],
    )
    settings = RecognizerSettings(1.0, sequence=SequenceSettings(3), mode='paper')
    stamps = np.array([7, 8, 10, 11]) * 10**9
    found = recognize_traverse(online, small_map.features[:4], 6, settings, stamps=stamps)
    assert online.stamps == stamps.tolist()
    assert found.sequence.places[1:3, :4].tolist() == [[1, 5, 0, -1], [4, 3, -1, -1]]
    assert found.sequence.best.tolist() == [0, 1, 4, 5]
    assert found.sequence.scores.tolist() == [0.25] * 4
    assert found.single.best.tolist() == [0, 1, 2, 5]
    assert found.single.scores.tolist() == [1, 2, 1, 0]
    assert found.single.places[2, :6].tolist() == [2, 0, 1, 3, 5, -1]
    assert [window.image for window in found.windows] == [1, 2]
    window = found.windows[1]
    assert (window.first, window.newest) == (0, 3)
    np.testing.assert_array_equal(window.distances[1], [9, 9, 1, 9, np.nan, 9])
    np.testing.assert_array_equal(found.distances.values[0], [1, 5, 5, 5, 5, 5])


def test_recognize_traverse_reduces_distances_to_block_minima(monkeypatch, small_map):
    monkeypatch.setattr(module, 'MATRIX_SIDE', 2)
    rows = [[5, 4, 9], [3, 8, 7], [6, 6, 1], [2, 6]]  # the last one has two places only
    settings = RecognizerSettings(1.0, sequence=SequenceSettings(3), mode='paper')
    online = Scripted(rows, [None] * 4, [None] * 4)
    reduced = recognize_traverse(online, small_map.features[:4], 3, settings).distances
    assert reduced.block == (2, 2)
    assert reduced.values.tolist() == [[3, 7], [2, 1]]


def results_of(places, scores):
    matches = Ranking(np.asarray(places)[:, None], np.asarray(scores))
    reduced = ReducedDistances(np.zeros((1, 1)), (60, 60))
    accepted, unknown = matches.scores < 1, np.full(len(places), np.nan)
    return TraverseResults(matches, matches, np.zeros(len(places)), (), reduced, accepted, unknown)


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
