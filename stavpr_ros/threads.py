"""How the numerics use the processor beside everything else that runs on a robot."""

import os


def wait_passively() -> None:
    """
    Let threads that wait for each other sleep instead of spin; before torch or numba is imported.

    Spinning is OpenMP's default. It saves 1.5 ms an image on an idle machine and costs 100 ms when
    another process wants the same cores. A choice that the user has made (OMP_WAIT_POLICY) stays.
    """
    os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')


def limit_threads(count: int) -> None:
    """
    Limit torch, numba and OpenCV to so many threads; numba for the thread that calls.

    :param count: 0 = all cores.
    """
    import cv2
    import numba
    import torch

    if count:
        torch.set_num_threads(count)
        cv2.setNumThreads(count)
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
