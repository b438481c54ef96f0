"""Exact inner products of queries with descriptors in memory, in half or single precision.

FAISS reads every descriptor once for each of a few queries, and halves no faster than floats.  Here six descriptors are
held against up to four queries at a time, in sums that stay in the processor's registers: memory is read once for all,
and halves, of which it holds twice as many, become floats on the way.  A product is summed in one order, whichever
queries and descriptors are compared along with it, so that it is the same number alone and in company.
"""

from __future__ import annotations

import platform
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from core.kernels.codes import prefetch

_ALL_BUT_SIGN = np.int32(0x7FFFFFFF)
_ROW = np.int64(0xFFFFFFFF)


def ranked(rows: NDArray[np.int64], products: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Both in the order of the products, best first.

    Args:
        rows: int64 [n], each less than 2^32, none twice, in any order.
        products: float32 [n], no NaN among them.
    """
    keys = np.empty(len(rows), np.int64)
    _join(rows, products.view(np.int32), keys)
    keys.sort()
    ordered, found = np.empty_like(rows), np.empty(len(rows), np.int32)
    _part(keys, ordered, found)
    return ordered, found.view(np.float32)


@numba.njit(cache=True, nogil=True)
def _join(rows, bits, keys):  # type: ignore[no-untyped-def]
    for position in range(len(rows)):
        value = bits[position]
        if not value & _ALL_BUT_SIGN:
            value = np.int32(0)  # both zeros are one value
        descending = ~(value ^ ((value >> 31) & _ALL_BUT_SIGN))
        keys[position] = np.int64(descending) << 32 | rows[position]


@numba.njit(cache=True, nogil=True)
def _part(keys, rows, bits):  # type: ignore[no-untyped-def]
    for position in range(len(keys)):
        rows[position] = keys[position] & _ROW
        value = np.int32(~(keys[position] >> 32))
        bits[position] = value ^ ((value >> 31) & _ALL_BUT_SIGN)


Rows = NDArray[np.float16] | NDArray[np.float32]


def _features() -> dict[str, bool]:
    """What this processor can do, by LLVM's names."""
    try:
        return dict(llvm.get_host_cpu_features())
    except RuntimeError:  # LLVM does not know of this kind of machine
        return {}


_WIDE = _features().get("avx512f", False)  # registers of sixteen floats, and 32 of them
_KNOWS_HALVES = _features().get("f16c", False) or platform.machine() in ("aarch64", "arm64")

_ROWS = 6
_QUERIES = 4 if _WIDE else 2
_LANES = 16 if _WIDE else 8
"""Six rows times four queries are 24 registers of sums; others have half as many registers, of half the width."""

_AHEAD = 2048
"""Bytes of a row that the cache is asked for ahead; by itself a processor looks less far."""

_INT, _LONG, _FLOAT, _HALF = ir.IntType(32), ir.IntType(64), ir.FloatType(), ir.HalfType()
_MAY_FUSE = ["contract"]
_HALVES, _FLOATS = np.empty(0, np.uint16), np.empty(0, np.float32)


def _tile(width: int) -> Any:
    """A function that compares ``_ROWS`` rows with ``width`` queries, compiled where it is called.

    Its arguments: an array of the rows' kind; addresses of the rows, int64 [_ROWS]; addresses of the queries,
    int64 [width]; D, int64; products float32 [width, _ROWS], written.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: tuple[Any, ...]) -> ir.Value:
        def content(number: int) -> Any:
            return context.make_array(signature.args[number])(context, builder, arguments[number]).data

        def addresses(number: int, count: int) -> list[ir.Value]:
            return [builder.load(builder.gep(content(number), [_LONG(i)])) for i in range(count)]

        kind = _FLOAT if signature.args[0].dtype == types.float32 else _HALF
        rows, queries, dimension = addresses(1, _ROWS), addresses(2, width), arguments[3]
        whole = builder.and_(dimension, _LONG(-_LANES))
        sums = _sums(builder, kind, _LANES, rows, queries, _LONG(0), whole)
        rest = _sums(builder, kind, 1, rows, queries, whole, dimension)
        for number, (first, last) in enumerate(zip(sums, rest, strict=True)):
            builder.store(builder.fadd(first, last), builder.gep(content(4), [_LONG(number)]))
        return context.get_dummy_value()

    def typed(typing_context: Any, rows: Any, places: Any, queries: Any, dimension: Any, products: Any) -> Any:
        return types.none(rows, places, queries, dimension, products), generate

    return intrinsic(typed)


def _sums(
    builder: ir.IRBuilder,
    kind: ir.Type,
    lanes: int,
    rows: list[ir.Value],
    queries: list[ir.Value],
    start: ir.Value,
    stop: ir.Value,
) -> list[ir.Value]:
    """Of the values from ``start`` to ``stop``, so many at a time; by query, then by row."""
    stored, vector = ir.VectorType(kind, lanes), ir.VectorType(_FLOAT, lanes)
    nothing = ir.Constant(vector, [0.0] * lanes)
    sums = [[cgutils.alloca_once_value(builder, nothing) for _ in rows] for _ in queries]  # type: ignore[no-untyped-call]
    size = 2 if kind == _HALF else 4

    def at(address: ir.Value, index: ir.Value, bytes_each: int, pointed: ir.Type) -> ir.Value:
        return builder.inttoptr(builder.add(address, builder.mul(index, _LONG(bytes_each))), pointed.as_pointer())

    with cgutils.for_range_slice(builder, start, stop, _LONG(lanes), _LONG) as (index, _):
        asked = [builder.load(at(query, index, 4, vector), align=4) for query in queries]
        for number, row in enumerate(rows):
            ahead = at(builder.add(row, _LONG(_AHEAD)), index, size, ir.IntType(8))
            builder.call(prefetch(builder), [ahead, _INT(0), _INT(3), _INT(1)])  # to read, into every cache, data
            values = builder.load(at(row, index, size, stored), align=size)
            values = values if kind == _FLOAT else builder.fpext(values, vector)
            for of_query, query in zip(sums, asked, strict=True):
                product = builder.fmul(values, query, flags=_MAY_FUSE)
                builder.store(builder.fadd(builder.load(of_query[number]), product, flags=_MAY_FUSE), of_query[number])
    return [_folded(builder, builder.load(found)) for of_query in sums for found in of_query]


def _folded(builder: ir.IRBuilder, vector: ir.Value) -> ir.Value:
    """The sum of a vector: its upper half is added to its lower one until one value is left."""
    count = vector.type.count
    while count > 1:
        count //= 2
        nothing = ir.Constant(vector.type, ir.Undefined)
        halves = [ir.Constant(ir.VectorType(_INT, count), list(range(first, first + count))) for first in (0, count)]
        lower, upper = (builder.shuffle_vector(vector, nothing, half) for half in halves)
        vector = builder.fadd(lower, upper)
    return builder.extract_element(vector, _INT(0))


_with_four, _with_two, _with_one = _tile(4), _tile(2), _tile(1)


@numba.njit(cache=True, nogil=True)
def _compare(kind, rows, stride, chosen, queries, count, dimension, products):  # type: ignore[no-untyped-def]
    """All rows and queries by their addresses, so that this is compiled once for each kind of rows.

    ``kind``: an array of theirs, float32, or halves as uint16; ``stride``: bytes from row to row; ``chosen``: int64
    [k]; ``count`` queries of float32 [dimension]; ``products``: float32 [count, k], written.
    """
    places, asked = np.empty(_ROWS, np.int64), np.empty(_QUERIES, np.int64)
    made = np.empty((_QUERIES, _ROWS), np.float32)
    for first in range(0, len(chosen), _ROWS):
        beside = min(_ROWS, len(chosen) - first)
        for i in range(_ROWS):  # the last block repeats its last row
            places[i] = rows + chosen[first + min(i, beside - 1)] * stride
        for begun in range(0, count, _QUERIES):
            left = min(_QUERIES, count - begun)
            for j in range(_QUERIES):
                asked[j] = queries + (begun + min(j, left - 1)) * dimension * 4
            if left > 2:
                _with_four(kind, places, asked, dimension, made)
            elif left == 2:
                _with_two(kind, places, asked, dimension, made)
            else:
                _with_one(kind, places, asked, dimension, made)
            for j in range(left):
                for i in range(beside):
                    products[begun + j, first + i] = made[j, i]


def compare(queries: NDArray[np.float32], rows: Rows, chosen: NDArray[np.int64]) -> NDArray[np.float32]:
    """The inner products of queries with the chosen ``rows``, summed in float32: float32 [B, k].

    Args:
        queries: float32 [B, D].
        rows: float16 or float32 [n, D].
        chosen: int64 [k], numbers of rows; the others are not read.

    Raises:
        IndexError: there is no such row.
        ValueError: queries and rows are not of one length.
    """
    if len(chosen) and not 0 <= chosen.min() <= chosen.max() < len(rows):
        raise IndexError(f"there are {len(rows)} rows")
    if rows.dtype == np.float16 and not _KNOWS_HALVES:
        rows, chosen = rows[chosen].astype(np.float32), np.arange(len(chosen))
    kind = _HALVES if rows.dtype == np.float16 else _FLOATS
    queries, read = np.ascontiguousarray(queries, np.float32), np.ascontiguousarray(rows)
    count, dimension = queries.shape
    if read.shape[1] != dimension:
        raise ValueError(f"queries are of {dimension} values, rows of {read.shape[1]}")
    products = np.empty((count, len(chosen)), np.float32)
    stride = dimension * read.itemsize
    _compare(kind, read.ctypes.data, stride, chosen, queries.ctypes.data, count, dimension, products)
    return products


def compile_ahead() -> None:
    """Compile now, or read from the cache, what the first search of a small map would wait for."""
    query, chosen = np.ones((1, 1), np.float32), np.zeros(1, np.int64)
    for rows in (np.ones((1, 1), np.float16), np.ones((1, 1), np.float32)):
        ranked(chosen, compare(query, rows, chosen)[0])
