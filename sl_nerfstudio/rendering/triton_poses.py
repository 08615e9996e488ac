# pyright: basic, reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
"""Poses from the increments to their bases, in Triton and in double precision; the formulas are those of `model/poses`.

Matrices act on columns (x, y, z, h) of a pose, where h is 1 for the translation and 0 for axes: a row of a tile is a
frame, a column one of the four. The exponential of an increment (v, w) is its series, applied to columns; that of its
derivative, `exp(xi + d) = exp(J d) exp(xi)`, is applied to adjoints. Both converge for any increment below a turn.
"""

from dataclasses import dataclass
from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from sl_nerfstudio.field.device_kernels import block, launch
from sl_nerfstudio.field.triton_vectors import along, columns, cross, summed, vector
from sl_nerfstudio.rendering.triton_devices import pose, turned, turned_back

_TERMS = tl.constexpr(26)  # of the series: exact in double precision up to 3 rad
_FRAMES = 16  # of a program


@triton.jit
def _double(v):
    """A vector for each row of a tile, in double precision."""
    v = columns(v)
    return v[0].to(tl.float64), v[1].to(tl.float64), v[2].to(tl.float64)


@triton.jit
def _increment(steps, row, there):
    """Translation and rotation vector of an increment."""
    return _double(vector(steps, 2 * row, there)), _double(vector(steps, 2 * row + 1, there))


@triton.jit
def _base(T, i, there):
    """A base pose, to act on columns."""
    T = pose(T, i, there)
    return columns(T[0]), columns(T[1]), columns(T[2]), columns(T[3])


@triton.jit
def _moved(step, x, h):
    """The exponential of an increment, applied to columns."""
    term = along(cross(step[1], x), h, step[0])
    total = along(x, 1.0, term)
    for n in range(2, _TERMS):
        term = cross(step[1], (term[0] / n, term[1] / n, term[2] / n))
        total = along(total, 1.0, term)
    return total


@triton.jit
def _turned_back_by(step, g):
    """The inverse of an increment's rotation, applied to directions."""
    w = -step[1][0], -step[1][1], -step[1][2]
    return _moved((w, w), g, 0.0)


@triton.jit
def _camera(step, base, x, h, ABOUT_SCENE: tl.constexpr):
    """The camera's pose, applied to columns."""
    if ABOUT_SCENE:
        return _moved(step, along(turned(base, x), h, base[3]), h)
    return along(turned(base, _moved(step, x, h)), h, base[3])


@triton.jit
def _by_camera(step, base, x, h, g, ABOUT_SCENE: tl.constexpr):
    """From the adjoint `g` of what `_camera` gives: what `_by_step` takes, and the adjoint of the columns `x`."""
    if ABOUT_SCENE:
        y = _moved(step, along(turned(base, x), h, base[3]), h)
        return _moment(y, h, g), turned_back(base, _turned_back_by(step, g))
    g = turned_back(base, g)
    return _moment(_moved(step, x, h), h, g), _turned_back_by(step, g)


@triton.jit
def _moment(y, h, g):
    """Adjoint of a small translation and turn of columns `y`, from theirs."""
    return summed((h * g[0], h * g[1], h * g[2])), summed(cross(y, g))


@triton.jit
def _store_by_step(out, row, step, by, there, SHARED: tl.constexpr):
    """Write the adjoint of an increment, or add it if the increment is that of all frames."""
    a, b = columns(by[0]), columns(by[1])
    total_a, total_b = a, b
    for n in range(2, _TERMS):
        b = along(cross(a, step[0]), 1.0, cross(b, step[1]))
        b = b[0] / n, b[1] / n, b[2] / n
        a = cross((a[0] / n, a[1] / n, a[2] / n), step[1])
        total_a, total_b = along(total_a, 1.0, a), along(total_b, 1.0, b)
    for AXIS in tl.static_range(3):
        x, y = tl.sum(total_a[AXIS], 1).to(tl.float32), tl.sum(total_b[AXIS], 1).to(tl.float32)
        if SHARED:
            tl.atomic_add(out + AXIS, tl.sum(tl.where(there, x, 0.0)))
            tl.atomic_add(out + 3 + AXIS, tl.sum(tl.where(there, y, 0.0)))
        else:
            tl.store(out + 6 * row + AXIS, x, there)
            tl.store(out + 6 * row + 3 + AXIS, y, there)


@triton.jit
def _identity():
    """The columns of the identity, and h."""
    j = tl.arange(0, 4)[None, :]
    return ((j == 0).to(tl.float64), (j == 1).to(tl.float64), (j == 2).to(tl.float64)), (j == 3).to(tl.float64)


@triton.jit
def _read(T, i, there):
    """The columns of matrices."""
    at, some = T + 16 * i[:, None] + tl.arange(0, 4)[None, :], there[:, None]
    x, y, z = tl.load(at, some, 0.0), tl.load(at + 4, some, 0.0), tl.load(at + 8, some, 0.0)
    return x.to(tl.float64), y.to(tl.float64), z.to(tl.float64)


