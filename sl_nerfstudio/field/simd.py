"""Vector instructions for numba kernels: register tiles of a matrix product, trilinear gather and scatter.

Numba's own vectoriser keeps neither a tile of a product nor a row of a table in registers, so these few inner loops
are emitted as LLVM vector code. LLVM maps it to whatever the machine has; only the tile's shape is chosen here.
All arrays are flat, contiguous float32; positions in them are counted in elements.
"""

import hashlib
import inspect
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import llvmlite.binding
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic as _intrinsic

from sl_nerfstudio.field.hash_grid import FEATURES
from sl_nerfstudio.parallel import ANY_ORDER, shared

intrinsic: Any = _intrinsic  # callers omit the typing context, which type checkers cannot know
F32, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_AVX512 = bool(llvmlite.binding.get_host_cpu_features().get("avx512f"))
WIDTH, ROWS = (16, 8) if _AVX512 else (8, 4)
"""Shape of a tile: up to 3 vectors of WIDTH numbers times ROWS rows (24 of 32 registers, or 12 of 16)."""


_njit: Any = njit  # its overloads do not accept options in a dictionary
_OPTIONS = {"nogil": True, "fastmath": ANY_ORDER}


def part(function: Callable[..., Any]) -> Any:
    """Compile a function for use in kernels with numba; it cannot be called from Python.

    Run-time type checkers wrap functions before this decorator sees them, but numba needs the unwrapped one.
    """
    return _njit(inspect.unwrap(function), no_cpython_wrapper=True, no_cfunc_wrapper=True, **_OPTIONS)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile with numba: no GIL, fused multiply-add allowed, kept on disk for the next start."""
    dispatcher = _njit(inspect.unwrap(function), no_cfunc_wrapper=True, **_OPTIONS)
    try:
        dispatcher.enable_caching()
    except RuntimeError:  # no folder to write to: compile at every start
        return dispatcher
    # Kernels use one another's code and constants, but numba looks only at the file that a kernel is in.
    dispatcher._cache._cache_file._source_stamp = _sources()
    return shared(dispatcher)


def needs_compiling(kernel: Any) -> bool:
    """Whether a kernel's code is not on disk, but will be once it was called."""
    kept = getattr(kernel._cache, "_cache_file", None)  # None if there is no folder to write to
    return kept is not None and not kept._load_index()


