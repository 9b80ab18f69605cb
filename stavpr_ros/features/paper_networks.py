"""What the networks with published weights have in common: settings, loading, batches, half precision."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import nn

from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.batch import BatchMaker
from stavpr_ros.features.checkpoint import load_parameters, read_checkpoint
from stavpr_ros.features.preprocessing import check_method
from stavpr_ros.features.registry import setting
from stavpr_ros.features.weights import (
    CACHED,
    DOWNLOAD,
    PublishedFile,
    find_weights,
    open_weights,
    promised_hash,
)

PER_PASS = 32  # images that go through a network together, which bounds its memory


@dataclass(frozen=True)
class PublishedSettings:
    """Settings of a network with published weights; it takes RGB with ImageNet's mean and deviation."""

    model: str = setting(
        CACHED,
        help="file of the weights; 'download' = the published one, downloaded unless it is in the cache; "
        "'cached' = the published one from the cache",
        identity=False,
    )
    size: int = setting(224, help='images are resized to size x size pixels')
    resize: str = setting(
        'bilinear', help='how images are resized: bilinear, or area (averages, no aliasing)'
    )
    half: bool = setting(
        False, help='float16 on a GPU: faster, hardly other features; no change on a CPU', identity=False
    )
    sha256: str = setting('', help='expected hash of the file; empty = take the file as it is')

    def __post_init__(self) -> None:
        check_method(self.resize)
        check_hash(self.sha256)
        if self.size < 32:
            raise SettingsError(f'size = {self.size} must be at least 32 pixels')


def check_hash(sha256: str) -> None:
    """
    Refuse what cannot be a sha256.

    :raises SettingsError: not empty and not 64 hexadecimal digits, lower case.
    """
    if sha256 and (len(sha256) != 64 or set(sha256) - set('0123456789abcdef')):
        raise SettingsError(f'sha256 = {sha256!r} must be empty or 64 digits 0-9 a-f')


class PublishedNetwork(ABC):
    """
    Feature maps of one layer of a network with published weights.

    A network is one subclass: its file, and how it is built.
    """

    Settings = PublishedSettings
    published: ClassVar[PublishedFile]

    def __init__(self, settings: PublishedSettings, device: str = 'cpu') -> None:
        self._device = torch.device(device)
        path = find_weights(settings.model, self.published, settings.sha256)
        file, digest = open_weights(path, promised_hash(path, self.published), settings.sha256)
        with file:
            parameters = read_checkpoint(file, str(path))
        # A map that was made with a downloaded file finds it in any cache, but downloads nothing by itself.
        model = CACHED if settings.model == DOWNLOAD else settings.model
        self.settings = replace(settings, model=model, sha256=digest)
        with torch.device('meta'):
            network = self.whole_network()
        load_parameters(network, self.current_names(parameters), str(path))
        dtype = torch.float16 if settings.half and self._device.type == 'cuda' else torch.float32
        self._layer = self.up_to_layer(network).eval().to(self._device, dtype)
        self._layer.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stub lacks it
        self._batch = BatchMaker(settings.size, settings.resize, self._device, dtype)

    @staticmethod
    @abstractmethod
    def whole_network() -> nn.Module:
        """Build the network with all parameters that the file has, under the names that they have there."""

    @staticmethod
    @abstractmethod
    def up_to_layer(network: nn.Module) -> nn.Module:
        """Return the part of the network that makes the feature maps, without what comes after them."""

    @staticmethod
    def current_names(parameters: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Rename the parameters of files from before a change of names."""
        return parameters

    def feature_maps(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """
        Describe a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size; resized without keeping the aspect.
        :returns: shape (n, C, H, Wf), values >= 0, float32, or float16 with ``half`` on a GPU.
        :raises UnavailableError: the device has too little memory.
        """
        try:
            with torch.inference_mode():
                parts = [
                    self._layer(self._batch(images[first : first + PER_PASS]))
                    for first in range(0, len(images), PER_PASS)
                ]
                return torch.cat(parts)
        except torch.cuda.OutOfMemoryError as error:
            raise UnavailableError(
                f'device {self._device} has too little memory for {min(len(images), PER_PASS)} images of '
                f'size {self.settings.size}: give fewer at a time, or take half or another device'
            ) from error
