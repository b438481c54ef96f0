"""Vector instructions for the second stage: inner products of a few cells with whole rows of cells, and their maxima.

The inner products of the grid's cells take most of the time of the second stage, and only those within reach are
needed: a few cells of one frame against a few rows of the other.  A vector holds a row of cells, one in each lane, in
words of several values; the other frame's values are repeated over all lanes.  The processor decides what a word holds:
four bytes if one instruction multiplies and adds those, two half words if one does that with half words (every
x86-64), else one value.  All are exact.  The loops are written in LLVM's vector instructions, which numba does not
offer.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16
HELD = LANES - 1
"""Cells of a vector.  The last lane holds zeros: as bytes are held with 128 added, it tells how much that adds."""

CELLS, ROWS = 7, 3
"""This many cells are compared with up to this many rows at a time: their sums fill the registers of AVX-512."""

FEWER_CELLS = 5
"""On other processors this many cells are compared with one row at a time."""

MOVED = 0x80808080 - (1 << 32)
"""Four zero bytes with 128 added, as a word."""

LOWEST, HIGHEST = -(1 << 31), (1 << 31) - 1

_BYTE, _HALF, _INT, _LONG = ir.IntType(8), ir.IntType(16), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_INT, LANES)
_BYTES = LANES * 4


def values_of_a_word(triple: str, features: str) -> int:
    """How many values of a word are multiplied and added at once (4, 2 or 1) on a processor that LLVM describes so."""
    if "+avx512vnni" in features.split(","):
        return 4
    return 2 if "86" in triple.split("-")[0] else 1


def has_wide_registers(features: str) -> bool:
    """Whether the processor has 32 registers of 512 bits, by LLVM's names of its features."""
    return "+avx512f" in features.split(",")


def _values(context: Any) -> int:
    triple, _, features = context.codegen().magic_tuple()
    return values_of_a_word(triple, features)


def _generate_values(typing_context: Any) -> Any:
    """The number of values of a word on the processor that this is compiled for; int64."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: tuple[Any, ...]) -> ir.Value:
        return _LONG(_values(context))

    return types.int64(), generate


def _generate_is_wide(typing_context: Any) -> Any:
    """Whether the processor that this is compiled for has wide registers."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: tuple[Any, ...]) -> ir.Value:
        return ir.IntType(1)(has_wide_registers(context.codegen().magic_tuple()[2]))

    return types.boolean(), generate


values_a_word: Any = intrinsic(_generate_values)
is_wide: Any = intrinsic(_generate_is_wide)


def _splat(builder: ir.IRBuilder, vector: ir.Value, lane: int) -> ir.Value:
    """One lane of a vector in all."""
    return builder.shuffle_vector(vector, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_VECTOR, [lane] * LANES))


def _everywhere(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    return _splat(builder, builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, _INT(0)), 0)


def _load(builder: ir.IRBuilder, address: ir.Value, kind: ir.Type) -> ir.Value:
    return builder.load(builder.inttoptr(address, kind.as_pointer()), align=1)


def _store(builder: ir.IRBuilder, value: ir.Value, address: ir.Value) -> None:
    builder.store(value, builder.inttoptr(address, _VECTOR.as_pointer()), align=4)


def _added(builder: ir.IRBuilder, values: int, sums: ir.Value, held: ir.Value, given: ir.Value) -> ir.Value:
    """Sums and, of each lane, the products of the words ``held`` and ``given`` value by value."""
    if values == 1:
        return builder.add(sums, builder.mul(held, given))
    if values == 4:  # bytes without a sign times bytes with one
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
        name = "llvm.x86.avx512.vpdpbusd.512"
        multiply = cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]
        return builder.call(multiply, [sums, held, given])
    halves, wide = ir.VectorType(_HALF, 2 * LANES), ir.VectorType(_INT, 2 * LANES)
    a, b = (builder.sext(builder.bitcast(words, halves), wide) for words in (held, given))
    products, nothing = builder.mul(a, b, flags=["nsw"]), ir.Constant(wide, ir.Undefined)
    even, odd = (
        builder.shuffle_vector(products, nothing, ir.Constant(_VECTOR, [2 * lane + side for lane in range(LANES)]))
        for side in (0, 1)
    )
    return builder.add(sums, builder.add(even, odd, flags=["nsw"]))


def _products(
    context: Any, builder: ir.IRBuilder, rows: int, cells: int, places: tuple[ir.Value, ...]
) -> list[list[ir.Value]]:
    """Of each row and cell the inner products, less what the last lane says."""
    held, held_stride, given, given_stride, steps = places
    values, nothing = _values(context), ir.Constant(_VECTOR, [0] * LANES)
    sums = [[cgutils.alloca_once(builder, _VECTOR) for _ in range(cells)] for _ in range(rows)]  # type: ignore[no-untyped-call]
    for cell in (cell for row in sums for cell in row):
        builder.store(nothing, cell)
    with cgutils.for_range(builder, steps) as loop:
        first = builder.add(held, builder.mul(loop.index, _LONG(_BYTES)))
        vectors = [_load(builder, builder.add(first, builder.mul(held_stride, _LONG(r))), _VECTOR) for r in range(rows)]
        word = builder.add(given, builder.mul(loop.index, _LONG(4)))
        for u in range(cells):
            other = _everywhere(builder, _load(builder, builder.add(word, builder.mul(given_stride, _LONG(u))), _INT))
            for r in range(rows):
                builder.store(_added(builder, values, builder.load(sums[r][u]), vectors[r], other), sums[r][u])
    loaded = [[builder.load(cell) for cell in row] for row in sums]
    return [[builder.sub(product, _splat(builder, product, HELD)) for product in row] for row in loaded]


