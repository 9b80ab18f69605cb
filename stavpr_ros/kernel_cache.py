# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of compiled kernels: damaged ones are compiled anew, and none is needed to go on."""

from collections.abc import Callable
from functools import cache, partial
from hashlib import blake2b
import logging
import multiprocessing
from pathlib import Path
import pickle
from tempfile import TemporaryDirectory
from typing import Any

from llvmlite import binding
import numba
from numba.core.caching import Cache
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import CompileResult
from numba.core.runtime import nrtdynmod
from numba.core.serialize import dumps
from stavpr_ros.regular_file import ElsewhereError, open_regular

READ_FAILED = 'damaged or not readable, and compiled anew'
WRITE_FAILED = 'they cannot be written, and are compiled again at the next start'
OURS = 'stavpr'  # kind of what is kept
failures: dict[str, str] = {}
"""First reason why files could not be read or written, by what happens instead."""


class Library(JITCodeLibrary):
    """
    Compiled code; of code from our cache, the bitcode is parsed only where a caller is compiled.

    Parsed, it takes ten times the memory of the machine's code.
    """

    _bitcode = b''

    def state(self) -> tuple[str, str, Any]:
        """Return what is kept: name, kind, defined symbols, machine's code and bitcode."""
        module = self._get_module_for_linking()
        symbols = (*module.functions, *module.global_variables)
        names = {symbol.name for symbol in symbols if not symbol.is_declaration}
        return self.name, OURS, (names, *self.serialize_using_object_code()[2])

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, Any]) -> Any:
        name, kind, content = state
        if kind != OURS:  # of a cache of numba
            return super()._unserialize(codegen, state)
        library = cls(codegen, name)
        names, code, library._bitcode = content
        library.enable_object_caching()
        library._set_compiled_object(code)
        library._finalize_final_module()
        codegen._engine._defined_symbols |= names
        return library

    def _get_module_for_linking(self) -> Any:
        if self._bitcode:
            self._shared_module = binding.parse_bitcode(self._bitcode)
            self._bitcode = b''
        return super()._get_module_for_linking()


JITCPUCodegen._library_class = Library


def reference_counting(context: Any) -> Library:
    """
    Return numba's functions that count references, which it compiles at each start otherwise.

    That makes the parts of LLVM resident that optimize and emit code, 20 MB.
    """
    codegen = context.codegen()
    file = _file('numba.reference_counting', codegen.magic_tuple())
    library = _load(file, codegen.unserialize_library)
    if library is None:
        module, library = nrtdynmod.create_nrt_module(context)
        library.enable_object_caching()
        library.add_ir_module(module)
        library.finalize()
        _save(file, library.state())
    return library


class KernelCache(Cache):
    """The compiled forms of a kernel in ``numba.config.CACHE_DIR``, each after its digest."""

    def __init__(self, function: Any) -> None:
        self._py_func, self._name = function, f'{function.__module__}.{function.__qualname__}'
        self._cache_path = numba.config.CACHE_DIR  # which numba reports
        code = function.__code__
        self._version = _of_source(code.co_filename), code.co_firstlineno
        self.enable()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return a compiled form, None = it is to be compiled."""
        target_context.refresh()
        key = self._version, self._index_key(sig, target_context.codegen())
        rebuild = partial(CompileResult._rebuild, target_context)
        return _load(_file(self._name, key), lambda content: rebuild(*content))

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled form, in one step, if the disk lets."""
        if data.library.has_dynamic_globals:  # addresses of this process
            return
        key = self._version, self._index_key(sig, data.codegen)
        _save(_file(self._name, key), (data.library.state(), *data._reduce()[1:]))


def _file(name: str, key: Any) -> Path:
    key = f'{numba.__version__} {key}'
    return Path(numba.config.CACHE_DIR, f'{name}.{_digest(key.encode()).hex()[:16]}.nbc')


def _load(path: Path, rebuild: Callable[[Any], Any]) -> Any:
    """Return what is built from the content of a file, None = from none."""
    try:
        with open_regular(path) as file:
            content = file.readall()
        digest, rest = content[:32], content[32:]
        if _digest(rest) != digest:
            raise ValueError(f'{path} is not as it was written')
        return rebuild(pickle.loads(rest))
    except (FileNotFoundError, ElsewhereError):
        return None
    except Exception as error:  # of the file, or of what LLVM makes of its content
        return _warn_once(READ_FAILED, error)


def _save(path: Path, content: Any) -> None:
    try:
        rest = dumps(content)
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=path.parent) as temporary:
            file = Path(temporary, 'kernel')
            file.write_bytes(_digest(rest) + rest)
            file.replace(path)
    except OSError as error:
        _warn_once(WRITE_FAILED, error)


def _warn_once(consequence: str, error: Exception) -> None:
    """Log the first failure of a kind, in one line; not in the processes of a pool."""
    if consequence not in failures and multiprocessing.parent_process() is None:
        reason = ' '.join(f'{type(error).__name__}: {error}'.split())[:300]
        text = 'compiled kernels in %s: %s (%s)'
        folder = numba.config.CACHE_DIR
        logging.getLogger('stavpr_ros').warning(text, folder, consequence, reason)
    failures.setdefault(consequence, str(error))


def _digest(content: bytes) -> bytes:
    return blake2b(content, digest_size=32).digest()


@cache
def _of_source(path: str) -> bytes:
    return _digest(Path(path).read_bytes())
