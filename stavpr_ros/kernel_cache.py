# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of compiled kernels: damaged ones are compiled anew, and none is needed to go on."""

import hashlib
import logging
import multiprocessing
from pathlib import Path
import pickle
from typing import Any

from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserProvidedCacheLocator,
)
from stavpr_ros.regular_file import ElsewhereError, open_regular

READ_FAILED = 'damaged or not readable, and compiled anew'
WRITE_FAILED = 'they cannot be written, and are compiled again at the next start'
DIGEST_SIZE = 32  # bytes at the head of a file: of its rest
failures: dict[str, str] = {}
"""First reason why files could not be read or written, by what happens instead."""


def _warn_once(consequence: str, path: object, error: Exception) -> None:
    """Log the first failure of a kind, in one line; not in the processes of a pool."""
    if consequence not in failures and multiprocessing.parent_process() is None:
        reason = ' '.join(f'{type(error).__name__}: {error}'.split())[:300]
        text = 'compiled kernels in %s: %s (%s)'
        logging.getLogger('stavpr_ros').warning(text, path, consequence, reason)
    failures.setdefault(consequence, str(error))


class _Locator(UserProvidedCacheLocator):
    """The folder of a kernel's files, which need not exist."""

    @classmethod
    def from_function(cls, function: Any, path: str) -> '_Locator':
        """Return the folder without a trial of writing."""
        return cls(function, path)


class _Implementation(CompileResultCacheImpl):
    _locator_classes = (_Locator,)


class _Files(IndexDataCacheFile):
    """A file for each signature, after a digest of it; without an index that processes share."""

    def _path(self, key: object) -> Path:
        text = f'{self._version} {self._source_stamp} {key}'
        name = hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
        return Path(self._index_path).with_suffix(f'.{name}.nbc')

    def load(self, key: object) -> Any:
        """Return what was saved, None = nothing; OSError, ValueError: it is damaged."""
        try:
            with open_regular(self._path(key)) as file:
                content = file.readall()
        except (FileNotFoundError, ElsewhereError):
            return None
        head, rest = content[:DIGEST_SIZE], content[DIGEST_SIZE:]
        if hashlib.blake2b(rest, digest_size=DIGEST_SIZE).digest() != head:
            raise ValueError(f'{self._path(key).name} is not as it was written')
        return pickle.loads(rest)

    def save(self, key: object, data: Any) -> None:
        """Write a file in one step."""
        rest = self._dump(data)
        with self._open_for_write(str(self._path(key))) as file:
            file.write(hashlib.blake2b(rest, digest_size=DIGEST_SIZE).digest() + rest)


class KernelCache(FunctionCache):
    """The compiled forms of a kernel in ``numba.config.CACHE_DIR``."""

    _impl_class = _Implementation

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = _Files(self._cache_path, self._impl.filename_base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return a compiled form, None = it is to be compiled."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # of the file, or of what LLVM makes of its content
            _warn_once(READ_FAILED, self._cache_path, error)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled form, if the disk lets."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn_once(WRITE_FAILED, self._cache_path, error)
