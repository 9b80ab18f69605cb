# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Images to local features: one kind a module, vertical strips, random projection.

The names below are imported on first use: :mod:`stavpr_ros.features.registry` loads without NumPy.
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from stavpr_ros.features.extractor import (
        FeatureExtractor,
        FeatureSettings,
        LocalFeatures,
        Projection,
    )

__all__ = ['FeatureExtractor', 'FeatureSettings', 'LocalFeatures', 'Projection']


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.extractor'), name)
