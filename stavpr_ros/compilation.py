# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compilation of the kernels: cached on disk, without the interpreter's lock, IEEE numbers."""

import numba as nb

# Of numba's threading layers, the default's fallback aborts the process when two threads meet in
# it.
if nb.config.THREADING_LAYER == 'default':
    nb.config.THREADING_LAYER = 'threadsafe'

kernel = nb.njit(cache=True, nogil=True, error_model='numpy')
parallel_kernel = nb.njit(cache=True, nogil=True, parallel=True, error_model='numpy')
# Sums in any order, products fused into them: dot products over lanes. Infinities and NaN stay as
# they are.
reassociating_kernel = nb.njit(
    cache=True, nogil=True, error_model='numpy', fastmath={'reassoc', 'contract', 'nsz'}
)
