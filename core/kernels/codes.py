"""Loops over codes, compiled: agreeing bits counted, the best estimates found.  They release the GIL.

A query is quantised to four bits a value, in two's complement: with its planes of bits p0, p1, p2 and p3, the sum
of its values where a code c has ones is |c ∧ p0| + 2 |c ∧ p1| + 4 |c ∧ p2| - 8 |c ∧ p3| (RaBitQ, section 3.3.2).
Codes come in groups of eight words, 512 bits, and planes as [groups, 4, 8], in the order in which they are read.
"""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

GROUP_WORDS = 8
"""Words that are compared at a time: the widest register that processors have, and a line of their caches."""
GROUP_BITS = 64 * GROUP_WORDS
PLANES = 4

_AHEAD = 32
"""Groups that the cache is asked for ahead, where codes are read one after another."""

_BYTE, _INT, _WORD = ir.IntType(8), ir.IntType(32), ir.IntType(64)
_GROUP = ir.VectorType(_WORD, GROUP_WORDS)


def _generate_sum(typing_context: Any, code: Any, planes: Any, groups: Any, next_code: Any) -> Any:
    """The sum of a query's values at the ones of one code.

    Takes addresses of the code and of the planes, the code's length in groups, and the address of the code that
    comes next, which the cache is to fetch meanwhile: the rows that are picked lie far apart.

    Written as LLVM's vector instructions, for its own vectoriser makes detours of so short a loop; machines
    without registers of 512 bits get what they have.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: tuple[Any, ...]) -> ir.Value:
        code, planes, next_code = (builder.inttoptr(arguments[number], _GROUP.as_pointer()) for number in (0, 1, 3))
        fetch = prefetch(builder)
        ones = _vector_function(builder, "llvm.ctpop.v8i64", _GROUP)
        nothing = ir.Constant(_GROUP, [0] * GROUP_WORDS)
        total = cgutils.alloca_once_value(builder, nothing)  # type: ignore[no-untyped-call]
        with cgutils.for_range(builder, arguments[2]) as loop:
            word = builder.load(builder.gep(code, [loop.index]), align=8)
            line = builder.bitcast(builder.gep(next_code, [loop.index]), _BYTE.as_pointer())
            builder.call(fetch, [line, _INT(0), _INT(3), _INT(1)])  # to read, into every cache, data
            first = builder.mul(loop.index, ir.Constant(loop.index.type, PLANES))
            added = builder.load(total)
            for number in range(PLANES):
                at = builder.add(first, ir.Constant(first.type, number))
                plane = builder.load(builder.gep(planes, [at]), align=8)
                counted = builder.call(ones, [builder.and_(word, plane)])
                weighted = builder.shl(counted, ir.Constant(_GROUP, [number] * GROUP_WORDS))
                added = (builder.sub if number == PLANES - 1 else builder.add)(added, weighted)
            builder.store(added, total)
        return builder.call(_vector_function(builder, "llvm.vector.reduce.add.v8i64", _WORD), [builder.load(total)])

    return types.int64(types.int64, types.int64, types.int64, types.int64), generate


_sum_at_ones: Any = intrinsic(_generate_sum)


def _vector_function(builder: ir.IRBuilder, name: str, result: ir.Type) -> ir.Function:
    """One of LLVM's functions of a group of words."""
    kind = ir.FunctionType(result, [_GROUP])
    return cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]


def prefetch(builder: ir.IRBuilder) -> ir.Function:
    """LLVM's hint that memory will be read."""
    kind = ir.FunctionType(ir.VoidType(), [_BYTE.as_pointer(), _INT, _INT, _INT])
    return cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")  # type: ignore[no-untyped-call]


@numba.njit(cache=True, nogil=True)
def estimates_of(codes, scales, planes, step, total, estimates):  # type: ignore[no-untyped-def]
    """Estimated inner products of a query with all rows.

    Args:
        codes: uint64 [n, 8·groups], contiguous; scales: float32 [n].
        planes: uint64 [groups, 4, 8]; step and total: float32, of the query.
        estimates: float32 [n], written.
    """
    first, stride, groups = codes.ctypes.data, codes.shape[1] * 8, len(planes)
    for row in range(len(codes)):
        agreeing = _sum_at_ones(
            first + row * stride, planes.ctypes.data, groups, first + (row + _AHEAD // groups) * stride
        )
        estimates[row] = scales[row] * (step * types.float32(agreeing) - total)


@numba.njit(cache=True, nogil=True)
def estimates_at(codes, scales, planes, step, total, rows, estimates):  # type: ignore[no-untyped-def]
    """The same with some ``rows``, int64 [k], into float32 [k]."""
    first, stride, groups = codes.ctypes.data, codes.shape[1] * 8, len(planes)
    for position in range(len(rows)):
        row, following = rows[position], rows[min(position + 1, len(rows) - 1)]
        agreeing = _sum_at_ones(first + row * stride, planes.ctypes.data, groups, first + following * stride)
        estimates[position] = scales[row] * (step * types.float32(agreeing) - total)


@numba.njit(cache=True, nogil=True)
def count_from(values, limit):  # type: ignore[no-untyped-def]
    """How many values are no less than a limit."""
    found = 0
    for value in values:
        found += value >= limit
    return found


@numba.njit(cache=True, nogil=True)
def gather_from(values, limit, positions):  # type: ignore[no-untyped-def]
    """Where the values no less than a limit are, ascending, into int64 [count]."""
    found = 0
    for position in range(len(values)):
        if values[position] >= limit:
            positions[found] = position
            found += 1
