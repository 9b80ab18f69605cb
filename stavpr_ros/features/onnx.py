# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Features of any network in an ONNX file, the output of a named inner layer.

Requires the extra ``onnx`` (packages onnx and onnxruntime). The file is data: weights and
operators of the ONNX standard; nothing in it is executed as Python.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.export import BATCH
from stavpr_ros.features.extractor import resize_square
from stavpr_ros.features.outputs import as_maps, as_vectors
from stavpr_ros.features.registry import OnnxSettings
from stavpr_ros.features.weights import read_model
import torch


def _import_extra() -> tuple[ModuleType, ModuleType]:
    try:
        import onnx
        import onnxruntime
    except ImportError as error:
        raise UnavailableError(
            f"features 'onnx' need the packages onnx and onnxruntime ({error}): pip install onnx "
            'onnxruntime'
        ) from error
    return onnx, onnxruntime


class Onnx:
    """Feature maps, or vectors, of one layer of a network, float32."""

    def __init__(self, settings: OnnxSettings, device: str = 'cpu') -> None:
        onnx, onnxruntime = _import_extra()
        file, digest = read_model(Path(settings.model), required=settings.sha256)
        with file:
            content = file.read()
        self.settings = replace(settings, sha256=digest)
        self._device = torch.device(device)
        self._layers = [layer for layer in (settings.layer, settings.vector) if layer]
        model = self._with_outputs(onnx, content)
        properties = {row.key: row.value for row in model.metadata_props}
        self._one_by_one = properties.get(BATCH) == '1'
        providers = ['CPUExecutionProvider']
        on_gpu = self._device.type == 'cuda'
        if on_gpu and 'CUDAExecutionProvider' in onnxruntime.get_available_providers():
            providers.insert(0, 'CUDAExecutionProvider')
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        try:
            self._session = onnxruntime.InferenceSession(
                model.SerializeToString(), options, providers=providers
            )
        except Exception as error:  # onnxruntime has exception types of its own
            raise UnavailableError(
                f'{settings.model} cannot be run by onnxruntime: {error}'
            ) from error
        self._input = self._session.get_inputs()[0]
        self._dtype = np.float16 if self._input.type == 'tensor(float16)' else np.float32

    def _with_outputs(self, onnx: ModuleType, content: bytes):  # type: ignore[no-untyped-def]
        """Return the model with the layers as its only outputs and a variable batch size."""
        name = self.settings.model
        try:
            model = onnx.load_model_from_string(content)
            onnx.checker.check_model(model)
        except Exception as error:  # protobuf and the checker have exception types of their own
            raise UnavailableError(f'{name} is no usable ONNX model: {error}') from error
        layers = [output for node in model.graph.node for output in node.output]
        for layer in self._layers:
            if layer in layers:
                continue
            shown = ', '.join(layers[:60]) + (', ...' if len(layers) > 60 else '')
            raise SettingsError(f'{name} has no layer {layer!r}: its layers are {shown}')
        weights = {tensor.name for tensor in model.graph.initializer}
        inputs = [value for value in model.graph.input if value.name not in weights]
        if len(inputs) != 1:
            raise SettingsError(f'{name} has {len(inputs)} inputs: expected one, the image')
        inputs[0].type.tensor_type.shape.dim[0].dim_param = 'batch'
        del model.graph.output[:]
        del model.graph.value_info[:]  # it may fix the batch size
        for layer in self._layers:
            model.graph.output.append(onnx.ValueInfoProto(name=layer))
        return model

    def feature_maps(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """
        Compute the feature maps of a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size; resized without keeping the aspect.
        :returns: maps (n, C, H, Wf) or vectors (n, D), float32.
        :raises SettingsError: the network rejects this size, or the layer is neither maps nor
            tokens nor vectors.
        """
        return self._maps(self._run(images)[0])

    def maps_and_vectors(self, images: Sequence[np.ndarray]) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Compute feature maps, see :meth:`feature_maps`, and the vectors (n, D) of layer ``vector``.

        :raises SettingsError: likewise; that layer is no vector.
        """
        maps, vectors = self._run(images)
        name = f'layer {self.settings.vector!r} of {self.settings.model}'
        return self._maps(maps), as_vectors(vectors, len(images), name)

    def _maps(self, output: torch.Tensor) -> torch.Tensor:
        name = f'layer {self.settings.layer!r} of {self.settings.model}'
        return as_maps(output, len(output), self.settings.prefix_tokens, name)

    def _run(self, images: Sequence[np.ndarray]) -> list[torch.Tensor]:
        """Return the outputs of the layers for a batch."""
        if self._one_by_one and len(images) > 1:
            single = [self._run([image]) for image in images]
            return [torch.cat(outputs) for outputs in zip(*single, strict=True)]
        batch = np.stack([self._prepare(image) for image in images]).astype(self._dtype)
        try:
            outputs = self._session.run(self._layers, {self._input.name: batch})
        except Exception as error:  # onnxruntime has exception types of its own
            raise SettingsError(
                f'{self.settings.model} rejects images of size {self.settings.size}: {error}'
            ) from error
        for layer, output in zip(self._layers, outputs, strict=True):
            if not np.issubdtype(output.dtype, np.floating):
                raise SettingsError(
                    f'layer {layer!r} is {output.dtype}, quantized numbers: name the output of '
                    'its DequantizeLinear'
                )
        return [torch.from_numpy(o.astype(np.float32)).to(self._device) for o in outputs]

    def _prepare(self, image: np.ndarray) -> np.ndarray:
        """Resize, order the channels, scale and shift: (3, size, size), float32."""
        settings = self.settings
        resized = resize_square(image, settings.size, settings.resize)
        if settings.channels == 'bgr':
            resized = resized[:, :, ::-1]
        values: np.ndarray = resized.astype(np.float32) * settings.scale
        mean, std = (np.array(numbers, np.float32) for numbers in (settings.mean, settings.std))
        return ((values - mean) / std).transpose(2, 0, 1)
