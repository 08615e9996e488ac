# type: ignore  (Warp compiles what is below; its types are not those of Python)
"""The losses of a training step by kernels for GPUs, from the poses' parameters to the gradients of all of them."""

from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from sl_nerfstudio.dataparser.dataparser import PixelSamples
from sl_nerfstudio.field.device_kernels import kernel, launch, part, structure
from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.poses import PoseParameters
from sl_nerfstudio.rendering.warp_step import Current, Devices, Pixels, Step, step_losses

# `PoseParameters` in Warp: one thread per frame, in double precision; see `model/pose_parameters.py`.
#
# `about_scene`: cameras turn about the scene's centre, else about their own. `projector` says what the projector's
# increment moves: 0 nothing, 1 the projector relative to its camera, 2 the projector by itself.

_SMALL = wp.constant(wp.float64(0.09))  # squared angle below which series are used

Turn = structure(
    "Turn",
    __name__,
    W=wp.mat33d,  # the rotation vector as a skew-symmetric matrix
    coefficients=wp.vec3d,  # sin(t)/t, (1 - cos(t))/t^2, (t - sin(t))/t^3
    slopes=wp.vec3d,  # their derivatives by t^2
)


@part
def skew(w: wp.vec3d):
    """`skew(w) p = w x p`."""
    o = wp.float64(0.0)
    return wp.mat33d(o, -w[2], w[1], w[2], o, -w[0], -w[1], w[0], o)


@part
def series(x: wp.float64, first: wp.int32):
    """Sum over k of (-x)^k / (2 k + first)!, and its derivative."""
    value = wp.float64(0.0)
    slope = wp.float64(0.0)
    power = wp.float64(1.0)  # (-x)^k
    before = wp.float64(0.0)  # its derivative
    factorial = wp.float64(1.0)
    for i in range(2, first + 1):
        factorial *= wp.float64(i)
    for k in range(9):
        value += power / factorial
        slope += before / factorial
        before = -power * wp.float64(k + 1)
        power = -power * x
        factorial *= wp.float64(2 * k + first + 1) * wp.float64(2 * k + first + 2)
    return wp.vec2d(value, slope)


@part
def turn_of(w: wp.vec3d):
    """What rotation and translation of a twist have in common."""
    turn = Turn()
    turn.W = skew(w)
    x = wp.dot(w, w)
    if x < _SMALL:
        a = series(x, 1)
        b = series(x, 2)
        c = series(x, 3)
        turn.coefficients = wp.vec3d(a[0], b[0], c[0])
        turn.slopes = wp.vec3d(a[1], b[1], c[1])
    else:
        t = wp.sqrt(x)
        two, three = wp.float64(2.0), wp.float64(3.0)
        sine = wp.sin(t)
        rest = two * wp.sin(t / two) * wp.sin(t / two)  # 1 - cos(t)
        turn.coefficients = wp.vec3d(sine / t, rest / x, (t - sine) / (x * t))
        turn.slopes = wp.vec3d(
            (t * wp.cos(t) - sine) / (two * x * t),
            (t * sine - two * rest) / (two * x * x),
            (t * rest - three * (t - sine)) / (two * x * x * t),
        )
    return turn


@part
def rigid(R: wp.mat33d, t: wp.vec3d):
    """A pose."""
    o, one = wp.float64(0.0), wp.float64(1.0)
    return wp.mat44d(
        R[0, 0], R[0, 1], R[0, 2], t[0], R[1, 0], R[1, 1], R[1, 2], t[1], R[2, 0], R[2, 1], R[2, 2], t[2], o, o, o, one
    )


