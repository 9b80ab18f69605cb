# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Strips rounded to int8, and the cosine distances of rounded strips: one byte a value.

A strip x of the map is rounded to whole numbers at a scale of its own, ``rint(s x)`` with
s = min(N / |x|, 127 / max |x_t|), one of the query with 63 instead of 127; N = 181 - sqrt(d) / 2.
The distance of two strips is 1 less the cosine of their whole numbers. These are never longer than
181, so that by Cauchy-Schwarz every product of two strips fits 16 bits, 181^2 < 2^15, and sums may
wrap in between. Two products of an unsigned map value and a query value, 2 * 255 * 63, fit as
well: nothing saturates. Sums of whole numbers have no order: every processor returns the same.

In memory, LANES places lie side by side, four dimensions of each: the lanes of one vector. It is
multiplied by four dimensions of the query, the same on all lanes, by the instruction that this
processor has (:data:`INSTRUCTIONS`).
"""

from typing import Any

from llvmlite import ir
import numba as nb
from numba.core import cgutils, types
from numba.core.registry import cpu_target
from numba.extending import intrinsic
import numpy as np
from stavpr_ros.compilation import kernel, parallel_kernel, reassociating_kernel
from stavpr_ros.memory import aligned_zeros
from stavpr_ros.simd import (
    LANES,
    load,
    load_splat,
    on_all_lanes,
    prefetch,
    splat,
    store,
    store_all,
    Vector,
)

TILE = 7  # query strips whose sums stay in registers: all of them, with the paper's W
NEAR = 5  # of them, where a strip of the map is compared with the nearest ones only
QUAD = 4  # dimensions of a lane
IMAGES = 256  # places a thread takes at a time; a multiple of LANES
AHEAD = 4096  # numbers of 32 bits of the map that are on their way to the cache
MAX_LENGTH = 181.0  # norm of a rounded strip
MAP_PEAK, QUERY_PEAK = 127.0, 63.0

# name, required features of the processor, lanes, LLVM's function; the first that fits is taken
INSTRUCTIONS: tuple[tuple[str, set[str], int, str], ...] = (
    ('avx512vnni', {'+avx512f', '+avx512vnni'}, 16, 'llvm.x86.avx512.vpdpbusd.512'),
    ('avxvnni', {'+avx2', '+avxvnni'}, 8, 'llvm.x86.avx512.vpdpbusd.256'),
    ('avx512bw', {'+avx512f', '+avx512bw'}, 16, 'llvm.x86.avx512.pmaddubs.w.512'),
    ('avx2', {'+avx2'}, 8, 'llvm.x86.avx2.pmadd.ub.sw'),
    ('ssse3', {'+ssse3'}, 4, 'llvm.x86.ssse3.pmadd.ub.sw.128'),
    ('dotprod', {'+neon', '+dotprod'}, 4, 'llvm.aarch64.neon.sdot.v4i32.v16i8'),
    ('plain', set(), LANES, ''),
)
INT8, INT16, INT32 = ir.IntType(8), ir.IntType(16), ir.IntType(32)


def choose_instruction(features: str, lanes: int) -> str:
    """
    Return the name of the instruction that multiplies and adds.

    :param features: features of the processor, as LLVM names them, '+avx2,-avx512f,...'.
    :param lanes: places that lie side by side.
    """
    available = set(features.split(','))
    return next(
        name
        for name, cpu_features, fitting, _ in INSTRUCTIONS
        if cpu_features <= available and fitting == lanes
    )


# features that numba's compiler uses, fixed by the first function that it compiles
_, _, FEATURES = cpu_target.target_context.codegen().magic_tuple()
INSTRUCTION = choose_instruction(FEATURES, LANES)


def _constant(vector: ir.VectorType, value: int) -> ir.Constant:
    return ir.Constant(vector, [value] * vector.count)


def write_multiply_add(builder: Any, name: str, total: Any, places: Any, query: Any) -> Any:
    """
    Write the code that adds four products to each lane.

    :param name: name of the instruction.
    :param total: sums so far, as many int32 as lanes; what they mean is known to the instruction
        until :func:`write_total`.
    :param places, query: four int8 a lane, as int32.
    """
    wide = total.type
    function = next(row[3] for row in INSTRUCTIONS if row[0] == name)
    bytes_ = ir.VectorType(INT8, wide.count * QUAD)
    if name == 'plain':
        for t in range(QUAD):
            a, b = (
                builder.ashr(builder.shl(vector, _constant(wide, 24 - 8 * t)), _constant(wide, 24))
                for vector in (places, query)
            )
            total = builder.add(total, builder.mul(a, b))
        return total
    if name == 'dotprod':
        arguments = [total, builder.bitcast(places, bytes_), builder.bitcast(query, bytes_)]
        return _call(builder, function, wide, arguments)
    unsigned = builder.xor(places, _constant(wide, -(2**31) | 0x00808080))  # 128 more
    if 'vpdpbusd' in function:
        return _call(builder, function, wide, [total, unsigned, query])
    pairs = ir.VectorType(INT16, wide.count * 2)
    arguments = [builder.bitcast(unsigned, bytes_), builder.bitcast(query, bytes_)]
    products = _call(builder, function, pairs, arguments)
    return builder.bitcast(builder.add(builder.bitcast(total, pairs), products), wide)


def write_total(builder: Any, name: str, total: Any, query_sum: Any) -> Any:
    """
    Write the code that turns sums into whole numbers, int32.

    :param query_sum: sum of the query's values, on all lanes.
    """
    wide = total.type
    if name in ('plain', 'dotprod'):
        return total
    surplus = builder.shl(query_sum, _constant(wide, 7))  # 128 for each value of the query
    if 'vnni' in name:
        return builder.sub(total, surplus)
    # two sums of 16 bits a lane, which may have wrapped; the whole sum fits again
    low = builder.ashr(builder.shl(total, _constant(wide, 16)), _constant(wide, 16))
    high = builder.ashr(total, _constant(wide, 16))
    whole = builder.sub(builder.add(low, high), surplus)
    return builder.ashr(builder.shl(whole, _constant(wide, 16)), _constant(wide, 16))


def _call(builder: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    function_type = ir.FunctionType(result, [argument.type for argument in arguments])
    function = builder.module.globals.get(name) or ir.Function(builder.module, function_type, name)
    return builder.call(function, arguments)


WHOLE = Vector(types.int32)


@intrinsic
def _multiply_add(typing: Any, total: Any, places: Any, query: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return write_multiply_add(builder, INSTRUCTION, *arguments)

    return WHOLE(WHOLE, WHOLE, WHOLE), generate


@intrinsic
def _multiply_add_all(typing: Any, totals: Any, places: Any, query: Any, first: Any) -> Any:
    """Add four products to each lane of totals, of one query strip each, from ``first`` on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        sums, four = cgutils.unpack_tuple(builder, arguments[0]), arguments[1]
        data = context.make_array(query)(context, builder, arguments[2]).data
        for i, total in enumerate(sums):
            at = builder.add(arguments[3], ir.Constant(arguments[3].type, i))
            own = on_all_lanes(builder, builder.load(builder.gep(data, [at])))
            sums[i] = write_multiply_add(builder, INSTRUCTION, total, four, own)
        return context.make_tuple(builder, signature.return_type, sums)

    return totals(totals, places, query, types.intp), generate


