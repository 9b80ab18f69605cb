# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Strips of an image, cut, weighted and projected, and the gradients that they are made of."""

from functools import partial

import cv2
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import SpatialSettings, strip_distances
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.features import FeatureExtractor, FeatureSettings, LocalFeatures, Projection
from stavpr_ros.features.extractor import cut_strips, normalize
from stavpr_ros.features.gradient import FLOOR, Gradient, GradientSettings, PER_THREAD
from stavpr_ros.features.registry import RESIZE_METHODS
from stavpr_ros.prepare.matcher import make_matcher
from stavpr_ros.threads import limit_threads

TOLERANCE = 1e-5


def random_strips(seed, W, n, d, zeros):
    """Return features as of a ReLU, a share of the strips all zero, (W, n, d) float32."""
    rng = np.random.default_rng(seed)
    strips = np.maximum(rng.standard_normal((W, n, d)), 0) * 10 ** rng.uniform(-3, 3, (W, n, 1))
    strips[rng.random((W, n)) < zeros] = 0
    return strips.astype(np.float32)


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


def test_normalize_by_hand():
    # one image, strips (3 4), (0 0), (0 12): norms 5, 0, 12, together 13
    directions, weights = normalize(np.array([[[3.0, 4]], [[0, 0]], [[0, 12]]], np.float32))
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
    result = strip_distances(normalize(query)[0][:, 0], normalize(reference)[0])
    assert tuple(result.shape) == (W, W, n)
    assert result.dtype == np.float32
    np.testing.assert_allclose(
        result, oracle.distances(query[:, 0], reference), rtol=0, atol=TOLERANCE
    )


def test_strip_distances_at_vgg_size_are_precise():
    query, reference = random_strips(0, 2, 1, 14336, 0.0), random_strips(1, 2, 2, 14336, 0.0)
    reference[0, 0] = 3 * query[0, 0]  # the same place: distance 0
    result = strip_distances(normalize(query)[0][:, 0], normalize(reference)[0])
    expected = oracle.distances(query[:, 0], reference)
    assert expected[0, 0, 0] == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(result, expected, rtol=0, atol=TOLERANCE)


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


# The gradient features against their definition in plain float64


def reference_maps(gray: np.ndarray, settings: GradientSettings) -> np.ndarray:
    """Return the features of a square image by definition, float64, cell by cell."""
    s, pixels = settings, np.pad(gray / 255, 1, mode='edge')
    dx, dy = pixels[1:-1, 2:] - pixels[1:-1, :-2], pixels[2:, 1:-1] - pixels[:-2, 1:-1]
    position = np.arctan2(dy, dx) / (2 * np.pi if s.signed else np.pi) * s.orientations
    # a pixel's share in an orientation falls linearly to 0 at the next one, round the circle
    offset = np.abs(position - np.arange(s.orientations)[:, None, None]) % s.orientations
    share = np.maximum(0, 1 - np.minimum(offset, s.orientations - offset))
    lengths = np.pad(share * np.hypot(dx, dy), ((0, 0), (s.cell, s.cell), (s.cell, s.cell)))
    starts = range(
        s.cell - s.cell // 2, s.size + s.cell // 2 - s.cell + 1, s.cell
    )  # a cell's first pixel
    window = 2 * s.cell
    cells = [
        [lengths[:, y : y + window, x : x + window].mean(axis=(1, 2)) for x in starts]
        for y in starts
    ]
    histograms = np.array(cells).transpose(2, 0, 1)
    energy = np.pad((histograms**2).sum(axis=0), 1, mode='edge')
    blocks = 1 / np.sqrt(
        energy[1:, 1:] + energy[1:, :-1] + energy[:-1, 1:] + energy[:-1, :-1] + FLOOR
    )
    return histograms * (blocks[1:, 1:] + blocks[1:, :-1] + blocks[:-1, 1:] + blocks[:-1, :-1]) / 4


def assert_same_features(maps, expected) -> None:
    """Compare the maps, and the unit-norm local features made of them, to 1e-5."""
    assert maps.shape == expected.shape
    batches = (m.reshape(-1, *m.shape[-3:]) for m in (maps, expected))
    for a, b in zip(*(normalize(cut_strips(batch, 1)) for batch in batches), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        maps.astype(np.float64), expected.astype(np.float64), rtol=0, atol=1e-5
    )


