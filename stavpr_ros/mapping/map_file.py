# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
One map, one file: saving, opening and checking it.

docs/map_format.md defines the format. Nothing in a file is executed.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from stavpr_ros.checks import require_choice, require_type
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping.map_container import DTYPES, errors_of, MapFile, Part
from stavpr_ros.mapping.map_content import map_content, PARTS, require_jpegs
from stavpr_ros.mapping.map_schema import identity_fields, SESSION, SETTINGS
from stavpr_ros.mapping.map_version2 import (
    copy_with,
    ERROR_RISKS,
    MAX_HEADER,
    read_header,
    write_parts,
)
from stavpr_ros.mapping.place_map import ErrorRisks, Map
from stavpr_ros.mapping.stored_features import MapStatistics, STATISTICS, StoredFeatures
from stavpr_ros.output_file import atomic_output, Force, MAP
from stavpr_ros.regular_file import open_regular

THUMBNAILS_AT_ONCE = 1000
STORAGE = {'float32': 'F32', 'float16': 'F16'}
# ---------------------------------------------------------------------------------------- saving


def save_map(
    place_map: Map,
    path: str | Path,
    storage: str = '',
    force: Force = False,
    statistics: MapStatistics | None = None,
) -> str:
    """
    Write a map to a file, all of it or nothing.

    :param storage: type of the features, ``float32`` or ``float16``; '' = as in their file,
        float32 in memory.
    :param force: replace an existing map, see :func:`stavpr_ros.output_file.atomic_output`.
    :param statistics: learned by recognition from the features as they will be stored, see
        :func:`stavpr_ros.prepare.prepared_map.statistics_of_map`; None = write none.
    :returns: the id of the map, 16 hexadecimal digits of the content's hash.
    :raises OutputError: the file is there already, or cannot be written.
    :raises SettingsError: no such storage.
    """
    manifest, parts = _manifest(place_map, statistics), _parts(place_map, storage)
    if statistics is not None:
        parts |= {name: _part(name, array) for name, array in statistics.parts().items()}
    with atomic_output(path, MAP, force) as file:
        return write_parts(file, manifest, parts)


def _manifest(place_map: Map, statistics: MapStatistics | None) -> dict[str, Any]:
    data: dict[str, Any] = {}
    sessions = place_map.sessions
    if place_map.camera is not None:
        data['intrinsics'] = asdict(place_map.camera)
    if any(s.camera or s.yaw is not None or s.intrinsics for s in sessions):
        data['cameras'] = [
            {
                'name': session.camera,
                'yaw': session.yaw,
                'intrinsics': session.intrinsics and asdict(session.intrinsics),
            }
            for session in sessions
        ]
    if place_map.same_as is not None:
        data['same_places'] = None
    if place_map.threshold is not None:
        data['threshold'] = place_map.threshold
    if place_map.settings.value_range is not None:
        data['value_range'] = place_map.settings.value_range
    if place_map.error_risks is not None:
        data[ERROR_RISKS] = asdict(place_map.error_risks)
    if statistics is not None:  # the writer knows the hash of the features
        data[STATISTICS] = {'method': statistics.method, 'features': '0' * 64}
    settings, projection = place_map.settings, place_map.projection
    backbone = {name: getattr(settings.backbone, name) for name in identity_fields(settings.kind)}
    return {
        'settings': {name: {**vars(settings), 'backbone': backbone}[name] for name in SETTINGS},
        'cells': place_map.features.cells,
        'projection': projection.name if projection else None,
        'sessions': [{key: vars(session)[key] for key in SESSION} for session in sessions],
        'sections': {name: _section(content, name) for name, content in data.items()},
    }


def _section(data: Any, name: str = '') -> dict[str, Any]:
    # programs that do not know the range of values would take their upper byte
    return {'version': 1, 'required': name == 'value_range', 'data': data}


def save_error_risks(risks: ErrorRisks, path: str | Path, force: Force) -> str:
    """
    Write a map file again with other error risks; all else, also its id, stays as it is.

    :param force: see :func:`save_map`.
    :returns: the id.
    :raises MapFileError: see :func:`load_map`.
    :raises OutputError: it cannot be written, or is another version now.
    """
    with errors_of(path := Path(path)):
        map_of(file := MapFile(open_regular(path), path))
        file.verify()
    sections = file.manifest['sections'] | {ERROR_RISKS: _section(asdict(risks))}
    with atomic_output(path, MAP, force) as output:
        return copy_with(sections, file, output)


