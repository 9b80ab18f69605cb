# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of compiled kernels: damaged ones are compiled anew, and none is needed to go on."""

from functools import cache
from hashlib import blake2b
import logging
import multiprocessing
from pathlib import Path
import pickle
from tempfile import TemporaryDirectory
from typing import Any

import numba
from numba.core.caching import Cache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from stavpr_ros.regular_file import ElsewhereError, open_regular

READ_FAILED = 'damaged or not readable, and compiled anew'
WRITE_FAILED = 'they cannot be written, and are compiled again at the next start'
failures: dict[str, str] = {}
"""First reason why files could not be read or written, by what happens instead."""


class KernelCache(Cache):
    """The compiled forms of a kernel in ``numba.config.CACHE_DIR``, each after its digest."""

    def __init__(self, function: Any) -> None:
        self._py_func, self._name = function, f'{function.__module__}.{function.__qualname__}'
        self._cache_path = numba.config.CACHE_DIR
        code = function.__code__
        self._version = numba.__version__, _of_source(code.co_filename), code.co_firstlineno
        self.enable()

    def _file(self, sig: Any, codegen: Any) -> Path:
        key = f'{self._version} {self._index_key(sig, codegen)}'
        return Path(self._cache_path, f'{self._name}.{_digest(key.encode()).hex()[:16]}.nbc')

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return a compiled form, None = it is to be compiled."""
        try:
            target_context.refresh()
            with open_regular(self._file(sig, target_context.codegen())) as file:
                content = file.readall()
            digest, rest = content[:32], content[32:]
            if _digest(rest) != digest:
                raise ValueError(f'{file.name} is not as it was written')
            return CompileResult._rebuild(target_context, *pickle.loads(rest))
        except (FileNotFoundError, ElsewhereError):
            return None
        except Exception as error:  # of the file, or of what LLVM makes of its content
            return self._warn_once(READ_FAILED, error)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled form, in one step, if the disk lets."""
        if data.library.has_dynamic_globals:  # addresses of this process
            return
        try:
            rest, folder = dumps(data._reduce()), Path(self._cache_path)
            folder.mkdir(parents=True, exist_ok=True)
            with TemporaryDirectory(dir=folder) as temporary:
                file = Path(temporary, 'kernel')
                file.write_bytes(_digest(rest) + rest)
                file.replace(self._file(sig, data.codegen))
        except OSError as error:
            self._warn_once(WRITE_FAILED, error)

    def _warn_once(self, consequence: str, error: Exception) -> None:
        """Log the first failure of a kind, in one line; not in the processes of a pool."""
        if consequence not in failures and multiprocessing.parent_process() is None:
            reason = ' '.join(f'{type(error).__name__}: {error}'.split())[:300]
            text = 'compiled kernels in %s: %s (%s)'
            logging.getLogger('stavpr_ros').warning(text, self._cache_path, consequence, reason)
        failures.setdefault(consequence, str(error))


def _digest(content: bytes) -> bytes:
    return blake2b(content, digest_size=32).digest()


@cache
def _of_source(path: str) -> bytes:
    return _digest(Path(path).read_bytes())
