# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
One map, one file: saving, opening and checking it.

:mod:`stavpr_ros.mapping.map_version2` writes and reads the present format, docs/map_format.md
explains it; :mod:`stavpr_ros.mapping.map_version1` reads the former one. Nothing in a file is
executed.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import fields, replace
import os
from pathlib import Path
import tempfile
from typing import Any, overload

import numpy as np
from stavpr_ros.errors import InputError, MapFileError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures, Projection
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping.jpeg import is_thumbnail, jpeg_pixels, MOST_PIXELS
from stavpr_ros.mapping.map_container import DTYPES, errors_of, MapFile, Part
from stavpr_ros.mapping.map_schema import identity_fields, Object
from stavpr_ros.mapping.map_version1 import read_version1
from stavpr_ros.mapping.map_version2 import MOST_HEADER, NewPart, read_version2, write_version2
from stavpr_ros.mapping.place_map import PlaceMap, Session
from stavpr_ros.regular_file import open_regular
import torch

STORAGE = {'float32': 'F32', 'float16': 'F16'}
LARGE = ('strips', 'thumbnails')  # parts that are read, and compared with their hashes, later
LONGEST = 1.01  # norm of a strip; float16 rounds it
THUMBNAILS_AT_ONCE = 2**24  # bytes
PLACES_AT_ONCE = 512  # of one strip: they stay in the cache while they are checked
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
}
_TOGETHER = (('ids', 'id_ends'), ('thumbnails', 'thumbnail_ends'))


# ---------------------------------------------------------------------------------------- saving


def save_map(place_map: PlaceMap, path: str | Path, storage: str = '') -> str:
    """
    Write a map to a file atomically: an existing file is replaced by the complete new one.

    :param storage: of the features, ``float32`` or ``float16``; '' = that of the file where they
        are, float32 in memory.
    :returns: the id of the map, 16 hexadecimal digits of the hash of its content.
    :raises MapFileError: the file cannot be written.
    :raises SettingsError: no such storage.
    """
    path, temporary = Path(path), None
    manifest, parts = _manifest(place_map), _parts(place_map, storage)
    try:
        with tempfile.NamedTemporaryFile(
            dir=path.parent, prefix=f'.{path.name}.', delete=False
        ) as file:
            temporary = file.name
            map_id = write_version2(file, manifest, parts)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        raise MapFileError(
            f'map {path} cannot be written ({error}); an existing file is untouched'
        ) from error
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)
    return map_id


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _manifest(place_map: PlaceMap) -> dict[str, Any]:
    settings, projection = place_map.settings, place_map.projection
    backbone = {name: getattr(settings.backbone, name) for name in identity_fields(settings.kind)}
    return {
        'settings': {
            'kind': settings.kind,
            'backbone': backbone,
            'strips': settings.strips,
            'projection': settings.projection,
            'feature_version': settings.feature_version,
        },
        'cells': place_map.features.cells,
        'projection': projection.name if projection else None,
        'sessions': [
            {row.name: getattr(session, row.name) for row in fields(session)}
            for session in place_map.sessions
        ],
        'sections': {},
    }


def _parts(place_map: PlaceMap, storage: str) -> dict[str, NewPart]:
    features, n = place_map.features, len(place_map)
    stored = features.storage if isinstance(features, StoredFeatures) else 'float32'
    if (storage or stored) not in STORAGE:
        raise SettingsError(
            f'storage {storage!r} is unknown: take one of {", ".join(STORAGE)}'
        )
    dtype = STORAGE[storage or stored]
    shape = (place_map.settings.strips, n, features.dimension)
    content = (strip.astype(DTYPES[dtype], copy=False) for strip in _strips(features))
    parts = {'strips': NewPart(dtype, shape, content)}

    def add(name: str, array: np.ndarray) -> None:
        dtype = PARTS[name][0][0]
        parts[name] = NewPart(dtype, array.shape, [array.astype(DTYPES[dtype], copy=False)])

    def add_texts(name: str, ends: str, texts: Sequence[bytes]) -> None:
        lengths = [len(text) for text in texts]
        parts[name] = NewPart('U8', (sum(lengths),), (np.frombuffer(t, np.uint8) for t in texts))
        add(ends, np.cumsum(lengths, dtype=np.int64))

    add('weights', features.weights.cpu().numpy())
    add('stamps', place_map.stamps)
    if place_map.poses is not None:
        add('poses', place_map.poses)
    if place_map.projection is not None:
        add('projection', place_map.projection.matrix)
    if any(place_map.ids):
        add_texts('ids', 'id_ends', [identifier.encode() for identifier in place_map.ids])
    if len(place_map.thumbnails):
        _require_thumbnails(place_map.thumbnails)
        add_texts('thumbnails', 'thumbnail_ends', place_map.thumbnails)
    if place_map.session_index is not None:
        add('session', place_map.session_index)
    return parts


