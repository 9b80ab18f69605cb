# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a map file, checked against each other and the manifest, as a map."""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import cache
import logging
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from stavpr_ros.errors import InputError, printable, SettingsError
from stavpr_ros.features import FeatureSettings, Projection
from stavpr_ros.features.registry import make_settings, settings_class
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.mapping.jpeg import jpeg_pixels, MAX_THUMBNAIL_PIXELS
from stavpr_ros.mapping.map_container import MapFile, Part
from stavpr_ros.mapping.map_schema import (
    CAMERAS,
    Check,
    identity_fields,
    INTRINSICS,
    number,
    record,
    RISKS,
    VALUE_RANGE,
)
from stavpr_ros.mapping.map_version2 import ERROR_RISKS, KNOWN_SECTIONS
from stavpr_ros.mapping.place_map import ErrorRisks, Map, Session
from stavpr_ros.mapping.stored_features import (
    CHANGES,
    MAX_NORM,
    STATISTICS,
    statistics_of,
    StoredFeatures,
    StoredThumbnails,
)

T = TypeVar('T')
_log = logging.getLogger(__name__)
# parts that are read, and compared with their hashes, later
LARGE = ('strips', 'thumbnails', 'statistics/codes')
THUMBNAILS_AT_ONCE = 2**24  # bytes
# Types and shape of each part; W, n, d are known from the others, a letter alone is any number.
PARTS: dict[str, tuple[tuple[str, ...], tuple[int | str, ...]]] = {
    'strips': (('F32', 'F16'), ('W', 'n', 'd')),
    'weights': (('F32',), ('W', 'n')),
    'stamps': (('I64',), ('n',)),
    'poses': (('F64',), ('n', 7)),
    'projection': (('F32',), ('D', 'd')),
    'ids': (('U8',), ('bytes',)),
    'id_ends': (('I64',), ('n',)),
    'thumbnails': (('U8',), ('bytes',)),
    'thumbnail_ends': (('I64',), ('n',)),
    'session': (('I32',), ('n',)),
    'same_places/same_as': (('I32',), ('n',)),
    'statistics/mean': (('F32',), ('W', 'd')),
    'statistics/directions': (('F32',), ('W', 'r', 'd')),
    'statistics/gains': (('F64',), ('W', 'r')),
    'statistics/changes': (('F32',), (CHANGES, 'n')),
    'statistics/codes': (('I8',), ('W', 'n', 'd')),
}
_TOGETHER = (('ids', 'id_ends'), ('thumbnails', 'thumbnail_ends'))


