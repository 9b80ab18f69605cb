# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Format version 2: a safetensors file with a manifest; docs/map_format.md defines it."""

from collections.abc import Iterable, Sequence
import hashlib
import json
from typing import Any, IO

import numpy as np
from stavpr_ros.errors import MapFileError, UnavailableError, UnfitMapError
from stavpr_ros.mapping.map_container import DTYPES, MapFile, Part, PIECE, read_json
from stavpr_ros.mapping.map_schema import integer, list_of, MANIFEST, record, text

FORMAT, VERSION = 'stavpr-map', 2
MAX_HEADER = 2**20  # bytes: parsing takes at most 25 times as much memory
ERROR_RISKS = 'error_risks'
SECTIONS = ERROR_RISKS, 'cameras', 'intrinsics', 'same_places', 'statistics', 'threshold'
KNOWN_SECTIONS = dict.fromkeys((*SECTIONS, 'value_range'), 1)  # name: highest known version
_METADATA = record(dict.fromkeys(('format', 'version', 'manifest', 'sha256'), text(MAX_HEADER)))
_TENSOR = record(
    {
        'dtype': text(8),
        'shape': list_of(integer(0, 2**40), 0, 4),
        'data_offsets': list_of(integer(0, 2**62), 2, 2),
    }
)


def read_header(file: MapFile) -> None:
    """
    Read and check header and manifest.

    :raises MapFileError: no map, or of another version.
    :raises ValueError: anything else that is wrong with it.
    """
    head = file.bytes_at(0, min(8, file.size))
    length = int.from_bytes(head, 'little')
    if file.size < 8 or not 2 <= length <= min(MAX_HEADER, file.size - 8):
        raise file.foreign_error(f'it names a header of {length} bytes and has {file.size}')
    content = file.bytes_at(8, length)
    try:
        header = read_json(content, 'the header')
        metadata = header.pop('__metadata__')
        if metadata['format'] != FORMAT:
            raise ValueError(f'another format than {FORMAT}')
        version = metadata['version']
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise file.foreign_error(f'no manifest in its header, {error}') from error
    if version != str(VERSION):
        raise UnfitMapError(
            f'{file.path} has format version {str(version)[:20]}, this program reads {VERSION}: '
            'update it'
        )
    _METADATA(metadata, 'the metadata')
    manifest = metadata['manifest'].encode()
    digest = hashlib.sha256(manifest).hexdigest()
    if digest != metadata['sha256']:
        raise ValueError('bytes 8 on, the manifest in the header, do not match their hash')
    file.manifest = read_json(manifest, 'the manifest')
    MANIFEST(file.manifest, 'manifest')
    file.map_id = _id_of(file.manifest, digest)
    file.parts = _parts(header, file.manifest['parts'], 8 + length, file.size)
    for name, section in file.manifest['sections'].items():
        if section['required'] and section['version'] > KNOWN_SECTIONS.get(name, 0):
            raise UnavailableError(
                f'it requires section {name}, version {section["version"]}, which this program '
                'does not know'
            )


def _id_of(manifest: dict[str, Any], digest: str) -> str:
    """Return the id of a map, whatever drives on it have shown; digest: of the manifest."""
    if ERROR_RISKS in manifest['sections']:
        sections = {n: section for n, section in manifest['sections'].items() if n != ERROR_RISKS}
        digest = hashlib.sha256(_json({**manifest, 'sections': sections}).encode()).hexdigest()
    return digest[:16]


def features_key(hashes: Sequence[str]) -> str:
    """Return the hash of features by the hashes of their pieces."""
    return hashlib.sha256(''.join(hashes).encode()).hexdigest()


