# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The gradient features against their definition in plain float64."""

import cv2
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.extractor import cut_strips, normalize
from stavpr_ros.features.gradient import FLOOR, Gradient, GradientSettings, PER_THREAD
from stavpr_ros.features.registry import RESIZE_METHODS
from stavpr_ros.threads import limit_threads


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


@pytest.mark.parametrize('bad', [{'cell': 1}, {'cell': 15}, {'size': 16}, {'orientations': 1}])
def test_gradient_settings_out_of_range_are_rejected(bad):
    with pytest.raises(SettingsError):
        GradientSettings(**bad)


def test_images_that_are_views_have_the_same_features():
    """BGR reversed to RGB, as OpenCV's images are, and crops."""
    image = np.random.default_rng(0).integers(0, 256, (300, 400, 3), dtype=np.uint8)
    extractor = FeatureExtractor('gradient')
    for view in (image[..., ::-1], image[10:, 20:], image[::-1]):
        expected = extractor.extract([view.copy()])
        np.testing.assert_array_equal(extractor.extract([view]).strips, expected.strips)
