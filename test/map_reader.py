# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A reader of map files, written from docs/map_format.md alone: nothing of this package."""

import hashlib
import json
import math

import numpy as np

TYPES = {
    'F64': '<f8',
    'I64': '<i8',
    'F32': '<f4',
    'I32': '<i4',
    'F16': '<f2',
    'U8': 'u1',
    'I8': 'i1',
}


def read(path):
    """Return the manifest, and the arrays of the map by name, ids and thumbnails as lists."""
    with open(path, 'rb') as file:
        content = file.read()
    length = int.from_bytes(content[:8], 'little')
    header = json.loads(content[8 : 8 + length])
    metadata = header.pop('__metadata__')
    assert (metadata['format'], metadata['version']) == ('stavpr-map', '2')
    text = metadata['manifest'].encode()
    assert hashlib.sha256(text).hexdigest() == metadata['sha256']
    manifest = json.loads(text)
    assert not any(section['required'] for section in manifest['sections'].values())
    arrays = {}
    for name, part in manifest['parts'].items():
        first, last = (8 + length + offset for offset in header[name]['data_offsets'])
        data = content[first:last]
        pieces = [data[at : at + 2**22] for at in range(0, len(data), 2**22)]
        assert part['sha256'] == [hashlib.sha256(piece).hexdigest() for piece in pieces]
        array = np.frombuffer(data, TYPES[part['dtype']])
        assert array.size == math.prod(part['shape'])
        arrays[name] = array.reshape(part['shape'])
    for name, ends in (('ids', 'id_ends'), ('thumbnails', 'thumbnail_ends')):
        if name in arrays:
            data, last = arrays[name].tobytes(), arrays.pop(ends).tolist()
            arrays[name] = [data[a:b] for a, b in zip([0, *last], last, strict=False)]
    if 'ids' in arrays:
        arrays['ids'] = [text.decode() for text in arrays['ids']]
    return manifest, arrays