@lru_cache(maxsize=1)
def _sources() -> str:
    """Digest of all sources of the compiled kernels."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, position: Any) -> Any:
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [position])


def _splat(builder: Any, scalar: Any, vector: ir.VectorType) -> Any:
    undefined = ir.Constant(vector, ir.Undefined)
    lanes = ir.Constant(ir.VectorType(I32, vector.count), [I32(0)] * vector.count)
    return builder.shuffle_vector(builder.insert_element(undefined, scalar, I32(0)), undefined, lanes)


def _load(builder: Any, pointer: Any, vector: ir.VectorType) -> Any:
    return builder.load(builder.bitcast(pointer, vector.as_pointer()), align=4)


def _store(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, builder.bitcast(pointer, value.type.as_pointer()), align=4)


def _fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    vector = a.type
    name = f"llvm.fmuladd.v{vector.count}f32"
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector] * 3), name)
    return builder.call(function, [a, b, c])


def _tile(vectors: int) -> Any:
    """`c[i, j] = (add ? c[i, j] : 0) + sum_k a[i, k] b[k, j]` for ROWS i and `vectors * WIDTH` j."""
    vector = ir.VectorType(F32, WIDTH)
    rows, columns = range(ROWS), range(vectors)

    @intrinsic
    def tile(typing: Any, a: Any, a0: Any, a_i: Any, a_k: Any, b: Any, b0: Any, b_k: Any, c: Any, c0: Any, c_i: Any, depth: Any, add: Any):  # fmt: skip  # noqa: E501
        n = types.int64
        signature = types.void(a, n, n, n, b, n, n, c, n, n, n, types.boolean)

        def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            a, a0, a_i, a_k, b, b0, b_k, c, c0, c_i, depth, add = args
            a = _pointer(context, builder, signature.args[0], a, a0)
            b = _pointer(context, builder, signature.args[4], b, b0)
            c = _pointer(context, builder, signature.args[7], c, c0)
            a = [builder.gep(a, [builder.mul(I64(i), a_i)]) for i in rows]
            c = [
                [builder.gep(c, [builder.add(builder.mul(I64(i), c_i), I64(j * WIDTH))]) for j in columns] for i in rows
            ]
            entry, loop, end = builder.block, builder.append_basic_block("k"), builder.append_basic_block("end")
            builder.branch(loop)
            builder.position_at_end(loop)
            k = builder.phi(I64)
            sums = [[builder.phi(vector) for _ in columns] for _ in rows]
            b_row = builder.gep(b, [builder.mul(k, b_k)])
            b_row = [_load(builder, builder.gep(b_row, [I64(j * WIDTH)]), vector) for j in columns]
            a_column = builder.mul(k, a_k)
            new = []
            for i in rows:
                x = _splat(builder, builder.load(builder.gep(a[i], [a_column]), align=4), vector)
                new.append([_fma(builder, x, b_row[j], sums[i][j]) for j in columns])
            k_next = builder.add(k, I64(1))
            builder.cbranch(builder.icmp_signed("<", k_next, depth), loop, end)
            k.add_incoming(I64(0), entry)
            k.add_incoming(k_next, loop)
            for i in rows:
                for j in columns:
                    sums[i][j].add_incoming(ir.Constant(vector, [F32(0.0)] * WIDTH), entry)
                    sums[i][j].add_incoming(new[i][j], loop)
            builder.position_at_end(end)
            with builder.if_else(add) as (then, otherwise):
                with then:
                    for i in rows:
                        for j in columns:
                            _store(builder, builder.fadd(_load(builder, c[i][j], vector), new[i][j]), c[i][j])
                with otherwise:
                    for i in rows:
                        for j in columns:
                            _store(builder, new[i][j], c[i][j])
            return context.get_dummy_value()

        return signature, emit

    return tile


_tile1, _tile2, _tile3 = _tile(1), _tile(2), _tile(3)


@part
def multiply(a, a_i, a_k, b, b_k, c, c_i, m, n, depth, add):
    """`c = a b` or `c += a b`; `a` [m, depth] with any strides, `b` [depth, n] and `c` [m, n] with row strides.

    `m` is a multiple of ROWS, `n` one of WIDTH, depth at least 1.
    """
    j = 0
    while j < n:
        left = (n - j) // WIDTH
        if left == 3 or left > 4:
            for i in range(0, m, ROWS):
                _tile3(a, i * a_i, a_i, a_k, b, j, b_k, c, i * c_i + j, c_i, depth, add)
            j += 3 * WIDTH
        elif left > 1:
            for i in range(0, m, ROWS):
                _tile2(a, i * a_i, a_i, a_k, b, j, b_k, c, i * c_i + j, c_i, depth, add)
            j += 2 * WIDTH
        else:
            for i in range(0, m, ROWS):
                _tile1(a, i * a_i, a_i, a_k, b, j, b_k, c, i * c_i + j, c_i, depth, add)
            j += WIDTH


_ROW = ir.VectorType(F32, FEATURES)


def _rows(context: Any, builder: Any, table_type: Any, table: Any, positions: Any) -> list[Any]:
    """Pointers of the eight corners, from a tuple of eight positions; x varies fastest."""
    corners = cgutils.unpack_tuple(builder, positions, 8)
    return [_pointer(context, builder, table_type, table, corner) for corner in corners]


def _lerp(builder: Any, a: Any, b: Any, t: Any) -> tuple[Any, Any]:
    """`a + t (b - a)` and `b - a`."""
    step = builder.fsub(b, a)
    return _fma(builder, t, step, a), step


@intrinsic
def prefetch(typing: Any, table: Any, positions: Any):
    """Prefetch some positions of an array, to be read or written soon."""
    signature = types.void(table, positions)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        table, positions = args
        for position in cgutils.unpack_tuple(builder, positions, len(signature.args[1])):
            pointer = builder.bitcast(_pointer(context, builder, signature.args[0], table, position), byte)
            builder.call(function, [pointer, I32(0), I32(3), I32(1)])
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def gather(typing: Any, table: Any, corners: Any, t: Any, weight: Any, out: Any, position: Any):
    """`out[position:] = weight * trilinear(rows at corners, t)`."""
    signature = types.void(table, corners, t, types.float32, out, types.int64)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        table, corners, t, weight, out, position = args
        rows = _rows(context, builder, signature.args[0], table, corners)
        x, y, z = (_splat(builder, s, _ROW) for s in cgutils.unpack_tuple(builder, t, 3))
        v = [_load(builder, row, _ROW) for row in rows]
        for s in (x, y, z):
            v = [_lerp(builder, v[2 * i], v[2 * i + 1], s)[0] for i in range(len(v) // 2)]
        pointer = _pointer(context, builder, signature.args[4], out, position)
        _store(builder, builder.fmul(v[0], _splat(builder, weight, _ROW)), pointer)
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def gather_jacobian(typing: Any, table: Any, corners: Any, t: Any, weight: Any, out: Any, position: Any, slope: Any, jacobian: Any, at: Any, stride: Any):  # fmt: skip  # noqa: E501
    """`gather`, and also `jacobian[at + axis * stride:] = slope[axis] * d trilinear / d t[axis]` for all three axes."""
    signature = types.void(table, corners, t, types.float32, out, types.int64, slope, jacobian, types.int64, types.int64)  # fmt: skip  # noqa: E501

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        table, corners, t, weight, out, position, slope, jacobian, at, stride = args
        rows = _rows(context, builder, signature.args[0], table, corners)
        x, y, z = (_splat(builder, s, _ROW) for s in cgutils.unpack_tuple(builder, t, 3))
        r = [_load(builder, row, _ROW) for row in rows]
        along_x = [_lerp(builder, r[2 * i], r[2 * i + 1], x) for i in range(4)]
        along_y = [_lerp(builder, along_x[2 * i][0], along_x[2 * i + 1][0], y) for i in range(2)]
        value, d_z = _lerp(builder, along_y[0][0], along_y[1][0], z)
        d_y = _lerp(builder, along_y[0][1], along_y[1][1], z)[0]
        d_x = [_lerp(builder, along_x[2 * i][1], along_x[2 * i + 1][1], y)[0] for i in range(2)]
        d_x = _lerp(builder, d_x[0], d_x[1], z)[0]
        pointer = _pointer(context, builder, signature.args[4], out, position)
        _store(builder, builder.fmul(value, _splat(builder, weight, _ROW)), pointer)
        pointer = _pointer(context, builder, signature.args[7], jacobian, at)
        for d, s in zip((d_x, d_y, d_z), cgutils.unpack_tuple(builder, slope, 3), strict=True):
            _store(builder, builder.fmul(d, _splat(builder, s, _ROW)), pointer)
            pointer = builder.gep(pointer, [stride])
        return context.get_dummy_value()

    return signature, emit


def _scatter(pairs: int) -> Any:
    """`table[corner c] += sum over pairs of weights[c] * values[position:]` for the eight corners in turn."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        table, corners, position, *rest = args
        factors = []
        for i in range(pairs):
            weights, values = rest[2 * i : 2 * i + 2]
            pointer = _pointer(context, builder, signature.args[4 + 2 * i], values, position)
            factors.append((cgutils.unpack_tuple(builder, weights, 8), _load(builder, pointer, _ROW)))
        for c, row in enumerate(_rows(context, builder, signature.args[0], table, corners)):
            total = _load(builder, row, _ROW)
            for weights, v in factors:
                total = _fma(builder, _splat(builder, weights[c], _ROW), v, total)
            _store(builder, total, row)
        return context.get_dummy_value()

    if pairs == 1:

        def scatter(typing: Any, table: Any, corners: Any, position: Any, weights: Any, values: Any):
            return types.void(table, corners, types.int64, weights, values), emit

        return intrinsic(scatter)

    def scatter_pair(typing: Any, table: Any, corners: Any, position: Any, w1: Any, v1: Any, w2: Any, v2: Any):
        return types.void(table, corners, types.int64, w1, v1, w2, v2), emit

    return intrinsic(scatter_pair)