@intrinsic
def _total(typing: Any, total: Any, query_sum: Any) -> Any:
    """Return the whole numbers of the sums, as float32, exactly."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        whole = write_total(builder, INSTRUCTION, *arguments)
        return builder.sitofp(whole, ir.VectorType(ir.FloatType(), LANES))

    return Vector(types.float32)(WHOLE, WHOLE), generate


# ------------------------------------------------ rounding


@reassociating_kernel
def _scale(x, longest, peak):
    """Return the scale of a strip, 0 for a zero one."""
    squares, peak_value = np.float32(0), np.float32(0)
    for t in range(len(x)):
        squares += x[t] * x[t]
        peak_value = max(peak_value, abs(x[t]))
    if squares == 0:
        return np.float32(0)
    return min(longest / np.sqrt(squares), peak / peak_value)


@parallel_kernel
def _round_places(strips, longest, peak, first, values, reciprocals):
    """
    Round strips (W, m, d) into places from ``first`` on.

    :param values: shape (W, groups, quads, LANES, QUAD), int8, written.
    :param reciprocals: shape (W, groups LANES), written: 1 / length of the rounded strip.
    """
    W, m, d = strips.shape
    begin, end = first // LANES, (first + m + LANES - 1) // LANES
    for at in nb.prange(W * (end - begin)):
        j, group = at // (end - begin), begin + at % (end - begin)
        for y in range(max(first, group * LANES), min(first + m, (group + 1) * LANES)):
            x, lane = strips[j, y - first], y % LANES
            scale = _scale(x, longest, peak)
            squares = np.int64(0)
            for t in range(d):
                value = np.int32(np.rint(scale * x[t]))
                squares += value * value
                values[j, group, t // QUAD, lane, t % QUAD] = value
            reciprocals[j, y] = np.float32(1 / np.sqrt(squares)) if squares else np.float32(0)


@kernel
def _round_queries(strips, longest, peak, values, reciprocals):
    """Round strips (Q, W, d) to int8, and write 1 / length of each rounded one, (Q, W)."""
    for x, j in np.ndindex(reciprocals.shape):
        strip, squares = strips[x, j], np.int64(0)
        scale = _scale(strip, longest, peak)
        for t in range(len(strip)):
            value = np.int32(np.rint(scale * strip[t]))
            squares += value * value
            values[x, j, t] = value
        reciprocals[x, j] = np.float32(1 / np.sqrt(squares)) if squares else np.float32(0)


@parallel_kernel
def _copy_places(codes, j, first, values, reciprocals):
    """
    Copy rounded strips (m, d) to places from ``first`` on, a multiple of LANES.

    :returns: the largest square of a length.
    """
    m, d = codes.shape
    max_squares = np.zeros((m + LANES - 1) // LANES, np.int64)
    for group in nb.prange(len(max_squares)):
        for y in range(group * LANES, min(m, (group + 1) * LANES)):
            squares = np.int64(0)
            for t in range(d):
                value = np.int64(codes[y, t])
                squares += value * value
                values[j, first // LANES + group, t // QUAD, y % LANES, t % QUAD] = value
            reciprocals[j, first + y] = (
                np.float32(1 / np.sqrt(squares)) if squares else np.float32(0)
            )
            max_squares[group] = max(max_squares[group], squares)
    return max_squares.max()


def _longest(d: int) -> np.float32:
    """Return N: rounding lengthens a strip by sqrt(d) / 2 at most."""
    return np.float32(max(MAX_LENGTH - np.sqrt(d) / 2, 1))


class Int8Strips:
    """
    The strips of n places, rounded to int8.

    :param W, places, d: strips, places and dimensions.
    """

    def __init__(self, W: int, places: int, d: int) -> None:
        groups, quads = -(-places // LANES), -(-d // QUAD)
        self.shape = W, places, d
        self.values = aligned_zeros((W, groups, quads, LANES, QUAD), np.int8)
        self.reciprocals: np.ndarray = np.zeros((W, groups * LANES), np.float32)

    def __len__(self) -> int:
        return self.shape[0]

    def __setitem__(self, index: tuple[slice, slice], strips: np.ndarray) -> None:
        """Round strips (W, m, d), float32, and keep them as the places [:, places]."""
        first, longest = index[1].start or 0, _longest(self.shape[2])
        strips = np.ascontiguousarray(strips)
        _round_places(strips, longest, np.float32(MAP_PEAK), first, self.values, self.reciprocals)

    def copy(self, j: int, first: int, codes: np.ndarray) -> None:
        """
        Copy strips that were rounded before.

        :param first: their first place, a multiple of LANES.
        :param codes: strip j of places, shape (m, d), int8, as of :meth:`codes`.
        :raises ValueError: a strip is longer than rounding makes it: sums could overflow.
        """
        longest = _copy_places(codes, j, first, self.values, self.reciprocals)
        if longest > MAX_LENGTH**2:
            raise ValueError(
                f'codes of strip {j}, from place {first} on, have length {longest**0.5:.0f}: at '
                f'most {MAX_LENGTH:.0f}'
            )

    def __getitem__(self, index: tuple[slice, slice | np.ndarray]) -> np.ndarray:
        """Return strips of places, [:, places], float32, of unit norm again."""
        places = np.arange(self.shape[1])[index[1]]
        codes = self.values[:, places // LANES, :, places % LANES]  # (m, W, quads, QUAD)
        strips = codes.reshape(len(places), len(self), -1)[:, :, : self.shape[2]]
        return np.ascontiguousarray(strips.transpose(1, 0, 2) * self.reciprocals[:, places, None])

    def codes(self) -> np.ndarray:
        """Return a copy of the whole numbers, (W, n, d), int8."""
        W, n, d = self.shape
        strips = self.values.transpose(0, 1, 3, 2, 4).reshape(W, self.values.shape[1] * LANES, -1)
        return np.ascontiguousarray(strips[:, :n, :d])

    def kernel_arguments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the features as the kernels take them."""
        return self.values.view(np.int32)[..., 0], self.reciprocals


