# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
One map, one file.

The file is a ZIP archive without compression: ``manifest.json`` (format, version, feature
settings, ids, the hash of every other member) and one ``.npy`` array each for strips, weights,
stamps, poses, projection and thumbnails. Nothing in it is executable, arrays of objects (pickles)
are rejected.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
import hashlib
import io
import json
from pathlib import Path
from threading import Lock
from typing import Any, IO
import weakref
import zipfile

import numpy as np
from stavpr_ros.errors import InputError, MapFileError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures, Projection
from stavpr_ros.mapping.place_map import PlaceMap
from stavpr_ros.output_file import atomic_output, Force, MAP
import torch

FORMAT = 'stavpr-map'
VERSION = 1
MANIFEST = 'manifest.json'
PIECE = 2**20  # bytes read at a time
HEADER = 2**12  # bytes that hold the header of an array
_TYPES = {
    'strips': np.float32,
    'weights': np.float32,
    'stamps': np.int64,
    'poses': np.float64,
    'projection': np.float32,
    'thumbnails': np.uint8,
    'thumbnail_ends': np.int64,
}


def _arrays(place_map: PlaceMap) -> dict[str, np.ndarray]:
    arrays = {
        'strips': place_map.features.strips.cpu().numpy(),
        'weights': place_map.features.weights.cpu().numpy(),
        'stamps': place_map.stamps,
    }
    if place_map.poses is not None:
        arrays['poses'] = place_map.poses
    if place_map.projection is not None:
        arrays['projection'] = place_map.projection.matrix
    if place_map.thumbnails:
        arrays['thumbnails'] = np.frombuffer(b''.join(place_map.thumbnails), np.uint8)
        arrays['thumbnail_ends'] = np.cumsum(
            [len(thumbnail) for thumbnail in place_map.thumbnails]
        )
    return {name: np.ascontiguousarray(array, _TYPES[name]) for name, array in arrays.items()}


def save_map(place_map: PlaceMap, path: str | Path, force: Force = False) -> None:
    """
    Write a map to a file, all of it or nothing.

    :param force: replace an existing map, see :func:`stavpr_ros.output_file.atomic_output`.
    :raises OutputError: the file is there already, or cannot be written.
    """
    members = {}
    for name, array in _arrays(place_map).items():
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, array, allow_pickle=False)
        members[name] = buffer.getbuffer()
    manifest = {
        'format': FORMAT,
        'version': VERSION,
        'settings': place_map.settings.to_json(),
        'projection': place_map.projection.name if place_map.projection else None,
        'cells': place_map.features.cells,
        'ids': place_map.ids,
        'members': {
            name: hashlib.sha256(content).hexdigest() for name, content in members.items()
        },
    }
    with (
        atomic_output(path, MAP, force) as file,
        zipfile.ZipFile(file, 'w', zipfile.ZIP_STORED) as archive,
    ):
        archive.writestr(MANIFEST, json.dumps(manifest))
        for name, content in members.items():
            archive.writestr(f'{name}.npy', content)


def load_map(path: str | Path) -> PlaceMap:
    """
    Read a map.

    :raises MapFileError: no such file, or one that is damaged, truncated, foreign or of a newer
        version.
    """
    with _readable(Path(path)), open(path, 'rb') as file:
        return _read_map(file, Path(path))


def open_map(path: str | Path) -> PlaceMap:
    """
    Read and check a map whose features stay in the file and are read on every use.

    :raises MapFileError: see :func:`load_map`.
    """
    with _readable(Path(path)):
        file = open(path, 'rb')  # noqa: SIM115 for as long as the features are used
        try:
            place_map = _read_map(file, Path(path))
        except BaseException:
            file.close()
            raise
        return replace(place_map, features=StoredFeatures(place_map.features, file, Path(path)))


class StoredFeatures(LocalFeatures):
    """
    Features of a map that stay in its file, without a copy in memory.

    Every access to ``strips`` and ``weights`` reads and checks them; ``features[:]`` reads both.
    The file stays open, so that it may be replaced or deleted. Thread-safe.
    """

    def __init__(self, features: LocalFeatures, file: IO[bytes], path: Path) -> None:
        self._shape = tuple(features.strips.shape)
        self._file, self._path, self._lock = file, path, Lock()
        object.__setattr__(self, 'settings', features.settings)
        object.__setattr__(self, 'cells', features.cells)
        weakref.finalize(self, file.close)

    def __len__(self) -> int:
        return self._shape[1]

    def __repr__(self) -> str:
        return f'StoredFeatures({str(self._path)!r}, shape {self._shape}, {self.settings})'

    def __getitem__(self, images: slice | np.ndarray) -> LocalFeatures:
        return LocalFeatures(
            self.strips[:, images], self.weights[:, images], self.settings, self.cells
        )

    @property
    def dimension(self) -> int:
        """Return the number d of dimensions of a strip."""
        return self._shape[2]

    @property
    def strips(self) -> torch.Tensor:
        """Return the features, read from the file; shape (W, n, d), float32."""
        return torch.from_numpy(self._read('strips'))

    @property
    def weights(self) -> torch.Tensor:
        """Return the norm of each strip over that of all, read from the file; (W, n), float32."""
        return torch.from_numpy(self._read('weights'))

    def to(self, device: str | torch.device) -> LocalFeatures:
        """Read the features to a device."""
        return self[:].to(device)

    def _read(self, name: str) -> np.ndarray:
        with self._lock, _readable(self._path), zipfile.ZipFile(self._file) as archive:
            return _read_array(archive, name, _read_manifest(archive, self._path)['members'][name])


