# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The packages of the extra ``evaluation``, which a robot does not need."""

import importlib
from types import ModuleType

from stavpr_ros.errors import UnavailableError

PACKAGES = {'sklearn.metrics': 'scikit-learn', 'jinja2': 'jinja2'}


def import_extra(module: str) -> ModuleType:
    """
    Import a module of the extra.

    :param module: one of ``PACKAGES``.
    :raises UnavailableError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = PACKAGES[module]
        raise UnavailableError(
            f'the evaluation needs {name} ({error}): pip install {name}'
        ) from error
