# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SeqSLAM and SSM-VPR by hand or plain loops; they and mode robust on real traverses."""

import numpy as np
from places import map_of
import pytest
from scores import best_f1
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_lab.evaluation.evaluate import evaluate_on_map, recognize_all
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import accepted_counts
from stavpr_lab.evaluation.paper.datasets import open_dataset
from stavpr_lab.evaluation.seqslam import match_differences, preprocess, seqslam, SeqSlamSettings
from stavpr_lab.evaluation.ssm_vpr import (
    cubes,
    learn_whitening,
    PcaWhitening,
    SpatialReranker,
    SsmVpr,
    SsmVprSettings,
)
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import extract_features
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings, Status
from stavpr_ros.sources import open_source
import torch

SMALL_IMAGES = SeqSlamSettings(width=4, height=2, patch=2)


def test_preprocess_patches_by_hand():
    """Left patch 0 2 / 2 4: mean 2, deviation sqrt 2. The right one is flat."""
    image = np.array([[0, 2, 5, 5], [2, 4, 5, 5]], np.uint8)
    root = np.sqrt(2)
    patches = preprocess([image], SMALL_IMAGES)
    assert patches.dtype == np.float32
    np.testing.assert_allclose(
        patches.reshape(2, 4), [[-root, 0, 0, 0], [0, root, 0, 0]], atol=1e-6
    )


def naive(D, settings):
    """Compute the paper's method in plain loops."""
    N, n = D.shape
    half, middle = settings.contrast_window // 2, (settings.length - 1) // 2
    enhanced = np.zeros((N, n))
    for i in range(N):
        for j in range(n):
            around = D[i, max(0, j - half) : j + half + 1]
            enhanced[i, j] = (D[i, j] - around.mean()) / around.std()
    places, scores = [-1] * N, [np.inf] * N
    count = round((settings.fastest - settings.slowest) / settings.speed_step) + 1
    for first in range(N - settings.length + 1):
        starts = {}
        for start in range(n):
            for v in range(count):
                speed = settings.slowest + v * settings.speed_step
                line = [start + int(speed * t + 0.5 + 1e-9) for t in range(settings.length)]
                if line[-1] < n:
                    total = sum(enhanced[first + t, place] for t, place in enumerate(line))
                    if start not in starts or total < starts[start][0]:
                        starts[start] = total, line[middle]
        best, place = min(starts.values())
        places[first + middle], scores[first + middle] = place, best / settings.length
    return places, scores


@pytest.mark.parametrize(
    ('length', 'window', 'n'), [(2, 2, 9), (5, 4, 25), (6, 10, 40), (7, 60, 12)]
)
def test_match_differences_equals_plain_loops(length, window, n):
    speeds = {'slowest': 0.6, 'fastest': 1.4, 'speed_step': 0.2}
    settings = SeqSlamSettings(length=length, contrast_window=window, **speeds)
    D = np.random.default_rng(length).random((15, n))
    expected_places, expected_scores = naive(D, settings)
    middle = settings.middle
    inner = slice(middle, middle + 15 - length + 1)
    for array, tolerance in ((D, 1e-9), (D.astype(np.float32), 1e-4)):
        places, scores = match_differences(array, settings)
        np.testing.assert_array_equal(places[inner], expected_places[inner])
        np.testing.assert_allclose(scores[inner], expected_scores[inner], atol=tolerance)


def test_seqslam_of_a_part_of_the_map_finds_it(route):
    places, scores = seqslam(route, route[10:50])
    assert places.tolist() == list(range(10, 50))
    assert scores.max() < -0.5


def test_match_differences_without_a_window_or_line_is_none():
    for D in (np.ones((19, 50)), np.ones((50, 15))):
        places, scores = match_differences(D, SeqSlamSettings())
        assert places.tolist() == [-1] * len(D)
        assert np.isinf(scores).all()


def test_match_differences_takes_the_first_line_where_only_one_fits_or_all_are_alike():
    for D in (np.random.default_rng(0).random((20, 16)), np.ones((20, 40))):
        places, _ = match_differences(D, SeqSlamSettings())
        assert places.tolist() == SeqSlamSettings().lines[0].tolist()


@pytest.mark.parametrize(
    ('name', 'known_f1'),
    [('gardens_point', 0.79), pytest.param('nordland', 0.95, marks=pytest.mark.long)],
)
def test_seqslam_on_real_traverses_gives_the_measured_f1(data_folder, name, known_f1):
    dataset = open_dataset(name, data_folder)
    images = [(frame.image for frame in source) for source in (dataset.map, dataset.query)]
    places, scores = seqslam(*images)
    assert best_f1(scores, dataset.ground_truth.accepts(places)).f1 > known_f1


SMALL = SsmVprSettings(large=3, large_dimension=10, small_dimension=12, neighbors=4, candidates=3)


def random_maps(n, C, side, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).random((n, C, side, side))).float()


def agreement(nearest, side, reach):
    """Count pairs in plain loops."""
    total = 0
    for i in range(side**2):
        for j in range(side**2):
            (y, x), (v, u) = divmod(i, side), divmod(j, side)
            if max(abs(y - v), abs(x - u)) > reach:
                continue
            (ty, tx), (tv, tu) = divmod(nearest[i], side), divmod(nearest[j], side)
            total += (ty - y, tx - x) == (tv - v, tu - u)
    return total


@pytest.mark.parametrize('seed', range(4))
def test_agreement_equals_plain_loops(seed):
    reranker = SpatialReranker(random_maps(3, 4, 8))
    side, rng = reranker.side, np.random.default_rng(seed)
    nearest = np.arange(side**2)[None].repeat(3, 0)
    nearest[1] = rng.integers(0, side**2, side**2)
    nearest[2, rng.random(side**2) < 0.4] = 5
    expected = [agreement(row, side, reranker.reach) for row in nearest]
    assert reranker.agreement(nearest).tolist() == expected


