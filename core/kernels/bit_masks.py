"""Which of a block of values reach a threshold, as the bits of one integer.

numba offers no comparison of a whole block of values, which the processor does sixteen at a time, so it is written
here in LLVM's instructions; it runs on every processor that LLVM supports.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

ir: Any = cgutils.ir  # type: ignore[attr-defined]  # the LLVM that numba itself compiles with

BLOCK = 64
"""Values of a block, one bit each."""


def _reaching(typingctx: Any, values: Any, start: Any, threshold: Any) -> Any:
    """Bit i is whether ``values[start + i] >= threshold``, for i from 0 to 63, all within the array.

    ``values`` is float32 [n], contiguous; ``start`` int64; ``threshold`` float32; the result uint64.
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
    """The position of the lowest bit that is set; uint64, not 0, to uint64."""
    signature = types.uint64(types.uint64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return signature, generate


lowest_bit: Any = intrinsic(_lowest_bit)


def _set_bits(typingctx: Any, bits: Any) -> Any:
    """The number of bits that are set; uint64 to uint64."""
    signature = types.uint64(types.uint64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return signature, generate


set_bits: Any = intrinsic(_set_bits)
