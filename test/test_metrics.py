"""F1 and the answer of every frame, by hand and against the oracle's plain loops."""

import numpy as np
import pytest

from stavpr_ros.alignment import SequenceMatch
from stavpr_ros.errors import InputError
from stavpr_ros.evaluation.metrics import best_f1, counts_at, image_matches, sweep
from stavpr_ros.recognition import Match, Status


def test_counts_by_hand():
    """Four queries: accepted right, accepted wrong, rejected, and one not in the map, rejected."""
    distances = np.array([0.1, 0.2, 0.5, 0.6])
    correct = np.array([True, False, True, False])
    has_match = np.array([True, True, True, False])
    score = counts_at(0.3, distances, correct, has_match)
    assert (score.true_positives, score.false_positives, score.false_negatives) == (1, 1, 1)
    assert score.precision == 0.5
    assert score.recall == 0.5
    assert score.f1 == 0.5
    assert counts_at(0.2, distances, correct).false_positives == 0  # accepted means below, not at


def test_best_f1_by_hand():
    """Accepting .1 and .2: 2 TP, 1 FN, F1 .8; accepting all: 2 TP, 1 FP, F1 .8 too; the lower wins."""
    best = best_f1(np.array([0.1, 0.2, 0.3]), np.array([True, True, False]))
    assert best.f1 == pytest.approx(0.8)
    assert best.threshold == 0.3


def test_accepting_nothing():
    scores = sweep(np.array([np.inf, np.nan]), np.array([False, False]))
    assert len(scores) == 1
    assert scores[0].f1 == 0
    assert scores[0].precision == 1


def test_shapes_must_agree():
    with pytest.raises(InputError, match='one value a query'):
        best_f1(np.zeros(3), np.zeros(2, bool))


def window(middle, path, distance=0.1):
    nearest = SequenceMatch(path[0][1], path[-1][1], middle, distance, -1, float('nan'))
    return Match(Status.NO_MATCH, sequence=nearest, path=np.array(path, np.int32))


NONE = Match(Status.WARMING_UP)


def test_frame_answers_by_hand():
    """
    Six images, windows of 4: midpoint floor(3 / 2) = 1. Windows end at images 3, 4, 5; their midpoints
    are images 1, 2, 3. Image 0 is read off the first path, images 4 and 5 off the last one's.
    """
    windows = [
        NONE,
        NONE,
        NONE,
        window(11, [(0, 10), (0, 11), (0, 12), (1, 12), (2, 12), (3, 12)], 0.3),
        window(12, [(0, 11), (1, 12), (2, 13), (3, 14)], 0.2),
        window(14, [(0, 12), (1, 13), (2, 15), (3, 16), (3, 17)], 0.4),
    ]
    answers = image_matches(windows, 4)
    assert answers.places.tolist() == [11, 11, 12, 14, 15, 16]
    assert answers.distances.tolist() == [0.3, 0.3, 0.2, 0.4, 0.4, 0.4]
    assert answers.within(np.array([11, 14, -1, 14, 12, 19]), 2).tolist() == [
        True,
        False,
        False,
        True,
        False,
        False,
    ]


def test_no_window_no_answer():
    answers = image_matches([NONE, NONE], 4)
    assert answers.places.tolist() == [-1, -1]
    assert np.isinf(answers.distances).all()


def test_f1_equals_the_oracle():
    import oracle

    rng = np.random.default_rng(0)
    for _ in range(50):
        distances = rng.integers(0, 6, 12) / 4
        places, truth = rng.integers(0, 5, 12), rng.integers(0, 5, 12)
        answers = list(zip(places.tolist(), distances.tolist(), strict=True))
        expected = oracle.best_f1(answers, [[place] for place in truth.tolist()], 1)
        assert best_f1(distances, np.abs(places - truth) <= 1).f1 == pytest.approx(expected)
