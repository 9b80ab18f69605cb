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
        requested = 'cpu' if why_no_cuda() else 'cuda'
    if isinstance(requested, str) and not requested.startswith('cuda:'):
        require_choice('backend', requested, BACKENDS)
        if requested == 'cpu':
            return 'cpu'
    if str(requested).startswith('cuda') and (reason := why_no_cuda()):
        raise UnavailableError(f"device '{requested}': {reason}; take 'cpu' or 'auto'")
    import torch

    return torch.device(requested)


@cache
def why_no_cuda() -> str:
    """Return why no CUDA device is used, '' = torch has one; without a driver, it stays unread."""
    try:
        ctypes.CDLL('libcuda.so.1')
    except OSError:
        return 'no CUDA driver is installed'
    try:
        import torch
    except (ImportError, OSError) as error:  # not installed, or without a library that it needs
        return f'a CUDA driver is installed, but torch cannot be imported: {error}'
    return '' if torch.cuda.is_available() else 'torch finds no CUDA device here'