def _part(name: str, array: np.ndarray) -> Part:
    dtype = PARTS[name][0][0]
    return Part(dtype, array.shape, content=[array.astype(DTYPES[dtype], copy=False)])


def _parts(place_map: Map, storage: str) -> dict[str, Part]:
    features, projection, n = place_map.features, place_map.projection, len(place_map)
    own_storage = features.storage if isinstance(features, StoredFeatures) else 'float32'
    require_choice('storage', storage or own_storage, STORAGE)
    dtype = STORAGE[storage or own_storage]
    shape = (place_map.settings.strips, n, features.dimension)
    strips = _strips(features, np.dtype(DTYPES[dtype]))
    parts = {'strips': Part(dtype, shape, content=strips)}

    def add_texts(name: str, ends: str, texts: Sequence[bytes]) -> None:
        lengths = [len(text) for text in texts]
        content = (np.frombuffer(text, np.uint8) for text in texts)
        parts[name] = Part('U8', (sum(lengths),), content=content)
        parts[ends] = _part(ends, np.cumsum(lengths, dtype=np.int64))

    arrays = {
        'weights': features.weights,
        'stamps': place_map.stamps,
        'poses': place_map.poses,
        'projection': projection.matrix if projection else None,
        'session': place_map.session_index,
        'same_places/same_as': place_map.same_as,
    }
    parts |= {name: _part(name, array) for name, array in arrays.items() if array is not None}
    if any(place_map.ids):
        add_texts('ids', 'id_ends', [identifier.encode() for identifier in place_map.ids])
    if len(place_map.thumbnails):
        for first in range(0, n, THUMBNAILS_AT_ONCE):
            part = place_map.thumbnails[first : first + THUMBNAILS_AT_ONCE]
            ends = np.cumsum([len(content) for content in part])
            require_jpegs(np.frombuffer(b''.join(part), np.uint8), ends, first)
        add_texts('thumbnails', 'thumbnail_ends', place_map.thumbnails)
    return parts


def _strips(features: LocalFeatures, dtype: np.dtype) -> Iterator[np.ndarray]:
    """Yield the features of one strip after the other, (n, d)."""
    for j in range(features.settings.strips):
        if isinstance(features, StoredFeatures):
            yield features.strip(j).astype(dtype, copy=False)
        else:
            yield features.strips[j].astype(dtype, copy=False)


# --------------------------------------------------------------------------------------- reading


def load_map(path: str | Path) -> Map:
    """
    Read a map into memory, and check all of it.

    :raises MapFileError: no such file, not a regular one, or one that is damaged, truncated,
        foreign or of a newer version.
    """
    return in_memory(open_map(path))


def in_memory(place_map: Map) -> Map:
    """
    Return an opened map, its features and thumbnails read and checked.

    :raises MapFileError: see :func:`verify_map`.
    """
    verify_map(place_map)
    thumbnails = tuple(place_map.thumbnails)
    return replace(place_map, features=place_map.features[:], thumbnails=thumbnails)


def open_map(path: str | Path) -> Map:
    """
    Read a map whose features and thumbnails stay in the file and are read on every use.

    Everything else is checked now; those two are compared with their hashes by :func:`verify_map`.

    :raises MapFileError: see :func:`load_map`.
    """
    require_type('path', path, (str, Path), 'the path of a map file')
    path = Path(path)
    with errors_of(path):
        return map_of(MapFile(open_regular(path), path))


def map_of(file: MapFile) -> Map:
    """
    Return the map in an open file; see :func:`open_map`.

    :raises ValueError: names what is wrong with it.
    :raises StavprError: likewise.
    """
    file.require_whole()
    read_header(file)
    return map_content(file)


def verify_map(place_map: Map, rest: Callable[[float], None] = lambda seconds: None) -> None:
    """
    Verify the hashes of the parts that are still on disk; of a map in memory, nothing.

    :param rest: called now and then with the seconds of work since; what it raises ends the work.
    :raises MapFileError: names the damaged part and where it is in the file.
    """
    features = place_map.features
    if isinstance(features, StoredFeatures):
        with errors_of(features.file.path):
            features.file.verify(rest=rest)


def is_map(path: str | Path) -> bool:
    """Return whether a file begins as maps do; False for one that cannot be read."""
    try:
        with open_regular(path) as file:
            start = file.read(9)
    except OSError:
        return False
    return int.from_bytes(start[:8], 'little') <= MAX_HEADER and start[8:] == b'{'
