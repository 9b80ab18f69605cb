# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
NetVLAD with its published weights: one vector an image.

Arandjelovic, Gronat, Torii, Pajdla, Sivic, "NetVLAD: CNN architecture for weakly supervised place
recognition", CVPR 2016. VGG16 up to conv5_3 without its ReLU; unit-norm columns x_p of the map;
soft assignment a_k = softmax_k(w_k . x_p + b_k); V_k = sum_p a_k (x_p - c_k); each V_k of unit
norm (intra-normalization), then all together; PCA whitening, and unit norm again.

Two layouts of files are read, recognized by their content; nothing in them is executed:

* MATLAB (.mat) of the authors' networks as structures (uzh-rpg/netvlad_tf_open,
  net_class2struct.m; hloc's as well): kernels (3, 3, in, out), assignment and centers (D, K),
  the centers negated, V flattened with k running fastest; input in 0..255 less the mean in it.
* PyTorch (.pth.tar) of Nanne/pytorch-NetVlad and QVPR/Patch-NetVLAD: assignment and centers
  (K, D), V flattened with d running fastest, whitening WPCA; input standardized as for ImageNet.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import io
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from stavpr_lab.features import NetVladSettings
from stavpr_lab.features.preprocessing import BatchMaker
from stavpr_lab.features.weights import expected_hash, read_checkpoint
from stavpr_ros.devices import choose_device
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.model_files import read_model
from stavpr_ros.features.registry import IMAGENET_MEAN, IMAGENET_STD
import torch
from torch.nn.functional import conv2d, linear, max_pool2d, normalize, relu

STAGES = (2, 2, 3, 3, 3)  # convolutions of VGG16 before each pooling
PER_PASS = 4  # images that go through the network together: bounds its memory


@dataclass(frozen=True)
class NetVladParameters:
    """
    The parameters of one file, float32.

    :param convolutions: kernels (out, in, 3, 3) and biases (out,) of the 13 convolutions.
    :param assignment: w, shape (K, D), and its bias b (K,) or None.
    :param centers: c, shape (K, D).
    :param k_fastest: V is flattened as (D, K), not (K, D).
    :param whitening: matrix (out, K * D) and bias (out,), or None.
    :param scale, mean, std: preparation of the input, see :class:`BatchMaker`.
    """

    convolutions: list[tuple[torch.Tensor, torch.Tensor]]
    assignment: tuple[torch.Tensor, torch.Tensor | None]
    centers: torch.Tensor
    k_fastest: bool
    whitening: tuple[torch.Tensor, torch.Tensor] | None
    scale: float
    mean: tuple[float, ...]
    std: tuple[float, ...]

    def tensors(self) -> Iterator[torch.Tensor]:
        """Return all of them."""
        pairs = [*self.convolutions, self.assignment, self.whitening or ()]
        yield from (value for pair in pairs for value in pair if value is not None)
        yield self.centers