def test_cubes_equal_plain_loops():
    maps = random_maps(2, 3, 5)
    result = cubes(maps, 3)
    assert result.shape == (2, 9, 27)
    columns = maps / maps.norm(dim=1, keepdim=True)
    for n, y, x in np.ndindex(2, 3, 3):
        cells = [columns[n, :, y + dy, x + dx] for dy in range(3) for dx in range(3)]
        np.testing.assert_allclose(result[n, 3 * y + x], torch.cat(cells), atol=1e-6)
    with pytest.raises(InputError, match='at least 9 x 9'):
        cubes(maps, 9)


def test_whitening_has_unit_covariance():
    samples = torch.from_numpy(np.random.default_rng(0).standard_normal((200, 30)) * range(1, 31))
    white = PcaWhitening(samples.float(), 5)(samples.float())
    assert white.shape == (200, 5)
    np.testing.assert_allclose(np.cov(white.T), np.eye(5), atol=1e-3)


def test_candidates_equal_plain_loops():
    maps = random_maps(7, 4, 6)
    ssm = SsmVpr(maps, maps, SMALL)
    query = maps[4] + 0.02 * random_maps(1, 4, 6, seed=2)[0]
    whitening = learn_whitening(maps, 3, 10)
    places = [
        (i, cube) for i, one in enumerate(maps) for cube in whitening(cubes(one[None], 3)[0])
    ]
    votes = [0] * 7
    for own in whitening(cubes(query[None], 3)[0]):
        near = sorted(places, key=lambda place: float((place[1] - own).norm()))
        for image, _ in near[: SMALL.neighbors]:
            votes[image] += 1
    expected = sorted(range(7), key=lambda image: (-votes[image], image))[:3]
    assert ssm.candidates(query).tolist() == expected
    assert expected[0] == 4


def test_weights_of_last_answers_by_hand():
    """Answers 10 (score 1) and 20 (score .5): place 13 gets .4 * 12 / 15, place 21 half of it."""
    ssm = SsmVpr(random_maps(3, 4, 6), random_maps(3, 4, 6), SMALL)
    places = np.array([13, 21, 40])
    assert ssm.weights(places).tolist() == [1, 1, 1]
    ssm._answers.extend([(10, 1.0), (20, 0.5)])
    np.testing.assert_allclose(
        ssm.weights(places), [1 + 0.4 * 12 / 15, 1 + max(0.4 * 4 / 15, 0.2 * 14 / 15), 1]
    )


def test_traverse_is_recognized_with_frame_correlation():
    maps = random_maps(9, 6, 10)
    ssm = SsmVpr(maps, maps, SMALL)
    for i in range(9):
        noisy = maps[i] + 0.1 * random_maps(1, 6, 10, seed=10 + i)[0]
        places, scores = ssm.recognize(noisy, noisy)
        assert places[0] == i
        assert len(places) == len(scores) == 3


# Mode robust on real traverses of other speed and view, and on other routes

SETTINGS = RecognizerSettings(mode='robust')


@pytest.fixture(scope='module')
def traverses(data_folder):
    """Return a function from a folder to the gradient features of its images."""
    extractor, known = FeatureExtractor('gradient'), {}

    def features(name):
        if name not in known:
            known[name] = extract_features(
                open_source(data_folder / name), extractor, progress=False
            )
        return known[name]

    return features


def evaluate(reference, query, truth):
    """Best F1, and the precision at the default threshold."""
    result = evaluate_on_map(map_of(reference), query, truth, SETTINGS)
    accepted = accepted_counts(result.results.accepted, result.correct, truth.has_match)
    return result.sequence.best.f1, accepted.precision


def test_gardens_point_at_every_speed_is_recognized(traverses):
    reference, query = traverses('gardens_point/day_left'), traverses('gardens_point/day_right')
    truth = GroundTruth.identity(200, 200, 2)
    f1, precision = evaluate(reference, query, truth)
    print(f'Gardens Point, robust, gradient: F1 {f1:.4f}, precision {precision:.4f}')
    assert f1 >= 0.99
    assert precision >= 0.95
    for kind in ('2x', '0.5x', 'vary', 'stop'):
        indices = DriveChanges.from_name(kind, 200).images(200)
        f1, precision = evaluate(reference, query[indices], truth.select(indices))
        print(f'Gardens Point {kind}: F1 {f1:.4f}, precision {precision:.4f}')
        assert f1 >= 0.95
        assert precision >= 0.93


def test_corridor_is_recognized(traverses, data_folder):
    truth = GroundTruth.from_file(data_folder / 'corridor' / 'ground_truth.csv', 111, 111, 0)
    f1, precision = evaluate(traverses('corridor/ref'), traverses('corridor/query'), truth)
    print(f'corridor, robust, gradient: F1 {f1:.4f}, precision {precision:.4f}')
    assert f1 >= 0.95
    assert precision >= 0.95


@pytest.mark.parametrize(
    ('route', 'query'),
    [('gardens_point/day_left', 'corridor/query'), ('corridor/ref', 'gardens_point/day_right')],
)
def test_other_route_is_not_matched(traverses, route, query):
    answers = recognize_all(PlaceRecognizer(map_of(traverses(route)), SETTINGS), traverses(query))[
        19:
    ]
    alarms = np.mean([answer.status is Status.MATCH for answer in answers])
    print(f'{query} on the map of {route}: {alarms:.3f} false alarms')
    assert alarms <= 0.05
