# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The matcher on CUDA and that of the CPU; also in the simulator (see test_cuda_kernels.py)."""

import os

import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import SequenceSettings, SpatialSettings
from stavpr_ros.alignment.cpu.int8 import Int8Strips, rounded_queries
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.features.extractor import FeatureSettings
from stavpr_ros.recognition.lm_dtw_window import LmDtwWindow
import torch

SIMULATOR = os.environ.get('NUMBA_ENABLE_CUDASIM') == '1'
SHORT = SequenceSettings(length=3, beta=2.0)
W, D = 4, 24
# Of products summed in float32, in the order of the library. Without near-ties: where the last bit
# decides on a path, or on the nearest strip I_c, the distance jumps.
TOLERANCE = 1e-5


@pytest.fixture(scope='module')
def matcher_of(cuda_runtime):
    """Return the function that makes a matcher, with small blocks."""
    from stavpr_ros.alignment.cuda import dtw, lm_dtw
    from stavpr_ros.prepare.matcher import make_matcher

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dtw, 'BLOCK', 4)
        patch.setattr(lm_dtw, 'BLOCK', 8)
        yield lambda map_, spatial, precision='float32': make_matcher(
            map_, spatial, 'cuda', precision
        )


def features(n, seed=0, strips=W, zero=()):
    """Features of n images, unit norm; those of ``zero`` (strip, image) are all zeros."""
    rng = np.random.default_rng(seed)
    x = rng.random((strips, n, D), np.float32) - np.float32(0.2)
    x /= np.linalg.norm(x, axis=2, keepdims=True)
    weights = rng.random((strips, n), np.float32) + np.float32(0.1)
    for strip, image in zero:
        x[strip, image] = weights[strip, image] = 0
    return LocalFeatures(
        x, weights / np.linalg.norm(weights, axis=0), FeatureSettings('gradient', None, strips)
    )


def expected_row(reference, query, i, settings, precision='float32'):
    """Distances of image i of the query, by products in float64 and the oracle."""
    x, y = query.strips[:, i].astype(float), reference.strips.astype(float)
    if precision == 'int8':
        whole, lengths = rounded_queries(query.strips)
        x = whole[i].astype(float) * lengths[i, :, None]
        held = Int8Strips(*y.shape)
        held.write(0, reference.strips)
        y = held[:, :].astype(float)
    products = np.einsum('id,jnd->ijn', x, y)
    if settings.strategy == 'none':
        weights = query.weights[:, i].astype(float)[:, None] * reference.weights.astype(float)
        return 1 - (np.einsum('iin->in', products) * weights).sum(axis=0)
    return oracle.image_distances(1 - products, settings.strategy, settings.sigma, settings.xi)


