# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Former names of the method, for one release: ``recognition`` and ``filter``."""

import importlib
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
import sys
from types import ModuleType
from typing import Any
import warnings

FORMER = {'stavpr_ros.recognition', 'stavpr_ros.filter'}
METHOD = 'stavpr_ros.method'


class _Former(MetaPathFinder, Loader):
    """Imports a former package as a module whose names are those of the method."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> ModuleSpec | None:
        return ModuleSpec(name, self) if name in FORMER else None

    def exec_module(self, module: ModuleType) -> None:
        """Fill the module; it warns once."""
        name = module.__name__
        warnings.warn(f'{name} is {METHOD} now', DeprecationWarning, stacklevel=2)
        method = importlib.import_module(METHOD)
        vars(module).update({each: getattr(method, each) for each in method.__all__})


def forward() -> None:
    """Let former packages be imported."""
    if not any(isinstance(each, _Former) for each in sys.meta_path):
        sys.meta_path.append(_Former())
