# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the numerics use the processor beside everything else that runs on a robot."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from functools import cache
import os
import sys
import threading
from typing import TypeVar
import warnings

Result = TypeVar('Result')
_limits = [0]  # the last one set


def wait_passively() -> None:
    """
    Let threads that wait for each other sleep instead of spin; before NumPy is imported.

    Spinning is OpenMP's default. It saves 1.5 ms an image on an idle machine and costs 100 ms when
    another process wants the same cores. NumPy's products get one thread each, which spins as well
    otherwise: blocks of a map are multiplied side by side. A choice that the user has made
    (OMP_WAIT_POLICY, OPENBLAS_NUM_THREADS) stays.
    """
    # numba asks for a lock in /dev/shm when it is imported, for a module that is not used
    warnings.filterwarnings('ignore', '.*Could not obtain multiprocessing lock')
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')


def limit_threads(count: int) -> None:
    """
    Limit numba, OpenCV, and torch where it is loaded, to so many threads.

    OpenCV's limit is for the process, the others' for the calling thread.

    :param count: 0 = as many as they take of themselves.
    """
    import cv2
    import numba

    _limits[:] = [count]
    available = numba.config.NUMBA_NUM_THREADS
    # before torch: the start of numba's threads sets the number of OpenMP's, which is torch's
    numba.set_num_threads(min(count or available, available))
    cv2.setNumThreads(count or -1)  # -1 = the number before the first limit
    if torch := sys.modules.get('torch'):
        torch.set_num_threads(count or _of_torch())


def thread_limit() -> int:
    """Return the limit of threads, for libraries that are loaded later; 0 = none."""
    return _limits[0]


def thread_count() -> int:
    """Return the number of threads that the calling thread may use."""
    import numba

    return int(numba.get_num_threads())


@cache
def _of_torch() -> int:
    """Return how many threads torch takes before the first limit."""
    return int(sys.modules['torch'].get_num_threads())


@contextmanager
def one_thread(is_enough: bool = True) -> Iterator[None]:
    """
    Run numba's kernels on the calling thread while the block runs.

    :param is_enough: else nothing changes.
    """
    import numba

    before = numba.get_num_threads() if is_enough else 1
    if before > 1:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        if before > 1:
            numba.set_num_threads(before)


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