def _require_thumbnails(thumbnails: Sequence[bytes]) -> None:
    """
    Reject thumbnails that could not be read again.

    :raises InputError: names the place.
    """
    for place, content in enumerate(thumbnails):
        if content and not is_thumbnail(content):
            raise InputError(f'the thumbnail of place {place} is no JPEG image of a small size')


def _strips(features: LocalFeatures) -> Iterator[np.ndarray]:
    """Yield the features of one strip after the other, (n, d)."""
    if isinstance(features, StoredFeatures):
        yield from (features.stored_strip(j) for j in range(features.settings.strips))
    else:
        yield from (strip.cpu().numpy() for strip in features.strips)


# --------------------------------------------------------------------------------------- reading


def load_map(path: str | Path) -> PlaceMap:
    """
    Read a map into memory, and check all of it.

    :raises MapFileError: no such file, not a regular one, or one that is damaged, truncated,
        foreign or of a newer version.
    """
    place_map = open_map(path)
    verify_map(place_map)
    with errors_of(Path(path)):
        thumbnails = tuple(place_map.thumbnails)
    return replace(place_map, features=place_map.features[:], thumbnails=thumbnails)


def open_map(path: str | Path) -> PlaceMap:
    """
    Read a map whose features and thumbnails stay in the file and are read on every use.

    Everything else is checked now; those two are compared with their hashes by :func:`verify_map`.

    :raises MapFileError: see :func:`load_map`.
    """
    path = Path(path)
    with errors_of(path):
        file = MapFile(open_regular(path), path)
        file.require_whole()
        archive = file.bytes_at(0, min(4, file.size)) == b'PK\x03\x04'
        (read_version1 if archive else read_version2)(file)
        return _place_map(file)


def verify_map(place_map: PlaceMap) -> None:
    """
    Compare all that an opened map left in its file with its hashes; nothing for one in memory.

    :raises MapFileError: names the damaged part and where it is in the file.
    """
    features = place_map.features
    if isinstance(features, StoredFeatures):
        with errors_of(features.file.path):
            features.file.verify()


def is_map(path: str | Path) -> bool:
    """Return whether a file begins as maps do; False for one that cannot be read."""
    try:
        with open_regular(path) as file:
            start = file.read(9)
    except OSError:
        return False
    short = int.from_bytes(start[:8], 'little') <= MOST_HEADER
    return start[:4] == b'PK\x03\x04' or (short and start[8:] == b'{')


def _place_map(file: MapFile) -> PlaceMap:
    manifest = file.manifest
    settings = _settings(manifest['settings'])
    sizes = _require_shapes(file.parts, settings, manifest['sections'])
    arrays = {
        name: file.read(name) for name in file.parts if name in PARTS and name not in LARGE
    }
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
    if weights.size and not (weights.min() >= 0 and weights.max() <= LONGEST):
        raise ValueError('part weights is not between 0 and 1')
    n = sizes['n']
    ids = file.ids or [''] * n
    if 'ids' in arrays:
        ends = _ends(arrays['id_ends'], len(arrays['ids']), 'id_ends')
        content = arrays['ids'].tobytes()
        ids = [content[a:b].decode() for a, b in zip([0, *ends], ends, strict=False)]
    return PlaceMap(
        features=StoredFeatures(file, torch.from_numpy(weights), settings, cells),
        projection=projection,
        stamps=arrays['stamps'],
        ids=tuple(ids),
        poses=arrays.get('poses'),
        thumbnails=_thumbnails(file, arrays.get('thumbnail_ends')),
        sessions=tuple(Session(**session) for session in manifest['sessions']),
        session_index=arrays.get('session'),
        map_id=file.map_id,
    )


