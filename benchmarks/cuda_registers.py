# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Resources of the compiled CUDA kernels: registers, stack, spills and shared memory, as JSON.

No GPU is needed: numba-cuda compiles each kernel to PTX, and NVIDIA's assembler reports on the
code.

    pip install 'numba-cuda[cu13]'      # and ptxas, a part of the CUDA toolkit, on the PATH
    python benchmarks/cuda_registers.py [--arch 90] [--out FILE]
"""

import argparse
import importlib.util
import json
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

# W and its band: the default, restricted alignment, more strips. l and k: the default and others.
SPATIAL = [(7, 7), (7, 3), (14, 14)]
LEVELS, SPEEDS = 3, 9  # of the place filter
SEQUENCES = [(5, 10), (20, 40), (20, 30), (33, 66), (50, 100), (76, 152), (77, 154), (1000, 2000)]


class MissingError(Exception):
    """A required program or package is missing; the text names it."""


def kernels() -> list[tuple[str, Any, Any]]:
    """List name, Python function and argument types of each kernel."""
    from numba import float32, int32, int64, uint8
    from stavpr_ros.alignment.cuda import dtw, lm_dtw, place_filter

    images = (float32[:, :, :], float32, int64, int64, float32[:, ::1])
    floats, whole = float32[::1], int32[::1]
    window = (float32[:, ::1], int64, int64, floats, whole, floats, whole, whole, whole, floats)
    found = [
        (f'spatial_dtw W={W} xi={xi}', dtw.spatial_dtw(W, xi).py_func, images) for W, xi in SPATIAL
    ]
    found.append(('sliding_window W=7', dtw.sliding_window(7, 4, 7).py_func, images))
    found += [
        (f'lm_dtw l={l} k={k}', lm_dtw.lm_dtw(l, k, lm_dtw.BLOCK).py_func, window)
        for l, k in SEQUENCES
    ]
    table, codes, steps = float32[:, ::1], uint8[:, ::1], int32[::1]
    K, V = LEVELS, SPEEDS
    motion = (int64, table, codes, floats, steps, floats, float32, float32, float32, floats)
    paths = (int64[::1], table, uint8[:, :, ::1], int32[:, ::1], int64, floats, int32[:, ::1])
    found += [
        ('filter mix', place_filter.mix(K, V).py_func, (int64, *(table,) * 4, codes)),
        ('filter move', place_filter.move(K, V).py_func, (*motion, table, codes, table)),
        ('filter trace', place_filter.trace(K, V).py_func, paths),
    ]
    return found


def assemble(ptx: str, arch: str) -> str:
    """Return the report of ptxas on one kernel."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, 'kernel.ptx').write_text(ptx)
        command = ['ptxas', '-v', f'-arch=sm_{arch}', 'kernel.ptx', '-o', 'kernel.cubin']
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    if 'Unsupported .version' in done.stderr:
        raise MissingError(
            'ptxas is older than the compiler that numba-cuda uses: put a newer one on the PATH'
        )
    if done.returncode:
        raise SystemExit(f'cuda_registers: ptxas failed: {done.stderr}')
    return done.stderr


def number(pattern: str, report: str) -> int:
    """Return the number that a pattern finds in the report."""
    found = re.search(pattern, report)
    if found is None:
        raise SystemExit(f'cuda_registers: the report of ptxas has no {pattern!r}: {report}')
    return int(found.group(1))


def report_on(function: Any, types: Any, arch: str) -> dict[str, int]:
    """Compile and assemble one kernel."""
    from numba import cuda

    ptx, _ = cuda.compile_ptx(function, types, cc=(int(arch[:-1]), int(arch[-1])))
    report = assemble(ptx, arch)
    return {
        'registers': number(r'Used (\d+) registers', report),
        'stack_bytes': number(r'(\d+) bytes stack frame', report),
        'spill_store_bytes': number(r'(\d+) bytes spill stores', report),
        'spill_load_bytes': number(r'(\d+) bytes spill loads', report),
        'shared_bytes': number(r'(\d+) bytes smem', report) if 'smem' in report else 0,
        'fused_multiply_adds': len(re.findall(r'fma\.rn\.f32', ptx)),
    }


def main() -> int:
    """Report on all kernels."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--arch', default='90', help='compute capability (%(default)s)')
    parser.add_argument('--out', type=Path, help='write the JSON to this file as well')
    options = parser.parse_args()
    try:
        if importlib.util.find_spec('numba_cuda') is None:
            raise MissingError("the package numba-cuda is missing: pip install 'numba-cuda[cu13]'")
        if shutil.which('ptxas') is None:
            raise MissingError('ptxas is not on the PATH: install the CUDA toolkit')
        results = {
            name: report_on(function, types, options.arch) for name, function, types in kernels()
        }
    except MissingError as missing:
        print(f'cuda_registers: {missing}', file=sys.stderr)
        return 2
    text = json.dumps({'arch': f'sm_{options.arch}', 'kernels': results}, indent=2)
    print(text)
    if options.out:
        options.out.write_text(text + '\n')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
