# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the numerics use the processor beside everything else that runs on a robot."""

from collections.abc import Callable
from concurrent.futures import Future
from functools import cache
import os
import threading
from typing import TypeVar

Result = TypeVar('Result')


def wait_passively() -> None:
    """
    Let threads that wait for each other sleep instead of spin; before torch or numba is imported.

    Spinning is OpenMP's default. It saves 1.5 ms an image on an idle machine and costs 100 ms when
    another process wants the same cores. A choice that the user has made (OMP_WAIT_POLICY) stays.
    """
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')


def limit_threads(count: int) -> None:
    """
    Limit torch, numba and OpenCV to so many threads.

    OpenCV's limit is that of the process, the others' for the calling thread.

    :param count: 0 = as many as they take of themselves.
    """
    import cv2
    import numba
    import torch

    of_torch, of_opencv = _unlimited()
    most = numba.config.NUMBA_NUM_THREADS
    # before torch: the start of numba's threads sets the number of OpenMP's, which is torch's
    numba.set_num_threads(min(count or most, most))
    torch.set_num_threads(count or of_torch)
    cv2.setNumThreads(count or of_opencv)


@cache
def _unlimited() -> tuple[int, int]:
    """Return how many threads torch and OpenCV take before the first limit."""
    import cv2
    import torch

    return torch.get_num_threads(), cv2.getNumThreads()


def call_on_thread(function: Callable[[], Result], name: str) -> Future[Result]:
    """Call a function on a thread of its own; it may be abandoned, the process does not wait."""
    future: Future[Result] = Future()

    def call() -> None:
        try:
            future.set_result(function())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=call, name=name, daemon=True).start()
    return future
