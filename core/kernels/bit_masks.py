"""Which of a block of values reach a threshold, as the bits of one integer: the processor compares sixteen at a time.

A compiled loop that collects the few values over a threshold looks at each; numba has no word for the comparison
of a whole block, so that it is written here in LLVM's (and runs on any processor that LLVM knows).
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

ir: Any = cgutils.ir  # type: ignore[attr-defined]  # the LLVM that numba itself compiles with

BLOCK = 64
"""Values compared at a time, one bit each."""


def _reaching(typingctx: Any, values: Any, start: Any, threshold: Any) -> Any:
    """Bit i: is ``values[start + i] >= threshold``?  For i from 0 to 63, all within the array.

    ``values``: float32 [n], contiguous; ``start``: int64; ``threshold``: float32.  Returns uint64.
    """
    signature = types.uint64(values, types.int64, types.float32)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        block, many = ir.VectorType(ir.FloatType(), BLOCK), ir.VectorType(ir.IntType(32), BLOCK)
        pointer = builder.bitcast(builder.gep(array.data, [arguments[1]]), block.as_pointer())
        seen = builder.load(pointer)
        seen.align = 4
        nothing = ir.Constant(block, ir.Undefined)
        one = builder.insert_element(nothing, arguments[2], ir.Constant(ir.IntType(32), 0))
        limit = builder.shuffle_vector(one, nothing, ir.Constant(many, [0] * BLOCK))
        return builder.bitcast(builder.fcmp_ordered(">=", seen, limit), ir.IntType(BLOCK))

    return signature, generate


reaching: Any = intrinsic(_reaching)


def _lowest_bit(typingctx: Any, bits: Any) -> Any:
    """The place of the lowest bit that is set; uint64, not 0, to uint64."""
    signature = types.uint64(types.uint64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return signature, generate


lowest_bit: Any = intrinsic(_lowest_bit)


def _set_bits(typingctx: Any, bits: Any) -> Any:
    """How many bits are set; uint64 to uint64."""
    signature = types.uint64(types.uint64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return signature, generate


set_bits: Any = intrinsic(_set_bits)
