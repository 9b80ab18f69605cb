# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The kind that features ``auto`` are on this machine."""

from importlib import import_module

from stavpr_ros.errors import StavprError
from stavpr_ros.features.efficientnet_lite_file import find_file

COST = 'ms of processor time for an image of 640x480'
HYBRID_MS, GRADIENT_MS = 7, 0.5  # on an AMD EPYC


def choose_kind() -> tuple[str, str]:
    """Return ``hybrid`` where it can be computed, else ``gradient``; and why, for the log."""
    try:
        import_module('onnxruntime')
        path = find_file()
    except (ImportError, StavprError) as error:
        remedy = ': pip install onnxruntime' * isinstance(error, ImportError)
        return 'gradient', (
            f'features auto: gradient, {GRADIENT_MS} {COST}, since features hybrid '
            f'({HYBRID_MS} ms, more matches in other light) are not there: {error}{remedy}'
        )
    return 'hybrid', (
        f'features auto: hybrid, {HYBRID_MS} {COST}, since onnxruntime and {path} are '
        f'there; features gradient take {GRADIENT_MS} ms'
    )
