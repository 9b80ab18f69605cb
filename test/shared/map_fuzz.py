# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Damaged files, and hand-made map files with correct hashes; see also reader_fuzz.py."""

from collections.abc import Iterator
import copy
from pathlib import Path
import random
import struct

from map_files import array_of, parts_of, tensor, version2
import numpy as np
from stavpr_ros.mapping import load_map, Map, open_map, verify_map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings

PIECES = (
    b'',
    bytes(8),
    b'\xff' * 8,
    b'1e999',
    b'-1',
    b'nan',
    b'[' * 3000,
    b'9' * 400,
    b',\n"',
    b'\0',
)
NUMBERS = ('<B', '<H', '<I', '<Q', '>I')
VALUES = (
    None, True, False, -1, 0, 1, 2, 7, 2**31, 2**63, 2**64, 10**400, 0.5, -0.0, 1e308,
    float('nan'), float('inf'), '', 'x', 'gradient', '\ud800', '\0', 'x' * 10_000, '{}',
    [], [[]], {}, {'a': 1}, ['x'], [1, 2], [1] * 5000,
)  # fmt: skip


def use(place_map: Map) -> None:
    """Use everything that is in a map, as the node does."""
    n = len(place_map)
    for i in range(n):
        place = place_map.place(i)
        assert -(2**31) <= place.stamp // 10**9 < 2**31
        place.identifier.encode()
        assert '\0' not in place.identifier
        assert place.pose is None or 0.98 < np.linalg.norm(place.pose[3:]) < 1.02
        place_map.session(i)
        place_map.thumbnail(i)
    for mode, precision in (('paper', 'float32'), ('robust', 'int8')) if n else ():
        settings = RecognizerSettings(0.5 if mode == 'paper' else None, mode=mode)
        recognizer = PlaceRecognizer(place_map, settings, 'cpu', precision)
        for i in range(22):
            match = recognizer.update(place_map.features[[i % n]])
        assert np.isfinite(match.distance) or mode == 'paper'


def use_file(path: Path, thorough: bool = True) -> None:
    """Read a file as the node and the commands do, and use it; reading may raise MapFileError."""
    place_map = open_map(path)
    verify_map(place_map)
    if thorough:
        use(place_map)  # with the statistics in its file
        use(load_map(path))


def mutate(content: bytes, rng: random.Random) -> bytes:
    """Return a file with damage: bytes removed, replaced, copied, or a number of any size."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 5))):
        at = int(len(data) * rng.random() ** rng.choice((1, 4)))
        other = rng.randrange(len(data) + 1)
        number = rng.choice(NUMBERS)
        value = rng.randrange(2 ** (8 * struct.calcsize(number) - rng.randrange(7)))
        removed = rng.choice((0, 1, 8, struct.calcsize(number), rng.randrange(40), len(data)))
        drawn = rng.choice((struct.pack(number, value), data[other : other + 64], *PIECES))
        data[at : at + removed] = drawn
    return bytes(data)


def _places_of(value: object, at: tuple = ()) -> Iterator[tuple]:
    """Yield the paths to all values in a manifest."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value)  # type: ignore
    for key, item in pairs:
        yield (*at, key)
        if isinstance(item, (dict, list)) and len(at) < 4:
            yield from _places_of(item, (*at, key))


def _change_manifest(manifest: dict, rng: random.Random) -> None:
    *keys, last = rng.choice(list(_places_of(manifest)))
    for key in keys:
        manifest = manifest[key]
    kind = rng.randrange(5)
    if kind == 0:
        del manifest[last]
    elif kind == 1 and isinstance(manifest, dict):
        manifest[str(rng.choice(VALUES))[:100]] = rng.choice(VALUES)
    else:
        manifest[last] = copy.deepcopy(rng.choice(VALUES))


def _changed_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    kind = rng.randrange(6)
    if kind == 0:
        return array.reshape(-1)
    if kind == 1:
        return array[..., None] if rng.random() < 0.5 else array[:-1]
    if kind == 2:
        return array.astype(rng.choice((np.float16, np.float32, np.float64, np.int64, np.uint8)))
    if kind == 3:
        return np.concatenate([array, array])
    array, values = array.copy(), (0, -1, 255, 2**31, 2**62, np.nan, np.inf, -np.inf, 1e-30, 3)
    with np.errstate(all='ignore'):
        value = np.array(rng.choice(values)).astype(array.dtype)
    if array.size:
        array.reshape(-1)[rng.randrange(array.size) if kind == 4 else slice(None)] = value
    return array


def hand_made(content: bytes, rng: random.Random) -> bytes:
    """Return a file with correct hashes and something else wrong, as a rule."""
    manifest, parts = parts_of(content)
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice(sorted(parts))
        kind = rng.randrange(5)
        if kind < 2:
            manifest.pop('parts', None)
            _change_manifest(manifest, rng)
        elif kind == 2:
            del parts[name]
        else:
            parts[name] = tensor(_changed_array(array_of(parts[name]), rng))
        if not parts:
            break
    if rng.random() < 0.8:
        manifest.pop('parts', None)
    return version2(manifest, parts)
