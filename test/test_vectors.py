# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features that are one vector an image (W = 1), and pooled strips."""

import numpy as np
import pytest
from stavpr_ros.alignment import SpatialSettings
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.features.extractor import cut_strips
from stavpr_ros.prepare.matcher import make_matcher


@pytest.mark.parametrize('pooling', ['mean', 'gem'])
def test_cut_strips_pooled_equals_plain_loops(pooling):
    """A map of 5 rows and 8 columns in three strips: columns 1-2, 3-4, 5-6."""
    maps = np.random.default_rng(0).standard_normal((2, 3, 5, 8)).astype(np.float32)
    strips = cut_strips(maps, 3, pooling)
    assert strips.shape == (3, 2, 3)
    for w in range(3):
        for n in range(2):
            for c in range(3):
                cells = [float(maps[n, c, y, 1 + 2 * w + x]) for y in range(5) for x in range(2)]
                expected = sum(cells) / 10
                if pooling == 'gem':
                    expected = (sum(max(v, 1e-6) ** 3 for v in cells) / 10) ** (1 / 3)
                assert float(strips[w, n, c]) == pytest.approx(expected, abs=1e-6)


def vectors(n, d, seed=0):
    """Return unit-norm vectors along a random curve; the first is zero."""
    steps = np.random.default_rng(seed).standard_normal((n, d))
    curve = np.cumsum(steps, axis=0) * 0.5 + steps
    curve /= np.linalg.norm(curve, axis=1, keepdims=True)
    curve[0] = 0
    weights = (np.linalg.norm(curve, axis=1) > 0).astype(np.float32)
    return LocalFeatures(
        (curve[None].astype(np.float32)),
        weights[None],
        FeatureSettings('gradient', None, 1),
        (1, 1),
    )


@pytest.mark.parametrize(
    ('strategy', 'precision', 'error'),
    [
        ('adaptive', 'float32', 1e-5),
        ('vanilla', 'float32', 1e-5),
        ('none', 'float32', 1e-5),
        ('vertical', 'float32', 1e-5),
        ('adaptive', 'int8', 0.02),
    ],
)
def test_alignment_of_one_strip_is_the_cosine_distance(strategy, precision, error):
    vertical = strategy == 'vertical'
    spatial = SpatialSettings('adaptive' if vertical else strategy, vertical=vertical)
    features, queries = vectors(131, 515), vectors(3, 515, seed=1)
    matcher = make_matcher(features, spatial, 'cpu', precision)
    matrix = matcher.distance_matrix(queries.strips, queries.weights)
    expected = 1 - queries.strips[0] @ features.strips[0].T
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=error)
    row = matcher.distances(queries.strips[:, 1], queries.weights[:, 1])
    assert np.array_equal(row, matrix[1])


def test_sliding_window_over_one_strip_is_rejected_with_the_map():
    with pytest.raises(InputError, match='W = 1 strips: the sliding window'):
        make_matcher(vectors(5, 4), SpatialSettings('sliding_window'), 'cpu', 'float32')