def map_content(file: MapFile) -> Map:
    """
    Return the map in a file; the large parts stay there.

    :raises ValueError: names what is wrong with it, and the part.
    :raises StavprError: likewise.
    """
    manifest, sections = file.manifest, file.manifest['sections']
    settings = _settings(manifest['settings'])
    if 'vectors' in sections:
        _note_vectors(file.path)
    readable = {n for n, row in sections.items() if row['version'] <= KNOWN_SECTIONS.get(n, 0)}
    if 'value_range' in readable:
        VALUE_RANGE(data := sections['value_range']['data'], 'section value_range')
        if data[0] >= data[1]:
            raise ValueError(f'section value_range is {data}: expected a range')
        settings = replace(settings, value_range=(data[0], data[1]))
    parts = {name: part for name, part in file.parts.items() if name in PARTS}
    if STATISTICS not in readable:
        parts = {n: part for n, part in parts.items() if not n.startswith(STATISTICS)}
    _require_parts(file.parts, sections)
    sizes = _sizes(parts, settings)
    arrays = {name: file.read(name) for name in parts if name not in LARGE}
    if (manifest['projection'] is None) is ('projection' in arrays):
        raise ValueError('the manifest and the parts disagree on whether there is a projection')
    projection = None
    if manifest['projection'] is not None:
        projection = Projection(arrays['projection'], manifest['projection'])
        if not np.isfinite(projection.matrix).all():
            raise ValueError('part projection is not finite')
    cells = None if manifest['cells'] is None else (manifest['cells'][0], manifest['cells'][1])
    _require_dimension(settings, sizes.get('D', sizes['d']), cells, projection is None)
    weights = arrays['weights']
    require_weights(weights)
    n = sizes['n']
    ids = [''] * n
    if 'ids' in arrays:
        ends = _ends(arrays['id_ends'], len(arrays['ids']), 'id_ends')
        content = arrays['ids'].tobytes()
        ids = [content[a:b].decode() for a, b in zip([0, *ends], ends, strict=False)]
    features = StoredFeatures(file, weights, settings, cells)
    if STATISTICS in readable:
        features.statistics = statistics_of(file, arrays)
        features.has_stale_statistics = features.statistics is None

    def section(name: str, check: Check, make: Callable[..., T], **missing: Any) -> T | None:
        if name not in readable:
            return None
        check(data := missing | sections[name]['data'], f'section {name}')
        return _construct(make, data)

    return Map(
        features=features,
        projection=projection,
        stamps=arrays['stamps'],
        ids=tuple(ids),
        poses=arrays.get('poses'),
        thumbnails=_thumbnails(file, arrays.get('thumbnail_ends')),
        sessions=_sessions(manifest, 'cameras' in readable),
        session_index=arrays.get('session'),
        camera=section('intrinsics', INTRINSICS, Camera),
        same_as=arrays.get('same_places/same_as'),
        threshold=_threshold(sections['threshold']['data']) if 'threshold' in readable else None,
        map_id=file.map_id,
        error_risks=section(ERROR_RISKS, RISKS, ErrorRisks, recordings=[]),
    )


def _construct(make: Callable[..., T], data: dict[str, Any]) -> T:
    return make(**{k: tuple(v) if type(v) is list else v for k, v in data.items()})


def _sessions(manifest: dict[str, Any], has_cameras: bool) -> tuple[Session, ...]:
    sessions = tuple(Session(**session) for session in manifest['sessions'])
    if not has_cameras:
        return sessions
    CAMERAS(data := manifest['sections']['cameras']['data'], 'section cameras')
    if len(data) != len(sessions):
        raise ValueError(f'section cameras has {len(data)} of them: expected {len(sessions)}')
    return tuple(
        replace(
            session,
            camera=camera['name'],
            yaw=camera['yaw'],
            intrinsics=camera['intrinsics'] and _construct(Camera, camera['intrinsics']),
        )
        for session, camera in zip(sessions, data, strict=True)
    )


@cache  # once for each file
def _note_vectors(path: Path) -> None:
    _log.warning('the vectors of whole images in %s are ignored', printable(str(path)))


def _threshold(data: Any) -> float:
    number(data, 'section threshold')
    return float(data)


def _settings(content: dict[str, Any]) -> FeatureSettings:
    """Build the settings of the features; the location of a model is unknown to a map."""
    kind = content['kind']
    rows = identity_fields(kind)
    # settings that there were none of when the map was made
    values = getattr(settings_class(kind), 'BEFORE', {}) | content['backbone']
    for name in getattr(settings_class(kind), 'DROPPED', ()):
        values.pop(name, None)
    if unknown := values.keys() - rows.keys():
        raise SettingsError(f'settings of features {kind} have the unknown {min(unknown)!r}')
    record(rows)(values, f'settings of features {kind}')
    if 'sha256' in rows and not values['sha256']:
        raise ValueError(f'settings of features {kind} lack the sha256 of the model')
    paths = {row.name for row in fields(settings_class(kind))} & {'model'}
    backbone = make_settings(kind, values | dict.fromkeys(paths, ''))
    return FeatureSettings(**{**content, 'backbone': backbone})


def _require_parts(parts: dict[str, Part], sections: dict[str, Any]) -> None:
    """Check which parts there are."""
    for name in ('strips', 'weights', 'stamps'):
        if name not in parts:
            raise ValueError(f'part {name} is missing')
    for name, other in _TOGETHER:
        if (name in parts) is not (other in parts):
            raise ValueError(f'of the parts {name} and {other}, one is missing')
    for name in parts:
        section, slash, _ = name.partition('/')
        if (slash or name not in PARTS) and section not in sections:
            raise ValueError(f'part {name[:80]} is {"of no section" if slash else "unknown"}')