def round_queries(queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Round the strips of Q images.

    :param queries: shape (W, Q, d), float32.
    :returns: int8, (Q, W, d); 1 / length of each rounded strip, (Q, W), float32.
    """
    W, Q, d = queries.shape
    codes, reciprocals = np.empty((Q, W, d), np.int8), np.empty((Q, W), np.float32)
    strips = np.ascontiguousarray(queries.transpose(1, 0, 2))
    _round_queries(strips, _longest(d), np.float32(QUERY_PEAK), codes, reciprocals)
    return codes, reciprocals


def tile(queries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Round the strips of Q images and lay them out as the kernels take them.

    :param queries: shape (W, Q, d), float32.
    :returns: four values each, (Q, tiles, quads, TILE) int32; 1 / length (Q, R) float32 and sum
        (Q, R) int32 of each rounded strip; R = tiles TILE, zeros from row W on.
    """
    W, Q, d = queries.shape
    tiles, quads = -(-W // TILE), -(-d // QUAD)
    codes: np.ndarray = np.zeros((Q, tiles * TILE, quads * QUAD), np.int8)
    reciprocals: np.ndarray = np.zeros((Q, tiles * TILE), np.float32)
    codes[:, :W, :d], reciprocals[:, :W] = round_queries(queries)
    packed = codes.view(np.int32).reshape(Q, tiles, TILE, quads).transpose(0, 1, 3, 2)
    sums = codes.sum(axis=2, dtype=np.int32)
    return np.ascontiguousarray(packed), reciprocals, sums


# ------------------------------------------------ distances


@kernel
def first_near(j, xi, rows):
    """Return the first of NEAR query strips i with ``|i - j| < xi``; -1 = all are compared."""
    if 2 * xi - 1 > NEAR or rows != TILE:
        return -1
    return min(max(j - NEAR // 2, 0), TILE - NEAR)


@kernel
def _row_sums(values, at, quads, query, base, zeros, sums):
    """Write sums of LANES places, from ``at``, with as many query strips as there are zeros."""
    totals = zeros
    for t in range(quads):
        prefetch(values, at + t * LANES + AHEAD)
        totals = _multiply_add_all(totals, load(values, at + t * LANES), query, base + t * TILE)
    store_all(sums, totals)


@kernel
def block_distances(features, queries, x, first, count, xi, d):
    """
    Fill d (rows, W, .), contiguous: strips of query x against ``count`` places from ``first``.

    :param features: result of :meth:`Int8Strips.kernel_arguments`; queries: of :func:`tile`.
    :param first: a multiple of LANES; count: rounded up to whole lanes, which d has room for.
    :param xi: only distances of strips i and j with ``|i - j| < xi`` are needed.
    """
    values, reciprocals = features
    packed, query_reciprocals, query_sums = queries
    W, groups, quads, _ = values.shape
    flat, query = values.reshape(-1), packed[x].reshape(-1)
    lengths, out = reciprocals.reshape(-1), d.reshape(-1)
    sums = np.empty(TILE * LANES, np.int32)
    zero, one = splat(np.int32(0)), splat(np.float32(1))
    few = zero, zero, zero, zero, zero
    for j in range(W):
        low = first_near(j, xi, d.shape[0])
        for y in range(0, count, LANES):
            group = j * groups + (first + y) // LANES
            length = load(lengths, group * LANES)
            for i in range(max(low, 0), d.shape[0], TILE):
                rows, at = TILE, group * quads * LANES
                if low >= 0:
                    rows = NEAR
                    _row_sums(flat, at, quads, query, i, few, sums)
                else:
                    _row_sums(flat, at, quads, query, i * quads, (*few, zero, zero), sums)
                for t in range(rows):
                    whole = _total(load(sums, t * LANES), splat(query_sums[x, i + t]))
                    cosine = whole * length * splat(query_reciprocals[x, i + t])
                    store(out, ((i + t) * W + j) * d.shape[2] + y, one - cosine)


@parallel_kernel
def cosine_distances(features, queries, out):
    """
    Distances of images that are one vector each (W = 1), equal to the other kernels' results.

    :param features, queries: as in :func:`block_distances`.
    :param out: shape (Q, m), written; m <= n: only so many places are looked at.
    """
    values, reciprocals = features
    packed, query_reciprocals, query_sums = queries
    flat, lengths, quads, n = values.reshape(-1), reciprocals[0], values.shape[2], out.shape[1]
    for block in nb.prange((n + IMAGES - 1) // IMAGES):
        first = block * IMAGES
        count = min(IMAGES, n - first)
        lanes = np.empty(IMAGES, np.float32)
        for x in range(out.shape[0]):
            query, one = packed[x, 0, :, 0].copy(), splat(np.float32(1))  # fits into the cache
            for y in range(0, count, LANES):
                sums = splat(np.int32(0))
                for t in range(quads):
                    places = load(flat, (first + y) * quads + t * LANES)
                    sums = _multiply_add(sums, places, load_splat(query, t))
                whole = _total(sums, splat(query_sums[x, 0]))
                cosine = whole * load(lengths, first + y) * splat(query_reciprocals[x, 0])
                store(lanes, y, one - cosine)
            out[x, first : first + count] = lanes[:count]
