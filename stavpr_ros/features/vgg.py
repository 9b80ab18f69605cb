"""
VGG16 with torchvision's ImageNet weights, its fourth pooling layer (section 1 of the method).

The network is configuration D of Simonyan and Zisserman, "Very deep convolutional networks for large-scale
image recognition", ICLR 2015.
"""

from typing import ClassVar

from torch import nn

from stavpr_ros.features.paper_networks import PublishedNetwork
from stavpr_ros.features.weights import PublishedFile

STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))  # convolutions' channels
POOL4 = 23  # its index among the layers of `features`; the file counts them so


class VGG16(nn.Module):
    """
    All parameters of the network, under the names that they have in torchvision's file.

    :param classes: outputs of the last layer.
    """

    def __init__(self, classes: int = 1000) -> None:
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
            nn.Linear(4096, classes),
        )

    def pool4(self) -> nn.Sequential:
        """Return the layers up to and with the fourth pooling."""
        return nn.Sequential(*list(self.features)[: POOL4 + 1])


class VGG16Pool4(PublishedNetwork):
    """Feature maps of 512 channels, size / 16 on a side: 14 x 14 at 224."""

    published: ClassVar[PublishedFile] = PublishedFile(
        'https://download.pytorch.org/models/vgg16-397923af.pth', sha256='397923af'
    )

    @staticmethod
    def whole_network() -> nn.Module:
        """Build all of VGG16, on torch's current default device."""
        return VGG16()

    @staticmethod
    def up_to_layer(network: nn.Module) -> nn.Module:
        """Keep the layers up to the fourth pooling: 29 of the 528 MB of weights."""
        assert isinstance(network, VGG16)
        return network.pool4()
