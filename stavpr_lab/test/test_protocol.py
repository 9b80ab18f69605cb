# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of recalls: by hand, intervals of known samples, the command on arrays."""

from evaluation_commands import read_json
import numpy as np
import pytest
from stavpr_lab.commands import evaluate
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import evaluate_ranking, Ranking
from stavpr_lab.evaluation.protocol import (
    error_rate_and_recall,
    evaluate_matches,
    image_vectors,
    LENGTHS,
    match_sequences,
)
from stavpr_ros.features import FeatureSettings, LocalFeatures


@pytest.fixture
def command(runner, tmp_path):
    """Run --protocol on descriptors of 60 places and of the same with noise."""
    rng = np.random.default_rng(0)
    places = 1 + rng.normal(size=(60, 16))
    for name, noise in (('map', 0.0), ('query', 0.9)):
        np.save(tmp_path / name, np.float32(places + noise * rng.normal(size=places.shape)))
    arrays = '--map', tmp_path / 'map.npy', '--query', tmp_path / 'query.npy'
    run = runner(evaluate)
    return lambda *options: run(*arrays, '--protocol', *options)


def test_recalls_equal_metrics_of_random_rankings():
    rng = np.random.default_rng(3)
    truth = GroundTruth.from_pairs(np.arange(0, 90), rng.integers(0, 9, 90), 100, 9, 1)
    places = rng.integers(-1, 9, 100)
    scores = rng.integers(0, 40, 100) / 40 - 0.2 * truth.accepts(places)  # with ties
    ranking = Ranking(places[:, None], scores)
    (result,) = evaluate_matches('plain', [(5, ranking)], {1: truth})
    expected = evaluate_ranking(ranking, truth)
    full = expected.recall_at_full_precision
    assert result.f1 == expected.best.f1
    assert result.recall_at_1[0] == expected.recall_at[1]
    assert result.recall_at_100_precision[0] == full
    assert 0 < full < expected.recall_at[1] < 1


def test_error_rate_and_recall_by_hand():
    """Of ten images eight are in the map; of six matches two are wrong, one of them off it."""
    accepted = np.array([1, 1, 1, 1, 1, 1, 0, 0, 0, 0], bool)
    correct = np.array([1, 1, 1, 1, 0, 0, 1, 0, 0, 0], bool)
    has_match = np.array([1, 1, 1, 1, 1, 0, 1, 1, 1, 0], bool)
    (rate, *interval), (recall, *recalled) = error_rate_and_recall(accepted, correct, has_match)
    assert (rate, recall) == (2 / 6, 4 / 7)
    assert 0 <= interval[0] < rate < interval[1] <= 1
    assert 0 <= recalled[0] < recall < recalled[1] <= 1
    # no right place: of all images
    rate, recall = error_rate_and_recall(accepted, correct & False, has_match & False)
    assert (rate[0], np.isnan(recall).all()) == (0.6, True)
    rate, recall = error_rate_and_recall(accepted & False, correct, has_match)
    assert (np.isnan(rate).all(), recall) == (True, (0, 0, 0))


@pytest.mark.parametrize('run_length', [1, 40])
def test_interval_has_the_width_of_independent_runs(run_length):
    """4000 images, half of them wrong in runs: the deviation follows from the number of runs."""
    runs = 4000 // run_length
    right = np.repeat(np.random.default_rng(5).permutation(np.arange(runs) % 2), run_length)
    ranking = Ranking(np.where(right, np.arange(4000), -1)[:, None], np.where(right, 0.1, np.inf))
    truths = {0: GroundTruth.identity(4000, 4000)}
    (result,) = evaluate_matches('plain', [(1, ranking)], truths)
    value, low, high = result.recall_at_1
    assert value == 0.5
    expected = 2 * 1.96 * 0.5 / np.sqrt(runs)
    assert 0.6 * expected < high - low < 1.5 * expected


def test_plain_sequences_are_the_smallest_sums_of_diagonals():
    """Sequences that are longer than the query are left out."""
    D = np.random.default_rng(1).random((12, 15))
    assert [length for length, _ in match_sequences(D, 'seqslam')] == [4, 5, 10]
    for length, result in match_sequences(D, 'plain', (1, 4, 5, 20)):
        middle = (length - 1) // 2
        for first in range(12 - length + 1):
            starts = range(15 - length + 1)
            sums = [sum(D[first + t, s + t] for t in range(length)) for s in starts]
            assert result.best[first + middle] == int(np.argmin(sums)) + middle
            assert result.scores[first + middle] == pytest.approx(min(sums) / length)


def test_vectors_of_images_are_weighted_strips_without_the_mean():
    strips = np.array([[[1, 0], [0, 1], [0, 0]], [[0, 1], [0, 1], [0, 0]]], np.float32)
    weights = np.array([[0.6, 0, 0], [0.8, 1, 0]], np.float32)
    features = LocalFeatures(strips, weights, FeatureSettings('synthetic', None, strips=2))
    expected = np.array([[0.6, 0, 0, 0.8], [0, 0, 0, 1], [0, 0, 0, 0]])
    np.testing.assert_allclose(image_vectors(features), expected, atol=1e-6)
    centered = expected - expected.mean(axis=0)
    centered /= np.linalg.norm(centered, axis=1, keepdims=True)
    np.testing.assert_allclose(image_vectors(features, centered=True), centered, atol=1e-6)


def test_evaluate_prints_the_protocol_of_arrays(command, tmp_path):
    """Sequences find all images that single ones miss; 20 places are removed from the map."""
    path = tmp_path / 'p.json'
    for removed in (), ('--remove-from-map', '20:40'):
        code, text, errors = command('--truth', 'identity', *removed, '--json', path, '--force')
        assert code == 0, errors
        rows = read_json(path.read_text())['protocol']
        lengths = [*LENGTHS, *LENGTHS, *LENGTHS[1:], *LENGTHS * 2]
        assert [row['length'] for row in rows] == list(np.repeat(lengths, 4))
        result = {(row['method'], row['length'], row['tolerance']): row for row in rows}
        single = [result['plain', 1, t]['recall_at_1'] for t in (0, 1, 2, 10)]
        known = [40, 42, 44, 60] if removed else [60] * 4  # queries with a place in the map
        right = np.multiply([value for value, *_ in single], known)
        np.testing.assert_allclose(right, np.round(right))
        if not removed:
            assert 0.5 < single[0][1] < single[0][0] < 1
            assert '\ncentered         5  1.000  1.000 (1.000-1.000)  1.000 (1.000-1.000)' in text
            assert result['robust', 10, 0]['f1'] > 0.9


@pytest.mark.parametrize('options', [(), ('--tolerance', 2), ('--output', 'report')])
def test_evaluate_rejects_options_that_contradict_the_protocol(command, options):
    code, _, errors = command(*options, *(('--truth', 'identity') if options else ()))
    assert code == 2
    assert (f'--protocol: leave {options[0]} out' if options else 'needs --truth') in errors