@triton.jit
def _write(T, i, x, h, there):
    """Write poses."""
    at, some = T + 16 * i[:, None] + tl.arange(0, 4)[None, :], there[:, None]
    for ROW in tl.static_range(3):
        tl.store(at + 4 * ROW, x[ROW].to(tl.float32), some)
    tl.store(at + 12, tl.where(some, h, 0.0).to(tl.float32), some)


@triton.jit(do_not_specialize=["n"])
def move_poses(
    camera_step, projector_step, base_camera, base_projector, T_camera, T_projector, n,
    ABOUT_SCENE: tl.constexpr, RELATIVE: tl.constexpr, OWN: tl.constexpr, SHARED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Poses of n cameras and projectors; `projector_step` has one row for all if SHARED."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there, row = i < n, i * 0 if SHARED else i
    one, h = _identity()
    step, base, own = _increment(camera_step, i, there), _base(base_camera, i, there), _read(base_projector, i, there)
    _write(T_camera, i, _camera(step, base, one, h, ABOUT_SCENE), h, there)
    if RELATIVE:
        own = turned_back(base, along(own, -h, base[3]))
        own = _camera(step, base, _moved(_increment(projector_step, row, there), own, h), h, ABOUT_SCENE)
    if OWN:
        base = _base(base_projector, i, there)
        own = along(turned(base, _moved(_increment(projector_step, row, there), one, h)), h, base[3])
    _write(T_projector, i, own, h, there)


@triton.jit(do_not_specialize=["n"])
def move_poses_adjoint(
    camera_step, projector_step, base_camera, base_projector, d_camera, d_projector, d_camera_step, d_projector_step, n,
    ABOUT_SCENE: tl.constexpr, RELATIVE: tl.constexpr, OWN: tl.constexpr, SHARED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adjoints of the increments from those of the poses; one for all frames must begin as 0."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there, row = i < n, i * 0 if SHARED else i
    one, h = _identity()
    step, base, g = _increment(camera_step, i, there), _base(base_camera, i, there), _read(d_projector, i, there)
    by, _ = _by_camera(step, base, one, h, _read(d_camera, i, there), ABOUT_SCENE)
    if RELATIVE:
        moving = _increment(projector_step, row, there)
        own = turned_back(base, along(_read(base_projector, i, there), -h, base[3]))
        own = _moved(moving, own, h)
        more, g = _by_camera(step, base, own, h, g, ABOUT_SCENE)
        by = along(by[0], 1.0, more[0]), along(by[1], 1.0, more[1])
        _store_by_step(d_projector_step, row, moving, _moment(own, h, g), there, SHARED)
    if OWN:
        moving, g = _increment(projector_step, row, there), turned_back(_base(base_projector, i, there), g)
        _store_by_step(d_projector_step, row, moving, _moment(_moved(moving, one, h), h, g), there, SHARED)
    _store_by_step(d_camera_step, i, step, by, there, False)


@dataclass(frozen=True)
class Moves:
    """What increments do: cameras turn about the scene's centre or their own; what the projector's one changes."""

    about_scene: bool
    relative: bool
    own: bool


def moved_poses(
    moves: Moves,
    camera_step: Float[Tensor, "frames 6"],
    projector_step: Float[Tensor, "k 6"],
    base_camera: Float64[Tensor, "frames 4 4"],
    base_projector: Float64[Tensor, "frames 4 4"],
) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
    """Poses of cameras and projectors, differentiable by the increments; the projector's may be one for all frames."""
    return _Moved.apply(moves, camera_step, projector_step, base_camera, base_projector)


class _Moved(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, moves: Moves, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        ctx.moves = moves
        ctx.save_for_backward(*tensors)
        camera, projector = tensors[0].new_empty(2, len(tensors[0]), 4, 4)
        _launch(move_poses, moves, *tensors, camera, projector)
        return camera, projector

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        tensors, moves = ctx.saved_tensors, ctx.moves
        shared = len(tensors[1]) < len(tensors[0])
        by_camera = torch.empty_like(tensors[0])
        by_projector = (torch.zeros_like if shared else torch.empty_like)(tensors[1])
        upstream = (x.contiguous() for x in grad_outputs)
        _launch(move_poses_adjoint, moves, *tensors, *upstream, by_camera, by_projector)
        return None, by_camera, by_projector if moves.relative or moves.own else None, None, None


def _launch(kernel: Any, moves: Moves, *tensors: Tensor) -> None:
    n = len(tensors[0])
    constants = {"ABOUT_SCENE": moves.about_scene, "RELATIVE": moves.relative, "OWN": moves.own}
    size = block(_FRAMES, n)
    launch(kernel, triton.cdiv(n, size), *tensors, n, **constants, SHARED=len(tensors[1]) < n, BLOCK=size)
