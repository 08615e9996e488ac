"""Sums of vectors of 6 and 12 numbers, the unknowns of half a frame and of a frame, as vector instructions.

As loops they cost more than twice as much: before each of them, code of numba checks whether its arrays overlap.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic as _intrinsic

intrinsic: Any = _intrinsic  # callers omit the typing context, which type checkers cannot know
_NUMBER = 8  # bytes


def _adding(count: int, lanes: int) -> Any:
    """`out[at : at + count] += scale * values[first : first + count]` in flat, contiguous arrays of float64."""
    vector = ir.VectorType(ir.DoubleType(), lanes)
    undefined, zeros = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)

    @intrinsic
    def add(typing: Any, out: Any, at: Any, scale: Any, values: Any, first: Any) -> Any:
        signature = types.void(out, types.int64, types.float64, values, types.int64)

        def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            out, at, scale, values, first = args
            target = context.make_array(signature.args[0])(context, builder, out).data
            source = context.make_array(signature.args[3])(context, builder, values).data
            first_lane = builder.insert_element(undefined, scale, ir.Constant(ir.IntType(32), 0))
            scales = builder.shuffle_vector(first_lane, undefined, zeros)
            kind = ir.FunctionType(vector, [vector] * 3)
            multiply_add = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{lanes}f64")

            def pointer(data: Any, place: Any, step: int) -> Any:
                there = builder.gep(data, [builder.add(place, ir.Constant(ir.IntType(64), step))])
                return builder.bitcast(there, vector.as_pointer())

            for step in range(0, count, lanes):
                x = builder.load(pointer(source, first, step), align=_NUMBER)
                sums = pointer(target, at, step)
                total = builder.call(multiply_add, [scales, x, builder.load(sums, align=_NUMBER)])
                builder.store(total, sums, align=_NUMBER)
            return context.get_dummy_value()

        return signature, emit

    return add


add_6, add_12 = _adding(6, 2), _adding(12, 4)
