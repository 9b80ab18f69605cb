# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Torch operations on fixed tensors, run again and again: on CUDA as one graph."""

from collections.abc import Callable
import gc
from weakref import WeakMethod

import torch


class DeviceGraph:
    """
    A method that reads and writes tensors in place, always the same ones.

    On a CUDA device, the first call runs it and the second one captures it in a CUDA graph: each
    call from then on is one launch. On other devices, each call runs it.

    :param method: without arguments, of the owner of this object; it must not wait for the device.
    """

    def __init__(self, device: torch.device, method: Callable[[], None]) -> None:
        self._device, self._method = device, WeakMethod(method)  # no cycle keeps tensors alive
        self._calls, self._graph = 0, torch.cuda.CUDAGraph() if device.type == 'cuda' else None

    def __call__(self) -> None:
        """Run the method; returns before the device has finished."""
        self._calls += 1
        if self._graph is None or self._calls == 1:  # this call loads libraries, a capture cannot
            self._run()
            return
        if self._calls == 2:
            with torch.cuda.device(self._device):
                self._capture(self._graph)
        self._graph.replay()

    def _run(self) -> None:
        method = self._method()
        assert method is not None
        method()

    def _capture(self, graph: torch.cuda.CUDAGraph) -> None:
        """Capture the method; no object may free memory of the device meanwhile."""
        was_enabled = gc.isenabled()
        gc.collect()
        gc.disable()
        try:
            with torch.cuda.graph(graph, capture_error_mode='thread_local'):
                self._run()
        finally:
            if was_enabled:
                gc.enable()


class HostCopy:
    """
    Memory of the host for one tensor on a device; copies to and fro do not wait.

    ``numpy`` is that memory.
    """

    def __init__(self, tensor: torch.Tensor) -> None:
        self._tensor = tensor
        self._host = torch.zeros(tensor.shape, dtype=tensor.dtype, pin_memory=tensor.is_cuda)
        self.numpy = self._host.numpy()

    def send(self) -> None:
        """Queue a copy to the device."""
        self._tensor.copy_(self._host, non_blocking=self._tensor.is_cuda)

    def receive(self) -> None:
        """Queue a copy from the device."""
        self._host.copy_(self._tensor, non_blocking=self._tensor.is_cuda)

    def wait(self) -> None:
        """Wait until the device has finished."""
        if self._tensor.is_cuda:
            torch.cuda.current_stream(self._tensor.device).synchronize()
