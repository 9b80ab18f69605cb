# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of models: where they are, and their hashes."""

import hashlib
import io
import os
from pathlib import Path

from stavpr_ros.errors import FeatureMismatchError, UnavailableError
from stavpr_ros.regular_file import home_folder, open_regular


def cache_folder() -> Path:
    """Return the folder of downloads, ``$XDG_CACHE_HOME/stavpr_ros`` or below ``~/.cache``."""
    return Path(os.environ.get('XDG_CACHE_HOME') or home_folder() / '.cache') / 'stavpr_ros'


def models_folder() -> Path:
    """Return the folder of the user's models: ``$STAVPR_MODELS``, or below ``~/.local/share``."""
    share = os.environ.get('XDG_DATA_HOME') or home_folder() / '.local' / 'share'
    return Path(os.environ.get('STAVPR_MODELS') or Path(share) / 'stavpr_ros' / 'models')


def find_model(sha256: str, path: str) -> Path:
    """
    Find the model of a map, which is known by its hash only.

    :param path: a file, which is returned; or a folder to look in; '' = the models folder and
        the cache of downloads.
    :raises UnavailableError: none of the files there has this hash.
    """
    if path and not Path(path).is_dir():
        return Path(path)
    folders = [Path(path)] if path else [models_folder(), cache_folder()]
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


def open_model(path: Path) -> io.BufferedReader:
    """
    Open the file of a model.

    :raises UnavailableError: it cannot be read, or is no regular file.
    """
    try:
        return io.BufferedReader(open_regular(path))
    except OSError as error:
        raise UnavailableError(f'model {str(path)!r} cannot be read: {error}') from error


def read_model(path: Path, expected: str = '', map_hash: str = '') -> tuple[bytes, str]:
    """
    Read a model into memory and check its hash: what is checked is what is used.

    :param expected: its hash, '' for any.
    :param map_hash: the hash that a map states, '' for any.
    :returns: its content and its sha256.
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
    if map_hash and digest != map_hash:
        raise FeatureMismatchError(
            f'model {path} has sha256 {digest[:16]}, the settings require {map_hash[:16]}: '
            'give the file that the map was built with'
        )
    return content, digest
