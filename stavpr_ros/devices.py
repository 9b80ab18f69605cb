# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The choice of the device for the features and of the backend for the matching."""

import ctypes
from functools import cache
import importlib.util

from stavpr_ros.checks import require_choice
from stavpr_ros.errors import UnavailableError

DEVICES = BACKENDS = ('auto', 'cpu', 'cuda')


def choose_device(requested: str) -> str:
    """
    Turn ``auto`` into ``cuda`` or ``cpu``.

    :raises SettingsError: no such device.
    :raises UnavailableError: ``cuda`` was requested and is not available.
    """
    require_choice('device', requested, DEVICES)
    available = torch_has_cuda()
    if requested == 'cuda' and not available:
        raise UnavailableError(
            "device 'cuda': torch finds no CUDA device here; take 'cpu' or 'auto'"
        )
    return ('cuda' if available else 'cpu') if requested == 'auto' else requested


def choose_backend(requested: str) -> str:
    """
    Turn ``auto`` into the backend of the matching, ``cuda`` or ``cpu``.

    :raises SettingsError: no such backend.
    :raises UnavailableError: ``cuda`` was requested, and its device or the package numba-cuda is
        not available.
    """
    if requested == 'auto':
        return 'cpu' if why_no_cuda() else 'cuda'
    require_choice('backend', requested, BACKENDS)
    if requested == 'cuda' and why_no_cuda():
        raise UnavailableError(f"backend 'cuda': {why_no_cuda()}; take 'cpu' or 'auto'")
    return requested


def why_no_cuda() -> str:
    """Return the reason why the ``cuda`` backend is not available; empty when it is."""
    if not torch_has_cuda():
        return 'torch finds no CUDA device here'
    if importlib.util.find_spec('numba_cuda') is None:
        return (
            'the package numba-cuda is not installed: pip install numba-cuda[cu13], '
            'or numba-cuda[cu12] where the driver is one for CUDA 12'
        )
    return ''


@cache
def torch_has_cuda() -> bool:
    """Return whether torch has a CUDA device; without a driver, torch is not imported."""
    try:
        ctypes.CDLL('libcuda.so.1')
    except OSError:
        return False
    import torch

    return bool(torch.cuda.is_available())
