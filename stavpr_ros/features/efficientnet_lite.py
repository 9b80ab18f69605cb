# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Learned features: EfficientNet-Lite1 up to block 14, trained on ImageNet; Apache-2.0.

A map has 112 channels and 7 x 7 cells, each the mean of 2 x 2 cells of the block, so that 7 strips
have 784 numbers each. ``stavpr weights efficientnet_lite1`` makes the ONNX file
once, on any machine with torch; a robot needs that file and onnxruntime. Requires the extra
``learned``.
"""

from dataclasses import replace
from pathlib import Path

from stavpr_ros.errors import UnavailableError
from stavpr_ros.features.model_files import cache_folder, models_folder
from stavpr_ros.features.onnx import Onnx
from stavpr_ros.features.registry import CACHED, EfficientNetSettings, OnnxSettings

FILE = 'efficientnet_lite1.onnx'
COMMAND = 'stavpr weights efficientnet_lite1'
INPUT, MAP = 'image', 'map'  # names in the file
POOLED = 2  # cells of the block, whose mean is a cell of the map, and as many rows
MEAN, STD = (127.0,) * 3, (128.0,) * 3  # of the training, for values 0..255


class EfficientNetLite1:
    """
    Feature maps (n, 112, 7, 7), by :class:`stavpr_ros.features.onnx.Onnx`.

    :param device: as for features ``onnx``.
    :raises UnavailableError: the file or onnxruntime is not there.
    """

    def __init__(self, settings: EfficientNetSettings, device: str = 'cpu') -> None:
        path = Path(settings.model) if settings.model != CACHED else find_file()
        onnx = OnnxSettings(
            model=str(path),
            layer=MAP,
            size=settings.size,
            resize=settings.resize,
            sha256=settings.sha256,
            scale=1.0,
            mean=MEAN,
            std=STD,
        )
        network = Onnx(onnx, device)
        self.feature_maps = network.feature_maps
        self.settings = replace(settings, sha256=network.settings.sha256)


def recommendation(kind: str) -> str:
    """Return a sentence for users of gradient who have the file of the network, '' = none."""
    if kind != 'gradient':
        return ''
    try:
        path = find_file()
    except UnavailableError:
        return ''
    return (
        f'recommended, since {path} is there: a map with features hybrid, with min_probability '
        '0.9; more matches in other light and seasons, as precise on the route as gradient; more '
        'wrong ones between floors that look alike'
    )


def find_file() -> Path:
    """
    Return the file of the network: in the models folder, or in the cache, where it is made.

    :raises UnavailableError: it is in neither.
    """
    models, cache = (folder / FILE for folder in (models_folder(), cache_folder()))
    for path in (models, cache):
        if path.is_file():
            return path
    raise UnavailableError(
        f'there is no {cache}: `{COMMAND}` makes it, with the extra learned; or copy it from a '
        f'machine that has it to {models}, or give its path'
    )
