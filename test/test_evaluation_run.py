"""What the evaluation rests on: the answer to every image, the picture of all distances, figures; by hand."""

import cv2
import numpy as np
import pytest

from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.errors import InputError
from stavpr_ros.evaluation.metrics import Ranking
from stavpr_ros.evaluation.evaluate import (
    ReducedDistances,
    TraverseResults,
    centered_images,
    evaluate_traverse,
    recognize_traverse,
)
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.report import worst_mistakes
from stavpr_ros.evaluation.report_figures import matrix_png, runs
from stavpr_ros.recognition import Match, RecognizerSettings, Status


class Scripted:
    """Answers windows of three with what it was told to."""

    def __init__(self, rows, answers, candidates):
        self.rows, self.answers, self.listed, self.at = rows, answers, candidates, -1

    def update(self, features):
        assert len(features) == 1
        self.at += 1
        found = self.answers[self.at]
        if found is None:
            return Match(Status.WARMING_UP)
        path = np.array(found, np.int32)
        middle = int(path[1, 1])
        nearest = SequenceMatch(int(path[0, 1]), int(path[-1, 1]), middle, 0.25, -1, float('nan'))
        return Match(Status.MATCH, sequence=nearest, path=path)

    def newest_row(self):
        return np.array(self.rows[self.at], np.float32)

    def candidates(self, count):
        listed = self.listed[self.at][:count]
        return np.array(listed), np.zeros(len(listed))


def test_every_image_gets_its_answers(small_map):
    """Four images, windows of three, by hand: middles are images 1 and 2; 0 and 3 come off the paths."""
    online = Scripted(
        rows=[[1, 5, 5, 5, 5, 5], [9, 2, 3, 4, 5, 6], [9, 9, 1, 9, np.inf, 9], [7, 7, 7, 7, 7, 0]],
        answers=[None, None, [(0, 0), (1, 1), (2, 3)], [(0, 2), (1, 4), (2, 5)]],
        candidates=[None, None, [1, 5, 0], [3, 4]],
    )
    settings = RecognizerSettings(1.0, sequence=SequenceSettings(length=3))
    found = recognize_traverse(online, small_map.features[:4], 6, settings)
    assert found.sequence.best.tolist() == [0, 1, 4, 5]
    assert found.sequence.places[:, :4].tolist() == [
        [0, -1, -1, -1], [1, 5, 0, -1], [4, 3, -1, -1], [5, -1, -1, -1],
    ]  # fmt: skip
    assert found.sequence.scores.tolist() == [0.25] * 4
    assert found.single.best.tolist() == [0, 1, 2, 5]
    assert found.single.scores.tolist() == [1, 2, 1, 0]
    assert found.single.places[2, :6].tolist() == [2, 0, 1, 3, 5, -1]
    assert [view.image for view in found.windows] == [1, 2]
    view = found.windows[1]
    assert (view.first, view.newest) == (0, 3)
    np.testing.assert_array_equal(view.distances[1], [9, 9, 1, 9, np.nan, 9])
    np.testing.assert_array_equal(found.distances.values[0], [1, 5, 5, 5, 5, 5])


def test_long_drives_are_pictured_by_the_smallest_of_each_block(monkeypatch, small_map):
    from stavpr_ros.evaluation import evaluate as module

    monkeypatch.setattr(module, 'MATRIX_SIDE', 2)
    rows = [[5, 4, 9], [3, 8, 7], [6, 6, 1], [2, 6]]  # the last one knows two places only
    online = Scripted(rows, [None] * 4, [None] * 4)
    settings = RecognizerSettings(1.0, sequence=SequenceSettings(length=3))
    picture = recognize_traverse(online, small_map.features[:4], 3, settings).distances
    assert picture.block == (2, 2)
    assert picture.values.tolist() == [[3, 7], [2, 1]]


def test_centered_images():
    assert centered_images(200, 20) == slice(9, 190)
    assert centered_images(5, 5) == slice(2, 3)
    with pytest.raises(InputError, match='at least l = 6'):
        centered_images(5, 6)


def test_figures():
    assert runs(np.array([1, 2, 3, 7, 9, 10])) == [(1, 3), (7, 7), (9, 10)]
    assert runs(np.array([], int)) == []
    picture = cv2.imdecode(np.frombuffer(matrix_png(np.array([[0, 1], [np.nan, 0.5]])), np.uint8), 1)
    assert picture.shape == (2, 2, 3)
    assert picture[1, 0].tolist() == [255, 255, 255]  # nothing there
    assert picture[0, 0].sum() < picture[1, 1].sum() < picture[0, 1].sum()  # dark is near


def test_the_worst_mistakes():
    """Another place before a near miss, the surest first, none beside another."""
    pytest.importorskip('sklearn', reason='the extra evaluation is not installed')
    places, scores = np.arange(60), np.full(60, 0.05)
    for image, place, score in ((10, 40, 0.5), (12, 41, 0.6), (30, 33, 0.1), (50, 5, 0.2), (55, 6, np.inf)):
        places[image], scores[image] = place, score
    answers = Ranking(places[:, None], scores)
    drive = TraverseResults(answers, answers, np.zeros(60), (), ReducedDistances(np.zeros((1, 1)), (60, 60)))
    evaluation = evaluate_traverse(drive, GroundTruth.identity(60, 60, 1), 20)
    assert worst_mistakes(evaluation, 9) == [50, 10, 30]
    assert worst_mistakes(evaluation, 1) == [50]
    with pytest.raises(InputError, match='59 images for 60'):
        evaluate_traverse(drive, GroundTruth.identity(59, 59, 1), 20)
