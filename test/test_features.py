# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The kinds of features and the extractor: unknown kinds, invalid settings."""

import numpy as np
import pytest
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.gradient import GradientSettings


def test_extractor_of_unknown_kind_is_rejected():
    with pytest.raises(SettingsError, match=r"'teleport'.*take one of gradient"):
        FeatureExtractor('teleport')


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