@part
def rotation(T: wp.mat44d):
    """The rotation of a pose, or of a pose's adjoint."""
    return wp.mat33d(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@part
def translation(T: wp.mat44d):
    """The translation of a pose, or of a pose's adjoint."""
    return wp.vec3d(T[0, 3], T[1, 3], T[2, 3])


@part
def inverse_pose(T: wp.mat44d):
    """The inverse of a pose."""
    R = wp.transpose(rotation(T))
    return rigid(R, -(R * translation(T)))


@part
def combined(turn: Turn, first: wp.int32):
    """`I + c0 W + c1 W^2` with two neighbouring coefficients: the rotation, or what the translation is turned by."""
    one = wp.identity(n=3, dtype=wp.float64)
    return one + turn.coefficients[first] * turn.W + turn.coefficients[first + 1] * (turn.W * turn.W)


@part
def twist(steps: wp.array2d(dtype=wp.float32), row: wp.int32, first: wp.int32):
    """Three numbers of an increment."""
    return wp.vec3d(wp.float64(steps[row, first]), wp.float64(steps[row, first + 1]), wp.float64(steps[row, first + 2]))


@part
def exponential(steps: wp.array2d(dtype=wp.float32), row: wp.int32):
    """The pose of an increment (translation, rotation)."""
    turn = turn_of(twist(steps, row, 3))
    return rigid(combined(turn, 0), combined(turn, 1) * twist(steps, row, 0))


@part
def inner(a: wp.mat33d, b: wp.mat33d):
    """Sum of the products of two matrices' entries."""
    return wp.ddot(a, b)


@part
def note_adjoint(
    steps: wp.array2d(dtype=wp.float32),
    row: wp.int32,
    g: wp.mat44d,
    shared: wp.bool,
    out: wp.array2d(dtype=wp.float32),
):
    """The adjoint of an increment, from that of its pose; added to it, if the increment is that of all frames."""
    v = twist(steps, row, 0)
    w = twist(steps, row, 3)
    turn = turn_of(w)
    g_R = rotation(g)
    g_t = translation(g)
    by_v = wp.transpose(combined(turn, 1)) * g_t
    W = turn.W
    W2 = W * W
    for k in range(3):
        axis = wp.vec3d()
        axis[k] = wp.float64(1.0)
        E = skew(axis)
        E2 = E * W + W * E
        s = (wp.float64(2.0) * w[k]) * turn.slopes
        c = turn.coefficients
        d_R = s[0] * W + c[0] * E + s[1] * W2 + c[1] * E2
        d_V = s[1] * W + c[1] * E + s[2] * W2 + c[2] * E2
        by_w = inner(g_R, d_R) + wp.dot(g_t, d_V * v)
        if shared:
            wp.atomic_add(out, row, k, wp.float32(by_v[k]))
            wp.atomic_add(out, row, 3 + k, wp.float32(by_w))
        else:
            out[row, k] = wp.float32(by_v[k])
            out[row, 3 + k] = wp.float32(by_w)


@kernel
def poses(
    camera_step: wp.array2d(dtype=wp.float32),
    projector_step: wp.array2d(dtype=wp.float32),
    base_camera: wp.array(dtype=wp.mat44d),
    base_projector: wp.array(dtype=wp.mat44d),
    about_scene: wp.int32,
    projector: wp.int32,
    T_scene_camera: wp.array(dtype=wp.mat44),
    T_scene_projector: wp.array(dtype=wp.mat44),
):
    """Poses of cameras and projectors; `projector_step` may have one row for all frames."""
    i = wp.tid()
    row = wp.where(projector_step.shape[0] == 1, 0, i)
    camera = base_camera[i] * exponential(camera_step, i)
    if about_scene != 0:
        camera = exponential(camera_step, i) * base_camera[i]
    own = base_projector[i]
    if projector == 1:
        own = camera * exponential(projector_step, row) * inverse_pose(base_camera[i]) * own
    elif projector == 2:
        own = own * exponential(projector_step, row)
    T_scene_camera[i] = wp.mat44(camera)
    T_scene_projector[i] = wp.mat44(own)


@kernel
def poses_adjoint(
    camera_step: wp.array2d(dtype=wp.float32),
    projector_step: wp.array2d(dtype=wp.float32),
    base_camera: wp.array(dtype=wp.mat44d),
    base_projector: wp.array(dtype=wp.mat44d),
    about_scene: wp.int32,
    projector: wp.int32,
    d_camera: wp.array(dtype=wp.mat44),
    d_projector: wp.array(dtype=wp.mat44),
    d_camera_step: wp.array2d(dtype=wp.float32),
    d_projector_step: wp.array2d(dtype=wp.float32),
):
    """Adjoints of the increments, from those of the poses; one that is shared by all frames must begin as 0."""
    i = wp.tid()
    row = wp.where(projector_step.shape[0] == 1, 0, i)
    shared = projector_step.shape[0] < camera_step.shape[0]
    base = base_camera[i]
    g = wp.mat44d(d_camera[i])
    g_own = wp.mat44d(d_projector[i])
    if projector == 1:
        camera = base * exponential(camera_step, i)
        if about_scene != 0:
            camera = exponential(camera_step, i) * base
        rest = inverse_pose(base) * base_projector[i]
        moved = exponential(projector_step, row) * rest
        g += g_own * wp.transpose(moved)
        g_step = wp.transpose(camera) * g_own * wp.transpose(rest)
        note_adjoint(projector_step, row, g_step, shared, d_projector_step)
    elif projector == 2:
        note_adjoint(projector_step, row, wp.transpose(base_projector[i]) * g_own, shared, d_projector_step)
    if about_scene != 0:
        g = g * wp.transpose(base)
    else:
        g = wp.transpose(base) * g
    note_adjoint(camera_step, i, g, False, d_camera_step)


def kernel_step(
    model: SLModel, samples: PixelSamples, index: Int[Tensor, "rays"]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Weighted losses and metrics of the pixels `index` (see `SLPixelSampler.choose`), as the model computes them."""
    none = index.new_empty(0, dtype=torch.int32)
    among = none if index.device.type == "cpu" else samples.training
    pixels = Pixels(index, among, samples.frame, samples.row, samples.column, samples.coords, samples.pattern)
    scalars = (model.kappa_now, model.surface_width_now, model.noise_px, model.px_per_length)
    devices = Devices(model.cameras, model.projector, model.pattern)
    c = model.config
    step = Step(pixels, devices, Current(*scalars), model.cache.values, c.sampling, c.losses, model.renders_now)
    found = step_losses(model.field, step, *device_poses(model.device_poses))
    metrics = {"coordinate_px": found.coordinate_px, "pattern_cosine": found.pattern_cosine}
    return found.terms, {name: value for name, value in metrics.items() if value is not None}


def device_poses(poses: PoseParameters) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
    """`T_scene_camera` and `T_scene_projector` of all frames in float32, differentiable by the increments."""
    kind = (int(poses.about_scene), ("nothing", "relative pose", "own pose").index(poses.projector_moves_by))
    return _Poses.apply(kind, poses.camera_step, poses.projector_step, poses.base_camera, poses.base_projector)


class _Poses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, kind: tuple[int, int], *tensors: Tensor) -> tuple[Tensor, Tensor]:
        ctx.kind = kind
        ctx.save_for_backward(*tensors)
        camera, projector = tensors[0].new_empty(2, len(tensors[0]), 4, 4)
        launch(poses, len(camera), *tensors, *kind, camera, projector)
        return camera, projector

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        tensors = ctx.saved_tensors
        shared = len(tensors[1]) < len(tensors[0])
        d_camera, d_projector = (
            torch.empty_like(tensors[0]),
            (torch.zeros_like if shared else torch.empty_like)(tensors[1]),
        )
        upstream = (x.contiguous() for x in grad_outputs)
        launch(poses_adjoint, len(d_camera), *tensors, *ctx.kind, *upstream, d_camera, d_projector)
        moves = ctx.kind[1] != 0
        return None, d_camera, d_projector if moves else None, None, None