def _sizes(parts: dict[str, Part], settings: FeatureSettings) -> dict[str, int]:
    """Return the sizes W, n, d and D, by which the shapes of all parts agree."""
    sizes: dict[str, int] = {'W': settings.strips}
    for name in sorted(parts, key=list(PARTS).index):
        (types, axes), dtype, shape = PARTS[name], parts[name].dtype, parts[name].shape
        if dtype not in types or len(shape) != len(axes):
            raise ValueError(
                f'part {name} is {dtype} {shape}: expected {" or ".join(types)} {axes}'
            )
        for axis, size in zip(axes, shape, strict=True):
            value = axis if isinstance(axis, int) else sizes.setdefault(axis, size)
            if axis != 'bytes' and size != value:
                raise ValueError(f'part {name} has shape {shape}: expected {value} for {axis}')
    if sizes['d'] < 1:
        raise ValueError('the strips have no dimensions')
    return sizes


def _require_dimension(
    settings: FeatureSettings, dimension: int, cells: tuple[int, int] | None, plain: bool
) -> None:
    """Check the dimensions of a strip before its projection."""
    if cells is not None and not plain:
        raise ValueError(f'cells {cells} of strips with a projection')
    if cells is not None and dimension % (cells[0] * cells[1]):
        raise ValueError(f'cells {cells} of strips of {dimension} dimensions')
    if settings.kind == 'gradient':
        side = settings.backbone.cells
        columns = side // settings.strips
        expected = settings.backbone.orientations * side * columns
        if dimension != expected or cells not in (None, (side, columns)):
            raise ValueError(
                f'strips of {dimension} dimensions, cells {cells}: expected {expected} and '
                f'{(side, columns)} by the settings of the features'
            )


def _ends(ends: np.ndarray, size: int, name: str) -> list[int]:
    """Return the ends of consecutive pieces that fill ``size`` bytes."""
    if (np.diff(ends, prepend=0) < 0).any() or (ends[-1] if len(ends) else 0) != size:
        raise ValueError(f'part {name} does not increase from 0 to {size}')
    return ends.tolist()


def _thumbnails(file: MapFile, ends: np.ndarray | None) -> Sequence[bytes]:
    """Check the headers of all thumbnails, in blocks of megabytes."""
    if ends is None:
        return ()
    part = file.parts['thumbnails']
    _ends(ends, part.size, 'thumbnail_ends')
    if not part.size:
        return ()
    first = 0
    while first < len(ends):
        start = int(ends[first - 1]) if first else 0
        last = max(first + 1, int(np.searchsorted(ends, start + THUMBNAILS_AT_ONCE, 'right')))
        content = np.empty(int(ends[last - 1]) - start, np.uint8)
        file.fill(content, part.start + start)
        require_jpegs(content, ends[first:last] - start, first)
        first = last
    return StoredThumbnails(file, ends)


def require_weights(weights: np.ndarray) -> None:
    """Raise ValueError if weights are not between 0 and 1."""
    if weights.size and not (weights.min() >= 0 and weights.max() <= MAX_NORM):
        raise ValueError('part weights is not between 0 and 1')


def require_jpegs(content: np.ndarray, ends: np.ndarray, first: int = 0) -> None:
    """
    Reject anything but JPEG images of a limited size; an empty one is none.

    :param content, ends: see :func:`stavpr_ros.mapping.jpeg.jpeg_pixels`.
    :param first: number of the first place.
    :raises InputError: names the place.
    """
    pixels = jpeg_pixels(content, ends)
    bad = np.flatnonzero((pixels < 0) | (pixels > MAX_THUMBNAIL_PIXELS))
    if len(bad):
        count, limit = pixels[bad[0]], MAX_THUMBNAIL_PIXELS
        what = f'has {count} pixels, at most {limit}' if count > 0 else 'is no JPEG image'
        raise InputError(f'the thumbnail of place {first + bad[0]} {what}')
