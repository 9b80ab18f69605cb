# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of arguments and settings at the border of the public functions."""

from collections.abc import Iterable
import math
import numbers
import re
from typing import Any

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


def require_at_least(name: str, value: float, minimum: float, unit: str = '') -> None:
    """Raise SettingsError if a setting is less, or not finite."""
    require_number(name, value)
    if not minimum <= value < math.inf:
        raise SettingsError(f'{name} = {value} must be at least {minimum} {unit}'.rstrip())


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


def require_monotonic(name: str, values: tuple[float, ...], start: float, end: float) -> None:
    """Raise SettingsError if values do not go strictly from ``start`` on to ``end`` at most."""
    array = np.asarray(values)
    ahead = (array - start if array.dtype.kind in 'fiu' else np.empty(0)) * np.sign(end - start)
    valid = array.ndim == 1 and ahead.size and 0 <= ahead[0] <= ahead[-1] <= abs(end - start)
    if not (valid and (np.diff(ahead) > 0).all()):
        raise SettingsError(
            f'{name} = {values}: expected numbers, at least one, each beyond the one before, from '
            f'{start} to {end}'
        )


def require_whole(name: str, value: float, minimum: int, unit: str = '') -> None:
    """Raise SettingsError if a setting is less, or no whole number."""
    require_at_least(name, value, minimum, unit)
    if not float(value).is_integer():
        raise SettingsError(f'{name} = {value} must be a whole number')


def require_shape(name: str, array: Any, axes: str, *dtypes: str) -> tuple[int, ...]:
    """
    Return the shape of an array, or of a tensor.

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


def float32_vector(name: str, values: np.ndarray, shortest: int, longest: int) -> np.ndarray:
    """Return a contiguous float32 vector of finite values or +inf; raise InputError for others."""
    array = no_nan(float_array(values, name, 'n'), name)
    if not shortest <= len(array) <= longest:
        raise InputError(f'{name} of {len(array)} places: expected {shortest} to {longest}')
    return array.astype(np.float32, copy=False)


def require_indices(name: str, values: Any, end: int) -> None:
    """Raise InputError if not all are whole numbers of at least 0 and below ``end``."""
    array = np.asarray(values)
    is_whole = not array.size or array.dtype.kind in 'iu'
    if not is_whole or (array.size and not 0 <= array.min() <= array.max() < end):
        raise InputError(f'{name} = {values}: expected whole numbers of at least 0, below {end}')


def require_ascending(name: str, values: np.ndarray, end: int) -> None:
    """Raise InputError if values are no ascending indices below ``end``, (m,), integers."""
    require_shape(name, values, 'm', 'int32', 'int64')
    if (np.diff(values, prepend=-1, append=end) < 1).any():
        raise InputError(f'{name} = {values}: expected ascending indices below {end}, each once')


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


def rgb_image(image: Any, name: str = 'image', *dtypes: str) -> np.ndarray:
    """
    Return an image as an array, RGB, shape (height, width, 3), C-contiguous.

    :param image: an array, or an object that NumPy converts to one, such as a PIL image.
    :param dtypes: allowed types; none = uint8.
    :raises InputError: another type or shape, and how to convert it.
    """
    dtypes = dtypes or ('uint8',)
    expected = f'expected RGB pixels of shape (height, width, 3), {" or ".join(dtypes)}'
    kind = type(image).__name__
    try:
        array = np.asarray(image)
    except (TypeError, ValueError, RuntimeError) as error:  # a ragged list, a tensor of a GPU
        raise InputError(f'{name} is {kind}, which is no array ({error}): {expected}') from error
    if array.ndim == 3 and array.shape[2] == 3 and array.size and array.dtype.name in dtypes:
        return np.ascontiguousarray(array)
    what = f'{name} is {kind} of shape {array.shape} {array.dtype}'
    raise InputError(f'{what}: {expected}: {_conversion(image, array)}')


def _conversion(image: Any, array: np.ndarray) -> str:
    """Return how to convert an image that is no RGB image of bytes."""
    shape, is_number = array.shape, array.dtype.kind in 'buif'
    low, high = (array.min(), array.max()) if is_number and array.size else (0, 0)
    nan, inf = (int(is_bad(array).sum()) if is_number else 0 for is_bad in (np.isnan, np.isinf))
    rows = (
        (hasattr(image, 'image'), 'give its field image'),
        (image is None, 'it was not read: check the name of its file'),
        (array.dtype == object and isinstance(image, Iterable), 'give its images one by one'),
        (not is_number, 'give the pixels as numbers; stavpr_ros.images(path) reads files'),
        (not array.size, 'it has no pixels: check that it was read'),
        (hasattr(image, 'convert'), "take np.asarray(image.convert('RGB'))"),  # a PIL image
        (len(shape) == 4, 'give each image alone, as image[0]'),
        (len(shape) == 2 or shape[2:] == (1,), 'gray becomes RGB by np.dstack(3 * [image])'),
        (shape[2:] == (4,), 'take image[..., :3], of BGRA image[..., 2::-1]'),
        (shape[:1] == (3,), 'the channels come first: take image.transpose(1, 2, 0)'),
        (shape[2:] != (3,), 'an axis is missing, or has another size'),
        (nan or inf, f'it contains {nan} NaN and {inf} infinite values: replace them'),
        (low >= 0 and high <= 1, 'values of 0 to 1 become bytes by np.uint8(255 * image)'),
        (low >= 0 and high <= 255, 'take np.uint8(image)'),
        (True, f'values are {low} to {high}: scale them to 0 to 255, then np.uint8(image)'),
    )
    return next(remedy for applies, remedy in rows if applies)