def _settings(record: dict[str, Any]) -> FeatureSettings:
    """Build the settings of the features; the location of a model is unknown to a map."""
    kind, values = record['kind'], record['backbone']
    rows = identity_fields(kind)
    Object(rows).check(values, f'settings of features {kind}')
    if 'sha256' in rows and not values['sha256']:
        raise ValueError(f'settings of features {kind} lack the sha256 of the model')
    located = {row.name for row in fields(settings_class(kind))} & {'model'}
    backbone = settings_class(kind)(**values, **dict.fromkeys(located, ''))
    return FeatureSettings(**{**record, 'backbone': backbone})


def _require_shapes(
    parts: dict[str, Part], settings: FeatureSettings, sections: Collection[str]
) -> dict[str, int]:
    """Check which parts there are, their types and shapes; return the sizes W, n, d and D."""
    for name in ('strips', 'weights', 'stamps'):
        if name not in parts:
            raise ValueError(f'part {name} is missing')
    for one, other in _TOGETHER:
        if (one in parts) is not (other in parts):
            raise ValueError(f'of the parts {one} and {other}, one is missing')
    sizes: dict[str, int] = {'W': settings.strips}
    for name, part in parts.items():
        if name not in PARTS:
            section, slash, _ = name.partition('/')
            if slash and section not in sections:
                raise ValueError(f'part {name[:80]} is of no section')
            if slash:
                continue
            raise ValueError(f'part {name[:80]} is unknown')
        types, shape = PARTS[name]
        if part.dtype not in types or len(part.shape) != len(shape):
            raise ValueError(
                f'part {name} is {part.dtype} {part.shape}: expected {" or ".join(types)} {shape}'
            )
    for name in PARTS:
        if name not in parts:
            continue
        for axis, size in zip(PARTS[name][1], parts[name].shape, strict=True):
            known = axis if isinstance(axis, int) else sizes.setdefault(axis, size)
            if axis != 'bytes' and size != known:
                raise ValueError(
                    f'part {name} has shape {parts[name].shape}: expected {known} for {axis}'
                )
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


def _thumbnails(file: MapFile, ends: np.ndarray | None) -> 'StoredThumbnails | tuple[()]':
    """Check the headers of all thumbnails, some megabytes at a time."""
    if ends is None:
        return ()
    part = file.parts['thumbnails']
    _ends(ends, part.size, 'thumbnail_ends')
    first = 0
    while first < len(ends):
        start = int(ends[first - 1]) if first else 0
        last = max(first + 1, int(np.searchsorted(ends, start + THUMBNAILS_AT_ONCE, 'right')))
        content = np.empty(int(ends[last - 1]) - start, np.uint8)
        file.fill(content, part.start + start)
        _require_jpegs(content, ends[first:last] - start, first)
        first = last
    return StoredThumbnails(file, ends)


def _require_jpegs(content: np.ndarray, ends: np.ndarray, first: int = 0) -> None:
    """
    Reject anything but JPEG images of a limited size; an empty one is none.

    :param content, ends: see :func:`stavpr_ros.mapping.jpeg.jpeg_pixels`.
    :param first: number of the first place.
    """
    pixels = jpeg_pixels(content, ends)
    bad = np.flatnonzero((pixels < 0) | (pixels > MOST_PIXELS))
    if len(bad):
        found = pixels[bad[0]]
        what = f'has {found} pixels, at most {MOST_PIXELS}' if found > 0 else 'is no JPEG image'
        raise ValueError(f'the thumbnail of place {first + bad[0]} {what}')


