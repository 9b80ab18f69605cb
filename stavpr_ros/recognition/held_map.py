# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The features of a map as a matcher holds them: centered, in its precision."""

from stavpr_ros.features import LocalFeatures
from stavpr_ros.recognition.int8_features import Int8Features, rounded
from stavpr_ros.recognition.robust import converted, MeanCentering, RobustOptions
import torch


def centering_of(features: LocalFeatures, options: RobustOptions) -> MeanCentering | None:
    """Learn the mean and the whitening that the options ask for, None without any."""
    if options.mean_centering or options.whitening:
        return MeanCentering(features, options.mean_centering, options.whitening)
    return None


def held_features(
    features: LocalFeatures, centering: MeanCentering | None, precision: str
) -> LocalFeatures | Int8Features:
    """Return the features for the matcher, in memory once; those of a map are not copied."""
    if precision == 'int8':
        return rounded(features, centering.places if centering else lambda some: some)
    dtype = torch.float16 if precision == 'float16' else torch.float32
    if centering is not None:
        return centering.places(features, dtype)
    if dtype == torch.float32:
        return features[:]
    return converted(features, lambda strips: strips, dtype)