class NetVlad:
    """Vectors of 4096 numbers, or of K * D = 32768 without whitening."""

    def __init__(self, settings: NetVladSettings, device: str = 'cpu') -> None:
        path = Path(settings.model)
        content, digest = read_model(path, expected_hash(path), settings.sha256)
        model = read_parameters(io.BytesIO(content), str(path))
        self.settings = replace(settings, sha256=digest)
        if settings.whitening and model.whitening is None:
            raise SettingsError(
                f'{path} has no PCA whitening: set whitening to false for vectors of '
                f'{model.centers.numel()} dimensions, or take a file with it'
            )
        self._device = torch.device(choose_device(device))
        self._convolutions = [
            tuple(value.to(self._device) for value in pair) for pair in model.convolutions
        ]
        weight, bias = model.assignment
        self._assignment = weight.to(self._device), None if bias is None else bias.to(self._device)
        self._centers = model.centers.to(self._device)
        self._k_fastest = model.k_fastest
        whitening = model.whitening if settings.whitening else None
        self._whitening = (
            None if whitening is None else [part.to(self._device) for part in whitening]
        )
        standard: dict[str, Any] = {'scale': model.scale, 'mean': model.mean, 'std': model.std}
        self._batch = BatchMaker(settings.size, settings.resize, self._device, **standard)

    def feature_maps(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """
        Compute the vectors of a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size; resized without keeping the aspect.
        :returns: shape (n, D), float32, of unit norm.
        """
        with torch.inference_mode():
            parts = [images[i : i + PER_PASS] for i in range(0, len(images), PER_PASS)]
            return torch.cat([self._vectors(self._batch(part)) for part in parts]).cpu().numpy()

    def _vectors(self, batch: torch.Tensor) -> torch.Tensor:
        columns = normalize(self._conv5_3(batch).flatten(2), dim=1)  # (n, D, P)
        weight, bias = self._assignment
        shares = linear(columns.mT, weight, bias).softmax(dim=2)  # (n, P, K)
        sums = torch.bmm(shares.mT, columns.mT)  # (n, K, D)
        residuals = normalize(sums - shares.sum(dim=1)[:, :, None] * self._centers, dim=2)
        ordered = residuals.mT if self._k_fastest else residuals
        vectors = normalize(ordered.flatten(1), dim=1)
        if self._whitening is None:
            return vectors
        return normalize(linear(vectors, *self._whitening), dim=1)

    def _conv5_3(self, maps: torch.Tensor) -> torch.Tensor:
        """Return the maps of conv5_3, before its ReLU, shape (n, D, H, W)."""
        last = len(self._convolutions) - 1
        ends = set(np.cumsum(STAGES) - 1)
        for i, (kernel, bias) in enumerate(self._convolutions):
            maps = conv2d(maps, kernel, bias, padding=1)
            if i < last:
                maps = relu(maps, inplace=True)
                maps = max_pool2d(maps, 2) if i in ends else maps
        return maps


def read_parameters(file: BinaryIO, name: str) -> NetVladParameters:
    """
    Read a file of published weights.

    :param name: name of the file, for errors.
    :raises UnavailableError: it is no such file, or damaged.
    """
    matlab = file.read(6) == b'MATLAB'
    file.seek(0)
    model = _from_matlab(file, name) if matlab else _from_torch(file, name)
    _require_fitting(model, name)
    return model


def _require_fitting(model: NetVladParameters, name: str) -> None:
    wrong = f'{name} is no file of weights of NetVLAD'
    K, D = model.centers.shape
    channels = 3
    for i, (kernel, bias) in enumerate(model.convolutions):
        expected = (len(kernel), channels, 3, 3)
        if tuple(kernel.shape) != expected or len(bias) != len(kernel):
            raise UnavailableError(
                f'{wrong}: convolution {i} has shape {tuple(kernel.shape)}, expected {expected}'
            )
        channels = len(kernel)
    if channels != D or tuple(model.assignment[0].shape) != (K, D):
        raise UnavailableError(
            f'{wrong}: {channels} channels, assignment {tuple(model.assignment[0].shape)}, '
            f'centers {(K, D)}: expected (K, D) with D channels'
        )
    if model.whitening is not None and model.whitening[0].shape[1] != K * D:
        raise UnavailableError(
            f'{wrong}: its whitening takes {model.whitening[0].shape[1]} numbers, expected {K * D}'
        )
    if not all(bool(torch.isfinite(value).all()) for value in model.tensors()):
        raise UnavailableError(f'{name} is damaged: it contains NaN or infinite numbers')


def _from_matlab(file: BinaryIO, name: str) -> NetVladParameters:
    from scipy.io import loadmat

    try:
        content = loadmat(
            io.BytesIO(file.read()), struct_as_record=False, squeeze_me=True, variable_names='net'
        )
        net = content['net']
        layers = [
            [_tensor(array) for array in layer.weights]
            for layer in net.layers
            if len(getattr(layer, 'weights', ()))
        ]
        mean = np.asarray(net.meta.normalization.averageImage, np.float64).reshape(-1, 3)[0]
        convolutions, (assignment, *bias, centers), *rest = layers[:13], *layers[13:]
        if len(convolutions) != 13 or len(rest) > 1:
            raise ValueError(f'{len(layers)} layers with weights, expected 14 or 15')
    except Exception as error:  # damaged files raise errors of any type
        raise UnavailableError(
            f'{name} cannot be read as the MATLAB file of a NetVLAD: {error}; expected a '
            'structure net with the layers of VGG16, one of VLAD and one of whitening (classes '
            'must have been made structures by net_class2struct.m)'
        ) from error
    return NetVladParameters(
        convolutions=[(kernel.permute(3, 2, 0, 1), bias) for kernel, bias in convolutions],
        assignment=(assignment.T, bias[0] if bias else None),
        centers=-centers.T,
        k_fastest=True,
        whitening=(rest[0][0].T, rest[0][1]) if rest else None,
        scale=1.0,
        mean=tuple(float(value) for value in mean),
        std=(1.0, 1.0, 1.0),
    )


def _tensor(array: Any) -> torch.Tensor:
    """Return an array of MATLAB, which is in Fortran's order, as float32."""
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def _from_torch(file: BinaryIO, name: str) -> NetVladParameters:
    parameters = {
        key.replace('.module.', '.'): value.float()
        for key, value in read_checkpoint(file, name).items()
    }
    convolutions: list[tuple[torch.Tensor, torch.Tensor]] = []
    index = 0
    try:
        for stage in STAGES:
            for _ in range(stage):
                kernel = parameters[f'encoder.{index}.weight']
                convolutions.append((kernel, parameters[f'encoder.{index}.bias']))
                index += 2  # a ReLU is between
            index += 1
        assignment, centers = parameters['pool.conv.weight'], parameters['pool.centroids']
        whitening = None
        if 'WPCA.0.weight' in parameters:
            whitening = parameters['WPCA.0.weight'].flatten(1), parameters['WPCA.0.bias']
    except KeyError as error:
        raise UnavailableError(
            f'{name} is no file of weights of NetVLAD: it lacks {error}; it has '
            f'{", ".join(sorted(parameters)[:5])}, ...'
        ) from error
    return NetVladParameters(
        convolutions,
        (assignment.flatten(1), parameters.get('pool.conv.bias')),
        centers,
        False,
        whitening,
        1 / 255,
        IMAGENET_MEAN,
        IMAGENET_STD,
    )
