# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of arrays at the border of the public functions."""

import numpy as np
from stavpr_ros.errors import InputError


def float_array(values: np.ndarray, name: str, ndim: int) -> np.ndarray:
    """
    Return ``values`` as a C-contiguous float32 or float64 array of ``ndim`` axes.

    :raises InputError: another type or number of axes.
    """
    array = np.asarray(values)
    if array.ndim != ndim:
        raise InputError(f'{name} has shape {array.shape}: expected {ndim} axes')
    if array.dtype not in (np.float32, np.float64):
        raise InputError(f'{name} is {array.dtype}: expected float32 or float64')
    return np.ascontiguousarray(array)


def no_nan(array: np.ndarray, name: str) -> np.ndarray:
    """
    Return ``array``, whose values may be finite or +inf (a pair that may not be used).

    :raises InputError: NaN or -inf among the values; with their number.
    """
    bad = np.count_nonzero(~(array > -np.inf))
    if bad:
        raise InputError(
            f'{name} has {bad} NaN or -inf among {array.size} values: check the features'
        )
    return array
