"""
DenseNet161 with the Places365 weights, its layer denseblock4.denselayer10.relu1 (section 1 of the method).

The network is that of Huang, Liu, van der Maaten and Weinberger, "Densely connected convolutional networks",
CVPR 2017, with growth rate 48; the weights are those of Zhou et al., "Places: a 10 million image database
for scene recognition", PAMI 2017.
"""

import re
from typing import ClassVar

import torch
from torch import nn
from torch.nn.functional import avg_pool2d, max_pool2d, relu

from stavpr_ros.features.paper_networks import PublishedNetwork
from stavpr_ros.features.weights import PublishedFile

GROWTH = 48  # channels that a layer adds
FIRST = 96  # channels before the first block
BLOCKS = (6, 12, 36, 24)  # layers of each block
LAST_LAYER = 10  # of the last block: the feature maps are what its first normalization and ReLU make
OLD_NAMES = re.compile(r'(\.denselayer\d+\.(?:norm|conv))\.([12]\.)')  # of files from before torch 0.4


class DenseLayer(nn.Module):
    """Bottleneck of 1 x 1 and 3 x 3, from all maps so far to ``GROWTH`` new ones."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm1 = nn.BatchNorm2d(channels)
        self.conv1 = nn.Conv2d(channels, 4 * GROWTH, 1, bias=False)
        self.norm2 = nn.BatchNorm2d(4 * GROWTH)
        self.conv2 = nn.Conv2d(4 * GROWTH, GROWTH, 3, padding=1, bias=False)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Make the new maps, (n, GROWTH, H, W), of those so far, (n, channels, H, W)."""
        narrow = self.conv1(relu(self.norm1(maps), inplace=True))
        return self.conv2(relu(self.norm2(narrow), inplace=True))


class DenseBlock(nn.ModuleDict):
    """Layers, each of which sees the maps of all before it."""

    def __init__(self, channels: int, layers: int) -> None:
        super().__init__({f'denselayer{i + 1}': DenseLayer(channels + i * GROWTH) for i in range(layers)})

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
        """Shrink the maps. The paper averages after the 1 x 1 convolution: the same, with 4 x the work."""
        return self.conv(avg_pool2d(relu(self.norm(maps), inplace=True), 2))


class DenseNet161(nn.Module):
    """
    All parameters of the network, under the names that they have in the published files.

    :param classes: outputs of the last layer.
    """

    def __init__(self, classes: int = 365) -> None:
        super().__init__()
        features: dict[str, nn.Module] = {
            'conv0': nn.Conv2d(3, FIRST, 7, stride=2, padding=3, bias=False),
            'norm0': nn.BatchNorm2d(FIRST),
        }
        channels = FIRST
        for i, layers in enumerate(BLOCKS, start=1):
            features[f'denseblock{i}'] = DenseBlock(channels, layers)
            channels += layers * GROWTH
            if i < len(BLOCKS):
                features[f'transition{i}'] = Transition(channels)
                channels //= 2
        features['norm5'] = nn.BatchNorm2d(channels)
        self.features = nn.ModuleDict(features)
        self.classifier = nn.Linear(channels, classes)


class UpToDenseLayer10(nn.Module):
    """The part of a DenseNet161 up to ``features.denseblock4.denselayer10.relu1``."""

    def __init__(self, network: DenseNet161) -> None:
        super().__init__()
        features = dict(network.features.items())
        self.conv0, self.norm0 = features['conv0'], features['norm0']
        last = features[f'denseblock{len(BLOCKS)}']
        assert isinstance(last, DenseBlock)
        end = last[f'denselayer{LAST_LAYER}']
        assert isinstance(end, DenseLayer)
        self.norm1 = end.norm1
        for i in range(LAST_LAYER, len(last) + 1):
            del last[f'denselayer{i}']
        stages = [[features[f'denseblock{i}'], features[f'transition{i}']] for i in range(1, len(BLOCKS))]
        self.blocks = nn.Sequential(*(part for stage in stages for part in stage), last)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Turn standardized images, (n, 3, H, W), into maps, (n, 1488, H / 32, W / 32)."""
        first = max_pool2d(relu(self.norm0(self.conv0(images)), inplace=True), 3, stride=2, padding=1)
        return relu(self.norm1(self.blocks(first)), inplace=True)


class DenseNet161Places365(PublishedNetwork):
    """Feature maps of 1488 channels, size / 32 on a side: 7 x 7 at 224."""

    published: ClassVar[PublishedFile] = PublishedFile(
        'http://places2.csail.mit.edu/models_places365/densenet161_places365.pth.tar'
    )

    @staticmethod
    def whole_network() -> nn.Module:
        """Build all of DenseNet161, on torch's current default device."""
        return DenseNet161()

    @staticmethod
    def up_to_layer(network: nn.Module) -> nn.Module:
        """Keep the layers up to the first ReLU of layer 10 in the last block."""
        assert isinstance(network, DenseNet161)
        return UpToDenseLayer10(network)

    @staticmethod
    def current_names(parameters: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Rename ``norm.1`` to ``norm1``, ``conv.2`` to ``conv2`` and so on."""
        return {OLD_NAMES.sub(r'\1\2', key): value for key, value in parameters.items()}
