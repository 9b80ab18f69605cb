# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The choice of the device for the features and of the backend for the matching."""

import ctypes
from functools import cache
from typing import TYPE_CHECKING

from stavpr_ros.checks import require_choice
from stavpr_ros.errors import UnavailableError

if TYPE_CHECKING:
    import torch

DEVICES = BACKENDS = ('auto', 'cpu', 'cuda')


def choose_device(requested: str) -> str:
    """
    Turn ``auto`` into ``cuda`` or ``cpu``.

    :raises SettingsError: no such device.
    :raises UnavailableError: ``cuda`` was requested and is not available.
    """
    require_choice('device', requested, DEVICES)
    return str(choose_backend(requested))


def choose_backend(requested: 'str | torch.device') -> 'str | torch.device':
    """
    Turn ``auto`` and ``cuda`` into what distances are computed on.

    :param requested: ``cpu``, ``cuda``, ``auto``, which is ``cuda`` where torch has such a device,
        a certain one such as ``cuda:1``, or any device of torch.
    :returns: ``cpu``, the kernels for the CPU, or a device of torch.
    :raises SettingsError: no such backend.
    :raises UnavailableError: ``cuda`` was requested and is not available.
    """
    if requested == 'auto':
        requested = 'cuda' if torch_has_cuda() else 'cpu'
    if isinstance(requested, str) and not requested.startswith('cuda:'):
        require_choice('backend', requested, BACKENDS)
        if requested == 'cpu':
            return 'cpu'
    if str(requested).startswith('cuda') and not torch_has_cuda():
        raise UnavailableError(
            f"device '{requested}': torch finds no CUDA device here; take 'cpu' or 'auto'"
        )
    import torch

    return torch.device(requested)


@cache
def torch_has_cuda() -> bool:
    """Return whether torch has a CUDA device; without a driver, torch is not imported."""
    try:
        ctypes.CDLL('libcuda.so.1')
    except OSError:
        return False
    import torch

    return bool(torch.cuda.is_available())
