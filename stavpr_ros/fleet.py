# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The former name of the package ``stavpr_fleet``, for one release: import that instead."""

from importlib import import_module
from typing import Any
import warnings


def __getattr__(name: str) -> Any:
    if name.startswith('__'):  # __path__ would make a package of this module
        raise AttributeError(name)
    value = getattr(import_module('stavpr_fleet'), name)
    text = f'stavpr_ros.fleet.{name} is now stavpr_fleet.{name}'
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return value
