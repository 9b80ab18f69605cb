# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The matcher of the CPU: fused kernels equal separate functions; vertical alignment."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numba
import numpy as np
import oracle
from places import features_of, map_of, route_strips
import pytest
from stavpr_ros.alignment import (
    best_match,
    image_distances,
    match_sequence,
    SequenceDistances,
    SequenceSettings,
    SpatialSettings,
    strip_distances,
)
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.features.gradient import GradientSettings
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.prepare.centering import z_normalized
from stavpr_ros.prepare.matcher import CpuMatcher, cut_cells, make_matcher, PRECISIONS
from stavpr_ros.prepare.prepared_map import prepare_map
from stavpr_ros.threads import limit_threads

ADAPTIVE = SpatialSettings()


def random_features(W, n, d, seed=0):
    """Return unit-norm features of n images; one strip of the first image is zero."""
    rng = np.random.default_rng(seed)
    strips = rng.standard_normal((W, n, d))
    strips[0, :1] = 0
    weights = rng.uniform(0.1, 1, (W, n)).astype(np.float32)
    return replace(features_of(strips), weights=weights / np.linalg.norm(weights, axis=0))


# ------------------------------------------------ distances


@settings(max_examples=30)
@given(
    W=st.integers(1, 15),
    n=st.sampled_from([0, 1, 15, 16, 17, 255, 256, 257]),
    d=st.sampled_from([1, 5, 16, 64, 100]),
    strategy=st.sampled_from(['adaptive', 'vanilla', 'rigid']),
    data=st.data(),
)
def test_fused_distances_equal_separate_functions(W, n, d, strategy, data):
    """Bit for bit: whole tiles of strips and blocks of images, and their remainders."""
    xi = data.draw(st.one_of(st.none(), st.integers(1, W)))
    features, queries = random_features(W, n, d), random_features(W, 3, d, seed=1)
    spatial = SpatialSettings(strategy, 1.0, xi)
    matrix = CpuMatcher(features, spatial).distance_matrix(queries.strips, queries.weights)
    assert matrix.shape == (3, n)
    for x in range(3):
        separate = image_distances(strip_distances(queries.strips[:, x], features.strips), spatial)
        np.testing.assert_array_equal(matrix[x], separate)
        row = CpuMatcher(features, spatial).distances(queries.strips[:, x], queries.weights[:, x])
        np.testing.assert_array_equal(row, separate)


@pytest.mark.parametrize('W', [1, 7])
def test_strategies_without_dtw_equal_separate_functions(W):
    features, query = random_features(W, 70, 24), random_features(W, 2, 24, seed=1)
    for x in range(2):
        strips, weights = query.strips[:, x], query.weights[:, x]
        row = CpuMatcher(features, SpatialSettings('none')).distances(strips, weights)
        query_image, places = (
            strips * weights[:, None],
            features.strips * features.weights[..., None],
        )
        expected = 1 - np.einsum('Wd,Wnd->n', query_image, places)
        np.testing.assert_allclose(row, expected, atol=1e-6)
        if W >= 4:
            row = CpuMatcher(features, SpatialSettings('sliding_window')).distances(
                strips, weights
            )
            d = strip_distances(strips, features.strips)
            np.testing.assert_array_equal(
                row, image_distances(d, SpatialSettings('sliding_window'))
            )


def test_distances_of_features_not_contiguous_are_equal():
    features, query = random_features(7, 60, 32), random_features(7, 1, 32, seed=1)
    part = CpuMatcher(features[11:40], ADAPTIVE).distances(query.strips[:, 0], query.weights[:, 0])
    whole = CpuMatcher(features, ADAPTIVE).distances(query.strips[:, 0], query.weights[:, 0])
    np.testing.assert_array_equal(part, whole[11:40])


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason='one processor only')
def test_kernels_of_one_and_two_threads_return_same_bits():
    features, queries = random_features(7, 3000, 16), random_features(7, 20, 16, seed=1)
    results = []
    for threads in (1, 2):
        limit_threads(threads)
        matrices = [
            make_matcher(features, SpatialSettings(strategy), 'cpu', precision).distance_matrix(
                queries.strips, queries.weights
            )
            for strategy in ('adaptive', 'vanilla', 'rigid', 'sliding_window')
            for precision in PRECISIONS
        ]
        sequences = match_sequence(matrices[0], SequenceSettings())
        arrays = [*matrices, sequences.distances, sequences.lengths]
        results.append([array.tobytes() for array in arrays])
    limit_threads(0)
    assert results[0] == results[1]


# ------------------------------------------------ the window


