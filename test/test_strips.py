# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Strips of an image: cut, pooled, weighted, projected at random, and one vector an image."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import SpatialSettings, strip_distances
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures, Projection
from stavpr_ros.features.extractor import cut_strips, normalize
from stavpr_ros.prepare.matcher import make_matcher

TOLERANCE = 1e-5


def random_strips(seed, W, n, d, zeros):
    """Return features as of a ReLU, a share of the strips all zero, (W, n, d) float32."""
    rng = np.random.default_rng(seed)
    strips = np.maximum(rng.standard_normal((W, n, d)), 0) * 10 ** rng.uniform(-3, 3, (W, n, 1))
    strips[rng.random((W, n)) < zeros] = 0
    return strips.astype(np.float32)


def unit(strips):
    """Return unit strips (W, n, d) and weights (W, n) as numpy."""
    directions, weights = normalize(strips)
    return directions, weights


def test_cut_strips_drops_surplus_columns_by_hand():
    # 8 columns, 3 strips of 2: r = 2, one lost on each side: (1 2) (3 4) (5 6)
    row = np.arange(8.0).reshape(1, 1, 1, 8)
    assert cut_strips(row, 3)[:, 0].tolist() == [[1, 2], [3, 4], [5, 6]]
    # 9 columns, 4 strips of 2: r = 1, floor(1 / 2) = 0 on the left
    row = np.arange(9.0).reshape(1, 1, 1, 9)
    assert cut_strips(row, 4)[:, 0].tolist() == [[0, 1], [2, 3], [4, 5], [6, 7]]
    # 13 columns, 7 strips of 1: r = 6, 3 on each side (the SqueezeNet map)
    row = np.arange(13.0).reshape(1, 1, 1, 13)
    assert cut_strips(row, 7)[:, 0].tolist() == [[3], [4], [5], [6], [7], [8], [9]]


@settings(max_examples=25)
@given(
    n=st.integers(0, 3),
    channels=st.integers(1, 4),
    height=st.integers(1, 4),
    width=st.integers(1, 19),
    W=st.integers(1, 9),
)
def test_cut_strips_equals_oracle(n, channels, height, width, W):
    W = min(W, width)
    size = n * channels * height * width
    maps = np.arange(size, dtype=np.float32).reshape(n, channels, height, width)
    np.testing.assert_array_equal(cut_strips(maps, W), oracle.cut_strips(maps, W))


@pytest.mark.parametrize(
    ('shape', 'W', 'text'),
    [
        ((1, 3, 5, 6), 7, 'Wf = 6 .*W = 7'),
        ((1, 3, 5, 6), 0, 'W = 0'),
        ((3, 5, 6), 2, r'\(3, 5, 6\)'),
    ],
)
def test_cut_strips_of_other_shape_is_rejected(shape, W, text):
    with pytest.raises(InputError, match=text):
        cut_strips(np.zeros(shape, np.float32), W)


def test_normalize_by_hand():
    # one image, strips (3 4), (0 0), (0 12): norms 5, 0, 12, together 13
    directions, weights = unit(np.array([[[3.0, 4]], [[0, 0]], [[0, 12]]], np.float32))
    np.testing.assert_allclose(directions[:, 0], [[0.6, 0.8], [0, 0], [0, 1]], atol=1e-7)
    np.testing.assert_allclose(weights[:, 0], [5 / 13, 0, 12 / 13], atol=1e-7)
    assert directions.dtype == weights.dtype == np.float32


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    W=st.integers(1, 9),
    n=st.integers(0, 6),
    d=st.integers(1, 20),
    zeros=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_strip_distances_equal_oracle(seed, W, n, d, zeros):
    query, reference = random_strips(seed, W, 1, d, zeros), random_strips(seed + 1, W, n, d, zeros)
    result = strip_distances(unit(query)[0][:, 0], unit(reference)[0])
    assert tuple(result.shape) == (W, W, n)
    assert result.dtype == np.float32
    np.testing.assert_allclose(
        result, oracle.distances(query[:, 0], reference), rtol=0, atol=TOLERANCE
    )


