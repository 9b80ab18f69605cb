# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Vectors of LANES numbers as a type that numba compiles.

Both recursions run over *lanes*: neighboring map images (or starts) side by side in one SIMD
register. Left to the compiler, such loops are vectorized depending on the size, an order
of magnitude apart; explicit vectors give predictable code on every processor. In a kernel
``+ - * / <`` work on vectors as on numbers; ``<`` gives a mask for :func:`select`. IEEE
arithmetic, nothing is reordered.

The functions here exist in compiled code only.
"""

import operator
from typing import Any

from llvmlite import binding, ir
import numba as nb
from numba.core import cgutils, types
from numba.extending import intrinsic, models, overload, register_model


def _lanes() -> int:
    """As many 32-bit numbers as one register of this processor has."""
    features = nb.config.CPU_FEATURES or binding.get_host_cpu_features().flatten()
    return 16 if '+avx512f' in features else 8 if '+avx2' in features else 4


LANES = _lanes()
LINE = 16  # numbers of a cache line
PREFETCH = 0, 2, 1  # to read; into the second cache; data
FUSED = ('contract',)  # a product and a sum may be one instruction


class Vector(types.Type):
    """LANES numbers of one type."""

    def __init__(self, element: types.Type) -> None:
        self.element = element
        super().__init__(name=f'Vector({element}, {LANES})')


class Mask(types.Type):
    """LANES truth values."""

    def __init__(self) -> None:
        super().__init__(name=f'Mask({LANES})')


_ELEMENTS = {
    types.float32: ir.FloatType(),
    types.float64: ir.DoubleType(),
    types.int32: ir.IntType(32),
    types.uint8: ir.IntType(8),
}


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector: Vector) -> None:
        super().__init__(manager, vector, ir.VectorType(_ELEMENTS[vector.element], LANES))


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, mask: Mask) -> None:
        super().__init__(manager, mask, ir.VectorType(ir.IntType(1), LANES))


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    vector = ir.VectorType(_ELEMENTS[array_type.dtype], LANES)
    return builder.bitcast(builder.gep(data, [offset]), vector.as_pointer())


@intrinsic
def load(typing: Any, array: Any, offset: Any) -> Any:
    """Read LANES neighbors of a flat array, from ``offset``, in any alignment."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], *arguments)
        return builder.load(pointer, align=array.dtype.bitwidth // 8)

    return Vector(array.dtype)(array, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, offset: Any, vector: Any) -> Any:
    """Write a vector into a flat array, from ``offset``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], pointer, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def load_thirds(typing: Any, array: Any, offset: Any) -> Any:
    """Read 3 LANES neighbors of a flat array of uint8, from ``offset``, as int32: x, y, z."""
    whole = Vector(types.int32)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        kind = ir.VectorType(ir.IntType(8), 3 * LANES).as_pointer()
        pixels = builder.load(builder.bitcast(builder.gep(data, [arguments[1]]), kind), align=1)
        masks = [range(first, 3 * LANES, 3) for first in range(3)]
        parts = [_shuffle(builder, pixels, pixels, mask) for mask in masks]
        wide = [builder.zext(part, ir.VectorType(ir.IntType(32), LANES)) for part in parts]
        return context.make_tuple(builder, signature.return_type, wide)

    return types.containers.UniTuple(whole, 3)(array, types.intp), generate


@intrinsic
def transpose(
    typing: Any, source: Any, at: Any, pitch: Any, target: Any, to: Any, room: Any
) -> Any:
    """
    Write LANES rows of a flat array as columns.

    :param at, pitch: where the rows begin, and how far they are apart.
    :param to, room: likewise, of the rows that are written, LANES numbers each.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def row(which: int, i: int) -> Any:
            array, first, apart = arguments[which : which + 3]
            offset = builder.add(first, builder.mul(apart, ir.Constant(apart.type, i)))
            return _pointer(context, builder, signature.args[which], array, offset)

        rows, half = [builder.load(row(0, i), align=4) for i in range(LANES)], LANES // 2
        masks = [[i // 2 + i % 2 * LANES + low for i in range(LANES)] for low in (0, half)]
        for _ in range(LANES.bit_length() - 1):
            pairs = zip(rows[:half], rows[half:], strict=True)
            rows = [_shuffle(builder, a, b, mask) for a, b in pairs for mask in masks]
        for i in range(LANES):
            builder.store(rows[i], row(3, i), align=4)
        return context.get_dummy_value()

    size = types.intp
    return types.void(source, size, size, target, size, size), generate


def _shuffle(builder: Any, a: Any, b: Any, lanes: Any) -> Any:
    mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(lanes))
    return builder.shuffle_vector(a, b, mask)


@intrinsic
def add_products(typing: Any, totals: Any, array: Any, first: Any, pitch: Any, factor: Any) -> Any:
    """Add vectors of a flat array, from ``first`` on and ``pitch`` apart, times one, to totals."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        sums, at = cgutils.unpack_tuple(builder, arguments[0]), arguments[2]
        for i, total in enumerate(sums):
            pointer = _pointer(context, builder, array, arguments[1], at)
            product = builder.fmul(builder.load(pointer, align=4), arguments[4], flags=FUSED)
            sums[i] = builder.fadd(product, total, flags=FUSED)
            at = builder.add(at, arguments[3])
        return context.make_tuple(builder, signature.return_type, sums)

    return totals(totals, array, types.intp, types.intp, factor), generate


@intrinsic
def store_all(typing: Any, array: Any, vectors: Any) -> Any:
    """Write a tuple of vectors into a flat array, from its begin on."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        for i, vector in enumerate(cgutils.unpack_tuple(builder, arguments[1])):
            at = ir.Constant(ir.IntType(64), i * LANES)
            pointer = _pointer(context, builder, array, arguments[0], at)
            builder.store(vector, pointer, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, vectors), generate


@intrinsic
def store_sums(typing: Any, array: Any, offset: Any, vectors: Any, others: Any) -> Any:
    """
    Write the sums over the lanes of pairs of vectors into a flat array, from ``offset``.

    The tuples have at most LANES vectors, and the array has room for LANES numbers behind the
    sums. Halves are added up, as LLVM adds up lanes.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        two = (cgutils.unpack_tuple(builder, vectors) for vectors in arguments[2:])
        parts, width = [builder.fadd(*pair) for pair in zip(*two, strict=True)], LANES

        def half(pair: Any, is_upper: bool) -> Any:
            lanes = [i for i in range(2 * LANES) if (2 * (i % width) >= width) == is_upper]
            return _shuffle(builder, pair[0], pair[1], lanes)

        while width > 1:
            parts += parts[-1:] * (len(parts) % 2)
            pairs = list(zip(parts[::2], parts[1::2], strict=True))
            parts = [builder.fadd(half(pair, False), half(pair, True)) for pair in pairs]
            width //= 2
        pointer = _pointer(context, builder, signature.args[0], *arguments[:2])
        builder.store(parts[0], pointer, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, vectors, others), generate


def on_all_lanes(builder: Any, number: Any) -> Any:
    empty = ir.Constant(ir.VectorType(number.type, LANES), ir.Undefined)
    first = builder.insert_element(empty, number, ir.Constant(ir.IntType(32), 0))
    return _shuffle(builder, first, first, [0] * LANES)


@intrinsic
def splat(typing: Any, number: Any) -> Any:
    """Put one number on all lanes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return on_all_lanes(builder, *arguments)

    return Vector(number)(number), generate


@intrinsic
def load_splat(typing: Any, array: Any, offset: Any) -> Any:
    """Put one number of a flat array on all lanes; unlike in ``array[offset]``, offset >= 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return on_all_lanes(builder, builder.load(builder.gep(data, [arguments[1]])))

    return Vector(array.dtype)(array, types.intp), generate


@intrinsic
def store_bytes(typing: Any, array: Any, offset: Any, vector: Any) -> Any:
    """Write the lowest byte of each int32 into a flat array of uint8, from ``offset``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], *arguments[:2])
        bytes_ = ir.VectorType(ir.IntType(8), LANES)
        builder.store(builder.trunc(arguments[2], bytes_), pointer, align=1)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def prefetch(typing: Any, array: Any, offset: Any) -> Any:
    """Bring the cache line of a number of a flat array nearer: it is read and written soon."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        byte, whole = ir.IntType(8).as_pointer(), ir.IntType(32)
        function_type = ir.FunctionType(ir.VoidType(), [byte, whole, whole, whole])
        name = 'llvm.prefetch.p0'
        function = builder.module.globals.get(name) or ir.Function(
            builder.module, function_type, name
        )
        address = builder.bitcast(builder.gep(data, [arguments[1]]), byte)
        is_write, locality, is_data = (ir.Constant(whole, value) for value in PREFETCH)
        builder.call(function, [address, is_write, locality, is_data])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


def _bits_as(element: types.Type) -> Any:
    """Make a function that returns the numbers of a type that have the bits of a vector."""

    @intrinsic
    def bits_as(typing: Any, vector: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.bitcast(arguments[0], ir.VectorType(_ELEMENTS[element], LANES))

        return Vector(element)(vector), generate

    return bits_as


bits, from_bits = _bits_as(types.int32), _bits_as(types.float32)  # of float32 numbers, and back


@intrinsic
def select(typing: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Take the lanes of ``yes`` where the mask is true, of ``no`` elsewhere."""
    return yes(mask, yes, no), lambda context, builder, signature, arguments: builder.select(
        *arguments
    )


def _operation(name: str, whole: str = '') -> Any:
    """Make an operator on two vectors of one instruction, ``whole`` for whole numbers."""

    @intrinsic
    def operation(typing: Any, left: Any, right: Any) -> Any:
        instruction = whole if isinstance(left.element, types.Integer) else name

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return getattr(builder, instruction)(*arguments)

        return left(left, right), generate

    return operation


@intrinsic
def _less(typing: Any, left: Any, right: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fcmp_ordered('<', *arguments)

    return Mask()(left, right), generate


def _register(function: Any, instruction: Any) -> None:
    """Let an operator mean an instruction where it is applied to vectors."""

    @overload(function)
    def implementation(left, right):
        if isinstance(left, Vector):
            # numba requires a function, not the instruction itself
            return lambda left, right: instruction(left, right)  # noqa: PLW0108
        return None


_register(operator.add, _operation('fadd', 'add'))
_register(operator.sub, _operation('fsub', 'sub'))
_register(operator.mul, _operation('fmul', 'mul'))
_register(operator.truediv, _operation('fdiv'))
_register(operator.lt, _less)
_register(operator.and_, _operation('', 'and_'))
_register(operator.or_, _operation('', 'or_'))
_register(operator.lshift, _operation('', 'shl'))
