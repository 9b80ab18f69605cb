# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
STA-VPR place recognition: spatio-temporal alignment of image sequences, and a ROS 2 node for it.

``Map``, ``Localizer`` and ``images`` are imported on first use, so that importing the package
itself loads nothing heavy. The parts are in its folders:
``alignment`` (the mathematics), ``features`` (image to local features), ``mapping`` (the reference
map), ``method`` (frame by frame), ``sources`` (frames from folders, bags and messages),
``pipeline`` (one image message at a time), ``ros`` (the node).
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

from stavpr_ros import former

if TYPE_CHECKING:
    from stavpr_ros.api import Localizer
    from stavpr_ros.mapping.place_map import Map
    from stavpr_ros.sources.arrays import images

__version__ = '0.9.0'
__all__ = ['Localizer', 'Map', 'images']
MODULES = {'Localizer': 'api', 'Map': 'mapping.place_map', 'images': 'sources.arrays'}

former.forward()


def __getattr__(name: str) -> Any:
    if name not in MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{MODULES[name]}'), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
