# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compilation of the kernels: cached on disk, without the interpreter's lock, IEEE numbers."""

from collections.abc import Callable
import ctypes
from functools import partial
import hashlib
import logging
import multiprocessing
import os
from pathlib import Path
import platform
import shutil
import sys
import tempfile
from typing import Any

from llvmlite import binding
import numba as nb
from numba.core import event
from numba.core.runtime import nrtdynmod
from stavpr_ros.kernel_cache import KernelCache, reference_counting
from stavpr_ros.progress import shows_bars
from tqdm import tqdm

AT_HWCAP, HWCAP_ASIMDDP = 16, 1 << 20  # of Linux on aarch64: sys/auxv.h, asm/hwcap.h
COMPILING = 'compiling kernels, once, one to two minutes'
PACKAGE = Path(__file__).parent
OWN_CACHE = PACKAGE / '__pycache__' / 'kernels'
KERNELS = 355  # that `stavpr warm` compiles with all packages, for the progress bar

# Of numba's threading layers, the default's fallback aborts the process when two threads meet in
# it.
if nb.config.THREADING_LAYER == 'default':
    nb.config.THREADING_LAYER = 'threadsafe'


def _has_dotprod() -> bool:
    """Whether this is an ARM processor with ``sdot``, as the kernel of Linux reports it."""
    if (platform.system(), platform.machine()) != ('Linux', 'aarch64'):
        return False
    getauxval = ctypes.CDLL(None).getauxval
    getauxval.argtypes, getauxval.restype = [ctypes.c_ulong], ctypes.c_ulong
    return bool(getauxval(AT_HWCAP) & HWCAP_ASIMDDP)


# LLVM's list of the host's features lacks dotprod, even where the processor's name implies it
if nb.config.CPU_FEATURES is None and _has_dotprod():
    nb.config.CPU_FEATURES = f'{binding.get_host_cpu_features().flatten()},+neon,+dotprod'


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _temporary_folder(template: Path | None) -> Path | None:
    """Return the user's temporary folder of kernels, at first a copy of a filled one, or None."""
    try:
        folder = Path(tempfile.gettempdir()) / f'stavpr_kernels_{os.getuid()}'
        if not folder.exists():
            with tempfile.TemporaryDirectory() as copy:  # removed where the disk is full
                if template is not None:
                    shutil.copytree(template, copy, dirs_exist_ok=True)
                os.chmod(copy, 0o700)
                os.rename(copy, folder)
        status = folder.lstat()
    except (OSError, shutil.Error):
        return None
    # of another user, it is not taken: numba unpickles the files in it
    is_own = status.st_uid == os.getuid() and not status.st_mode & 0o022
    return folder if is_own and not folder.is_symlink() and _is_writable(folder) else None


def cache_folder() -> Path | None:
    """
    Return the folder of the compiled kernels, None = none can be written.

    NUMBA_CACHE_DIR, or else the first that can be written of the package's and the user's cache;
    otherwise a temporary one, which is logged.
    """
    if environment := os.environ.get('NUMBA_CACHE_DIR'):
        folders = [Path(environment)]
    else:
        user = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')
        folders = [OWN_CACHE, Path(user) / 'stavpr']
    for folder in folders:
        if folder.is_absolute() and _is_writable(folder):
            return folder
    temporary = _temporary_folder(next(filter(Path.is_dir, folders), None))
    if multiprocessing.parent_process() is None:
        logging.getLogger('stavpr_ros').warning(
            'no cache folder of kernels can be written (%s): %s; set NUMBA_CACHE_DIR to a folder '
            'that can be, and run `stavpr warm` once',
            ', '.join(map(str, folders)),
            f'{temporary} is used' if temporary else 'they are compiled at each start',
        )
    return temporary


class _Progress(event.Listener):
    """Reports the compilation of kernels that are not in the cache."""

    def __init__(self) -> None:
        self.announce: Callable[[str], object] | None = None
        self._bar: tqdm | None = None
        self._depth = self._compiled = 0

    def on_start(self, event: event.Event) -> None:
        """Show a progress bar, or announce the first kernel, on a terminal or not."""
        if self.announce is None and not shows_bars():
            self.announce = partial(print, file=sys.stderr, flush=True)
        if self._depth == 0 and self.announce is None:
            self._bar = tqdm(
                desc=COMPILING,
                total=KERNELS,
                initial=self._compiled,
                unit='kernel',
                leave=False,
                disable=None,
            )
        elif self._compiled == self._depth == 0 and self.announce is not None:
            self.announce(COMPILING)
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """Count a kernel."""
        self._depth -= 1
        self._compiled += 1
        if self._bar is not None:
            self._bar.update()
            if self._depth == 0:
                self._bar.close()


progress = _Progress()
"""Set its ``announce`` to log one line instead of the progress bar."""

event.register('numba:compile', progress)


def _digest() -> str:
    """Return a digest of all kernels: numba compares the module of each alone with its cache."""
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(PACKAGE.rglob('*.py')):
        source = path.read_bytes()
        if b'stavpr_ros.compilation' in source or b'numba' in source:
            digest.update(source)
    return digest.hexdigest()


CACHE = cache_folder()
"""Folder of these compiled kernels, None = none can be written."""

if CACHE is not None:
    of_version = CACHE / _digest()
    if CACHE == OWN_CACHE and not of_version.is_dir():
        shutil.rmtree(CACHE, ignore_errors=True)  # of an earlier version of the package
    CACHE = of_version
    nb.config.CACHE_DIR = str(CACHE)
    nrtdynmod.compile_nrt_functions = reference_counting


def _decorator(**options: Any) -> Any:
    """Return a decorator of kernels, which are kept in the cache if there is one."""
    compiled = nb.njit(nogil=True, error_model='numpy', **options)

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = compiled(function)
        if CACHE is not None:
            dispatcher._cache = KernelCache(function)
        return dispatcher

    return decorate


kernel = _decorator()
parallel_kernel = _decorator(parallel=True)
# Sums in any order, products fused into them: dot products over lanes. Infinities and NaN stay as
# they are.
reassociating_kernel = _decorator(fastmath={'reassoc', 'contract', 'nsz'})
