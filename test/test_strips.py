# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Vertical strips, their norms, and the distances between them, against the oracle."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import strip_distances
from stavpr_ros.errors import InputError
from stavpr_ros.features.extractor import cut_strips, normalize

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
