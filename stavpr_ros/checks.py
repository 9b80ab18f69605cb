# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of arguments and settings at the border of the public functions."""

from collections.abc import Iterable
import math
import numbers
import re

import numpy as np
from stavpr_ros.errors import InputError, SettingsError

MAX_TEXT = 4096  # characters of names and paths, as many as bytes in a path of Linux


def require_choice(name: str, value: object, choices: Iterable[str]) -> None:
    """Raise SettingsError if a setting is none of the choices."""
    choices = tuple(choices)
    if value not in choices:
        raise SettingsError(f'{name} = {value!r} is unknown: take one of {", ".join(choices)}')


def require_type(name: str, value: object, kind: type | tuple[type, ...], remedy: str) -> None:
    """Raise InputError if an argument is of another type; the remedy is what to give."""
    if not isinstance(value, kind):
        raise InputError(f'{name} is of type {type(value).__name__}: expected {remedy}')


def require_plain(name: str, text: str) -> None:
    """Raise SettingsError if a text, which goes into logs, is long or has control characters."""
    if len(text) > MAX_TEXT or re.search('[\0-\x1f\x7f-\x9f]', text):
        raise SettingsError(
            f'{name} = {text[:80]!r} has {len(text)} characters: expected at most {MAX_TEXT}, '
            'none of them a control character'
        )


def require_number(name: str, value: object) -> None:
    """Raise SettingsError if a setting is no number."""
    if not isinstance(value, numbers.Real):
        raise SettingsError(f'{name} = {value!r} is {type(value).__name__}: expected a number')


def require_at_least(name: str, value: float, least: float, unit: str = '') -> None:
    """Raise SettingsError if a setting is less, or not finite."""
    require_number(name, value)
    if not least <= value < math.inf:
        raise SettingsError(f'{name} = {value} must be at least {least} {unit}'.rstrip())


def require_between(name: str, value: float, low: float, high: float, unit: str = '') -> None:
    """Raise SettingsError if a setting is outside of a closed interval."""
    require_number(name, value)
    if not low <= value <= high:
        raise SettingsError(f'{name} = {value} must be {low} to {high} {unit}'.rstrip())


def require_above(name: str, value: float, bound: float, below: float = math.inf) -> None:
    """Raise SettingsError if a setting is outside of an open interval."""
    require_number(name, value)
    if not bound < value < below:
        upper = '' if below == math.inf else f' and below {below}'
        raise SettingsError(f'{name} = {value} must be above {bound}{upper}')


def require_whole(name: str, value: float, least: int, unit: str = '') -> None:
    """Raise SettingsError if a setting is less, or no whole number."""
    require_at_least(name, value, least, unit)
    if not float(value).is_integer():
        raise SettingsError(f'{name} = {value} must be a whole number')


def require_shape(name: str, array: np.ndarray, axes: str, *dtypes: str) -> tuple[int, ...]:
    """
    Return the shape of an array.

    :param axes: of each axis its size, or a name: axes of one name have one size, which is above 0
        where the name begins with a capital, as ``W W n``.
    :param dtypes: allowed types; none = any.
    :raises InputError: another shape or type.
    """
    words = axes.split()
    sizes = dict(zip(words, array.shape, strict=False))
    shape = tuple(int(word) if word.isdecimal() else sizes.get(word) for word in words)
    is_empty = any(not size for word, size in sizes.items() if word[0].isupper())
    if array.shape != shape or is_empty or (dtypes and array.dtype not in dtypes):
        expected = f'({", ".join(words)}) {" or ".join(dtypes)}'.rstrip()
        raise InputError(f'{name}: shape {array.shape} {array.dtype}, expected {expected}')
    return tuple(array.shape)


def float_array(values: np.ndarray, name: str, axes: str) -> np.ndarray:
    """
    Return ``values`` as a C-contiguous float32 or float64 array.

    :raises InputError: another type or other axes, see :func:`require_shape`.
    """
    array = np.asarray(values)
    require_shape(name, array, axes, 'float32', 'float64')
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