def _read_map(file: IO[bytes], path: Path) -> PlaceMap:
    with zipfile.ZipFile(file) as archive:
        manifest = _read_manifest(archive, path)
        members = manifest['members'].items()
        return _assemble(
            manifest, {name: _read_array(archive, name, digest) for name, digest in members}
        )


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Name the file, and the remedy, in the errors of its reading."""
    try:
        yield
    except MapFileError:
        raise
    except FileNotFoundError as error:
        raise MapFileError(f'map {path} does not exist: make one with build_map') from error
    except (IsADirectoryError, PermissionError) as error:
        raise MapFileError(
            f'map {path} cannot be read ({error.strerror}): name a map file'
        ) from error
    except (
        OSError,
        EOFError,
        LookupError,
        TypeError,
        ValueError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise MapFileError(
            f'map {path} is damaged or truncated ({type(error).__name__}: {error}): build it again'
        ) from error
    except zipfile.BadZipFile as error:
        raise MapFileError(
            f'{path} is no map of this program, or damaged or truncated ({error}): build it with '
            'build_map'
        ) from error


def _read(archive: zipfile.ZipFile, member: str) -> np.ndarray:
    """Return the bytes of a member, uint8, in memory that begins with a cache line."""
    info = archive.getinfo(member)
    if info.compress_type != zipfile.ZIP_STORED:  # rejects ZIP bombs
        raise ValueError(f'{member} is compressed')
    content = torch.empty(info.file_size, dtype=torch.uint8).numpy()
    at = 0
    with archive.open(info) as file:
        while piece := file.read(PIECE):
            content[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
            at += len(piece)
    return content


def _read_manifest(archive: zipfile.ZipFile, path: Path) -> dict[str, Any]:
    if MANIFEST not in archive.namelist():
        raise MapFileError(
            f'{path} is no map of this program: it is a ZIP file without {MANIFEST}'
        )
    manifest = json.loads(_read(archive, MANIFEST).tobytes())
    if not isinstance(manifest, dict) or manifest.get('format') != FORMAT:
        raise MapFileError(
            f'{path} is no map of this program: its manifest does not state {FORMAT!r}'
        )
    if manifest['version'] > VERSION:
        raise MapFileError(
            f'{path} has format version {manifest["version"]}, this program reads up to '
            f'{VERSION}: update it'
        )
    return manifest


def _read_array(archive: zipfile.ZipFile, name: str, digest: str) -> np.ndarray:
    content = _read(archive, f'{name}.npy')
    if hashlib.sha256(content.data).hexdigest() != digest:
        raise ValueError(f'{name} does not match its hash')
    header = io.BytesIO(content[:HEADER].tobytes())
    if np.lib.format.read_magic(header) != (1, 0):
        raise ValueError(f'{name} has a header of another version')
    shape, columns_first, dtype = np.lib.format.read_array_header_1_0(header)
    if dtype != _TYPES[name] or columns_first:
        raise ValueError(f'{name} is {dtype}, columns first {columns_first}')
    # not a copy, and aligned: NumPy's headers end at a multiple of 64 bytes
    return content[header.seek(0, io.SEEK_CUR) :].view(dtype).reshape(shape)


def _map_id(members: dict[str, str]) -> str:
    """Return the identity of the content of a map, from the hash of each member."""
    return hashlib.sha256(''.join(sorted(members.values())).encode()).hexdigest()[:16]


def _assemble(manifest: dict[str, Any], arrays: dict[str, np.ndarray]) -> PlaceMap:
    try:
        settings = FeatureSettings.from_json(manifest['settings'])
        strips, weights = arrays['strips'], arrays['weights']
        if (
            strips.ndim != 3
            or strips.shape[0] != settings.strips
            or weights.shape != strips.shape[:2]
        ):
            raise ValueError(
                f'strips {strips.shape} and weights {weights.shape} for W = {settings.strips}'
            )
        extremes = [
            extreme(initial=0) for array in (strips, weights) for extreme in (array.min, array.max)
        ]
        if not np.isfinite(extremes).all():  # NaN among the values is their minimum
            raise ValueError('features are not finite')
        cells = manifest.get('cells')
        if cells is not None:
            rows, columns = (int(number) for number in cells)
            if rows < 1 or columns < 1 or strips.shape[2] % (rows * columns):
                raise ValueError(f'cells {cells} for strips of {strips.shape[2]} dimensions')
            cells = rows, columns
        projection = None
        if manifest['projection'] is not None:
            projection = Projection(arrays['projection'], manifest['projection'])
        thumbnails: tuple[bytes, ...] = ()
        if 'thumbnails' in arrays:
            content, ends = arrays['thumbnails'].tobytes(), arrays['thumbnail_ends'].tolist()
            thumbnails = tuple(
                content[start:end] for start, end in zip([0, *ends[:-1]], ends, strict=True)
            )
        return PlaceMap(
            features=LocalFeatures(
                torch.from_numpy(strips), torch.from_numpy(weights), settings, cells
            ),
            projection=projection,
            stamps=arrays['stamps'],
            ids=tuple(str(identifier) for identifier in manifest['ids']),
            poses=arrays.get('poses'),
            thumbnails=thumbnails,
            map_id=_map_id(manifest['members']),
        )
    except (InputError, SettingsError) as error:
        raise ValueError(str(error)) from error
