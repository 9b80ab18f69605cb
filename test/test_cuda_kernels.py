# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The CUDA kernels, bit for bit against the oracle.

They run on a CUDA device where there is one, and in numba's simulator everywhere: numba reads
NUMBA_ENABLE_CUDASIM when it is imported, so the simulator has a process of its own, which runs
this file and test_cuda_matcher.py once more.
"""

import json
import math
import os
from pathlib import Path
import re
import subprocess
import sys

import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import (
    best_match,
    match_sequence,
    SequenceDistances,
    SequenceSettings,
)
from stavpr_ros.errors import UnavailableError
import torch

SIMULATOR = os.environ.get('NUMBA_ENABLE_CUDASIM') == '1'
INF = math.inf
FILES = [f'test_cuda_{name}.py' for name in ('kernels', 'matcher', 'filter')]


@pytest.fixture(scope='module')
def runtime(cuda_runtime):
    """Return the device or the simulator."""
    return cuda_runtime


@pytest.mark.skipif(SIMULATOR, reason='this is the simulator')
def test_kernels_in_simulator_pass():
    root = Path(__file__).resolve().parents[1]
    # without the options of `colcon test`, which name its cache and its report
    environment = os.environ | {'NUMBA_ENABLE_CUDASIM': '1', 'PYTEST_ADDOPTS': ''}
    files = [str(Path(__file__).with_name(name)) for name in FILES]
    command = [sys.executable, '-m', 'pytest', '-q', '-rs', '-p', 'no:cacheprovider']
    command += ['-c', str(root / 'pytest.ini')]
    done = subprocess.run(
        [*command, *files], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
    assert ' passed' in done.stdout


def test_runtime_without_device_fails():
    if SIMULATOR or torch.cuda.is_available():
        pytest.skip('there is something to run kernels on')
    from stavpr_ros.alignment.cuda import compilation

    with pytest.raises(UnavailableError, match='no CUDA device'):
        compilation.runtime()


def test_device_without_numba_cuda_fails(monkeypatch):
    from stavpr_ros.alignment.cuda import compilation

    monkeypatch.setattr('stavpr_ros.devices.torch_has_cuda', lambda: True)
    monkeypatch.setattr('importlib.util.find_spec', lambda name: None)
    with pytest.raises(UnavailableError, match='pip install numba-cuda'):
        compilation.Device()


@pytest.mark.skipif(SIMULATOR, reason='the simulator compiles nothing')
def test_compiled_kernels_spill_no_registers():
    from stavpr_ros.alignment.cuda import lm_dtw

    program = Path(__file__).resolve().parents[1] / 'benchmarks' / 'cuda_registers.py'
    done = subprocess.run(
        [sys.executable, str(program)], capture_output=True, text=True, check=False
    )
    if done.returncode == 2:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr
    kernels = json.loads(done.stdout)['kernels']
    assert {'spatial_dtw W=7 xi=3', 'sliding_window W=7', 'lm_dtw l=20 k=40'} <= set(kernels)
    for name, report in kernels.items():
        if not name.startswith('filter'):  # of these, the last bits differ from the CPU's
            assert report['fused_multiply_adds'] == 0, name
        assert report['spill_store_bytes'] == report['spill_load_bytes'] == 0, name
        rows = re.search(r'l=(\d+)', name)
        long = rows is not None and int(rows[1]) > lm_dtw.REGISTER_ROWS
        assert (report['stack_bytes'] > 0) == long, name


def image_distances(runtime, products, strategy, sigma=1.0, xi=None, block=4):
    """Run a spatial kernel on products (queries, W, W, places)."""
    from stavpr_ros.alignment.cuda import dtw

    queries, W, _, n = products.shape
    band = W if xi is None else xi
    if strategy == 'sliding_window':
        function = dtw.sliding_window(W, 4, band)
    else:
        function = dtw.spatial_dtw(W, band)
    device = runtime.torch_device
    block_of_products = torch.from_numpy(products).reshape(queries * W, W, n).to(device)
    # one row and two columns more than the kernel is to write
    out = torch.full((queries + 1, n + 2), -7.0, device=device)
    grid = (-(-n // block), queries)
    runtime.launch(
        function, grid, block, runtime.array(block_of_products), np.float32(sigma), 1, 2,
        runtime.array(out),
    )  # fmt: skip
    out = out.cpu().numpy()
    assert (out[0] == -7).all()
    assert (out[:, :2] == -7).all()
    return out[1:, 2:]


def expected_images(products, strategy, sigma=1.0, xi=None):
    d = np.float32(1) - products
    return np.stack(
        [oracle.image_distances(query, strategy, sigma, xi, np.float32) for query in d]
    )


def random_products(seed, queries, W, n, levels=None):
    rng = np.random.default_rng(seed)
    products = rng.random((queries, W, W, n), np.float32)
    if levels is None:
        return products
    return np.round(products * levels).astype(np.float32) / np.float32(levels)


@pytest.mark.parametrize('strategy', ['adaptive', 'sliding_window'])
@pytest.mark.parametrize(
    ('W', 'xi', 'n', 'sigma', 'levels'),
    [
        (7, None, 5, 1.0, None),
        (7, 3, 5, 0.3, 3),  # three levels: ties everywhere
        (6, None, 1, 0.0, 3),  # vanilla DTW
        (4, None, 6, 5.0, None),  # an even number of strips
    ],
)
def test_image_distances_equal_oracle(runtime, strategy, W, xi, n, sigma, levels):
    products = random_products(W * 10 + n, 2, W, n, levels)
    got = image_distances(runtime, products, strategy, sigma, xi)
    np.testing.assert_array_equal(got, expected_images(products, strategy, sigma, xi))


def test_image_distances_ignore_cells_outside_band(runtime):
    products = random_products(3, 1, 7, 5)
    expected = expected_images(products, 'adaptive', 1.0, 3)
    i, j = np.indices((7, 7))
    products[:, abs(i - j) >= 3] = np.nan
    np.testing.assert_array_equal(image_distances(runtime, products, 'adaptive', 1.0, 3), expected)


def test_image_distances_of_any_strides_equal_oracle(runtime):
    from stavpr_ros.alignment.cuda import dtw

    products = random_products(5, 2, 5, 6)
    by_strip = np.ascontiguousarray(products.reshape(10, 5, 6).transpose(1, 0, 2))
    view = torch.from_numpy(by_strip).to(runtime.torch_device).permute(1, 0, 2)
    out = torch.zeros((2, 6), device=runtime.torch_device)
    arguments = runtime.array(view), np.float32(1), 0, 0, runtime.array(out)
    runtime.launch(dtw.spatial_dtw(5, 5), (2, 2), 4, *arguments)
    np.testing.assert_array_equal(out.cpu().numpy(), expected_images(products, 'adaptive'))


def run_sequences(runtime, D, k, apart, block=8, columns=None, first=0, launches=1):
    """Run the kernel on a window D (l, n); return distances, lengths and the selection."""
    from stavpr_ros.alignment.cuda import lm_dtw, selection

    l, n = D.shape
    device = runtime.torch_device
    blocks = -(-n // block)
    rows = torch.full((first + l, lm_dtw.row_pitch(n, k, block)), INF)
    rows[:first] = -1  # rows that are not of the window
    rows[first:, :n] = torch.from_numpy(D)
    rows = rows.to(device)
    distances, block_distances = torch.zeros(n, device=device), torch.zeros(blocks, device=device)
    lengths, block_starts, finished = (
        torch.zeros(count, dtype=torch.int32, device=device) for count in (n, blocks, 1)
    )
    buffer = selection.SelectionBuffer(runtime, l, k)
    scratch = (distances, lengths, block_distances, block_starts, finished)
    arrays = [runtime.array(tensor) for tensor in scratch]
    function = lm_dtw.lm_dtw(l, k, block, columns)
    for _ in range(launches):
        window = runtime.array(rows), first, apart
        runtime.launch(function, (blocks, 1), block, *window, *arrays, *buffer.arguments)
        found = buffer.fetch()
    assert finished.item() == 0
    return distances.cpu().numpy(), lengths.cpu().numpy(), found


def check_sequences(runtime, D, beta, apart=3, **launch):
    """Compare every start and the selection with the oracle, exactly."""
    l, n = D.shape
    k = oracle.frames_searched(l, beta)
    distances, lengths, found = run_sequences(runtime, D, k, min(apart, n), **launch)
    q, m = oracle.match_sequence(D, beta, np.float32)
    finite = np.isfinite(q)
    np.testing.assert_array_equal(distances, q)
    np.testing.assert_array_equal(lengths, np.where(finite, m, 0))
    answer = oracle.best_match(q, m, apart)
    twin = best_match(SequenceDistances(distances, lengths), apart)
    assert (answer is None) == (twin is None) == (found.start == -1)
    if answer is None:
        return
    assert (found.start, found.length) == (answer.start, answer.length)
    assert found.distance == answer.distance
    if answer.second_best_index == -1:
        assert found.second_best_start == twin.second_best_index == -1
    else:
        middle = (2 * found.second_best_start + found.second_best_length - 1) // 2
        assert middle == answer.second_best_index == twin.second_best_index
        assert (
            found.second_best_distance == answer.second_best_distance == twin.second_best_distance
        )
    seen = D[:, found.start : found.start + k]
    np.testing.assert_array_equal(found.cells[:, : seen.shape[1]], seen)
    assert np.isinf(found.cells[:, seen.shape[1] :]).all()


def random_window(seed, l, n, levels=None, banned=0.0):
    rng = np.random.default_rng(seed)
    D = rng.random((l, n), np.float32)
    if levels is not None:
        D = np.round(D * levels).astype(np.float32)
    D[rng.random(D.shape) < banned] = np.inf
    return D


@pytest.mark.parametrize(
    ('l', 'n', 'beta', 'levels', 'banned', 'apart', 'block', 'columns'),
    [
        (5, 22, 2.0, None, 0.0, 3, 8, None),  # several blocks, the last one not full
        (5, 22, 2.0, None, 0.0, 3, 8, 3),  # its columns staged in pieces
        (3, 16, 2.0, 4, 0.1, 2, 4, 3),  # whole blocks, ties; near starts in an earlier block
        (3, 24, 2.0, 0, 0.0, 4, 4, None),  # all starts are equal: the lowest one of all blocks
        (3, 9, 2.0, None, 1.0, 2, 4, 3),  # no path
        (3, 5, 3.1, 5, 0.0, 8, 8, None),  # fewer places than a block has threads, and k > n
        (2, 9, 1.2, None, 0.0, 8, 2, 3),  # the shortest window, k = 3
        (3, 1, 2.0, None, 0.0, 3, 1, None),  # one place
        (7, 13, 1.3, 4, 0.1, 12, 8, 3),  # odd k, not a multiple of l
    ],
)
def test_sequences_equal_oracle(runtime, l, n, beta, levels, banned, apart, block, columns):
    D = random_window(l * n, l, n, levels, banned)
    check_sequences(runtime, D, beta, apart, block=block, columns=columns)


def test_sequences_from_any_row_and_repeated_are_equal(runtime):
    D = random_window(17, 3, 12)
    once = run_sequences(runtime, D, 6, 2, block=4)
    again = run_sequences(runtime, D, 6, 2, block=4, columns=0, first=3, launches=2)
    for a, b in zip((*once[:2], once[2].cells), (*again[:2], again[2].cells), strict=True):
        np.testing.assert_array_equal(a, b)
    assert once[2].start == again[2].start
    assert once[2].second_best_start == again[2].second_best_start


def test_staged_columns_fit_into_shared_memory():
    from stavpr_ros.alignment.cuda import lm_dtw

    assert lm_dtw.staged_columns(20, 40, lm_dtw.BLOCK) == 40
    for l in range(2, lm_dtw.REGISTER_ROWS + 1):
        columns = lm_dtw.staged_columns(l, 2 * l, lm_dtw.BLOCK)
        assert columns >= 1
        assert 4 * l * (lm_dtw.BLOCK + columns - 1) + 8 * lm_dtw.BLOCK <= 48 * 1024
    assert lm_dtw.staged_columns(1000, 2000, lm_dtw.BLOCK) == 0


@pytest.mark.skipif(SIMULATOR, reason='sizes of a real map take a real device')
def test_sequences_of_many_places_on_device_equal_cpu(runtime):
    from stavpr_ros.alignment.cuda import lm_dtw

    for l, n, beta in ((20, 70_001, 2.0), (33, 5000, 1.7), (80, 3000, 1.5)):
        D = random_window(l, l, n)
        sequence = SequenceSettings(length=l, beta=beta)
        expected = match_sequence(D, sequence)
        distances, lengths, found = run_sequences(runtime, D, sequence.k, 20, block=lm_dtw.BLOCK)
        np.testing.assert_array_equal(distances, expected.distances)
        np.testing.assert_array_equal(lengths, expected.lengths)
        assert found.start == best_match(expected, 20).first
        assert found.second_best_distance == best_match(expected, 20).second_best_distance
