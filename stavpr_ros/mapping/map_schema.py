# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The declared schema of a map's manifest, format version 2; see docs/map_format.md.

A check is a function of a value and its name; it raises ValueError for any other value.
"""

from collections.abc import Callable
from dataclasses import fields
import math
import re
from typing import Any, get_type_hints

from stavpr_ros.errors import SettingsError
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping.place_map import plain_text

SHA256 = re.compile('[0-9a-f]{64}')
NAME = re.compile('[a-z][a-z0-9_]{0,63}')  # name of a section
MAX_KEYS = 64
Check = Callable[[Any, str], None]


def _rule(is_valid: Callable[[Any], bool], expected: str) -> Check:
    def check(value: Any, where: str) -> None:
        if not is_valid(value):
            size = f' of {len(value)}' if isinstance(value, (list, dict)) else ''
            words = f'a {type(value).__name__}{size}' if size else repr(value)[:80]
            words = ascii(value[:80]) if isinstance(value, str) else words
            raise ValueError(f'{where} is {words}: expected {expected}')

    return check


def integer(low: int = 0, high: int = 2**31 - 1) -> Check:
    """Take an integer, bool excluded."""
    return _rule(
        lambda value: type(value) is int and low <= value <= high,
        f'an integer from {low} to {high}',
    )


def text(longest: int = 256, pattern: re.Pattern[str] | None = None) -> Check:
    """Take a string that can be written as UTF-8 and published: no lone surrogates, no NUL."""
    expected = f' like {pattern.pattern}' if pattern else f' of at most {longest} characters'

    def is_valid(value: Any) -> bool:
        is_text = type(value) is str and len(value) <= longest and value == plain_text(value)
        return is_text and (pattern is None or bool(pattern.fullmatch(value)))

    return _rule(is_valid, f'a text{expected}')


def list_of(item: Check, min_length: int = 0, max_length: int = 2**16) -> Check:
    """Take a list."""
    sized = _rule(
        lambda value: type(value) is list and min_length <= len(value) <= max_length,
        f'a list of {min_length} to {max_length} elements',
    )

    def check(value: Any, where: str) -> None:
        sized(value, where)
        for i, element in enumerate(value):
            item(element, f'{where}[{i}]')

    return check


def nullable(item: Check) -> Check:
    """Take a value, or null."""
    return lambda value, where: None if value is None else item(value, where)


def record(keys: dict[str, Check]) -> Check:
    """Take an object with exactly these keys."""
    names = ', '.join(keys)
    is_object = _rule(lambda value: type(value) is dict, f'an object with {names}')

    def check(value: Any, where: str) -> None:
        is_object(value, where)
        for key in value.keys() ^ keys.keys():
            state = 'lacks' if key in keys else 'has the unknown'
            raise ValueError(f'{where} {state} {key[:80]!r}: expected {names}')
        for key, item in keys.items():
            item(value[key], f'{where}.{key}')

    return check


def mapping(key: Check, item: Check) -> Check:
    """Take an object whose keys are names of one kind, with values of one kind."""
    sized = _rule(
        lambda value: type(value) is dict and len(value) <= MAX_KEYS,
        f'an object with at most {MAX_KEYS} keys',
    )

    def check(value: Any, where: str) -> None:
        sized(value, where)
        for name, entry in value.items():
            key(name, f'a name in {where}')
            item(entry, f'{where}.{name}')

    return check


def anything(value: Any, where: str) -> None:
    """Take any JSON."""


boolean = _rule(lambda value: type(value) is bool, 'true or false')
number = _rule(
    lambda value: type(value) in (int, float) and abs(value) < math.inf, 'a finite number'
)
SETTINGS = {
    'kind': text(64),
    'backbone': mapping(text(64), anything),
    'strips': integer(1, 1024),
    'projection': nullable(text()),
    'feature_version': integer(1),
}
SESSION = {'id': text(64), 'name': text(128), 'robot': text(64), 'start': integer(0, 2**63 - 1)}
SECTION = {'version': integer(1), 'required': boolean, 'data': anything}
PART = {
    'dtype': text(8),
    'shape': list_of(integer(0, 2**40), 1, 4),
    'sha256': list_of(text(64, SHA256)),
}
MANIFEST = record(
    {
        'settings': record(SETTINGS),
        'cells': nullable(list_of(integer(1, 4096), 2, 2)),
        'projection': nullable(text()),
        'sessions': list_of(record(SESSION), max_length=1024),
        'sections': mapping(text(64, NAME), record(SECTION)),
        'parts': mapping(text(129), record(PART)),
    }
)
INTRINSICS = record(
    {
        'width': integer(1, 2**16),
        'height': integer(1, 2**16),
        'focal': list_of(number, 2, 2),
        'center': list_of(number, 2, 2),
        'model': text(64),
        'distortion': list_of(number, max_length=16),
        'mount': list_of(number, 7, 7),
    }
)
CAMERAS = list_of(
    record({'name': text(64), 'yaw': nullable(number), 'intrinsics': nullable(INTRINSICS)}),
    max_length=1024,
)
VALUE_RANGE = list_of(integer(0, 65535 + 1), 2, 2)
RISKS = record(
    {
        'method': text(),
        'units': integer(1),
        'probabilities': list_of(number, 1, 256),
        'risks': list_of(number, 1, 256),
        'recordings': list_of(text(64), 0, 1024),
    }
)
_SETTING_TYPES: dict[Any, Check] = {
    bool: boolean,
    int: integer(-(2**31)),
    float: number,
    str: text(1024),
    tuple[float, ...]: list_of(number, max_length=64),
}


def identity_fields(kind: str) -> dict[str, Check]:
    """
    Return the settings of a kind that a map has, with the check of each.

    The location of a model is not among them, nor what is without effect on the features.
    """
    cls, checks = settings_class(kind), dict[str, Check]()
    for name in (row.name for row in fields(cls) if row.compare):
        if (annotation := get_type_hints(cls)[name]) not in _SETTING_TYPES:
            raise SettingsError(
                f'setting {name} of features {kind} is a {annotation}: expected bool, int, float, '
                'str or tuple[float, ...], which map files have'
            )
        checks[name] = _SETTING_TYPES[annotation]
    return checks
