# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The kinds of features and the extractor: unknown kinds, invalid settings, a real network."""

import numpy as np
import pytest
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.gradient import GradientSettings
import torch


@pytest.mark.parametrize(
    ('kind', 'words'), [('teleport', 'take one of gradient'), ('torchscript', 'to an ONNX file')]
)
def test_extractor_of_unknown_kind_is_rejected(kind, words):
    with pytest.raises(SettingsError, match=f"'{kind}'.*{words}"):
        FeatureExtractor(kind)


@pytest.mark.parametrize('bad', [{'cell': 1}, {'cell': 15}, {'size': 16}, {'orientations': 1}])
def test_gradient_settings_out_of_range_are_rejected(bad):
    with pytest.raises(SettingsError):
        GradientSettings(**bad)


def test_onnx_squeezenet_has_expected_shape(squeezenet_settings):
    """The real network's inner layer: 13 x 13 x 384, cropped to seven strips of one column."""
    extractor = FeatureExtractor('onnx', squeezenet_settings)
    rng = np.random.default_rng(0)
    features = extractor.extract([rng.integers(0, 256, (60, 80, 3), np.uint8) for _ in range(3)])
    assert features.strips.shape == (7, 3, 13 * 384)
    torch.testing.assert_close(torch.linalg.vector_norm(features.strips, dim=2), torch.ones(7, 3))
