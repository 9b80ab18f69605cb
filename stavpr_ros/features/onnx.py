# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Features of any network in an ONNX file, the output of a named inner layer.

Requires the extra ``onnx`` (packages onnx and onnxruntime; onnxruntime-gpu for a GPU); a
:class:`Network` whose only output is the layer needs onnxruntime alone. The file is data: weights
and operators of the ONNX standard; nothing in it is executed as Python.
"""

from collections.abc import Sequence
from dataclasses import replace
import logging
import math
from pathlib import Path
import time
from types import ModuleType
from typing import Any

import numpy as np
from stavpr_ros.devices import choose_device
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.extractor import resize_square, TEST_SIDE
from stavpr_ros.features.model_files import read_model
from stavpr_ros.features.registry import OnnxSettings
from stavpr_ros.threads import thread_limit

FLOAT, FLOAT16 = 1, 10  # as ONNX numbers them
BATCH = 'stavpr_batch'  # property of a file: '1' = the images of a batch influence each other
TOLERANCE = 1e-3  # largest difference between computations of one network, over the largest value
ON_GPU = ('CUDAExecutionProvider', 'TensorrtExecutionProvider')  # the first that is offered
ON_CPU = 'CPUExecutionProvider'
FAST = 0.02  # s of an image on one thread, up to which a network gets no more
F = np.float32
_log = logging.getLogger(__name__)


def import_onnx() -> tuple[ModuleType, ModuleType]:
    """
    Return the modules onnx and onnxruntime.

    :raises UnavailableError: they are not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise UnavailableError(
            f'networks in ONNX files need the packages onnx and onnxruntime ({error}): pip '
            'install onnx onnxruntime'
        ) from error
    return onnx, import_onnxruntime()


