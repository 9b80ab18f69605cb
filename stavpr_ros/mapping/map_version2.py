# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Format version 2: a safetensors file with a manifest; docs/map_format.md defines it."""

from collections.abc import Iterable
import hashlib
import json
import math
from typing import Any, IO, NamedTuple

import numpy as np
from stavpr_ros.errors import MapFileError
from stavpr_ros.mapping.map_container import DTYPES, MapFile, Part, PIECE, read_json
from stavpr_ros.mapping.map_schema import Int, ListOf, MANIFEST, Object, Text

FORMAT, VERSION = 'stavpr-map', 2
MOST_HEADER = 2**20  # bytes: parsing takes at most 25 times as much memory
# name: highest known version
KNOWN_SECTIONS = {'intrinsics': 1, 'same_places': 1, 'statistics': 1, 'vectors': 1}
_TEXT = Text(MOST_HEADER)
_METADATA = Object({'format': _TEXT, 'version': _TEXT, 'manifest': _TEXT, 'sha256': _TEXT})
_TENSOR = Object(
    {
        'dtype': Text(8),
        'shape': ListOf(Int(0, 2**40), 0, 4),
        'data_offsets': ListOf(Int(0, 2**62), 2, 2),
    }
)


class NewPart(NamedTuple):
    """A part to be written: its content comes in contiguous arrays, one after the other."""

    dtype: str
    shape: tuple[int, ...]
    content: Iterable[np.ndarray]

    @property
    def size(self) -> int:
        """Return the number of bytes."""
        return math.prod(self.shape) * np.dtype(DTYPES[self.dtype]).itemsize


def read_version2(file: MapFile) -> None:
    """
    Read and check header and manifest.

    :raises MapFileError: no map, or of another version.
    :raises ValueError: anything else that is wrong with it.
    """
    head = file.bytes_at(0, min(8, file.size))
    if head.startswith(b'PK'):
        raise MapFileError(
            f'{file.path} is a ZIP archive, as maps of format version 1 were: build the map again '
            'with build_map'
        )
    length = int.from_bytes(head, 'little')
    if file.size < 8 or not 2 <= length <= min(MOST_HEADER, file.size - 8):
        raise file.foreign(f'its header would have {length} of {file.size} bytes')
    text = file.bytes_at(8, length)
    try:
        header = read_json(text, 'the header')
        metadata = header.pop('__metadata__')
        if metadata['format'] != FORMAT:
            raise ValueError(f'another format than {FORMAT}')
        version = metadata['version']
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise file.foreign(f'no manifest in its header, {error}') from error
    if version != str(VERSION):
        raise MapFileError(
            f'{file.path} has format version {str(version)[:20]}, this program reads {VERSION}: '
            'update it'
        )
    _METADATA.check(metadata, 'the metadata')
    manifest = metadata['manifest'].encode()
    digest = hashlib.sha256(manifest).hexdigest()
    if digest != metadata['sha256']:
        raise ValueError('bytes 8 on, the manifest in the header, do not match their hash')
    file.map_id = digest[:16]
    file.manifest = read_json(manifest, 'the manifest')
    MANIFEST.check(file.manifest, 'manifest')
    file.parts = _parts(header, file.manifest['parts'], 8 + length, file.size)
    _require_known_sections(file.manifest['sections'])


def features_key(hashes: list[str]) -> str:
    """Return the hash of features by those of their pieces."""
    return hashlib.sha256(''.join(hashes).encode()).hexdigest()