def _parts(
    header: dict[str, Any], entries: dict[str, Any], begin: int, size: int
) -> dict[str, Part]:
    """Check that the tensors are as in the manifest and fill the file without gaps."""
    for name in header.keys() ^ entries.keys():
        where = 'header, but not in the manifest' if name in header else 'manifest only'
        raise ValueError(f'tensor {name[:80]!r} is in the {where}')
    parts, end = {}, begin
    for name, tensor in header.items():
        _TENSOR(tensor, f'tensor {name}')
    for name in sorted(header, key=lambda name: header[name]['data_offsets']):
        tensor, entry = header[name], entries[name]
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
        if len(part.hashes) != part.pieces:
            raise ValueError(f'tensor {name} has {len(part.hashes)} hashes')
        parts[name] = part
    if end != size:
        raise ValueError(f'its tensors end at byte {end}, the file at byte {size}')
    return parts


def write_parts(file: IO[bytes], manifest: dict[str, Any], parts: dict[str, Part]) -> str:
    """
    Write a map to a new file that can be positioned; returns its id.

    :param manifest: without its ``parts``.
    :raises MapFileError: the manifest is too long.
    """
    # the widest numbers first: each tensor begins at a multiple of the size of its numbers
    names = sorted(parts, key=lambda n: (-np.dtype(DTYPES[parts[n].dtype]).itemsize, n))
    parts = {name: parts[name] for name in names}
    length = len(_header(manifest, parts, {n: ['0' * 64] * parts[n].pieces for n in names})[0])
    if length > 8 + MAX_HEADER:
        raise MapFileError(
            f'the manifest has {length} bytes, at most {MAX_HEADER} can be read: make two maps'
        )
    file.write(bytes(length))
    hashes = {name: _write(file, part.content) for name, part in parts.items()}
    if 'statistics' in manifest['sections']:
        manifest['sections']['statistics']['data']['features'] = features_key(hashes['strips'])
    header, map_id = _header(manifest, parts, hashes)
    file.seek(0)
    file.write(header)
    return map_id


def copy_with(sections: dict[str, Any], source: MapFile, file: IO[bytes]) -> str:
    """Write an opened map to a new file with other sections; returns its id."""
    hashes = {name: list(part.hashes) for name, part in source.parts.items()}
    header, map_id = _header({**source.manifest, 'sections': sections}, source.parts, hashes)
    file.write(header)
    for at in range(min(part.start for part in source.parts.values()), source.size, PIECE):
        piece = np.empty(min(PIECE, source.size - at), np.uint8)
        source.fill(piece, at)
        file.write(piece.data)
    return map_id


def _write(file: IO[bytes], arrays: Iterable[np.ndarray]) -> list[str]:
    """Write arrays one after the other; return the hash of every ``PIECE`` bytes."""
    hashes, digest, room = [], hashlib.sha256(), PIECE
    for array in arrays:
        if not array.size:
            continue
        view = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
        while len(view):
            piece, view = view[:room], view[room:]
            file.write(piece)
            digest.update(piece)
            room -= len(piece)
            if not room:
                hashes.append(digest.hexdigest())
                digest, room = hashlib.sha256(), PIECE
    return hashes if room == PIECE else [*hashes, digest.hexdigest()]


def _header(
    manifest: dict[str, Any], parts: dict[str, Part], hashes: dict[str, list[str]]
) -> tuple[bytes, str]:
    """Return the first bytes of the file, a multiple of eight, and the id of the map."""
    header: dict[str, Any] = {}
    entries: dict[str, Any] = {}
    end = 0
    for name, part in parts.items():
        start, end = end, end + part.size
        entry = {'dtype': part.dtype, 'shape': part.shape}
        header[name] = entry | {'data_offsets': [start, end]}
        entries[name] = entry | {'sha256': hashes[name]}
    manifest = {**manifest, 'parts': entries}
    content = _json(manifest)
    digest = hashlib.sha256(content.encode()).hexdigest()
    header['__metadata__'] = {
        'format': FORMAT,
        'version': str(VERSION),
        'manifest': content,
        'sha256': digest,
    }
    encoded = _json(header).encode()
    encoded += b' ' * (-len(encoded) % 8)
    return len(encoded).to_bytes(8, 'little') + encoded, _id_of(manifest, digest)


def _json(value: Any) -> str:
    return json.dumps(
        value, sort_keys=True, ensure_ascii=False, allow_nan=False, separators=(',', ':')
    )