_Best = tuple[ir.Value, ir.Value]
"""The best products of each lane and the cells that they are of."""


def _better(builder: ir.IRBuilder, first: _Best, second: _Best) -> _Best:
    """Of each lane the higher one; the first, if they are equal."""
    higher = builder.icmp_signed(">", second[0], first[0])
    return builder.select(higher, second[0], first[0]), builder.select(higher, second[1], first[1])


def _best_at(builder: ir.IRBuilder, address: ir.Value) -> _Best:
    return _load(builder, address, _VECTOR), _load(builder, builder.add(address, _LONG(_BYTES)), _VECTOR)


def _keep(builder: ir.IRBuilder, best: _Best, address: ir.Value) -> None:
    _store(builder, best[0], address)
    _store(builder, best[1], builder.add(address, _LONG(_BYTES)))


def _comparison(rows: int, cells: int) -> Any:
    """Compare so many cells of the reference with so many rows of the query.

    Takes a tuple of int64: the address of the first row's vectors and how far apart those of rows are; the address of
    the first cell's words and how far apart cells are; how many words a cell has; the address of the limits of the
    first cell's products, HIGHEST where a lane is within reach and LOWEST elsewhere; the addresses of the best so
    far of the first row's lanes (and how far apart rows are) and of the first cell's, each a vector of products and
    one of cells; the number of the first reference cell; that of the query cell of the first row's first lane; the
    columns.
    """

    def generate_comparison(typing_context: Any, places: Any) -> Any:
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: tuple[Any, ...]) -> ir.Value:
            given = cgutils.unpack_tuple(builder, arguments[0], 12)  # type: ignore[no-untyped-call]
            limits, there, there_stride, back, cell, query, columns = given[5:]
            products = _products(context, builder, rows, cells, tuple(given[:5]))
            numbers = [builder.add(query, builder.mul(columns, _LONG(r))) for r in range(rows)]
            lanes = ir.Constant(_VECTOR, list(range(LANES)))
            names = [builder.add(_everywhere(builder, builder.trunc(n, _INT)), lanes) for n in numbers]
            at_rows = [builder.add(there, builder.mul(there_stride, _LONG(r))) for r in range(rows)]
            of_rows = [_best_at(builder, at) for at in at_rows]
            for u in range(cells):
                limit = _load(builder, builder.add(limits, _LONG(u * _BYTES)), _VECTOR)
                name = _everywhere(builder, builder.trunc(builder.add(cell, _LONG(u)), _INT))
                at = builder.add(back, _LONG(2 * u * _BYTES))
                of_cell = _best_at(builder, at)
                for r in range(rows):
                    within = builder.icmp_signed("<", products[r][u], limit)
                    product = builder.select(within, products[r][u], limit)
                    of_rows[r] = _better(builder, of_rows[r], (product, name))
                    of_cell = _better(builder, of_cell, (product, names[r]))
                _keep(builder, of_cell, at)
            for best, at in zip(of_rows, at_rows, strict=True):
                _keep(builder, best, at)
            return context.get_dummy_value()

        return types.void(types.UniTuple(types.int64, 12)), generate  # type: ignore[no-untyped-call]

    return intrinsic(generate_comparison)


one_with_one: Any = _comparison(1, 1)
fewer_cells: Any = _comparison(1, FEWER_CELLS)
one_row: Any = _comparison(1, CELLS)
two_rows: Any = _comparison(2, CELLS)
three_rows: Any = _comparison(ROWS, CELLS)


def _generate_highest(typing_context: Any, address: Any) -> Any:
    """The highest value of a vector at an address, and the lowest of the names behind it that have it; two int32."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: tuple[Any, ...]) -> ir.Value:
        kind = ir.FunctionType(_INT, [_VECTOR])
        greatest, least = (
            cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.{way}.v{LANES}i32")  # type: ignore[no-untyped-call]
            for way in ("smax", "smin")
        )
        values = _load(builder, arguments[0], _VECTOR)
        names = _load(builder, builder.add(arguments[0], _LONG(_BYTES)), _VECTOR)
        highest = builder.call(greatest, [values])
        equal = builder.icmp_signed("==", values, _everywhere(builder, highest))
        others = ir.Constant(_VECTOR, [HIGHEST] * LANES)
        lowest = builder.call(least, [builder.select(equal, names, others)])
        return context.make_tuple(builder, signature.return_type, (highest, lowest))

    two = types.UniTuple(types.int32, 2)  # type: ignore[no-untyped-call]
    return two(types.int64), generate


highest: Any = intrinsic(_generate_highest)


def _generate_byte(typing_context: Any, address: Any) -> Any:
    """The byte at an address; int8."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: tuple[Any, ...]) -> ir.Value:
        return _load(builder, arguments[0], _BYTE)

    return types.int8(types.int64), generate


byte_at: Any = intrinsic(_generate_byte)