@pytest.mark.parametrize(
    ('strategy', 'xi', 'precision'),
    [
        ('adaptive', None, 'float32'),
        ('vanilla', 2, 'float32'),
        ('sliding_window', 2, 'float32'),
        ('none', None, 'float32'),
        ('adaptive', 2, 'int8'),
        ('none', None, 'int8'),
    ],
)
def test_distances_of_every_strategy_equal_oracle(matcher_of, strategy, xi, precision):
    reference, query = features(7, zero=[(1, 2)]), features(3, seed=1, zero=[(0, 0)])
    settings = SpatialSettings(strategy, 0.7, xi)
    matcher = matcher_of(reference, settings, precision)
    assert matcher.places == 7
    matrix = matcher.distance_matrix(query.strips, query.weights)
    assert matrix.dtype == np.float32
    for i in range(3):
        expected = expected_row(reference, query, i, settings, precision)
        np.testing.assert_allclose(matrix[i], expected, rtol=0, atol=TOLERANCE)
        row = matcher.distances(query.strips[:, i], query.weights[:, i])
        np.testing.assert_allclose(row.cpu().numpy(), expected, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize('precision', ['float32', 'int8'])
def test_distances_in_pieces_are_equal(matcher_of, monkeypatch, precision):
    from stavpr_ros.prepare import cuda_matcher

    reference, query = features(11), features(5, seed=1)
    whole = matcher_of(reference, SpatialSettings(), precision)
    expected = whole.distance_matrix(query.strips, query.weights)
    monkeypatch.setattr(cuda_matcher, 'BLOCK_WORDS', 4 * W * W * 2)
    monkeypatch.setattr(cuda_matcher, 'QUERIES', 2)
    monkeypatch.setattr(cuda_matcher, 'PLACES_IN_PIECES', 3)
    pieces = matcher_of(reference, SpatialSettings(), precision)
    got = pieces.distance_matrix(query.strips, query.weights)
    np.testing.assert_allclose(got, expected, rtol=0, atol=TOLERANCE)
    holistic = matcher_of(reference, SpatialSettings('none'), precision)
    row = holistic.distances(query.strips[:, 0], query.weights[:, 0]).cpu().numpy()
    expected = expected_row(reference, query, 0, SpatialSettings('none'), precision)
    np.testing.assert_allclose(row, expected, rtol=0, atol=TOLERANCE)


def same(a, b):
    """Return whether two matches of a window are equal."""
    match, twin, path, twin_path = a.nearest, b.nearest, a.path, b.path
    if match is None or twin is None:
        return match is twin and path.shape == twin_path.shape == (0, 2)
    fields = ('first', 'last', 'distance', 'second_best_index')
    equal = all(getattr(match, name) == getattr(twin, name) for name in fields)
    seconds = np.array_equal(match.second_best_distance, twin.second_best_distance, equal_nan=True)
    return equal and seconds and np.array_equal(path, twin_path) and path.dtype == twin_path.dtype


@pytest.mark.parametrize(
    ('n', 'length', 'beta', 'nms_radius'), [(11, 3, 2.0, 3), (1, 2, 1.5, 0), (4, 3, 3.0, 0)]
)
def test_window_equals_that_of_cpu(matcher_of, n, length, beta, nms_radius):
    sequence = SequenceSettings(length=length, beta=beta)
    window, twin = windows(n, sequence)
    rng = np.random.default_rng(n)
    for t in range(2 * length + 2):
        row = np.round(rng.random(n, np.float32), 1)
        row[rng.random(n) < 0.2] = np.inf
        push(window, twin, row)
        if t + 1 >= length:
            answer, expected = window.match(nms_radius), twin.match(nms_radius)
            assert same(answer, expected), (answer, expected)
            for one, other in zip(answer.sequences()[:2], expected.sequences()[:2], strict=True):
                np.testing.assert_array_equal(one, other)
    window.reset()
    assert len(window.buffer) == 0
    assert window.match(nms_radius).nearest is None


def windows(places, sequence=SHORT):
    """Return a window on the device, and its twin on the CPU."""
    from stavpr_ros.recognition.cuda_windows import CudaLmDtwWindow

    return CudaLmDtwWindow(sequence, places), LmDtwWindow(sequence, places)


def push(window, twin, row):
    window.buffer.push(torch.from_numpy(row).to(window.buffer.memory.device))
    twin.buffer.push(row)


def first_image(x):
    return x.strips[:, 0], x.weights[:, 0]


def test_distances_returned_before_stay_unchanged(matcher_of):
    reference = features(6)
    matcher = matcher_of(reference, SpatialSettings())
    first = matcher.distances(*first_image(reference))
    kept = first.clone()
    matcher.distances(reference.strips[:, 3], reference.weights[:, 3])
    assert torch.equal(first, kept)


def test_window_of_empty_map_has_no_match(matcher_of):
    query = features(1)
    matcher = matcher_of(features(3)[0:0], SpatialSettings())
    assert matcher.places == 0
    window, _ = windows(0)
    for _ in range(3):
        row = matcher.distances(*first_image(query))
        assert row.shape == (0,)
        window.buffer.push(row)
    found = window.match(20)
    assert found.nearest is None
    assert found.path.shape == (0, 2)


def test_cuda_matcher_with_invalid_settings_is_rejected(matcher_of):
    with pytest.raises(SettingsError, match='xi = 5'):
        matcher_of(features(3), SpatialSettings(xi=5))
    with pytest.raises(InputError, match='at least 4'):
        matcher_of(features(3, strips=3), SpatialSettings('sliding_window'))


@pytest.mark.skipif(SIMULATOR, reason='sizes of a real map take a real device')
@pytest.mark.parametrize('precision', ['float32', 'int8'])
def test_distances_of_large_map_on_device_equal_cpu(matcher_of, monkeypatch, precision):
    from stavpr_ros.alignment.cuda import dtw, lm_dtw
    from stavpr_ros.prepare.matcher import make_matcher

    monkeypatch.setattr(dtw, 'BLOCK', 128)
    monkeypatch.setattr(lm_dtw, 'BLOCK', 128)
    reference, query = features(30_000, strips=7), features(25, seed=1, strips=7)
    settings, sequence = SpatialSettings(xi=3), SequenceSettings()
    matcher = matcher_of(reference, settings, precision)
    twin = make_matcher(reference, settings, 'cpu', precision)
    window, twin_window = windows(len(reference), sequence)
    matrix = matcher.distance_matrix(query.strips, query.weights)
    expected = twin.distance_matrix(query.strips, query.weights)
    apart = abs(matrix - expected) > TOLERANCE
    assert apart.mean() < 1e-4  # near-ties
    for row in matrix:
        push(window, twin_window, row)
    assert same(window.match(20), twin_window.match(20))