def import_onnxruntime() -> ModuleType:
    """
    Return the module onnxruntime.

    :raises UnavailableError: it is not installed.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise UnavailableError(
            f'networks need the package onnxruntime ({error}): pip install onnxruntime'
        ) from error
    return onnxruntime


class Network:
    """
    Feature maps, or vectors, of a network, float32.

    It computes on one thread if an image takes at most 20 ms there, else on as many as the limit
    of threads allows; they never wait by spinning.

    :param settings: how images are prepared; ``layer`` is an output of the network.
    :param content: the ONNX file; its first dimension is of any size.
    :param device: ``cuda`` computes with onnxruntime's provider of CUDA or TensorRT; ``auto`` logs
        whether it takes one of them, where torch has a GPU.
    :raises UnavailableError: onnxruntime is not installed or cannot run the network, or device
        ``cuda`` has no provider.
    """

    _one_by_one: bool | None = None  # whether images go through alone; None = not known yet

    def __init__(self, settings: OnnxSettings, content: bytes, device: str = 'cpu') -> None:
        self.settings = settings
        self._device = choose_device(device)
        self._session = self._start(content, 1 if self._device == 'cpu' else thread_limit())
        if self._device == 'cuda':
            self._check_provider(device)
        self._input = self._session.get_inputs()[0]
        self._dtype = np.float16 if self._input.type == 'tensor(float16)' else np.float32
        mean, std = (np.array(numbers, np.float32) for numbers in (settings.mean, settings.std))
        self._mean, self._std = mean[:, None, None], std[:, None, None]
        if self._device == 'cpu' and thread_limit() != 1 and not self._is_fast():
            self._session = self._start(content, thread_limit())

    def _start(self, content: bytes, threads: int) -> Any:
        """Return a session; threads: 0 = as many as there are cores."""
        onnxruntime = import_onnxruntime()
        providers = onnxruntime.get_available_providers()
        gpu = [name for name in ON_GPU if name in providers][: self._device == 'cuda']
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.add_session_config_entry('session.intra_op.allow_spinning', '0')
        options.log_severity_level = 4  # errors are raised
        try:
            return onnxruntime.InferenceSession(content, options, providers=[*gpu, ON_CPU])
        except Exception as error:  # onnxruntime has exception types of its own
            raise UnavailableError(
                f'{self.settings.model} cannot be run by onnxruntime: {error}'
            ) from error

    def _is_fast(self) -> bool:
        """Return whether one thread computes an image in FAST, at the first try or the next."""
        image = np.zeros((TEST_SIDE, TEST_SIDE, 3), np.uint8)
        for _ in range(4):
            start = time.thread_time()
            try:
                self._run_batch([image])
            except SettingsError:  # reported for the first image
                return True
            if (seconds := time.thread_time() - start) <= FAST:
                return True
            if seconds > 5 * FAST:
                break
        return False

    def _check_provider(self, device: str) -> None:
        """Reject a session on the CPU if ``cuda`` was requested; else log where it computes."""
        provider = self._session.get_providers()[0]  # onnxruntime leaves out what it cannot load
        if provider in ON_GPU:
            _log.info('features onnx: %s', provider)
            return
        reason = (
            "onnxruntime computes features 'onnx' on the CPU: its providers of CUDA and TensorRT "
            'are not installed or cannot be loaded; pip install onnxruntime-gpu instead of '
            'onnxruntime'
        )
        if device == 'cuda':
            raise UnavailableError(f"device 'cuda': {reason}, or take 'cpu' or 'auto'")
        _log.warning('device auto: %s', reason)

    def feature_maps(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """
        Compute the feature maps of a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size; resized without keeping the aspect.
        :returns: maps (n, C, H, Wf) or vectors (n, D), float32.
        :raises SettingsError: the network rejects this size, or the layer is neither maps nor
            tokens nor vectors.
        """
        name = f'layer {self.settings.layer!r} of {self.settings.model}'
        return as_maps(self._run(images), len(images), self.settings.prefix_tokens, name)

    def _run(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Return the output of the layer for images, in a batch if that changes nothing."""
        if len(images) == 1:
            return self._run_batch(images)
        if self._one_by_one is None:
            self._one_by_one = not self._runs_batches()
        if not self._one_by_one:
            return self._run_batch(images)
        return np.concatenate([self._run_batch([image]) for image in images])

    def _runs_batches(self) -> bool:
        """Return whether two images in a batch have the output that each has alone."""
        bright = np.random.default_rng(0).integers(0, 256, (TEST_SIDE, TEST_SIDE, 3), np.uint8)
        two = [bright, bright // 8]
        alone = np.concatenate([self._run_batch([image]) for image in two])
        try:
            both = self._run_batch(two)
        except SettingsError:  # a batch of one is written into the network
            return False
        if alone.shape != both.shape:
            return False
        return bool(abs(alone - both).max() <= TOLERANCE * abs(alone).max())

    def _run_batch(self, images: Sequence[np.ndarray]) -> np.ndarray:
        size = self.settings.size
        batch = np.empty((len(images), 3, size, size), self._dtype)
        for image, tensor in zip(images, batch, strict=True):
            self._prepare(image, tensor)
        try:
            (output,) = self._session.run([self.settings.layer], {self._input.name: batch})
        except Exception as error:  # onnxruntime has exception types of its own
            raise SettingsError(
                f'{self.settings.model} rejects images of size {self.settings.size}: {error}'
            ) from error
        if not np.issubdtype(output.dtype, np.floating):
            raise SettingsError(
                f'layer {self.settings.layer!r} is {output.dtype}, expected float numbers: of the '
                'quantized numbers, name the output of their DequantizeLinear'
            )
        if output.shape[:1] != (len(images),):
            raise SettingsError(
                f'layer {self.settings.layer!r} of {self.settings.model} returns {output.shape} '
                f'for {len(images)} images: expected as many rows; name another layer'
            )
        return output.astype(np.float32, copy=False)

    def _prepare(self, image: np.ndarray, tensor: np.ndarray) -> None:
        """Resize, order the channels, scale and shift: (3, size, size), written."""
        settings = self.settings
        resized = resize_square(image, settings.size, settings.resize)
        if settings.channels == 'bgr':
            resized = resized[:, :, ::-1]
        values = np.multiply(resized.transpose(2, 0, 1), F(settings.scale), dtype=np.float32)
        values -= self._mean
        np.divide(values, self._std, out=tensor, casting='same_kind')


class Onnx(Network):
    """
    Feature maps, or vectors, of one layer of a network in a file, float32.

    :param device: as for :class:`Network`.
    :raises UnavailableError: the packages are not installed, the file cannot be read or run, or
        device ``cuda`` has no provider.
    :raises SettingsError: the file has another input, or no such layer.
    """

    def __init__(self, settings: OnnxSettings, device: str = 'cpu') -> None:
        onnx, _ = import_onnx()
        content, digest = read_model(Path(settings.model), map_hash=settings.sha256)
        self.settings = replace(settings, sha256=digest)
        model = self._with_output(onnx, content)
        properties = {row.key: row.value for row in model.metadata_props}
        super().__init__(self.settings, model.SerializeToString(), device)
        if properties.get(BATCH) == '1':
            self._one_by_one = True

    def _with_output(self, onnx: ModuleType, content: bytes):  # type: ignore[no-untyped-def]
        """Return the model with the layer as its only output and a variable batch size."""
        name, layer = self.settings.model, self.settings.layer
        try:
            model = onnx.load_model_from_string(content)
            if any(tensor.external_data for tensor in model.graph.initializer):
                raise ValueError('weights are in other files: save it as one, onnx.save')
            onnx.checker.check_model(model)
        except Exception as error:  # protobuf and the checker have exception types of their own
            raise UnavailableError(f'{name} is no usable ONNX model: {error}') from error
        layers = [output for node in model.graph.node for output in node.output]
        if layer not in layers:
            outputs = [value.name for value in model.graph.output]
            names = outputs + [layer_name for layer_name in layers if layer_name not in outputs]
            text = ', '.join(names[:60]) + (', ...' if len(names) > 60 else '')
            raise SettingsError(f'{name} has no layer {layer!r}: its layers are {text}')
        weights = {tensor.name for tensor in model.graph.initializer}
        inputs = [value for value in model.graph.input if value.name not in weights]
        if len(inputs) != 1:
            raise SettingsError(f'{name} has {len(inputs)} inputs: expected one, the image')
        self._require_images(inputs[0])
        inputs[0].type.tensor_type.shape.dim[0].dim_param = 'batch'
        _prune(model.graph, layer)
        del model.graph.output[:]
        del model.graph.value_info[:]  # it may fix the batch size
        model.graph.output.append(onnx.ValueInfoProto(name=layer))
        return model

    def _require_images(self, value: Any) -> None:
        """Reject a network whose input is no batch of images of the set size."""
        name, size, tensor = self.settings.model, self.settings.size, value.type.tensor_type
        if tensor.elem_type not in (FLOAT, FLOAT16):
            raise SettingsError(
                f'{name}: input {value.name!r} is of ONNX type {tensor.elem_type}, expected '
                f'{FLOAT} (float32) or {FLOAT16} (float16): export it without its conversion'
            )
        shape = [dim.dim_value for dim in tensor.shape.dim]  # 0 = any
        image = (3, size, size)
        if len(shape) == 4 and all(a in (0, b) for a, b in zip(shape[1:], image, strict=True)):
            return
        square = len(shape) == 4 and shape[1] in (0, 3) and shape[2] == shape[3]
        raise SettingsError(
            f'{name} takes inputs of shape {tuple(shape)}, 0 = any, not (n, 3, {size}, {size}): '
            + (f'set size = {shape[2]}' if square else 'export it for square RGB images')
        )


def _prune(graph: Any, layer: str) -> None:
    """Remove the nodes that a layer does not depend on: onnxruntime would compute them as well."""
    names, nodes = {layer}, []
    for node in reversed(graph.node):
        if names.intersection(node.output):
            names |= _inputs(node)
            nodes.append(node)
    del graph.node[:]
    graph.node.extend(reversed(nodes))


def _inputs(node: Any) -> set[str]:
    """Return the names that a node takes, also those within its branches and loops."""
    graphs = [attribute.g for attribute in node.attribute if attribute.HasField('g')]
    return set(node.input).union(*(_inputs(inner) for graph in graphs for inner in graph.node))


def as_maps(output: Any, images: int, prefix_tokens: int, name: str) -> Any:
    """
    Return what a network computes for a batch as feature maps or vectors.

    :param output: maps (n, C, H, Wf), vectors (n, D) or (n, D, 1, 1), or the tokens of a vision
        transformer (n, T, C), of square images; a NumPy array or a tensor.
    :param images: number n of images.
    :param prefix_tokens: leading tokens that are no patches.
    :param name: name of the layer, for errors.
    :returns: maps or vectors, an array or a tensor as ``output``.
    :raises SettingsError: another shape or type; tokens that are no square.
    """
    shape = tuple(getattr(output, 'shape', ()))
    if len(shape) not in (2, 3, 4) or shape[0] != images or 0 in shape:
        form = shape if shape else f'type {type(output).__name__}'
        raise SettingsError(
            f'{name} returns {form} for {images} images: expected maps (n, C, H, W), tokens '
            '(n, T, C) or vectors (n, D); name another layer'
        )
    if shape[2:] == (1, 1):  # result of a pooling over the whole map
        return output[:, :, 0, 0]
    if len(shape) != 3:
        return output
    n, T, C = shape
    side = math.isqrt(max(T - prefix_tokens, 0))
    if side < 1 or side**2 != T - prefix_tokens:
        largest = math.isqrt(T)
        raise SettingsError(
            f'{name} returns {T} tokens, {T - prefix_tokens} without the first {prefix_tokens}: '
            f'expected those of a square; prefix_tokens = {T - largest**2} leaves {largest} x '
            f'{largest}'
        )
    return output[:, prefix_tokens:].swapaxes(1, 2).reshape(n, C, side, side)
