"""
One map, one file.

The file is a ZIP archive without compression: ``manifest.json`` (format, version, feature settings,
ids, the hash of every other member) and one ``.npy`` array each for strips, weights, stamps, poses,
projection and thumbnails. Nothing in it is executable, arrays of objects (pickles) are refused.
"""

import hashlib
import io
import json
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from stavpr_ros.errors import InputError, MapFileError, SettingsError
from stavpr_ros.features import FeatureSettings, LocalFeatures, Projection
from stavpr_ros.mapping.place_map import PlaceMap

FORMAT = 'stavpr-map'
VERSION = 1
MANIFEST = 'manifest.json'
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
        arrays['thumbnail_ends'] = np.cumsum([len(picture) for picture in place_map.thumbnails])
    return {name: np.ascontiguousarray(array, _TYPES[name]) for name, array in arrays.items()}


def save_map(place_map: PlaceMap, path: str | Path) -> None:
    """
    Write a map to a file, whole or not at all: a file that was there stays until the new one is complete.

    :raises MapFileError: the file cannot be written.
    """
    path = Path(path)
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
        'members': {name: hashlib.sha256(content).hexdigest() for name, content in members.items()},
    }
    temporary = None
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f'.{path.name}.', delete=False) as file:
            temporary = file.name
            with zipfile.ZipFile(file, 'w', zipfile.ZIP_STORED) as archive:
                archive.writestr(MANIFEST, json.dumps(manifest))
                for name, content in members.items():
                    archive.writestr(f'{name}.npy', content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        raise MapFileError(f'map {path} cannot be written ({error}); what was there is untouched') from error
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def load_map(path: str | Path) -> PlaceMap:
    """
    Read a map.

    :raises MapFileError: no such file, or one that is damaged, truncated, foreign or from a newer version.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            manifest = _read_manifest(archive, path)
            arrays = {
                name: _read_array(archive, name, digest) for name, digest in manifest['members'].items()
            }
        return _assemble(manifest, arrays)
    except MapFileError:
        raise
    except FileNotFoundError as error:
        raise MapFileError(f'map {path} does not exist: make one with build_map') from error
    except (IsADirectoryError, PermissionError) as error:
        raise MapFileError(f'map {path} cannot be read ({error.strerror}): name a map file') from error
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
            f'{path} is no map of this program, or damaged or truncated ({error}): build it with build_map'
        ) from error


def _read(archive: zipfile.ZipFile, member: str) -> bytes:
    info = archive.getinfo(member)
    if info.compress_type != zipfile.ZIP_STORED:  # ours never is; a bomb would be
        raise ValueError(f'{member} is compressed')
    return archive.read(info)


def _read_manifest(archive: zipfile.ZipFile, path: Path) -> dict[str, Any]:
    if MANIFEST not in archive.namelist():
        raise MapFileError(f'{path} is no map of this program: it is a ZIP file without {MANIFEST}')
    manifest = json.loads(_read(archive, MANIFEST))
    if not isinstance(manifest, dict) or manifest.get('format') != FORMAT:
        raise MapFileError(f'{path} is no map of this program: its manifest does not say {FORMAT!r}')
    if manifest['version'] > VERSION:
        raise MapFileError(
            f'{path} has format version {manifest["version"]}, this program reads up to {VERSION}: update it'
        )
    return manifest


def _read_array(archive: zipfile.ZipFile, name: str, digest: str) -> np.ndarray:
    content = _read(archive, f'{name}.npy')
    if hashlib.sha256(content).hexdigest() != digest:
        raise ValueError(f'{name} does not match its hash')
    array = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
    if array.dtype != _TYPES[name]:
        raise ValueError(f'{name} is {array.dtype}')
    return array


def _assemble(manifest: dict[str, Any], arrays: dict[str, np.ndarray]) -> PlaceMap:
    try:
        settings = FeatureSettings.from_json(manifest['settings'])
        strips, weights = arrays['strips'], arrays['weights']
        if strips.ndim != 3 or strips.shape[0] != settings.strips or weights.shape != strips.shape[:2]:
            raise ValueError(f'strips {strips.shape} and weights {weights.shape} for W = {settings.strips}')
        if not np.isfinite(strips).all() or not np.isfinite(weights).all():
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
        pictures: tuple[bytes, ...] = ()
        if 'thumbnails' in arrays:
            content, ends = arrays['thumbnails'].tobytes(), arrays['thumbnail_ends'].tolist()
            pictures = tuple(content[start:end] for start, end in zip([0, *ends[:-1]], ends, strict=True))
        return PlaceMap(
            features=LocalFeatures(torch.from_numpy(strips), torch.from_numpy(weights), settings, cells),
            projection=projection,
            stamps=arrays['stamps'],
            ids=tuple(str(identifier) for identifier in manifest['ids']),
            poses=arrays.get('poses'),
            thumbnails=pictures,
        )
    except (InputError, SettingsError) as error:
        raise ValueError(str(error)) from error