def test_strip_distances_at_vgg_size_are_precise():
    query, reference = random_strips(0, 2, 1, 14336, 0.0), random_strips(1, 2, 2, 14336, 0.0)
    reference[0, 0] = 3 * query[0, 0]  # the same place: distance 0
    result = strip_distances(unit(query)[0][:, 0], unit(reference)[0])
    expected = oracle.distances(query[:, 0], reference)
    assert expected[0, 0, 0] == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(result, expected, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(
    ('query', 'reference', 'named'),
    [
        ((7, 5), (7, 3, 6), r'\(7, 3, 6\) float32, expected \(7, n, 5\)'),
        ((6, 5), (7, 3, 5), r'\(7, 3, 5\) float32, expected \(6, n, 5\)'),
        ((7, 5, 1), (7, 3, 5), r'\(7, 5, 1\)'),
        ((7, 5), (7, 5), r'\(7, 5\)'),
    ],
)
def test_distances_of_other_shapes_are_rejected(query, reference, named):
    query, reference = np.zeros(query, np.float32), np.zeros(reference, np.float32)
    with pytest.raises(InputError, match=named):
        strip_distances(query, reference)


def test_strip_distances_of_other_dtype_are_rejected():
    query, reference = np.zeros((7, 5), np.float32), np.zeros((7, 3, 5), np.float32)
    for pair in ((query.astype(np.float64), reference), (query, reference.astype(np.float64))):
        with pytest.raises(InputError, match='float64'):
            strip_distances(*pair)


def test_projection_identity_follows_matrix():
    one, two = Projection.gaussian(40, 16, seed=3), Projection.gaussian(40, 16, seed=3)
    np.testing.assert_array_equal(one.matrix, two.matrix)
    assert one.matrix.dtype == np.float32
    assert Projection(one.matrix.copy(), one.name).identity == two.identity  # of a loaded map
    two.matrix[3, 5] = np.nextafter(two.matrix[3, 5], np.float32(9))
    assert Projection(two.matrix, one.name).identity != one.identity
    others = [(40, 16, 0), (40, 16, 1), (40, 17, 0), (41, 16, 0)]
    assert len({Projection.gaussian(*other).identity for other in others}) == 4


def test_apply_equals_matrix_product():
    projection = Projection.gaussian(6, 4, seed=1)
    strips = np.random.default_rng(0).standard_normal((3, 5, 6)).astype(np.float32)
    strips[1, 2] = 0
    result = projection.apply(strips)
    assert result.dtype == np.float32
    np.testing.assert_allclose(
        result, np.einsum('ind,dm->inm', strips.astype(float), projection.matrix), atol=1e-5
    )
    assert not result[1, 2].any()


def test_gaussian_entries_are_normal_with_mean_zero():
    matrix = Projection.gaussian(1000, 512).matrix
    spread = matrix.std()
    assert spread == pytest.approx(512**-0.5, rel=0.01)  # norms are kept on average
    # 512,000 entries: the mean deviates by spread / 715, the share within one sigma by .0007
    assert abs(matrix.mean()) < 5 * spread / 715
    assert np.mean(np.abs(matrix) < spread) == pytest.approx(0.6827, abs=0.004)


def test_apply_of_other_dimension_is_rejected():
    with pytest.raises(InputError, match=r'shape \(7, 2, 5\) float32, expected \(W, n, 6\)'):
        Projection.gaussian(6, 4).apply(np.zeros((7, 2, 5), np.float32))


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [((0, 4), 'features = 0'), ((6, 0), '= 0'), ((6, -3), '= -3'), ((6, 4, -1), 'seed .* = -1')],
)
def test_gaussian_out_of_range_is_rejected(arguments, text):
    with pytest.raises(SettingsError, match=text):
        Projection.gaussian(*arguments)


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
