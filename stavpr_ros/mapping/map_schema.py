# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The declared schema of a map's manifest, format version 2; see docs/map_format.md."""

from dataclasses import dataclass, fields
import math
import re
from typing import Any

from stavpr_ros.features.registry import settings_class

SHA256 = re.compile('[0-9a-f]{64}')
NAME = re.compile('[a-z][a-z0-9_]{0,63}')  # of a section


@dataclass(frozen=True)
class Int:
    """An integer, bool excluded."""

    low: int = 0
    high: int = 2**31 - 1

    def check(self, value: Any, where: str) -> None:
        """Reject another value."""
        if type(value) is not int or not self.low <= value <= self.high:
            raise _wrong(where, value, f'an integer from {self.low} to {self.high}')


@dataclass(frozen=True)
class Text:
    """A string that can be written as UTF-8 and published: no lone surrogates, no NUL."""

    longest: int = 256
    pattern: re.Pattern[str] | None = None

    def check(self, value: Any, where: str) -> None:
        """Reject another value."""
        if type(value) is not str or len(value) > self.longest or not is_text(value):
            raise _wrong(where, value, f'a text of at most {self.longest} characters')
        if self.pattern is not None and not self.pattern.fullmatch(value):
            raise _wrong(where, value, f'a text like {self.pattern.pattern}')


@dataclass(frozen=True)
class Bool:
    """True or false."""

    def check(self, value: Any, where: str) -> None:
        """Reject another value."""
        if type(value) is not bool:
            raise _wrong(where, value, 'true or false')


@dataclass(frozen=True)
class Number:
    """A finite number, bool excluded."""

    def check(self, value: Any, where: str) -> None:
        """Reject another value."""
        if type(value) not in (int, float) or not abs(value) < math.inf:
            raise _wrong(where, value, 'a finite number')


@dataclass(frozen=True)
class ListOf:
    """A list."""

    item: Any
    least: int = 0
    most: int = 2**16

    def check(self, value: Any, where: str) -> None:
        """Reject another value."""
        if type(value) is not list or not self.least <= len(value) <= self.most:
            raise _wrong(where, value, f'a list of {self.least} to {self.most} elements')
        for i, item in enumerate(value):
            self.item.check(item, f'{where}[{i}]')


@dataclass(frozen=True)
class Nullable:
    """A value, or null."""

    item: Any

    def check(self, value: Any, where: str) -> None:
        """Reject another value."""
        if value is not None:
            self.item.check(value, where)


@dataclass(frozen=True)
class Object:
    """An object with exactly these keys."""

    keys: dict[str, Any]

    def check(self, value: Any, where: str) -> None:
        """Reject another value."""
        if type(value) is not dict:
            raise _wrong(where, value, f'an object with {", ".join(self.keys)}')
        for key in value.keys() ^ self.keys.keys():
            state = 'lacks' if key in self.keys else 'has the unknown'
            raise ValueError(f'{where} {state} {key[:80]!r}: expected {", ".join(self.keys)}')
        for key, item in self.keys.items():
            item.check(value[key], f'{where}.{key}')


@dataclass(frozen=True)
class ObjectOf:
    """An object whose keys are names of one kind, with values of one kind."""

    key: Text
    item: Any
    most: int = 64

    def check(self, value: Any, where: str) -> None:
        """Reject another value."""
        if type(value) is not dict or len(value) > self.most:
            raise _wrong(where, value, f'an object with at most {self.most} keys')
        for key, item in value.items():
            self.key.check(key, f'a name in {where}')
            self.item.check(item, f'{where}.{key}')


@dataclass(frozen=True)
class Anything:
    """Any JSON."""

    def check(self, value: Any, where: str) -> None:
        """Reject nothing."""


HASHES = ListOf(Text(64, SHA256))
MANIFEST = Object(
    {
        'settings': Object(
            {
                'kind': Text(64),
                'backbone': ObjectOf(Text(64), Anything()),
                'strips': Int(1, 1024),
                'projection': Nullable(Text()),
                'feature_version': Int(1),
            }
        ),
        'cells': Nullable(ListOf(Int(1, 4096), 2, 2)),
        'projection': Nullable(Text()),
        'sessions': ListOf(
            Object(
                {
                    'id': Text(64),
                    'name': Text(128),
                    'robot': Text(64),
                    'start': Int(0, 2**63 - 1),
                }
            ),
            most=1024,
        ),
        'sections': ObjectOf(
            Text(64, NAME),
            Object({'version': Int(1), 'required': Bool(), 'data': Anything()}),
        ),
        'parts': ObjectOf(
            Text(129),
            Object({'dtype': Text(8), 'shape': ListOf(Int(0, 2**40), 1, 4), 'sha256': HASHES}),
        ),
    }
)
INTRINSICS = Object(
    {
        'width': Int(1, 2**16),
        'height': Int(1, 2**16),
        'focal': ListOf(Number(), 2, 2),
        'center': ListOf(Number(), 2, 2),
        'model': Text(64),
        'distortion': ListOf(Number(), most=16),
        'mount': ListOf(Number(), 7, 7),
    }
)
_SETTING_TYPES: dict[Any, Any] = {
    bool: Bool(),
    int: Int(-(2**31)),
    float: Number(),
    str: Text(1024),
    tuple[float, ...]: ListOf(Number(), most=64),
}


def identity_fields(kind: str) -> dict[str, Any]:
    """
    Return the settings of a kind that a map holds, with the schema of each.

    The location of a model is not among them, nor what is without effect on the features.
    """
    return {
        row.name: _SETTING_TYPES[row.type] for row in fields(settings_class(kind)) if row.compare
    }


def is_text(value: str) -> bool:
    """Whether a string can be written as UTF-8, without a NUL."""
    try:
        return '\0' not in value and value.encode() is not None
    except UnicodeEncodeError:
        return False


def _wrong(where: str, value: Any, expected: str) -> ValueError:
    size = f' of {len(value)}' if isinstance(value, (list, dict, str)) else ''
    shown = f'a {type(value).__name__}{size}' if size else repr(value)[:80]
    shown = ascii(value[:80]) if isinstance(value, str) else shown
    return ValueError(f'{where} is {shown}: expected {expected}')
