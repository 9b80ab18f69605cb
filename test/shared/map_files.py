# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Map files, taken apart and put together again with correct hashes."""

from collections.abc import Callable
import hashlib
import json

import numpy as np

PIECE = 2**22


def parts_of(content: bytes) -> tuple[dict, dict[str, tuple[str, list[int], bytes]]]:
    """Return the manifest of a file, and type, shape and bytes of its tensors."""
    length = int.from_bytes(content[:8], 'little')
    header = json.loads(content[8 : 8 + length])
    manifest = json.loads(header.pop('__metadata__')['manifest'])
    tensors = {}
    for name, tensor in header.items():
        first, last = (8 + length + offset for offset in tensor['data_offsets'])
        tensors[name] = tensor['dtype'], tensor['shape'], content[first:last]
    return manifest, tensors


def hashes(content: bytes) -> list[str]:
    pieces = [content[at : at + PIECE] for at in range(0, len(content), PIECE)]
    return [hashlib.sha256(piece).hexdigest() for piece in pieces]


def version2(manifest: dict, tensors: dict, metadata: dict | None = None) -> bytes:
    """Put a file together; ``metadata`` replaces entries of its header."""
    listed = {
        name: {'dtype': dtype, 'shape': shape, 'sha256': hashes(content)}
        for name, (dtype, shape, content) in tensors.items()
    }
    text = json.dumps({'parts': listed} | manifest)
    header: dict = {
        '__metadata__': {
            'format': 'stavpr-map',
            'version': '2',
            'manifest': text,
            'sha256': hashlib.sha256(text.encode('utf-8', 'surrogatepass')).hexdigest(),
        }
        | (metadata or {})
    }
    end = 0
    for name, (dtype, shape, content) in tensors.items():
        start, end = end, end + len(content)
        header[name] = {'dtype': dtype, 'shape': shape, 'data_offsets': [start, end]}
    encoded = json.dumps(header).encode()
    return (
        len(encoded).to_bytes(8, 'little')
        + encoded
        + b''.join(content for _, _, content in tensors.values())
    )


def tensor(array: np.ndarray) -> tuple[str, list[int], bytes]:
    """Return type, shape and bytes of an array."""
    names = {'f': 'F', 'i': 'I', 'u': 'U'}
    return (
        f'{names[array.dtype.kind]}{array.itemsize * 8}',
        list(array.shape),
        np.ascontiguousarray(array).tobytes(),
    )


def array_of(part: tuple[str, list[int], bytes]) -> np.ndarray:
    """Return the array of a tensor."""
    dtype = part[0].lower().replace('f', 'float').replace('i', 'int').replace('u', 'uint')
    return np.frombuffer(part[2], dtype).reshape(part[1]).copy()


def alter(content: bytes, change: Callable | None = None, **parts: np.ndarray | None) -> bytes:
    """
    Return a file with another manifest, and other parts.

    :param change: changes the manifest.
    :param parts: by name, ``__`` for its slash; None drops one.
    """
    manifest, tensors = parts_of(content)
    del manifest['parts']
    for key, array in parts.items():
        name = key.replace('__', '/')
        tensors.pop(name, None)
        if array is not None:
            tensors[name] = tensor(array)
    if change is not None:
        change(manifest)
    return version2(manifest, tensors)


def network(**values: object) -> Callable[[dict], None]:
    """Return a change of a manifest: to features of an ONNX file of these settings."""

    def change(manifest: dict) -> None:
        manifest['settings'] |= {
            'kind': 'onnx',
            'backbone': {
                'size': 32, 'resize': 'area', 'layer': 'y', 'channels': 'rgb', 'scale': 1.0,
                'mean': [0, 0, 0], 'std': [1, 1, 1], 'sha256': '0' * 64,
            } | values,
        }  # fmt: skip
        manifest['cells'] = None

    return change
