# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The kinds of features and the extractor: unknown kinds, invalid settings."""

import pytest
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.gradient import GradientSettings


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
