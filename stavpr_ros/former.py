# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Former names, for one release: packages, classes and fields of results, with a warning."""

from collections.abc import Callable
import importlib
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from operator import attrgetter
import sys
from types import ModuleType
from typing import Any, TYPE_CHECKING
import warnings

FORMER = {'stavpr_ros.recognition', 'stavpr_ros.filter'}
METHOD = 'stavpr_ros.method'
CLASSES = {
    'stavpr_ros.mapping': {'PlaceMap': 'Map'},
    'stavpr_ros.mapping.place_map': {'PlaceMap': 'Map'},
    'stavpr_ros.pipeline.operations': {'Localizer': 'LocalizationOperation'},
}
FIELDS: dict[str, dict[str, str]] = {
    'Path': {'middle': 'place', 'second_best_index': 'second_best'},
    'Match': {
        'place_index': 'place',
        'newest_index': 'newest',
        'sequence': 'path',
        'direction': 'path.direction',
        'min_probability': 'limits.probability',
        'image_index': 'last_image',
        'first_image_index': 'first_image',
    },
    'ImageResult': {
        **{name: f'match.{name}' for name in ('status', 'reason', 'threshold', 'accepted')},
        **{name: f'match.{name}' for name in ('distance', 'probability', 'inliers', 'late')},
        'path_probabilities': 'match.path_probabilities',
        'place_index': 'match.place',
        'newest_index': 'match.newest',
        'nearest_index': 'match.path.place',
    },
}


class FormerNames:
    """Base of results: their former fields, with a warning."""

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            kind = type(self).__name__
            if name not in FIELDS.get(kind, {}):
                raise AttributeError(f'{kind} has no attribute {name!r}')
            field = FIELDS[kind][name]
            warnings.warn(f'{kind}.{name} is {field} now', DeprecationWarning, stacklevel=2)
            return attrgetter(field)(self)


def classes(module: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a module with former names of classes."""

    def former_class(name: str) -> Any:
        if name not in CLASSES[module]:
            raise AttributeError(f'module {module!r} has no attribute {name!r}')
        present = CLASSES[module][name]
        warnings.warn(f'{module}.{name} is {present} now', DeprecationWarning, stacklevel=2)
        return getattr(importlib.import_module(module), present)

    return former_class


class _Former(MetaPathFinder, Loader):
    """Imports a former package as a module with the names of the method."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> ModuleSpec | None:
        return ModuleSpec(name, self) if name in FORMER else None

    def exec_module(self, module: ModuleType) -> None:
        """Fill the module; it warns once."""
        name = module.__name__
        warnings.warn(f'{name} is {METHOD} now', DeprecationWarning, stacklevel=2)
        method = importlib.import_module(METHOD)
        vars(module).update({name: getattr(method, name) for name in method.__all__})


def forward() -> None:
    """Let former packages be imported."""
    if not any(isinstance(finder, _Former) for finder in sys.meta_path):
        sys.meta_path.append(_Former())
