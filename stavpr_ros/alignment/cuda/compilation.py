# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The seam between the kernels and what runs them: a CUDA device, or numba's simulator.

On a device the kernels work on torch's memory and torch's current stream, without copies. With
``NUMBA_ENABLE_CUDASIM=1`` in the environment before numba is imported, numba runs them in Python
on torch's CPU tensors: slow, and right. Nothing outside this module knows which of the two it is.
"""

from collections.abc import Callable
import functools
import operator
from typing import Any
import warnings

from stavpr_ros.devices import why_no_cuda
from stavpr_ros.errors import UnavailableError
import torch


@functools.cache
def simulated() -> bool:
    """Return whether numba.cuda is the simulator in this process."""
    from numba import cuda

    return bool(cuda.config.ENABLE_CUDASIM)


def kernel(function: Callable[..., None]) -> Any:
    """
    Make a kernel of a function: compiled at its first launch.

    On a device without link-time optimization, so that the machine code is the one that the
    registers are counted of (benchmarks/cuda_registers.py).
    """
    from numba import cuda

    return cuda.jit(function) if simulated() else cuda.jit(function, lto=False)


def device_function(function: Callable[..., Any]) -> Any:
    """Make a function that kernels call; it is inlined."""
    from numba import cuda

    return cuda.jit(function, device=True, inline='always')


def multiply() -> Callable[..., Any]:
    """
    Return the product that is rounded before anything is added to it, as on the CPU.

    The compiler contracts ``a * x + S`` to a fused multiply-add, which rounds once (numba has no
    option against it, and ``fastmath=False`` is none). This product is never contracted: answers
    stay equal bit for bit. Kernels bind it to a name and call that.
    """
    if simulated():
        return operator.mul
    from numba.cuda import libdevice

    return libdevice.fmul_rn


@functools.cache
def _resident_class() -> Any:
    """
    Make the class of arguments that lie on the device and stay there.

    At every launch numba asks each array anew where it lies: 8 us an array, which for nine of them
    is most of a launch's time. These remember the answer (1 us).
    """
    from numba import cuda

    class Resident(cuda.InOut):
        ready: Any = None

        def to_device(self, retr: list[Any], stream: Any = 0) -> Any:
            if self.ready is None:
                self.ready = super().to_device(retr, stream)
            return self.ready

    return Resident


class Device:
    """A CUDA device: the current one of torch, shared with it."""

    def __init__(self) -> None:
        if why_no_cuda():
            raise UnavailableError(f"backend 'cuda': {why_no_cuda()}; take 'cpu' or 'auto'")
        torch.cuda.init()
        self.torch_device = torch.device('cuda', torch.cuda.current_device())
        self._launches: dict[tuple[Any, ...], Any] = {}

    def array(self, tensor: torch.Tensor) -> Any:
        """Return the view of a tensor for kernels; it takes longer to make than a launch."""
        from numba import cuda

        return _resident_class()(cuda.as_cuda_array(tensor, sync=False))

    def launch(self, function: Any, grid: tuple[int, int], block: int, *arguments: Any) -> None:
        """Run a kernel on torch's current stream; returns before it has run."""
        stream = torch.cuda.current_stream(self.torch_device).cuda_stream
        launch = self._launches.get((function, grid, block, stream))
        if launch is None:
            launch = self._configured(function, grid, block, stream)
        launch(*arguments)

    def _configured(self, function: Any, grid: tuple[int, int], block: int, stream: int) -> Any:
        """Return a kernel ready for launch; they are kept, but not without limit."""
        from numba import cuda

        if len(self._launches) >= 256:
            self._launches.clear()
        with warnings.catch_warnings():
            # a map of a few thousand places does not fill a large device, and need not
            warnings.filterwarnings('ignore', message='Grid size')
            launch = function[grid, block, cuda.external_stream(stream) if stream else 0]
        self._launches[function, grid, block, stream] = launch
        return launch

    def host_buffer(self, size: int) -> torch.Tensor:
        """Make bytes on the host that the device writes to by itself."""
        return torch.empty(size, dtype=torch.uint8, pin_memory=True)

    def fetch(self, buffer: torch.Tensor, host: torch.Tensor) -> None:
        """Copy bytes from the device to the host and wait for them: the one synchronization."""
        host.copy_(buffer, non_blocking=True)
        torch.cuda.current_stream(self.torch_device).synchronize()


class Simulator:
    """Numba's simulator: kernels in Python over torch's CPU tensors, methods of a device."""

    torch_device = torch.device('cpu')

    def array(self, tensor: torch.Tensor) -> Any:
        """Return the tensor as kernels take it: the same memory, of any strides."""
        from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray

        return FakeCUDAArray(tensor.numpy())

    def launch(self, function: Any, grid: tuple[int, int], block: int, *arguments: Any) -> None:
        """Run a kernel."""
        function[grid, block](*arguments)

    def host_buffer(self, size: int) -> torch.Tensor:
        """Make bytes on the host."""
        return torch.empty(size, dtype=torch.uint8)

    def fetch(self, buffer: torch.Tensor, host: torch.Tensor) -> None:
        """Copy bytes to the host."""
        host.copy_(buffer)


Runtime = Device | Simulator


@functools.cache
def runtime() -> Runtime:
    """
    Return what kernels run on in this process.

    :raises UnavailableError: there is no CUDA device, or the package numba-cuda is missing.
    """
    return Simulator() if simulated() else Device()
