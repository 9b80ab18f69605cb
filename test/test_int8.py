# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Strips rounded to int8: exact products on every processor, bounds of the rounding."""

import os
from pathlib import Path
import subprocess
import sys

from hypothesis import given, settings
from hypothesis import strategies as st
from llvmlite import binding, ir
import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import image_distances, SpatialSettings
from stavpr_ros.alignment.cpu import dot, int8
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.features.gradient import GradientSettings
from stavpr_ros.prepare.blocks import convert_features
from stavpr_ros.prepare.matcher import make_matcher

TILE = int8.TILE


def unit(strips):
    return strips / np.linalg.norm(strips, axis=-1, keepdims=True).clip(1e-12)


def random_strips(W, n, d, seed=0):
    """Return unit-norm strips (W, n, d), the first of the first image zero."""
    strips = unit(np.random.default_rng(seed).standard_normal((W, n, d), np.float32))
    if n:
        strips[0, 0] = 0
    return strips


def features_of(strips):
    W, n, _ = strips.shape
    weights = np.full((W, n), W**-0.5, np.float32)
    return LocalFeatures(strips, weights, FeatureSettings('gradient', GradientSettings(), W))


def kernel_distances(reference, queries, x):
    """Return d (W, W, n) of query x by the kernel."""
    W, n, d = reference.shape
    held = int8.Int8Strips(W, n, d)
    held[:, :] = reference
    out = np.empty((-(-W // TILE) * TILE, W, n), np.float32)
    dot.strip_distances(held.kernel_arguments(), int8.tile(queries), x, out)
    return out[:W], held


def expected_distances(held, queries, x):
    """Return the oracle's d of the same whole numbers."""
    whole, lengths = int8.round_queries(queries)
    n = held.shape[1]
    return oracle.whole_number_distances(
        whole[x], held.codes(), lengths[x], held.reciprocals[:, :n]
    )


@settings(max_examples=25)
@given(
    W=st.sampled_from([1, 6, 7, 8]),
    n=st.sampled_from([1, 7, 8, 9, 17]),
    d=st.sampled_from([1, 3, 4, 5, 30]),
    seed=st.integers(0, 9),
)
def test_strip_distances_equal_oracle_bit_for_bit(W, n, d, seed):
    """Whole tiles, lanes and quads, and their remainders."""
    reference, queries = random_strips(W, n, d, seed), random_strips(W, 2, d, seed + 10)
    for x in range(2):
        result, held = kernel_distances(reference, queries, x)
        np.testing.assert_array_equal(result, expected_distances(held, queries, x))


@pytest.mark.parametrize(('n', 'd'), [(1, 5), (9, 30), (300, 1000)])
def test_vectors_equal_single_strips_bit_for_bit(n, d):
    """The kernel for one vector an image, and the kernel for strips."""
    reference, queries = random_strips(1, n, d), random_strips(1, 2, d, seed=10)
    held = convert_features(features_of(reference), rounds=True).strips
    out = np.empty((2, n), np.float32)
    int8.cosine_distances(held.kernel_arguments(), int8.tile(queries), out)
    for x in range(2):
        result, _ = kernel_distances(reference, queries, x)
        np.testing.assert_array_equal(out[x], result[0, 0])


@pytest.mark.parametrize('d', [1, 2, 8, 224, 1000])
def test_products_of_extreme_strips_neither_saturate_nor_overflow(d):
    """Strips with one value, all equal, two neighbors, in all signs: the largest products."""
    one, two, even = np.zeros(d, np.float32), np.zeros(d, np.float32), np.ones(d, np.float32)
    one[d // 2], two[: min(2, d)] = 1, 1
    kinds = [unit(sign * x) for x in (one, two, even) for sign in (1, -1)]
    strips = np.stack([np.stack(kinds)] * 2)  # (2, 6, d)
    for x in range(len(kinds)):
        result, held = kernel_distances(strips, strips, x)
        np.testing.assert_array_equal(result, expected_distances(held, strips, x))
        np.testing.assert_allclose(result[0, 0, x], 0, atol=1e-6)  # itself
        np.testing.assert_allclose(result[0, 0, x ^ 1], 2, atol=1e-6)  # its opposite


@pytest.mark.parametrize('d', [16, 64, 224, 2000])
def test_rounding_moves_distances_little(d):
    """A rounded value is off by half a step; strips are as long as 16 bits of a product allow."""
    reference, query = random_strips(1, 400, d), random_strips(1, 2, d, seed=1)
    result, held = kernel_distances(reference, query, 1)
    whole = held.codes()[0].astype(np.int64)
    assert np.sqrt((whole**2).sum(axis=1)).max() <= int8.MAX_LENGTH
    assert np.abs(whole).max() <= 127
    exact = 1 - reference[0].astype(np.float64) @ query[0, 1].astype(np.float64)
    off = result[0, 0] - exact
    # both sides are off by a vector of length sqrt(d / 12) / N in a direction of its own
    N = int8.MAX_LENGTH - np.sqrt(d) / 2
    assert np.sqrt((off**2).mean()) < 1.5 * max(np.sqrt(2 / 12) / N, 0.29 / 63)
    assert held[:, 3:5].shape == (1, 2, d)
    assert (
        np.linalg.norm(held[:, 3:5] - reference[:, 3:5], axis=2).max() < 1.3 * np.sqrt(d / 12) / N
    )


@pytest.mark.parametrize('strategy', ['adaptive', 'vanilla', 'rigid', 'sliding_window', 'none'])
def test_matcher_in_int8_equals_functions_of_its_strip_distances(strategy):
    reference, queries = features_of(random_strips(7, 300, 20)), random_strips(7, 3, 20, seed=1)
    spatial = SpatialSettings(strategy)
    weights = np.full((7, 3), 7**-0.5, np.float32)
    matrix = make_matcher(reference, spatial, 'cpu', 'int8').distance_matrix(queries, weights)
    assert matrix.shape == (3, 300)
    for x in range(3):
        d, _ = kernel_distances(reference.strips, queries, x)
        if strategy == 'none':
            expected = np.einsum('iiy->y', d) / 7
            np.testing.assert_allclose(matrix[x], expected, atol=1e-6)
        else:
            np.testing.assert_array_equal(matrix[x], image_distances(d, spatial))


def test_features_rounded_in_blocks_equal_those_rounded_at_once():
    features = features_of(random_strips(3, 600, 10))
    at_once = int8.Int8Strips(3, 600, 10)
    at_once[:, :] = features.strips
    held = convert_features(features, rounds=True)
    np.testing.assert_array_equal(held.strips.values, at_once.values)
    np.testing.assert_array_equal(held.strips.reciprocals, at_once.reciprocals)
    assert held.strips.values.nbytes < 1.25 * 3 * 600 * 10  # whole quads: 12 for 10 dimensions


PROCESSORS = (
    ('avx512vnni', 'x86_64', 'icelake-server', 'vpdpbusd'),
    ('avxvnni', 'x86_64', 'alderlake', 'vpdpbusd'),
    ('avx512bw', 'x86_64', 'skylake-avx512', 'vpmaddubsw'),
    ('avx2', 'x86_64', 'haswell', 'vpmaddubsw'),
    ('ssse3', 'x86_64', 'core2', 'pmaddubsw'),
    ('dotprod', 'aarch64', 'neoverse-n1', 'sdot'),
)


def assembly(name, architecture, processor):
    """Compile one multiply-add and its total for a processor; return the assembly."""
    lanes = next(row[2] for row in int8.INSTRUCTIONS if row[0] == name)
    wide = ir.VectorType(ir.IntType(32), lanes)
    module = ir.Module()
    function = ir.Function(module, ir.FunctionType(wide, [wide] * 4), 'multiply_add')
    builder = ir.IRBuilder(function.append_basic_block())
    total, places, query, query_sum = function.args
    total = int8.write_multiply_add(builder, name, total, places, query)
    builder.ret(int8.write_total(builder, name, total, query_sum))
    target = binding.Target.from_triple(f'{architecture}-unknown-linux-gnu')
    machine = target.create_target_machine(cpu=processor, opt=3)
    return machine.emit_assembly(binding.parse_assembly(str(module)))


@pytest.mark.parametrize(('name', 'architecture', 'processor', 'instruction'), PROCESSORS)
def test_instruction_is_in_assembly_of_processor(name, architecture, processor, instruction):
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    try:
        code = assembly(name, architecture, processor)
    except RuntimeError as error:
        pytest.skip(f'this LLVM does not compile for {architecture}: {error}')
    assert instruction in code
    assert 'call' not in code


def test_instruction_of_processor_fits_its_lanes():
    assert int8.choose_instruction('+avx512f,+avx512bw,+avx512vnni,+avx2', 16) == 'avx512vnni'
    assert int8.choose_instruction('+avx512f,+avx512bw,-avx512vnni,+avx2', 16) == 'avx512bw'
    assert int8.choose_instruction('+avx2,+avxvnni,+ssse3', 8) == 'avxvnni'
    assert int8.choose_instruction('+avx2,+ssse3', 8) == 'avx2'
    assert int8.choose_instruction('+ssse3,+sse2', 4) == 'ssse3'
    assert int8.choose_instruction('+neon,+dotprod', 4) == 'dotprod'
    assert int8.choose_instruction('+neon', int8.LANES) == 'plain'


HASHED = """
import hashlib, numpy as np
from stavpr_ros.alignment.cpu import dot, int8
rng = np.random.default_rng(0)
strips = rng.standard_normal((3, 21, 37)).astype(np.float32)
held = int8.Int8Strips(3, 21, 37)
held[:, :] = strips
out = np.empty((7, 3, 21), np.float32)
dot.strip_distances(held.kernel_arguments(), int8.tile(strips), 5, out)
print(int8.INSTRUCTION, hashlib.sha256(out[:3].tobytes()).hexdigest())
"""


@pytest.mark.long
@pytest.mark.skipif(os.uname().machine != 'x86_64', reason='features of x86 processors')
def test_every_instruction_of_this_processor_returns_same_bits():
    result = {}
    avx2 = '+sse2,+sse3,+ssse3,+sse4.1,+avx,+avx2,+fma'
    sets = ['', '+sse2', '+sse2,+sse3,+ssse3', avx2]
    flags = Path('/proc/cpuinfo').read_text().split()
    if 'avx512_vnni' in flags:
        sets.append(f'{avx2},+avx512f,+avx512bw')
        # the instruction of avxvnni on 32 bytes, which this processor encodes in another form
        sets.append(f'{avx2},+avx512vl,+avx512vnni,+avxvnni')
    for features in sets:
        chosen = {'NUMBA_CPU_NAME': 'x86-64', 'NUMBA_CPU_FEATURES': features} if features else {}
        command = [sys.executable, '-c', HASHED]
        printed = subprocess.check_output(command, env=os.environ | chosen, text=True)
        name, value = printed.split()
        result[name] = value
    assert len(result) == len(sets)
    assert len(set(result.values())) == 1
