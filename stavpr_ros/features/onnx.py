"""
Features of any convolutional network in an ONNX file, read off a named inner layer.

Needs the extra ``onnx`` (packages onnx and onnxruntime). The file is data: weights and operators of the
ONNX standard; nothing in it is executed as Python.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from stavpr_ros.errors import FeatureMismatchError, SettingsError, UnavailableError
from stavpr_ros.features.preprocessing import check_method, resize_square
from stavpr_ros.features.registry import setting


@dataclass(frozen=True)
class OnnxSettings:
    """Settings of the ONNX features; mean and std are per channel, in the units of scale * (0..255)."""

    model: str = setting(help='the ONNX file', identity=False)
    layer: str = setting(help='name of the inner output (tensor) to use, a map of shape (n, C, H, W)')
    size: int = setting(224, help='images are resized to size x size pixels')
    resize: str = setting(
        'bilinear', help='how images are resized: bilinear, or area (averages, no aliasing)'
    )
    channels: str = setting('rgb', help='order of the input channels, rgb or bgr')
    scale: float = setting(1 / 255, help='factor on the pixel values 0..255, before the mean')
    mean: tuple[float, ...] = setting((0.485, 0.456, 0.406), help='subtracted, in the order of the channels')
    std: tuple[float, ...] = setting((0.229, 0.224, 0.225), help='divided by, in the order of the channels')
    sha256: str = setting('', help='expected hash of the file; empty = take the file as it is')

    def __post_init__(self) -> None:
        check_method(self.resize)
        object.__setattr__(self, 'mean', tuple(float(v) for v in self.mean))
        object.__setattr__(self, 'std', tuple(float(v) for v in self.std))
        if self.channels not in ('rgb', 'bgr'):
            raise SettingsError(f"channels = {self.channels!r} must be 'rgb' or 'bgr'")
        if len(self.mean) != 3 or len(self.std) != 3 or not all(self.std):
            raise SettingsError(f'mean {self.mean} and std {self.std} must be three numbers each, std not 0')
        if self.size < 8:
            raise SettingsError(f'size = {self.size} must be at least 8 pixels')


def _import_extra() -> tuple[ModuleType, ModuleType]:
    try:
        import onnx
        import onnxruntime
    except ImportError as error:
        raise UnavailableError(
            f"features 'onnx' need the packages onnx and onnxruntime ({error}): pip install onnx onnxruntime"
        ) from error
    return onnx, onnxruntime


class Onnx:
    """Feature maps of one layer of a network, float32."""

    Settings = OnnxSettings

    def __init__(self, settings: OnnxSettings, device: str = 'cpu') -> None:
        onnx, onnxruntime = _import_extra()
        path = Path(settings.model)
        try:
            content = path.read_bytes()
        except OSError as error:
            raise UnavailableError(f'ONNX model {settings.model!r} cannot be read: {error}') from error
        digest = hashlib.sha256(content).hexdigest()
        if settings.sha256 and settings.sha256 != digest:
            raise FeatureMismatchError(
                f'ONNX model {path} has sha256 {digest[:16]}, the settings ask for {settings.sha256[:16]}: '
                'give the file that the map was built with'
            )
        self.settings = replace(settings, sha256=digest)
        self._device = torch.device(device)
        model = self._with_output(onnx, content)
        providers = ['CPUExecutionProvider']
        if self._device.type == 'cuda' and 'CUDAExecutionProvider' in onnxruntime.get_available_providers():
            providers.insert(0, 'CUDAExecutionProvider')
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        try:
            self._session = onnxruntime.InferenceSession(
                model.SerializeToString(), options, providers=providers
            )
        except Exception as error:  # onnxruntime raises types of its own
            raise UnavailableError(f'{path} cannot be run by onnxruntime: {error}') from error
        self._input = self._session.get_inputs()[0]
        self._dtype = np.float16 if self._input.type == 'tensor(float16)' else np.float32

    def _with_output(self, onnx: ModuleType, content: bytes):  # type: ignore[no-untyped-def]
        """Return the model with the layer as its only output and the batch size left free."""
        try:
            model = onnx.load_model_from_string(content)
            onnx.checker.check_model(model)
        except Exception as error:  # protobuf and the checker raise types of their own
            raise UnavailableError(f'{self.settings.model} is no usable ONNX model: {error}') from error
        names = [name for node in model.graph.node for name in node.output]
        if self.settings.layer not in names:
            shown = ', '.join(names[:60]) + (', ...' if len(names) > 60 else '')
            raise SettingsError(
                f'{self.settings.model} has no layer {self.settings.layer!r}: its layers are {shown}'
            )
        weights = {tensor.name for tensor in model.graph.initializer}
        inputs = [value for value in model.graph.input if value.name not in weights]
        if len(inputs) != 1:
            raise SettingsError(f'{self.settings.model} has {len(inputs)} inputs: expected one, the image')
        inputs[0].type.tensor_type.shape.dim[0].dim_param = 'batch'
        del model.graph.output[:]
        del model.graph.value_info[:]  # they may fix the batch size
        model.graph.output.append(onnx.ValueInfoProto(name=self.settings.layer))
        return model

    def feature_maps(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """
        Describe a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size; resized without keeping the aspect.
        :returns: shape (n, C, H, Wf), float32.
        :raises SettingsError: the network does not take this size, or the layer is no map with four axes.
        """
        batch = np.stack([self._prepare(image) for image in images]).astype(self._dtype)
        try:
            maps = self._session.run([self.settings.layer], {self._input.name: batch})[0]
        except Exception as error:  # onnxruntime raises types of its own
            raise SettingsError(
                f'{self.settings.model} does not take images of size {self.settings.size}: {error}'
            ) from error
        if maps.ndim != 4:
            raise SettingsError(
                f'layer {self.settings.layer!r} has shape {maps.shape}: expected a map (n, C, H, W); '
                'name a layer before the pooling'
            )
        return torch.from_numpy(maps.astype(np.float32)).to(self._device)

    def _prepare(self, image: np.ndarray) -> np.ndarray:
        """Resize, order the channels, scale and shift: (3, size, size), float32."""
        resized = resize_square(image, self.settings.size, self.settings.resize)
        if self.settings.channels == 'bgr':
            resized = resized[:, :, ::-1]
        values: np.ndarray = resized.astype(np.float32) * self.settings.scale
        values = (values - np.array(self.settings.mean, np.float32)) / np.array(self.settings.std, np.float32)
        return values.transpose(2, 0, 1)
