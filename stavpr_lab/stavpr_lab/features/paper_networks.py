# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The paper's two networks with their published weights (section 1 of the method).

DenseNet161: Huang, Liu, van der Maaten, Weinberger, "Densely connected convolutional networks",
CVPR 2017, growth rate 48, with the Places365 weights of Zhou et al., "Places: a 10 million image
database for scene recognition", PAMI 2017; its layer denseblock4.denselayer10.relu1.

VGG16: configuration D of Simonyan, Zisserman, "Very deep convolutional networks for large-scale
image recognition", ICLR 2015, with torchvision's ImageNet weights; its fourth pooling layer, and
its first fully connected layer fc6.
"""

from collections.abc import Sequence
from dataclasses import replace
import io
import re
from typing import ClassVar

import numpy as np
from stavpr_lab.features import PublishedSettings
from stavpr_lab.features.preprocessing import BatchMaker
from stavpr_lab.features.weights import (
    expected_hash,
    load_parameters,
    published_path,
    PublishedFile,
    read_checkpoint,
)
from stavpr_ros.devices import choose_device
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features.model_files import read_model
import torch
from torch import nn
from torch.nn.functional import avg_pool2d, max_pool2d, relu

PER_PASS = 32  # images that go through a network together: bounds its memory

GROWTH = 48  # channels of a layer of DenseNet161
STEM = 96  # channels before the first block
BLOCKS = (6, 12, 36, 24)  # layers of each block
LAST_LAYER = 10  # of the last block: its first normalization and ReLU give the feature maps
OLD_NAMES = re.compile(r'(\.denselayer\d+\.(?:norm|conv))\.([12]\.)')  # from before torch 0.4

# Channels of the convolutions of VGG16, and the index of the fourth pooling among its layers.
STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
POOL4 = 23


class PublishedNetwork:
    """
    Feature maps of one layer of a network with published weights.

    A subclass names the file and the network: the whole network, with all parameters of the file
    under their names there, and its part up to the layer.
    """

    published: ClassVar[PublishedFile]
    whole_network: ClassVar[type[nn.Module]]

    def __init__(self, settings: PublishedSettings, device: str = 'cpu') -> None:
        self._device = torch.device(choose_device(device))
        path = published_path(settings.model, self.published)
        content, digest = read_model(path, expected_hash(path, self.published), settings.sha256)
        parameters = read_checkpoint(io.BytesIO(content), str(path))
        self.settings = replace(settings, sha256=digest)
        with torch.device('meta'):
            network = self.whole_network()
        load_parameters(network, self.current_names(parameters), str(path))
        half = settings.half and self._device.type == 'cuda'
        dtype = torch.float16 if half else torch.float32
        self._layer = self.up_to_layer(network).eval().to(self._device, dtype)
        self._layer.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._batch = BatchMaker(settings.size, settings.resize, self._device, dtype)

    @staticmethod
    def up_to_layer(network: nn.Module) -> nn.Module:
        """Return the part of the network up to the feature maps."""
        raise NotImplementedError

    @staticmethod
    def current_names(parameters: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Rename the parameters of a file with old names."""
        return parameters

    def feature_maps(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """
        Compute the feature maps of a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size; resized without keeping the aspect.
        :returns: maps (n, C, H, Wf), or vectors (n, D), >= 0, float32.
        :raises UnavailableError: the device has too little memory.
        """
        try:
            with torch.inference_mode():
                parts = [images[i : i + PER_PASS] for i in range(0, len(images), PER_PASS)]
                maps = torch.cat([self._layer(self._batch(part)) for part in parts])
                return maps.float().cpu().numpy()
        except torch.cuda.OutOfMemoryError as error:
            raise UnavailableError(
                f'device {self._device} has too little memory for '
                f'{min(len(images), PER_PASS)} images of size {self.settings.size}: give fewer at '
                'a time, or take half or another device'
            ) from error


class VGG16(nn.Module):
    """All parameters of the network, under their names in torchvision's file."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for stage in STAGES:
            for width in stage:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
                channels = width
            layers.append(nn.MaxPool2d(2))
        self.features = nn.Sequential(*layers)
        self.classifier = nn.Sequential(
            nn.Linear(channels * 7 * 7, 4096),
            nn.ReLU(),
            nn.Dropout(),
            nn.Linear(4096, 4096),
            nn.ReLU(),
            nn.Dropout(),
            nn.Linear(4096, 1000),
        )


class VGG16Pool4(PublishedNetwork):
    """Feature maps of 512 channels, size / 16 on a side: 14 x 14 at 224."""

    whole_network = VGG16
    published = PublishedFile(
        'https://download.pytorch.org/models/vgg16-397923af.pth',
        sha256='397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0',
    )

    @staticmethod
    def up_to_layer(network: nn.Module) -> nn.Module:
        """Keep the layers up to the fourth pooling: 29 of the 528 MB of weights."""
        assert isinstance(network, VGG16)
        return network.features[: POOL4 + 1]


class VGG16Fc6(VGG16Pool4):
    """Vectors of 4096 numbers: the first fully connected layer, after its ReLU."""

    @staticmethod
    def up_to_layer(network: nn.Module) -> nn.Module:
        """Keep the layers up to fc6; maps of other sizes are averaged to 7 x 7 first."""
        features, classifier = network.features, network.classifier
        pool = nn.AdaptiveAvgPool2d(7)
        return nn.Sequential(features, pool, nn.Flatten(), classifier[:2])  # type: ignore


class DenseLayer(nn.Module):
    """Bottleneck of 1 x 1 and 3 x 3, from all maps so far to ``GROWTH`` new ones."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm1 = nn.BatchNorm2d(channels)
        self.conv1 = nn.Conv2d(channels, 4 * GROWTH, 1, bias=False)
        self.norm2 = nn.BatchNorm2d(4 * GROWTH)
        self.conv2 = nn.Conv2d(4 * GROWTH, GROWTH, 3, padding=1, bias=False)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Compute new maps, (n, GROWTH, H, W), from those so far, (n, channels, H, W)."""
        narrow = self.conv1(relu(self.norm1(maps), inplace=True))
        return self.conv2(relu(self.norm2(narrow), inplace=True))


class DenseBlock(nn.ModuleDict):
    """Layers, each with the maps of all layers before it as input."""

    def __init__(self, channels: int, layers: int) -> None:
        widths = [channels + i * GROWTH for i in range(layers)]
        super().__init__({f'denselayer{i}': DenseLayer(w) for i, w in enumerate(widths, start=1)})

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Append each layer's maps, (n, channels + layers * GROWTH, H, W)."""
        for layer in self.values():
            maps = torch.cat([maps, layer(maps)], dim=1)
        return maps


class Transition(nn.Module):
    """Half as many channels, half as wide and high."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(channels)
        self.conv = nn.Conv2d(channels, channels // 2, 1, bias=False)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Shrink the maps. The paper averages after the convolution: equal, with 4 x the work."""
        return self.conv(avg_pool2d(relu(self.norm(maps), inplace=True), 2))


class DenseNet161(nn.Module):
    """All parameters of the network, under their names in the published files."""

    def __init__(self) -> None:
        super().__init__()
        features: dict[str, nn.Module] = {
            'conv0': nn.Conv2d(3, STEM, 7, stride=2, padding=3, bias=False),
            'norm0': nn.BatchNorm2d(STEM),
        }
        channels = STEM
        for i, layers in enumerate(BLOCKS, start=1):
            features[f'denseblock{i}'] = DenseBlock(channels, layers)
            channels += layers * GROWTH
            if i < len(BLOCKS):
                features[f'transition{i}'] = Transition(channels)
                channels //= 2
        features['norm5'] = nn.BatchNorm2d(channels)
        self.features = nn.ModuleDict(features)
        self.classifier = nn.Linear(channels, 365)


class UpToDenseLayer10(nn.Module):
    """The part of a DenseNet161 up to ``features.denseblock4.denselayer10.relu1``."""

    def __init__(self, network: DenseNet161) -> None:
        super().__init__()
        conv0, norm0, *blocks, last, _ = network.features.values()
        assert isinstance(last, DenseBlock)
        end = last[f'denselayer{LAST_LAYER}']
        assert isinstance(end, DenseLayer)
        for i in range(LAST_LAYER, len(last) + 1):
            del last[f'denselayer{i}']
        self.conv0, self.norm0, self.norm1 = conv0, norm0, end.norm1
        self.blocks = nn.Sequential(*blocks, last)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Turn standardized images, (n, 3, H, W), into maps, (n, 1488, H / 32, W / 32)."""
        first = relu(self.norm0(self.conv0(images)), inplace=True)
        first = max_pool2d(first, 3, stride=2, padding=1)
        return relu(self.norm1(self.blocks(first)), inplace=True)


class DenseNet161Places365(PublishedNetwork):
    """Feature maps of 1488 channels, size / 32 on a side: 7 x 7 at 224."""

    whole_network = DenseNet161
    published = PublishedFile(
        'https://places2.csail.mit.edu/models_places365/densenet161_places365.pth.tar'
    )

    @staticmethod
    def up_to_layer(network: nn.Module) -> nn.Module:
        """Keep the layers up to the first ReLU of layer 10 in the last block."""
        assert isinstance(network, DenseNet161)
        return UpToDenseLayer10(network)

    @staticmethod
    def current_names(parameters: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Rename ``norm.1`` to ``norm1``, ``conv.2`` to ``conv2`` and so on."""
        return {OLD_NAMES.sub(r'\1\2', key): value for key, value in parameters.items()}