@pytest.mark.parametrize(('places', 'changes', 'precision'), [
    (2_000, {}, 'int8'),
    (1_999, {}, 'float32'),
    (2_000, {'mode': 'paper', 'threshold': 1.0}, 'float32'),
    (2_000, {'spatial': SpatialSettings(vertical=True)}, 'float32'),
])  # fmt: skip
def test_precision_auto_is_int8_on_large_maps_in_mode_robust(places, changes, precision):
    features = replace(features_of(route_strips(0, places, 32)), cells=(4, 2))
    settings, query = RecognizerSettings(**changes), features[50:51]
    auto, as_set = (
        PlaceRecognizer(map_of(features), settings, precision=name).distances(query)
        for name in ('auto', precision)
    )
    np.testing.assert_array_equal(auto, as_set)
    other = 'int8' if precision == 'float32' and 'spatial' not in changes else 'float32'
    as_other = PlaceRecognizer(map_of(features), settings, precision=other).distances(query)
    assert np.array_equal(auto, as_other) == ('spatial' in changes)


@pytest.mark.parametrize(('precision', 'strategy'), [('float32', 'none'), ('int8', 'adaptive')])
def test_kernels_reject_arrays_of_other_shapes(precision, strategy):
    features = features_of(route_strips(0, 40))
    prepared = prepare_map(features, precision)
    matcher = make_matcher(prepared.features, SpatialSettings(strategy), 'cpu', precision)
    image, weights = features.strips[:, 0], features.weights[:, 0]
    for function, arguments, words in [
        (matcher.distances, (image[:, :-1], weights), r'strips: shape .*, expected \(7, n, 24\)'),
        (matcher.distances, (image, weights[:3]), r'weights: shape \(3, 1\)'),
        (prepared.centering.next_query, (image[:-1],), r'strips: shape .*, expected \(7, 24\)'),
        (z_normalized, (np.ones(9, np.float32), None, np.ones(3, bool)), 'counted: shape'),
        (best_match, (SequenceDistances(np.ones(9), np.ones(3, int)), 2), 'lengths: shape'),
    ]:
        with pytest.raises(InputError, match=words):
            function(*arguments)


# Vertical alignment, for cameras at changing heights: cells of strips first, then strips

SETTINGS = FeatureSettings('gradient', GradientSettings(), 5)


def features_with_cells(n, H=4, channels=3, columns=2, W=5, seed=0):
    rng = np.random.default_rng(seed)
    strips = rng.random((W, n, channels * H * columns))
    strips[1, 0].reshape(channels, H, columns)[:, 2] = 0  # one cell of one strip is empty
    strips /= np.linalg.norm(strips, axis=2, keepdims=True)
    return LocalFeatures(
        strips.astype(np.float32), np.ones((W, n), np.float32), SETTINGS, (H, columns)
    )


def test_cut_cells_are_those_of_feature_map():
    features = features_with_cells(3)
    cells = cut_cells(features.strips, (4, 2))
    assert cells.shape == (20, 3, 6)
    for strip in range(5):
        for image in range(3):
            cube = features.strips[strip, image].reshape(3, 4, 2)
            for row in range(4):
                cell = cube[:, row].reshape(-1)
                expected = cell / max(np.linalg.norm(cell), 1e-12)
                np.testing.assert_allclose(cells[strip * 4 + row, image], expected, atol=1e-6)


@pytest.mark.parametrize(
    ('n', 'strategy', 'xi'), [(1, 'adaptive', None), (15, 'vanilla', None), (65, 'adaptive', 2)]
)
def test_vertical_distances_equal_oracle(n, strategy, xi):
    """The inner alignment has its own central cell and no band."""
    reference, query = features_with_cells(n), features_with_cells(2, seed=1)
    spatial = SpatialSettings(strategy, 1.0, xi, vertical=True)
    matcher = CpuMatcher(reference, spatial)
    result = matcher.distance_matrix(query.strips, query.weights)
    x = cut_cells(query.strips, (4, 2)).astype(np.float64)
    y = cut_cells(reference.strips, (4, 2)).astype(np.float64)
    for image in sorted({0, n // 2, n - 1}):
        d = np.empty((5, 5))
        for i in range(5):
            for j in range(5):
                cells = 1 - x[4 * i : 4 * i + 4, 1] @ y[4 * j : 4 * j + 4, image].T
                d[i, j] = oracle.align_images(cells, strategy)
        expected = oracle.align_images(d, strategy, xi=xi)
        assert result[1, image] == pytest.approx(expected, abs=2e-6)
    np.testing.assert_array_equal(
        matcher.distances(query.strips[:, 1], query.weights[:, 1]), result[1]
    )


def test_vertical_alignment_and_precision_of_other_settings_are_rejected(small_map):
    spatial = SpatialSettings(vertical=True)
    with pytest.raises(InputError, match='without projection'):
        PlaceRecognizer(small_map, RecognizerSettings(spatial=spatial))
    with pytest.raises(SettingsError, match='vertical'):
        SpatialSettings('none', vertical=True)
    for backend, precision, words in (
        ('cuda', 'float32', 'cuda'),
        ('cpu', 'int8', "'int8' has no vertical"),
        ('cpu', 'float16', "'float16' is unknown: take one of float32, int8"),
    ):
        with pytest.raises(SettingsError, match=words):
            make_matcher(features_with_cells(3), spatial, backend, precision)
