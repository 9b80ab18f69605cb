# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of recalls: by hand, intervals of known samples, the command on arrays."""

from evaluation_commands import read_json, runner
import numpy as np
import pytest
from stavpr_lab.commands import evaluate
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import evaluate_ranking, Ranking
from stavpr_lab.evaluation.protocol import (
    block_length,
    block_samples,
    evaluate_recalls,
    image_vectors,
    LENGTHS,
    match_sequences,
    recalls,
)
from stavpr_ros.features import FeatureSettings, LocalFeatures

PLACES = 60


@pytest.fixture
def run(monkeypatch, capsys):
    return runner(evaluate, monkeypatch, capsys)


@pytest.fixture
def arrays(tmp_path):
    """Write descriptors of 60 places and of the same with noise, with an offset of all."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(PLACES, 16))
    for name, noise in (('map', 0.0), ('query', 0.9)):
        vectors = places + 1 + noise * rng.normal(size=places.shape)
        np.save(tmp_path / f'{name}.npy', vectors.astype(np.float32))
    return ['--map', tmp_path / 'map.npy', '--query', tmp_path / 'query.npy']


def ranking(places, scores):
    return Ranking(np.array(places)[:, None], np.array(scores, float))


def test_recalls_by_hand():
    """Of six queries five are in the map; 0 and 1 precede the best wrong match, 4 ties with it."""
    correct = np.array([1, 1, 0, 0, 1, 0], bool)
    has_match = np.array([1, 1, 1, 0, 1, 1], bool)
    scores = np.array([0.1, 0.2, 0.3, 0.4, 0.3, np.inf])
    assert recalls(correct, scores, has_match) == (3 / 5, 2 / 5)
    stacked = [np.stack([column, column[::-1]]) for column in (correct, scores, has_match)]
    assert [values.tolist() for values in recalls(*stacked)] == [[0.6, 0.6], [0.4, 0.4]]
    assert np.isnan(recalls(correct & False, scores, has_match & False)).all()


def test_recalls_equal_metrics_of_random_rankings():
    rng = np.random.default_rng(3)
    truth = GroundTruth.from_pairs(np.arange(0, 90), rng.integers(0, 9, 90), 100, 9, 1)
    places = rng.integers(-1, 9, 100)
    scores = rng.integers(0, 40, 100) / 40 - 0.2 * truth.accepts(places)  # with ties
    found = ranking(places, scores)
    estimated, expected = evaluate_recalls(found, truth), evaluate_ranking(found, truth)
    assert estimated.f1 == expected.best.f1
    assert estimated.recall_at_1.value == expected.recall_at[1]
    assert estimated.recall_at_100_precision.value == expected.recall_at_full_precision
    assert 0 < expected.recall_at_full_precision < expected.recall_at[1] < 1


def test_blocks_are_successive_images_and_cover_all_alike():
    assert [block_length(count) for count in (3, 100, 199, 200, 5000)] == [1, 20, 39, 40, 40]
    images = block_samples(100, resamples=2000)
    assert images.shape == (2000, 100)
    steps = np.diff(images.reshape(2000, 5, 20)) % 100
    assert (steps == 1).all()
    counts = np.bincount(images.reshape(-1), minlength=100)
    assert counts.min() > 0.85 * 2000
    assert counts.max() < 1.15 * 2000


@pytest.mark.parametrize('run_length', [1, 40])
def test_interval_has_the_width_of_independent_runs(run_length):
    """4000 images, half of them wrong in runs: the deviation is that of the number of runs."""
    runs = 4000 // run_length
    right = np.repeat(np.random.default_rng(5).permutation(np.arange(runs) % 2), run_length)
    truth = GroundTruth.identity(4000, 4000)
    places = np.where(right, np.arange(4000), -1)
    found = evaluate_recalls(ranking(places, np.where(right, 0.1, np.inf)), truth).recall_at_1
    assert found.value == 0.5
    expected = 2 * 1.96 * 0.5 / np.sqrt(runs)
    assert 0.6 * expected < found.high - found.low < 1.5 * expected


@pytest.mark.parametrize('length', [1, 4, 5])
def test_plain_sequences_are_the_smallest_sums_of_diagonals(length):
    D = np.random.default_rng(length).random((12, 15))
    ((_, found),) = match_sequences(D, 'plain', (length,))
    middle = (length - 1) // 2
    for first in range(12 - length + 1):
        sums = [sum(D[first + t, s + t] for t in range(length)) for s in range(15 - length + 1)]
        assert found.best[first + middle] == int(np.argmin(sums)) + middle
        assert found.scores[first + middle] == pytest.approx(min(sums) / length)


def test_sequences_longer_than_the_query_are_left_out():
    D = np.random.default_rng(0).random((6, 30))
    assert [length for length, _ in match_sequences(D, 'plain')] == [1, 4, 5]
    assert [length for length, _ in match_sequences(D, 'seqslam')] == [4, 5]


def test_vectors_of_images_are_weighted_strips_without_the_mean():
    strips = np.array([[[1, 0], [0, 1], [0, 0]], [[0, 1], [0, 1], [0, 0]]], np.float32)
    weights = np.array([[0.6, 0, 0], [0.8, 1, 0]], np.float32)
    features = LocalFeatures(strips, weights, FeatureSettings('synthetic', None, strips=2))
    expected = [[0.6, 0, 0, 0.8], [0, 0, 0, 1], [0, 0, 0, 0]]
    np.testing.assert_allclose(image_vectors(features), expected, atol=1e-6)
    centered = np.array(expected) - np.mean(expected, axis=0)
    centered /= np.linalg.norm(centered, axis=1, keepdims=True)
    np.testing.assert_allclose(image_vectors(features, centered=True), centered, atol=1e-6)


def test_evaluate_prints_the_protocol_of_arrays(arrays, run, tmp_path):
    """Sequences find all that single images miss; a removed place has no correct one."""
    given = [*arrays, '--truth', 'identity', '--protocol', '--json', tmp_path / 'p.json']
    code, text, errors = run(*given)
    assert code == 0, errors
    rows = read_json((tmp_path / 'p.json').read_text())['protocol']
    assert [row['length'] for row in rows] == [*LENGTHS, *LENGTHS, *LENGTHS[1:], *LENGTHS * 2]
    found = {(row['method'], row['length']): row['recalls']['0'] for row in rows}
    single, sequence = (found['centered', length]['recall_at_1'] for length in (1, 5))
    assert single['low'] < single['value'] < single['high'] <= sequence['value'] == 1
    assert sequence['low'] == 1
    assert found['robust', 10]['f1'] > 0.9
    assert '\ncentered         5  1.000  1.000 (1.000-1.000)  1.000 (1.000-1.000)' in text
    code, text, errors = run(*given, '--force', '--remove-from-map', '20:40')
    rows = read_json((tmp_path / 'p.json').read_text())['protocol']
    plain = next(row for row in rows if (row['method'], row['length']) == ('plain', 1))
    values = [plain['recalls'][t]['recall_at_1']['value'] for t in ('0', '1', '2', '10')]
    known = [40, 42, 44, 60]  # queries within the tolerance of a place that is left
    right = [round(value * count, 9) for value, count in zip(values, known, strict=True)]
    assert right == [round(number) for number in right]
    assert 'without places 20 .. 39' in text


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        ([], '--protocol needs --truth'),
        (['--truth', 'identity', '--tolerance', 2], 'leave --tolerance out'),
        (['--truth', 'identity', '--output', 'report'], 'leave --output out'),
    ],
)
def test_evaluate_rejects_options_that_contradict_the_protocol(arrays, run, options, message):
    code, _, errors = run(*arrays, '--protocol', *options)
    assert (code, message in errors) == (2, True)