@st.composite
def gradient_settings(draw):
    """Any settings, of images that are not too large."""
    cell = draw(st.integers(2, 17))
    cells = draw(st.integers(2, 64 // cell + 2))
    bins, signed, logarithm = draw(st.integers(2, 12)), draw(st.booleans()), draw(st.booleans())
    return GradientSettings(
        cell * cells, draw(st.sampled_from(RESIZE_METHODS)), cell, bins, signed, logarithm
    )


def noise_image(seed: int, contrast: int, shape: tuple[int, int]) -> np.ndarray:
    """Noise of a contrast, its left half smoothed: strong and weak gradients, and none."""
    rng = np.random.default_rng(seed)
    gray = (rng.integers(0, contrast + 1, shape) + (255 - contrast) // 2).astype(np.uint8)
    half = (shape[1] + 1) // 2
    gray[:, :half] = cv2.blur(gray[:, :half], (5, 5))
    return gray


noise = {'seed': st.integers(0, 2**32 - 1), 'contrast': st.sampled_from([0, 1, 3, 60, 255])}


@settings(max_examples=25)
@given(
    settings=gradient_settings(), height=st.integers(1, 150), width=st.integers(1, 150), **noise
)
def test_gradient_of_any_image_size_equals_definition(settings, height, width, seed, contrast):
    """Color, resizing and kernel, against OpenCV and the definition."""
    image = np.dstack(
        [noise_image(seed + channel, contrast, (height, width)) for channel in range(3)]
    )
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    averages = settings.resize == 'area' and min(height, width) >= settings.size
    method = cv2.INTER_AREA if averages else cv2.INTER_LINEAR
    square = cv2.resize(gray, (settings.size, settings.size), interpolation=method)
    if settings.logarithm:
        square = np.rint(255 * np.log(1 + 32 * (square / 255)) / np.log(33))
    assert_same_features(
        Gradient(settings).feature_maps([image])[0], reference_maps(square, settings)
    )


@pytest.fixture
def two_threads():
    limit_threads(2)
    yield
    limit_threads(0)


@pytest.mark.usefixtures('two_threads')
@pytest.mark.parametrize('n', [0, 1, 2 * PER_THREAD + 3])
def test_gradient_on_threads_equals_single_images(route, n):
    gradient = Gradient(GradientSettings())
    together = gradient.feature_maps(route[:n])
    assert together.shape == (n, 8, 14, 14)
    for i in range(n):
        assert np.array_equal(together[i], gradient.feature_maps([route[i]])[0])


@pytest.mark.usefixtures('two_threads')
def test_gradient_error_in_thread_is_raised(route):
    images = [*route[: 2 * PER_THREAD]]
    images[3] = np.empty((0, 5, 3), np.uint8)
    with pytest.raises(cv2.error):
        Gradient(GradientSettings()).feature_maps(images)


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(64, 500),
    width=st.integers(64, 500),
    seed=st.integers(0, 2),
    blur=st.booleans(),
)
def test_area_averages_equal_opencv(height, width, seed, blur):
    gray = np.random.default_rng(seed).integers(0, 256, (height, width), np.uint8)
    gray = cv2.GaussianBlur(gray, (0, 0), 2) if blur else gray
    made = Gradient(GradientSettings(size=64, logarithm=False))
    expected = cv2.resize(gray, (64, 64), interpolation=cv2.INTER_AREA)
    padded = made._prepare(cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB))
    np.testing.assert_array_equal(padded, np.pad(expected, 1, mode='edge'))


def test_images_that_are_views_have_the_same_features():
    """BGR reversed to RGB, as OpenCV's images are, and crops."""
    image = np.random.default_rng(0).integers(0, 256, (300, 400, 3), dtype=np.uint8)
    extractor = FeatureExtractor('gradient')
    for view in (image[..., ::-1], image[10:, 20:], image[::-1]):
        expected = extractor.extract([view.copy()])
        np.testing.assert_array_equal(extractor.extract([view]).strips, expected.strips)


def zeros(*shape, dtype=np.float32):
    return np.zeros(shape, dtype)


@pytest.mark.parametrize(
    ('work', 'arguments', 'text'),
    [
        (cut_strips, (zeros(1, 3, 5, 6), 7), 'Wf = 6 .*W = 7'),
        (cut_strips, (zeros(1, 3, 5, 6), 0), 'W = 0'),
        (cut_strips, (zeros(3, 5, 6), 2), r'\(3, 5, 6\)'),
        (strip_distances, (zeros(7, 5), zeros(7, 3, 6)), r'32, expected \(7, n, 5\)'),
        (strip_distances, (zeros(6, 5), zeros(7, 3, 5)), r'32, expected \(6, n, 5\)'),
        (strip_distances, (zeros(7, 5, 1), zeros(7, 3, 5)), r'\(7, 5, 1\)'),
        (strip_distances, (zeros(7, 5), zeros(7, 5)), r'\(7, 5\)'),
        (strip_distances, (zeros(7, 5, dtype=float), zeros(7, 3, 5)), 'float64'),
        (strip_distances, (zeros(7, 5), zeros(7, 3, 5, dtype=float)), 'float64'),
        (Projection.gaussian(6, 4).apply, (zeros(7, 2, 5),), r'32, expected \(W, n, 6\)'),
        (Projection.gaussian, (0, 4), 'features = 0'),
        (Projection.gaussian, (6, 0), '= 0'),
        (Projection.gaussian, (6, -3), '= -3'),
        (Projection.gaussian, (6, 4, -1), 'seed .* = -1'),
        (make_matcher, (vectors(5, 4), SpatialSettings('sliding_window'), 'cpu', 'float32'),
         'W = 1 strips: the sliding window'),
        *((partial(GradientSettings, **{name: value}), (), name) for name, value in (
            ('cell', 1), ('cell', 15), ('size', 16), ('orientations', 1))),
    ],
)  # fmt: skip
def test_arguments_that_do_not_fit_are_rejected(work, arguments, text):
    with pytest.raises((InputError, SettingsError), match=text):
        work(*arguments)