class StoredThumbnails(Sequence[bytes]):
    """Thumbnails that stay in the map's file; thread-safe."""

    def __init__(self, file: MapFile, ends: np.ndarray) -> None:
        self._file, self._ends = file, ends

    def __len__(self) -> int:
        return len(self._ends)

    @overload
    def __getitem__(self, place: int) -> bytes: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[bytes, ...]: ...

    def __getitem__(self, place: int | slice) -> bytes | tuple[bytes, ...]:
        if isinstance(place, slice):
            return tuple(self[i] for i in range(len(self))[place])
        i = range(len(self))[place]
        start = int(self._ends[i - 1]) if i else 0
        with errors_of(self._file.path):
            return self._file.bytes_at(
                self._file.parts['thumbnails'].start + start, int(self._ends[i]) - start
            )


class StoredFeatures(LocalFeatures):
    """
    Features of a map that stay in its file, without a copy in memory.

    Every access to ``strips`` reads them all, ``features[places]`` some of them. The file stays
    open, so that it may be replaced or deleted. Thread-safe.

    :param weights: see :class:`LocalFeatures`; in memory.
    """

    def __init__(
        self,
        file: MapFile,
        weights: torch.Tensor,
        settings: FeatureSettings,
        cells: tuple[int, int] | None,
    ) -> None:
        self.file, self._part = file, file.parts['strips']
        for name, value in (('weights', weights), ('settings', settings), ('cells', cells)):
            object.__setattr__(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return self._part.shape[1]

    def __repr__(self) -> str:
        return f'StoredFeatures({str(self.file.path)!r}, {self._part.shape}, {self.settings})'

    def __getitem__(self, images: slice | np.ndarray) -> LocalFeatures:
        strips = self._read(np.arange(len(self))[images])
        return LocalFeatures(strips, self.weights[:, images], self.settings, self.cells)

    @property
    def dimension(self) -> int:
        """Return the number d of dimensions of a strip."""
        return self._part.shape[2]

    @property
    def storage(self) -> str:
        """Return the type in the file, ``float32`` or ``float16``."""
        return np.dtype(DTYPES[self._part.dtype]).name

    @property
    def strips(self) -> torch.Tensor:
        """Return the features, read from the file; shape (W, n, d), float32."""
        return self._read(np.arange(len(self)))

    def to(self, device: str | torch.device) -> LocalFeatures:
        """Read the features to a device."""
        return self[:].to(device)

    def stored_strip(self, j: int) -> np.ndarray:
        """Return the features of one strip in the type of the file, shape (n, d)."""
        _, n, d = self._part.shape
        strip = np.empty((n, d), DTYPES[self._part.dtype])
        with errors_of(self.file.path):
            self.file.fill(strip, self._part.start + j * strip.nbytes)
            self._require_normalized(torch.from_numpy(strip), j, 0)
        return strip

    def _read(self, places: np.ndarray) -> torch.Tensor:
        """Return the features of some places, shape (W, len(places), d), float32."""
        W, n, d = self._part.shape
        row = d * np.dtype(DTYPES[self._part.dtype]).itemsize
        # runs of neighbors, each read at once
        ends = np.append(np.flatnonzero(np.diff(places) != 1) + 1, len(places))
        runs = [(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True) if a < b]
        pieces = [(c, min(c + PLACES_AT_ONCE, b)) for a, b in runs for c in range(a, b, PLACES_AT_ONCE)]
        out = torch.empty((W, len(places), d))
        with errors_of(self.file.path):
            for j in range(W):
                for a, b in pieces:
                    target = out[j, a:b]
                    start = self._part.start + (j * n + int(places[a])) * row
                    if self.storage == 'float32':
                        self.file.fill(target.numpy(), start)
                    else:
                        half = torch.empty((b - a, d), dtype=torch.float16)
                        self.file.fill(half.numpy(), start)
                        target.copy_(half)
                    self._require_normalized(target, j, int(places[a]))
        return out

    def _require_normalized(self, strips: torch.Tensor, j: int, place: int) -> None:
        for low in range(0, len(strips), PLACES_AT_ONCE):
            norms = strips[low : low + PLACES_AT_ONCE].float().norm(dim=1)
            if not bool((norms <= LONGEST).all()):  # NaN included
                raise ValueError(
                    f'part strips, strip {j}, from place {place + low} on: features are not '
                    'finite, or longer than 1'
                )