def _parts(
    header: dict[str, Any], listed: dict[str, Any], begin: int, size: int
) -> dict[str, Part]:
    """Check that the tensors are those of the manifest and fill the file without gaps."""
    for name in header.keys() ^ listed.keys():
        where = 'header, but not in the manifest' if name in header else 'manifest only'
        raise ValueError(f'tensor {name[:80]!r} is in the {where}')
    parts, end = {}, begin
    for name, tensor in header.items():
        _TENSOR.check(tensor, f'tensor {name}')
    for name in sorted(header, key=lambda name: header[name]['data_offsets']):
        tensor, entry = header[name], listed[name]
        if (tensor['dtype'], tensor['shape']) != (entry['dtype'], entry['shape']):
            raise ValueError(f'tensor {name} has another type or shape than in the manifest')
        if tensor['dtype'] not in DTYPES:
            raise ValueError(f'tensor {name} has the unknown type {tensor["dtype"]}')
        first, last = (begin + offset for offset in tensor['data_offsets'])
        part = Part(tensor['dtype'], tuple(tensor['shape']), end, entry['sha256'])
        start, end = end, end + part.size
        if (first, last) != (start, end):
            raise ValueError(
                f'tensor {name}: bytes {first} to {last}, expected {start} to {end}, by its shape'
            )
        if len(entry['sha256']) != -(-part.size // PIECE):
            raise ValueError(f'tensor {name} has {len(entry["sha256"])} hashes')
        parts[name] = part
    if end != size:
        raise ValueError(f'its tensors end at byte {end}, the file at byte {size}')
    return parts


def _require_known_sections(sections: dict[str, Any]) -> None:
    for name, section in sections.items():
        known = KNOWN_SECTIONS.get(name, 0)
        if section['required'] and section['version'] > known:
            raise ValueError(
                f'it requires section {name}, version {section["version"]}, which this program '
                'does not know: update it'
            )


def write_version2(file: IO[bytes], manifest: dict[str, Any], parts: dict[str, NewPart]) -> str:
    """
    Write a map to a new file that can be positioned; returns its id.

    :param manifest: without its ``parts``.
    :raises MapFileError: the manifest is too long.
    """
    # the widest numbers first: each tensor begins at a multiple of the size of its numbers
    names = sorted(parts, key=lambda n: (-np.dtype(DTYPES[parts[n].dtype]).itemsize, n))
    hashes = {name: ['0' * 64] * -(-parts[name].size // PIECE) for name in names}
    length = len(_header(manifest, parts, names, hashes)[0])
    if length > 8 + MOST_HEADER:
        raise MapFileError(
            f'the manifest has {length} bytes, at most {MOST_HEADER} can be read: make two maps'
        )
    file.write(bytes(length))
    for name in names:
        hasher = _PieceHasher()
        for array in parts[name].content:
            if array.size:
                view = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
                hasher.update(view)
                file.write(view)
        hashes[name] = hasher.hashes()
    if 'statistics' in manifest['sections']:
        manifest['sections']['statistics']['data']['features'] = features_key(hashes['strips'])
    header, map_id = _header(manifest, parts, names, hashes)
    file.seek(0)
    file.write(header)
    return map_id


def _header(
    manifest: dict[str, Any],
    parts: dict[str, NewPart],
    names: list[str],
    hashes: dict[str, list[str]],
) -> tuple[bytes, str]:
    """Return the first bytes of the file, a multiple of eight, and the id of the map."""
    listed = {
        name: {'dtype': parts[name].dtype, 'shape': parts[name].shape, 'sha256': hashes[name]}
        for name in names
    }
    text = _json({**manifest, 'parts': listed})
    digest = hashlib.sha256(text.encode()).hexdigest()
    tensors: dict[str, Any] = {
        '__metadata__': {
            'format': FORMAT,
            'version': str(VERSION),
            'manifest': text,
            'sha256': digest,
        }
    }
    end = 0
    for name in names:
        start, end = end, end + parts[name].size
        dtype, shape, _ = parts[name]
        tensors[name] = {'dtype': dtype, 'shape': shape, 'data_offsets': [start, end]}
    header = _json(tensors).encode()
    header += b' ' * (-len(header) % 8)
    return len(header).to_bytes(8, 'little') + header, digest[:16]


def _json(value: Any) -> str:
    return json.dumps(
        value, sort_keys=True, ensure_ascii=False, allow_nan=False, separators=(',', ':')
    )


class _PieceHasher:
    """Hashes a stream in pieces."""

    def __init__(self) -> None:
        self._done: list[str] = []
        self._hash, self._room = hashlib.sha256(), PIECE

    def update(self, view: memoryview) -> None:
        while len(view):
            self._hash.update(view[: self._room])
            taken = min(len(view), self._room)
            view, self._room = view[taken:], self._room - taken
            if not self._room:
                self._done.append(self._hash.hexdigest())
                self._hash, self._room = hashlib.sha256(), PIECE

    def hashes(self) -> list[str]:
        return self._done + ([self._hash.hexdigest()] if self._room < PIECE else [])
