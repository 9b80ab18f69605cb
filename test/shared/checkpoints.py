# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoints for the tests: random parameters, in the formats of Python 2 and torch 0.3."""

from collections import OrderedDict
from dataclasses import dataclass
import io
import os
import pickle
import struct

import numpy as np
import torch

# The first two numbers in every file from before torch 1.6.
MAGIC, PROTOCOL = 0x1950A86A20F9469CFC6C, 1001


def random_parameters(
    shapes: dict[str, tuple[int, ...]], seed: int = 0
) -> dict[str, torch.Tensor]:
    """
    Return parameters that keep the maps at about one scale, equal to the bit on every machine.

    Those of linear layers are zeros, one element in memory.
    """
    generator = np.random.RandomState(seed)  # whose bytes are the same in every version of numpy
    parameters = {}
    for name, shape in shapes.items():
        if len(shape) == 2:
            parameters[name] = torch.zeros(1).expand(shape)
            continue
        numbers = np.frombuffer(generator.bytes(int(np.prod(shape))), np.int8)
        noise = torch.from_numpy(numbers.reshape(shape).astype(np.float32) / 74)  # deviation 1
        if len(shape) == 4:
            noise *= (2 / (shape[1] * shape[2] * shape[3])) ** 0.5
        elif name.endswith('running_var'):
            noise = noise.abs() + 0.5
        elif 'norm' in name and name.endswith('weight'):
            noise = 1 + 0.2 * noise
        else:
            noise *= 0.2
        parameters[name] = noise
    return parameters


class OldPickle(pickle._Pickler):
    """Pickles as of Python 2 (byte strings, long numbers); storages are kept for later."""

    dispatch = pickle._Pickler.dispatch.copy()

    def __init__(self, storages: dict[str, torch.Tensor]) -> None:
        self.stream, self.storages = io.BytesIO(), storages
        super().__init__(self.stream, protocol=2)

    def save_bytes_string(self, text: str) -> None:
        self.write(pickle.SHORT_BINSTRING + bytes([len(text)]) + text.encode())

    def save_long_number(self, number: int) -> None:
        size = number.bit_length() // 8 + 1
        self.write(pickle.LONG1 + bytes([size]) + number.to_bytes(size, 'little', signed=True))

    dispatch[str] = save_bytes_string
    dispatch[int] = save_long_number

    def persistent_id(self, value: object) -> tuple[object, ...] | None:
        if not isinstance(value, Storage):
            return None
        key, size = value.key, self.storages[value.key].numel()
        return ('storage', torch.cuda.FloatStorage, key, 'cuda:0', size, None)

    def reducer_override(self, value: object) -> object:
        if isinstance(value, OrderedDict):
            return OrderedDict, ([list(item) for item in value.items()],)
        if not isinstance(value, torch.Tensor):
            return NotImplemented
        key = str(94000000 + len(self.storages))
        expanded = not any(value.stride())  # of one element
        self.storages[key] = value.as_strided((1,), (1,)) if expanded else value.contiguous()
        strides = value.stride() if expanded else value.contiguous().stride()
        return torch._utils._rebuild_tensor, (Storage(key), 0, tuple(value.shape), strides)


@dataclass
class Storage:
    key: str


def old_file(content: object) -> bytes:
    """Return a file of before torch 1.6: five pickles, then the numbers of all storages."""
    storages: dict[str, torch.Tensor] = {}
    sizes = {'int': 4, 'long': 4}
    system = {'protocol_version': PROTOCOL, 'little_endian': True, 'type_sizes': sizes}
    parts = []
    for part in (MAGIC, PROTOCOL, system, content, None):
        pickler = OldPickle(storages)
        pickler.dump(sorted(storages) if part is None else part)
        parts.append(pickler.stream.getvalue())
    for _, tensor in sorted(storages.items()):
        parts += [struct.pack('<q', tensor.numel()), tensor.numpy().tobytes()]
    return b''.join(parts)


@dataclass
class Hostile:
    """Makes a folder when it is unpickled."""

    path: str

    def __reduce__(self):
        return (os.mkdir, (self.path,))


def places365_file(parameters: dict[str, torch.Tensor]) -> bytes:
    """Return a checkpoint as that of Places365: old names, ``module.``, other entries beside."""
    old = OrderedDict()
    for name, value in parameters.items():
        older = name
        for part in ('norm1', 'norm2', 'conv1', 'conv2') if '.denselayer' in name else ():
            older = older.replace(f'.{part}.', f'.{part[:-1]}.{part[-1]}.')
        old[f'module.{older}'] = value
    entries = {'epoch': 90, 'arch': 'densenet161', 'state_dict': old, 'best_prec1': 56.1}
    return old_file(entries)
