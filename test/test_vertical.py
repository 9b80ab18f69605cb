# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Vertical alignment, for cameras at changing heights: cells of strips first, then strips."""

import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import SpatialSettings
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.features.gradient import GradientSettings
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.prepare.matcher import CpuMatcher, cut_cells, make_matcher

SETTINGS = FeatureSettings('gradient', GradientSettings(), 5)


def random_features(n, H=4, channels=3, columns=2, W=5, seed=0):
    rng = np.random.default_rng(seed)
    strips = rng.random((W, n, channels * H * columns))
    strips[1, 0].reshape(channels, H, columns)[:, 2] = 0  # one cell of one strip is empty
    strips /= np.linalg.norm(strips, axis=2, keepdims=True)
    return LocalFeatures(
        strips.astype(np.float32), np.ones((W, n), np.float32), SETTINGS, (H, columns)
    )


def test_cut_cells_are_those_of_feature_map():
    features = random_features(3)
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
    reference, query = random_features(n), random_features(2, seed=1)
    spatial = SpatialSettings(strategy, 1.0, xi, vertical=True)
    matcher = CpuMatcher(reference, spatial)
    found = matcher.distance_matrix(query.strips, query.weights)
    x = cut_cells(query.strips, (4, 2)).astype(np.float64)
    y = cut_cells(reference.strips, (4, 2)).astype(np.float64)
    for image in sorted({0, n // 2, n - 1}):
        d = np.empty((5, 5))
        for i in range(5):
            for j in range(5):
                cells = 1 - x[4 * i : 4 * i + 4, 1] @ y[4 * j : 4 * j + 4, image].T
                d[i, j] = oracle.align_images(cells, strategy)
        expected = oracle.align_images(d, strategy, xi=xi)
        assert found[1, image] == pytest.approx(expected, abs=2e-6)
    np.testing.assert_array_equal(
        matcher.distances(query.strips[:, 1], query.weights[:, 1]), found[1]
    )


def test_vertical_alignment_of_other_settings_is_rejected(small_map):
    spatial = SpatialSettings(vertical=True)
    with pytest.raises(InputError, match='without projection'):
        PlaceRecognizer(small_map, RecognizerSettings(spatial=spatial))
    with pytest.raises(SettingsError, match='vertical'):
        SpatialSettings('none', vertical=True)
    with pytest.raises(SettingsError, match='cuda'):
        make_matcher(random_features(3), spatial, 'cuda', 'float32')
