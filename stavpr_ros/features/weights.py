# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of models: paths, downloads, hashes; and checkpoints into networks."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
import hashlib
import http.client
import io
import os
from pathlib import Path
import re
import tempfile
from typing import Any, BinaryIO, IO
import urllib.request

import numpy as np
from stavpr_ros.errors import FeatureMismatchError, UnavailableError
from stavpr_ros.features.registry import CACHED
from stavpr_ros.regular_file import open_regular
import torch
from torch import nn
from tqdm import tqdm

TIMEOUT = 30  # seconds without a byte
PIECE = 1 << 20  # bytes
HASH_FILE = 4096  # bytes read of NAME.sha256
SCHEMES = ('https',)  # of downloads
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


def cache_folder() -> Path:
    """Return the folder of downloads, ``$XDG_CACHE_HOME/stavpr_ros`` or below ``~/.cache``."""
    return Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache') / 'stavpr_ros'


def models_folder() -> Path:
    """Return the folder of the user's models: ``$STAVPR_MODELS``, or below ``~/.local/share``."""
    share = os.environ.get('XDG_DATA_HOME') or Path.home() / '.local' / 'share'
    return Path(os.environ.get('STAVPR_MODELS') or Path(share) / 'stavpr_ros' / 'models')


def find_model(sha256: str, stated: str) -> Path:
    """
    Find the model of a map, which is known by its hash only.

    :param stated: a file, which is returned; or a folder to look in; '' = the models folder and
        the cache of downloads.
    :raises UnavailableError: none of the files there has this hash.
    """
    if stated and not Path(stated).is_dir():
        return Path(stated)
    folders = [Path(stated)] if stated else [models_folder(), cache_folder()]
    files = [file for folder in folders if folder.is_dir() for file in sorted(folder.iterdir())]
    for file in sorted(files, key=lambda file: sha256[:8] not in file.name):
        if file.is_file() and os.access(file, os.R_OK):
            with open_model(file) as content:
                if hashlib.file_digest(content, 'sha256').hexdigest() == sha256:
                    return file
    raise UnavailableError(
        f'the model with sha256 {sha256} is not in {" or ".join(map(str, folders))}: copy the '
        'file that the map was built with there, or give its path as model_path'
    )


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


def open_model(path: Path) -> io.BufferedReader:
    """
    Open the file of a model.

    :raises UnavailableError: it cannot be read, or is no regular file.
    """
    try:
        return io.BufferedReader(open_regular(path))
    except OSError as error:
        raise UnavailableError(f'model {str(path)!r} cannot be read: {error}') from error


def read_model(path: Path, expected: str = '', required: str = '') -> tuple[BinaryIO, str]:
    """
    Read a model into memory and check its hash: what is checked is what is used.

    :param expected: its hash, see :func:`expected_hash`, '' for any.
    :param required: the hash that a map states, '' for any.
    :returns: its content, as a file, and its sha256.
    :raises UnavailableError: it cannot be read, or is damaged.
    :raises FeatureMismatchError: it is another file than the required one.
    """
    try:
        with open_model(path) as file:
            content = file.read()
    except OSError as error:
        raise UnavailableError(f'model {str(path)!r} cannot be read: {error}') from error
    digest = hashlib.sha256(content).hexdigest()
    if expected and digest != expected:
        raise UnavailableError(
            f'{path} has sha256 {digest[:16]}, expected {expected[:16]}: it is damaged or '
            'another file; delete it and get it again'
        )
    if required and digest != required:
        raise FeatureMismatchError(
            f'model {path} has sha256 {digest[:16]}, the settings require {required[:16]}: '
            'give the file that the map was built with'
        )
    return io.BytesIO(content), digest


def download(address: str, path: Path, sha256: str) -> None:
    """
    Download a file; it appears under its name complete and checked, or not at all.

    :param sha256: its required hash, all 64 digits.
    :raises UnavailableError: the download fails, is incomplete or has another hash.
    """
    advice = f'download it by other means and give its path, or copy it to {path}'
    partial = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            dir=path.parent, prefix=f'{path.name}.', delete=False
        ) as file:
            partial = Path(file.name)
            digest = _fetch(address, file, path.name)
        if digest != sha256:
            raise UnavailableError(
                f'the file from {address} has sha256 {digest}, expected {sha256}: it was changed '
                f'or damaged on its way; try again, or {advice}'
            )
        _hash_file(path).write_text(f'{digest}  {path.name}\n')
        partial.replace(path)
    except (OSError, http.client.HTTPException) as error:
        raise UnavailableError(f'{address} cannot be downloaded ({error}): {advice}') from error
    finally:
        if partial is not None:
            partial.unlink(missing_ok=True)


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to the allowed schemes only."""

    def redirect_request(self, *request: Any) -> urllib.request.Request | None:
        _require_scheme(request[-1])  # the new address
        return super().redirect_request(*request)


def _require_scheme(address: str) -> None:
    if address.partition(':')[0] not in SCHEMES:
        raise OSError(f'{address} is not {" or ".join(SCHEMES)}')


def _fetch(address: str, file: IO[bytes], name: str) -> str:
    """Copy the content of an address into a file and return its sha256."""
    digest, received = hashlib.sha256(), 0
    _require_scheme(address)
    with urllib.request.build_opener(_Redirects).open(address, timeout=TIMEOUT) as response:
        length = response.headers.get('Content-Length')
        total = int(length) if length and length.isdigit() else None
        with tqdm(total=total, unit='B', unit_scale=True, desc=name, disable=None) as bar:
            while piece := response.read(PIECE):
                file.write(piece)
                digest.update(piece)
                received += len(piece)
                bar.update(len(piece))
    if total is not None and received != total:
        raise OSError(f'only {received} of {total} bytes received')
    return digest.hexdigest()


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
        blocked = re.search(r'GLOBAL (\S+)', str(error))
        if blocked:
            reason = f'it requires {blocked[1]}, which is not plain weights and was not executed'
        raise UnavailableError(f'{name} cannot be read as a file of weights: {reason}') from error
    if isinstance(content, Mapping) and isinstance(content.get('state_dict'), Mapping):
        content = content['state_dict']
    if not isinstance(content, Mapping) or not content:
        raise UnavailableError(
            f'{name} holds {_kind(content)}: expected the parameters of a network by name'
        )
    for key, value in content.items():
        if not isinstance(key, str) or not isinstance(value, torch.Tensor):
            raise UnavailableError(
                f'{name} holds {_kind(value)} as {key!r}: expected parameters by name'
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
    """Return the last line of an error of torch: those before it are a trace of the program."""
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
    given = {key: value for key, value in parameters.items() if not key.endswith(COUNTER)}
    wrong = f'{name} is no file of weights of {type(network).__name__}'
    missing, unknown = sorted(expected.keys() - given), sorted(given.keys() - expected)
    if missing:
        raise UnavailableError(f'{wrong}: it lacks {_listed(missing)}')
    if unknown:
        raise UnavailableError(f'{wrong}: it has {_listed(unknown)}, unknown to the network')
    floats: dict[str, torch.Tensor] = {}
    for key, value in given.items():
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
            raise UnavailableError(f'{name} is damaged: {key} holds NaN or infinite numbers')
    counters = {key: torch.zeros((), dtype=torch.long) for key in state if key.endswith(COUNTER)}
    network.load_state_dict(floats | counters, assign=True)


def _listed(names: list[str]) -> str:
    return repr(names[0]) + (f' and {len(names) - 1} more' if len(names) > 1 else '')