scatter, scatter_pair = _scatter(1), _scatter(2)


def _sum(builder: Any, v: Any) -> Any:
    """Sum of a row's numbers, pairwise."""
    while v.type.count > 1:
        half = v.type.count // 2
        undefined = ir.Constant(v.type, ir.Undefined)
        low, high = (
            builder.shuffle_vector(
                v, undefined, ir.Constant(ir.VectorType(I32, half), [I32(k + i) for i in range(half)])
            )
            for k in (0, half)
        )
        v = builder.fadd(low, high)
    return builder.extract_element(v, I32(0))


@intrinsic
def contract(typing: Any, jacobian: Any, at: Any, stride: Any, values: Any, position: Any, rows: Any):
    """Three sums over `rows` rows (at least one): `sum jacobian[at + axis * stride:] * values[position:]`."""
    n, x = types.int64, types.float32
    signature = types.UniTuple(x, 3)(jacobian, n, n, values, n, n)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        jacobian, at, stride, values, position, rows = args
        jacobian = _pointer(context, builder, signature.args[0], jacobian, at)
        axes = [builder.gep(jacobian, [builder.mul(I64(a), stride)]) for a in range(3)]
        values = _pointer(context, builder, signature.args[3], values, position)
        entry, loop, end = builder.block, builder.append_basic_block("row"), builder.append_basic_block("end")
        builder.branch(loop)
        builder.position_at_end(loop)
        k, sums = builder.phi(I64), [builder.phi(_ROW) for _ in range(3)]
        step = builder.mul(k, I64(FEATURES))
        v = _load(builder, builder.gep(values, [step]), _ROW)
        new = [
            _fma(builder, _load(builder, builder.gep(j, [step]), _ROW), v, t) for j, t in zip(axes, sums, strict=True)
        ]
        k_next = builder.add(k, I64(1))
        builder.cbranch(builder.icmp_signed("<", k_next, rows), loop, end)
        k.add_incoming(I64(0), entry)
        k.add_incoming(k_next, loop)
        for total, after in zip(sums, new, strict=True):
            total.add_incoming(ir.Constant(_ROW, [F32(0.0)] * FEATURES), entry)
            total.add_incoming(after, loop)
        builder.position_at_end(end)
        return context.make_tuple(builder, signature.return_type, [_sum(builder, total) for total in new])

    return signature, emit
