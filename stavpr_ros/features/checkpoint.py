"""Published checkpoints into networks: read without executing anything, held against the network's shapes."""

import re
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import nn

from stavpr_ros.errors import UnavailableError

COUNTER = '.num_batches_tracked'  # of training only; checkpoints from before torch 0.4 have none


def read_checkpoint(file: BinaryIO, name: str) -> dict[str, torch.Tensor]:
    """
    Read the parameters in a checkpoint: the file itself, or its entry ``state_dict``.

    Nothing in the file is executed: it is read with ``weights_only=True``, and a file that needs more than
    tensors, numbers and containers is refused. A prefix ``module.`` (of DataParallel) is taken off.

    :param name: of the file, for errors.
    :raises UnavailableError: it is damaged, no checkpoint, or needs more than that.
    """
    try:
        content = torch.load(file, map_location='cpu', weights_only=True)
    except Exception as error:  # what damaged files raise is not bounded
        reason = str(error).strip().split('\n')[-1] or type(error).__name__
        blocked = re.search(r'GLOBAL (\S+)', str(error))
        if blocked:
            reason = f'it asks for {blocked[1]}, which is not plain weights and was not executed'
        raise UnavailableError(f'{name} cannot be read as a file of weights: {reason}') from error
    if isinstance(content, Mapping) and isinstance(content.get('state_dict'), Mapping):
        content = content['state_dict']
    if not isinstance(content, Mapping) or not content:
        raise UnavailableError(f'{name} holds {_what(content)}: expected the parameters of a network by name')
    for key, value in content.items():
        if not isinstance(key, str) or not isinstance(value, torch.Tensor):
            raise UnavailableError(f'{name} holds {_what(value)} as {key!r}: expected parameters by name')
    return {key.removeprefix('module.'): value for key, value in content.items()}


def _what(value: Any) -> str:
    empty = isinstance(value, Mapping) and not value
    return 'nothing' if empty else f'a {type(value).__name__}'


def load_parameters(network: nn.Module, parameters: Mapping[str, torch.Tensor], name: str) -> None:
    """
    Give a network its parameters, all of which must be there and fit, and no others; on the cpu, float32.

    :param network: may be on the device ``meta``, without memory of its own.
    :param name: of the file, for errors.
    :raises UnavailableError: a parameter is missing, unknown, of another shape, or not finite.
    """
    expected = {key: value for key, value in network.state_dict().items() if not key.endswith(COUNTER)}
    given = {key: value for key, value in parameters.items() if not key.endswith(COUNTER)}
    wrong = f'{name} is no file of weights of {type(network).__name__}'
    missing, unknown = sorted(expected.keys() - given.keys()), sorted(given.keys() - expected.keys())
    if missing:
        raise UnavailableError(f'{wrong}: it lacks {_some(missing)}')
    if unknown:
        raise UnavailableError(f'{wrong}: it has {_some(unknown)}, which the network has not')
    floats: dict[str, torch.Tensor] = {}
    for key, value in given.items():
        if value.shape != expected[key].shape:
            raise UnavailableError(
                f'{wrong}: {key} has shape {tuple(value.shape)}, expected {tuple(expected[key].shape)}'
            )
        if not value.is_floating_point() or value.layout != torch.strided or value.is_meta:
            raise UnavailableError(
                f'{wrong}: {key} is of type {value.dtype}, {value.layout}, no plain floats'
            )
        floats[key] = value.detach().float()
        if not np.isfinite(floats[key].numpy()).all():  # on one thread: torch's would meet 800 times
            raise UnavailableError(f'{name} is damaged: {key} holds NaN or infinite numbers')
    counters = {
        key: torch.zeros((), dtype=torch.long) for key in network.state_dict() if key.endswith(COUNTER)
    }
    network.load_state_dict(floats | counters, assign=True)


def _some(names: list[str]) -> str:
    return repr(names[0]) + (f' and {len(names) - 1} more' if len(names) > 1 else '')
