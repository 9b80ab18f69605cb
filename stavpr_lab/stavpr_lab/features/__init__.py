# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Kinds of features that stavpr_ros does not have: networks of the paper and of its baselines.

Imports no torch: :mod:`stavpr_ros.features.registry` loads this module for the settings.
"""

from dataclasses import dataclass
from typing import ClassVar

from stavpr_ros.features.registry import CACHED, Kind, NetworkSettings, setting

HALF_HELP = 'float16 on a GPU: faster, nearly the same features; no effect on a CPU'


@dataclass(frozen=True, kw_only=True)
class PublishedSettings(NetworkSettings):
    """Settings of a network with published weights; its input is normalized as for ImageNet."""

    MIN_SIZE: ClassVar[int] = 32

    model: str = setting(
        CACHED,
        help="file of the weights; 'cached': the published file, as `stavpr weights` downloads it",
        identity=False,
    )
    half: bool = setting(False, help=HALF_HELP, identity=False)


@dataclass(frozen=True, kw_only=True)
class NetVladSettings(NetworkSettings):
    """Settings of NetVLAD; how its input is normalized is in the file, or as for ImageNet."""

    MIN_SIZE: ClassVar[int] = 32

    model: str = setting(help='file of the weights, .mat or .pth.tar', identity=False)
    size: int = setting(480, help='images are resized to size x size pixels')
    whitening: bool = setting(
        True, help='PCA whitening as in the file, 4096 dimensions in the published ones'
    )


_NETWORKS = 'stavpr_lab.features.paper_networks'
DENSENET161 = Kind(PublishedSettings, f'{_NETWORKS}:DenseNet161Places365')
VGG16 = Kind(PublishedSettings, f'{_NETWORKS}:VGG16Pool4')
VGG16_FC6 = Kind(PublishedSettings, f'{_NETWORKS}:VGG16Fc6')
NETVLAD = Kind(NetVladSettings, 'stavpr_lab.features.netvlad:NetVlad')
