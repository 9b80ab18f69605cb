# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Reading format version 1: a ZIP archive without compression, of ``manifest.json`` and .npy arrays.

The manifest is turned into one of version 2, and the position of each array is looked up, so that
nothing else of this program depends on the version.
"""

from dataclasses import fields
import hashlib
import io
import re
import struct
from typing import Any
import zipfile

from stavpr_ros.errors import MapFileError
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping.map_container import MapFile, Part, Piece, read_json
from stavpr_ros.mapping.map_schema import Int, ListOf, Nullable, Object, ObjectOf, SHA256, Text
from stavpr_ros.mapping.map_version2 import FORMAT

MANIFEST = 'manifest.json'
MOST_MANIFEST = 2**22  # bytes: parsing takes at most 25 times as much memory
MOST_DIRECTORY = 2**16  # bytes of the archive's directory
MOST_SETTINGS = 2**16  # characters
_LOCAL = struct.Struct('<4s5H3I2H')  # header before each member
_NPY = struct.Struct('<8sH')  # magic and version, length of the header
_HEADER = re.compile(
    r"\{'descr': '([<|]\w\d)', 'fortran_order': False, 'shape': \(((?:\d{1,12}, ?)*(?:\d{1,12})?)"
    r'\), \} *\n'
)
_TYPES = {'<f4': 'F32', '<f8': 'F64', '<i8': 'I64', '|u1': 'U8'}
_SCHEMA = {
    'format': Text(),
    'version': Int(1, 1),
    'settings': Text(MOST_SETTINGS),
    'projection': Nullable(Text()),
    'cells': Nullable(ListOf(Int(1, 4096), 2, 2)),
    'ids': ListOf(Text(4096), most=MOST_MANIFEST),
    'members': ObjectOf(Text(), Text(64, SHA256)),
}


class _SmallReads(io.RawIOBase):
    """A file of which zipfile reads the directory only."""

    def __init__(self, file: MapFile) -> None:
        self._file, self._at = file, 0

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        base = {0: 0, 1: self._at, 2: self._file.size}[whence]
        if base + offset < 0:
            raise OSError('before the first byte')
        self._at = base + offset
        return self._at

    def read(self, count: int = -1) -> bytes:
        left = max(0, self._file.size - self._at)
        count = left if count < 0 else min(count, left)
        if count > MOST_DIRECTORY:
            raise ValueError(f'its directory has {count} bytes')
        content = self._file.bytes_at(self._at, count)
        self._at += count
        return content


def read_version1(file: MapFile) -> None:
    """
    Read and check the directory and the manifest.

    :raises MapFileError: no map, or of another version.
    :raises ValueError: anything else that is wrong with it.
    """
    try:
        with zipfile.ZipFile(_SmallReads(file)) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, OSError) as error:
        raise file.foreign(str(error)) from error
    by_name = {member.filename: member for member in members}
    if MANIFEST not in by_name:
        raise file.foreign(f'it is a ZIP file without {MANIFEST}')
    start, end = _position(file, by_name[MANIFEST])
    if end - start > MOST_MANIFEST:
        raise ValueError(f'{MANIFEST} has {end - start} bytes, expected at most {MOST_MANIFEST}')
    text = file.bytes_at(start, end - start)
    manifest = read_json(text, MANIFEST)
    if not isinstance(manifest, dict) or manifest.get('format') != FORMAT:
        raise file.foreign(f'its manifest does not state {FORMAT!r}')
    version = manifest.get('version')
    if type(version) is int and version > 1:
        raise MapFileError(
            f'{file.path} has format version {str(version)[:20]}, this program reads 1 to 2: '
            'update it'
        )
    manifest.setdefault('cells', None)
    Object(_SCHEMA).check(manifest, MANIFEST)
    hashes = manifest['members']
    expected = sorted([MANIFEST, *(f'{name}.npy' for name in hashes)])
    if sorted(member.filename for member in members) != expected:
        raise ValueError('its members are not those of its manifest, each once')
    file.version, file.map_id = 1, hashlib.sha256(text).hexdigest()[:16]
    file.ids = manifest['ids']
    file.parts = {name: _part(file, by_name[f'{name}.npy'], hashes[name]) for name in hashes}
    file.manifest = {
        'settings': _settings(manifest['settings']),
        'cells': manifest['cells'],
        'projection': manifest['projection'],
        'sessions': [],
        'sections': {},
    }


def _settings(text: str) -> dict[str, Any]:
    """Return the settings without those that no longer are in maps: a model's location."""
    settings = read_json(text.encode(), 'settings')
    if isinstance(settings, dict) and isinstance(settings.get('backbone'), dict):
        kind = settings.get('kind')
        rows = {row.name: row for row in fields(settings_class(str(kind)))}
        before = getattr(settings_class(str(kind)), 'BEFORE', {})
        for name in list(settings['backbone']):
            if name in rows and not rows[name].compare:
                del settings['backbone'][name]
        defaults = {
            name: list(row.default) if isinstance(row.default, tuple) else row.default
            for name, row in rows.items()
            if row.compare and isinstance(row.default, (bool, int, float, str, tuple))
        }
        settings['backbone'] = defaults | before | settings['backbone']
    return {'projection': None, 'feature_version': 1} | settings


def _position(file: MapFile, member: zipfile.ZipInfo) -> tuple[int, int]:
    """Return where the content of a member begins and ends in the file."""
    name = member.filename[:80]
    if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
        raise ValueError(f'{name} is compressed')
    fields = _LOCAL.unpack(file.bytes_at(member.header_offset, _LOCAL.size))
    if fields[0] != b'PK\x03\x04':
        raise ValueError(f'no member at byte {member.header_offset}')
    start = member.header_offset + _LOCAL.size + fields[-2] + fields[-1]
    end = start + member.file_size
    if end > file.size:
        raise ValueError(f'{name} would end at byte {end}, the file has {file.size}')
    return start, end


def _part(file: MapFile, member: zipfile.ZipInfo, sha256: str) -> Part:
    start, end = _position(file, member)
    name = member.filename[:80]
    magic, length = _NPY.unpack(file.bytes_at(start, _NPY.size))
    header = file.bytes_at(start + _NPY.size, length)
    found = _HEADER.fullmatch(header.decode('latin-1')) if magic == b'\x93NUMPY\1\0' else None
    if found is None or found[1] not in _TYPES:
        raise ValueError(f'{name}, byte {start}: no array of numbers')
    shape = tuple(int(text) for text in found[2].split(',') if text.strip())
    part = Part(_TYPES[found[1]], shape, start + _NPY.size + length, (Piece(start, end, sha256),))
    if part.start + part.size != end:
        raise ValueError(f'{name} has {end - part.start} bytes, {part.size} by its shape {shape}')
    return part
