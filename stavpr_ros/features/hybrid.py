# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Gradient and learned features together, strip by strip: they fail at different places.

With the unit-norm strips g_i, e_i of both kinds, and their shares a_i, b_i of the image's norm,
strip i is w_i (g_i, e_i) / sqrt(2), w_i^2 = (a_i^2 + b_i^2) / 2: the cosine of two strips is the
mean of both cosines. ``auto`` takes it where its network is.
"""

from collections.abc import Sequence

import numpy as np
from stavpr_ros.features.efficientnet_lite import EfficientNetLite1
from stavpr_ros.features.extractor import cut_strips, normalize, STRIPS
from stavpr_ros.features.gradient import Gradient
from stavpr_ros.features.registry import GradientSettings, HybridSettings

GRADIENT = GradientSettings(224, 'area', 16, 8, signed=True, logarithm=True)


class Hybrid:
    """
    Feature maps (n, 1008, 1, 7): a column is a strip.

    :param device: device of the learned features.
    :raises UnavailableError: as for features ``efficientnet_lite1``.
    """

    def __init__(self, settings: HybridSettings, device: str = 'cpu') -> None:
        self._learned = EfficientNetLite1(settings, device)
        self._gradient = Gradient(GRADIENT)
        self.settings = self._learned.settings

    def feature_maps(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """
        Compute the feature maps of a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size.
        :returns: shape (n, 1008, 1, 7), float32.
        """
        maps = (kind.feature_maps(images) for kind in (self._gradient, self._learned))
        (g, a), (e, b) = (normalize(cut_strips(kind_maps, STRIPS)) for kind_maps in maps)
        strips = np.concatenate([g, e], axis=2) * (np.sqrt(a**2 + b**2) / 2)[:, :, None]
        return strips.transpose(1, 2, 0)[:, :, None]
