# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Published weights: downloads, hashes; and checkpoints into networks."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
import http.client
from pathlib import Path
import re
from typing import Any, BinaryIO

import numpy as np
from stavpr_ros.errors import OutputError, UnavailableError
from stavpr_ros.features.model_files import cache_folder
from stavpr_ros.features.registry import CACHED
from stavpr_ros.output_file import ANY, write_output
from stavpr_ros.regular_file import open_regular
import torch
from torch import nn

HASH_FILE = 4096  # bytes read of NAME.sha256
COUNTER = '.num_batches_tracked'  # for training only; missing in files from before torch 0.4


@dataclass(frozen=True)
class PublishedFile:
    """
    A file of weights on the server of its authors.

    :param sha256: '' if unpublished: whoever downloads it must state it.
    """

    address: str
    sha256: str = ''

    @property
    def name(self) -> str:
        """Return the name of the file."""
        return self.address.rsplit('/', 1)[-1]


def published_path(model: str, published: PublishedFile) -> Path:
    """
    Turn a setting into the path of a file.

    :param model: a path; or ``cached``, the published file in the cache.
    :raises UnavailableError: the published file is not there.
    """
    if model != CACHED:
        return Path(model)
    path = cache_folder() / published.name
    if not path.exists():
        raise UnavailableError(
            f'there is no {path}: `stavpr weights` downloads it from {published.address}; or give '
            "the file's path"
        )
    return path


def expected_hash(path: Path, published: PublishedFile | None = None) -> str:
    """
    Return the expected hash of a file, '' if unknown.

    It is the hash published by the authors, else that in ``NAME.sha256`` beside the file, in the
    format of sha256sum: a download writes it, so that later changes are detected.
    """
    if published is not None and published.sha256 and path.name == published.name:
        return published.sha256
    try:
        with open_regular(_hash_file(path)) as file:
            words = file.read(HASH_FILE).decode().split()
    except FileNotFoundError:
        return ''
    except (OSError, ValueError) as error:
        raise UnavailableError(f'{_hash_file(path)} cannot be read: {error}') from error
    return words[0].lower() if words else ''


def _hash_file(path: Path) -> Path:
    return path.with_name(path.name + '.sha256')


def download(address: str, path: Path, sha256: str) -> None:
    """
    Download a file; it appears under its name complete and checked, or not at all.

    :param sha256: its required hash, all 64 digits.
    :raises UnavailableError: the download fails, is incomplete or has another hash.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.hub.download_url_to_file(address, str(path), sha256)
        write_output(_hash_file(path), f'{sha256}  {path.name}\n', ANY, force=True)
    except (OSError, RuntimeError, http.client.HTTPException, OutputError) as error:
        raise UnavailableError(
            f'{address} cannot be downloaded ({error}): try again, or download it by other means '
            f'and give its path, or copy it to {path}'
        ) from error


def read_checkpoint(file: BinaryIO, name: str) -> dict[str, torch.Tensor]:
    """
    Read the parameters in a checkpoint: the file itself, or its entry ``state_dict``.

    Nothing in the file is executed: it is read with ``weights_only=True``, and a file with more
    than tensors, numbers and containers is rejected. A prefix ``module.`` (of DataParallel) is
    removed.

    :raises UnavailableError: it is damaged, no checkpoint, or requires code to be executed.
    """
    try:
        with _numbers_of_numpy():
            content = torch.load(file, map_location='cpu', weights_only=True)
    except Exception as error:  # damaged files raise errors of any type
        reason = last_line(error)
        code = re.search(r'GLOBAL (\S+)', str(error))
        if code:
            reason = f'it requires {code[1]}, which is not plain weights and was not executed'
        raise UnavailableError(f'{name} cannot be read as a file of weights: {reason}') from error
    if isinstance(content, Mapping) and isinstance(content.get('state_dict'), Mapping):
        content = content['state_dict']
    if not isinstance(content, Mapping) or not content:
        raise UnavailableError(
            f'{name} contains {_kind(content)}: expected the parameters of a network by name'
        )
    for key, value in content.items():
        if not isinstance(key, str) or not isinstance(value, torch.Tensor):
            raise UnavailableError(
                f'{name} contains {_kind(value)} as {key!r}: expected parameters by name'
            )
    return {key.removeprefix('module.'): value for key, value in content.items()}


def _numbers_of_numpy() -> AbstractContextManager[None]:
    """Permit numbers of NumPy beside the weights, such as the accuracy of each epoch."""
    if not hasattr(torch.serialization, 'safe_globals'):  # torch before 2.5
        return nullcontext()
    types = [type(np.dtype(name)) for name in ('float32', 'float64', 'int32', 'int64')]
    scalar: Any = np.float64(0).__reduce__()[0]
    names: list[Any] = [(scalar, f'numpy.{core}.multiarray.scalar') for core in ('core', '_core')]
    return torch.serialization.safe_globals([*types, np.dtype, *names])


def last_line(error: Exception) -> str:
    """Return the last line of an error of torch: the lines before are a trace of the program."""
    return str(error).strip().split('\n')[-1] or type(error).__name__


def _kind(value: Any) -> str:
    empty = isinstance(value, Mapping) and not value
    return 'nothing' if empty else f'a {type(value).__name__}'


def load_parameters(network: nn.Module, parameters: Mapping[str, torch.Tensor], name: str) -> None:
    """
    Load all parameters of a network, which must be there and fit, and no others; cpu, float32.

    :param network: may be on the device ``meta``, without memory of its own.
    :raises UnavailableError: a parameter is missing, unknown, of another shape, or not finite.
    """
    state = network.state_dict()
    expected = {key: value for key, value in state.items() if not key.endswith(COUNTER)}
    weights = {key: value for key, value in parameters.items() if not key.endswith(COUNTER)}
    wrong = f'{name} is no file of weights of {type(network).__name__}'
    missing, unknown = sorted(expected.keys() - weights), sorted(weights.keys() - expected)
    if missing:
        raise UnavailableError(f'{wrong}: it lacks {_summary(missing)}')
    if unknown:
        raise UnavailableError(f'{wrong}: it has {_summary(unknown)}, unknown to the network')
    floats: dict[str, torch.Tensor] = {}
    for key, value in weights.items():
        if value.shape != expected[key].shape:
            raise UnavailableError(
                f'{wrong}: {key} has shape {tuple(value.shape)}, expected '
                f'{tuple(expected[key].shape)}'
            )
        if not value.is_floating_point() or value.layout != torch.strided or value.is_meta:
            raise UnavailableError(
                f'{wrong}: {key} is of type {value.dtype}, {value.layout}, no plain floats'
            )
        floats[key] = value.detach().float()
        # numpy: torch would start its threads for each of 800 parameters
        if not np.isfinite(floats[key].numpy()).all():
            raise UnavailableError(f'{name} is damaged: {key} contains NaN or infinite numbers')
    counters = {key: torch.zeros((), dtype=torch.long) for key in state if key.endswith(COUNTER)}
    network.load_state_dict(floats | counters, assign=True)


def _summary(names: list[str]) -> str:
    return repr(names[0]) + (f' and {len(names) - 1} more' if len(names) > 1 else '')
