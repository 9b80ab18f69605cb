# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checkpoints for the tests: random parameters, in the formats of Python 2 and torch 0.3."""

from collections import OrderedDict
from dataclasses import dataclass
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


class OldPickle:
    """Pickles as of Python 2 (byte strings, long numbers); storages are kept for later."""

    def __init__(self) -> None:
        self.storages: dict[str, torch.Tensor] = {}

    def file(self, content: object) -> bytes:
        """Return the whole file: five pickles, then the numbers of all storages."""
        system = {
            'protocol_version': PROTOCOL,
            'little_endian': True,
            'type_sizes': {'int': 4, 'long': 4},
        }
        parts = [self.pickle(part) for part in (MAGIC, PROTOCOL, system, content)]
        parts.append(self.pickle(sorted(self.storages)))
        for _, tensor in sorted(self.storages.items()):
            parts += [struct.pack('<q', tensor.numel()), tensor.numpy().tobytes()]
        return b''.join(parts)

    def pickle(self, value: object) -> bytes:
        return b'\x80\x02' + self._emit(value) + b'.'

    def _emit(self, value: object) -> bytes:
        match value:
            case None:
                return b'N'
            case bool():
                return b'\x88' if value else b'\x89'
            case int():
                size = value.bit_length() // 8 + 1
                return b'\x8a' + bytes([size]) + value.to_bytes(size, 'little', signed=True)
            case float():
                return b'G' + struct.pack('>d', value)
            case str():
                return b'U' + bytes([len(value)]) + value.encode()
            case Global():
                return f'c{value.module}\n{value.name}\n'.encode()
            case Call():
                return self._emit(value.function) + self._emit(value.arguments) + b'R'
            case OrderedDict():
                return self._emit(
                    Call(Global('collections', 'OrderedDict'), ([list(x) for x in value.items()],))
                )
            case dict():
                items = b''.join(self._emit(part) for item in value.items() for part in item)
                return b'}(' + items + b'u'
            case list():
                return b'](' + b''.join(map(self._emit, value)) + b'e'
            case tuple():
                return b'(' + b''.join(map(self._emit, value)) + b't'
            case torch.Tensor():
                return self._tensor(value)
        raise TypeError(type(value))

    def _tensor(self, tensor: torch.Tensor) -> bytes:
        key = str(94000000 + len(self.storages))
        expanded = not any(tensor.stride())  # of one element
        self.storages[key] = tensor.as_strided((1,), (1,)) if expanded else tensor.contiguous()
        kind = Global('torch.cuda', 'FloatStorage')
        size = self.storages[key].numel()
        storage = self._emit(('storage', kind, key, 'cuda:0', size, None)) + b'Q'
        strides = tensor.stride() if expanded else tensor.contiguous().stride()
        view = b'(' + storage + b''.join(map(self._emit, (0, tuple(tensor.shape), strides))) + b't'
        return self._emit(Global('torch._utils', '_rebuild_tensor')) + view + b'R'


@dataclass
class Global:
    module: str
    name: str


@dataclass
class Call:
    function: Global
    arguments: tuple[object, ...]


@dataclass
class Hostile:
    """Writes a file when it is unpickled."""

    path: str

    def __reduce__(self):
        return (open, (self.path, 'w'))


def places365_file(parameters: dict[str, torch.Tensor]) -> bytes:
    """Return a checkpoint as Places365 publishes it: old names, ``module.``, other entries."""
    old = OrderedDict()
    for name, value in parameters.items():
        older = name
        for part in ('norm1', 'norm2', 'conv1', 'conv2') if '.denselayer' in name else ():
            older = older.replace(f'.{part}.', f'.{part[:-1]}.{part[-1]}.')
        old[f'module.{older}'] = value
    entries = {'epoch': 90, 'arch': 'densenet161', 'state_dict': old, 'best_prec1': 56.1}
    return OldPickle().file(entries)
