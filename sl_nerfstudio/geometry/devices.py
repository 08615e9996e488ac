"""Cameras and projectors: intrinsics, device models, lens distortion; projection as tensors and in compiled loops."""

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.parallel import compiled

# Axes of a device.

Y_Z_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between device axes of computer vision (+y down, looking along +z) and ours (+y up, looking along -z)."""

# Intrinsics of one device, and of a batch of devices as a tensor.

DeviceKind = Literal["OPENCV", "DOE"]
"""Names of the device models, the keys of `MODELS`."""
PARAMETERS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class Device:
    """Intrinsics of one camera or projector; focal lengths and principal point in pixels."""

    w: int
    h: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    model: DeviceKind = "OPENCV"

    @property
    def parameters(self) -> Float64[ndarray, "8"]:
        """PARAMETERS, for compiled loops."""
        return np.array([getattr(self, key) for key in PARAMETERS], dtype=np.float64)

    def scaled(self, factor: float) -> "Device":
        """Resize the device's image by `factor` (no half-pixel shift, because centres are at .5)."""
        return replace(
            self,
            w=round(self.w * factor),
            h=round(self.h * factor),
            **{k: getattr(self, k) * factor for k in ("fl_x", "fl_y", "cx", "cy")},
        )

    def shrunk(self, factor: int) -> "Device":
        """The device of an image whose squares of `factor` pixels are one, without what fills no square."""
        return replace(self.scaled(1 / factor), w=self.w // factor, h=self.h // factor)


@dataclass(frozen=True)
class Intrinsics:
    """A batch of devices of one model as a tensor; `params` holds PARAMETERS in the last dimension."""

    params: Float[Tensor, "*batch 8"]
    model: DeviceKind
    distorted: bool

    @staticmethod
    def of(devices: Device | Sequence[Device], dtype: torch.dtype = torch.float32) -> "Intrinsics":
        """Batch of shape () from one device, or (n,) from a sequence. Raises ValueError for mixed models."""
        if isinstance(devices, Device):
            one = Intrinsics.of([devices], dtype)
            return Intrinsics(one.params[0], one.model, one.distorted)
        models: list[DeviceKind] = sorted({d.model for d in devices})
        if len(models) != 1:
            raise ValueError(f"devices of one batch must share a model, got {models}")
        params = torch.tensor([d.parameters.tolist() for d in devices], dtype=dtype)
        return Intrinsics(params, models[0], bool((params[:, 4:] != 0).any()))

    def __getitem__(self, index: Int[Tensor, "*n"] | int | slice) -> "Intrinsics":
        """Devices selected along the first batch dimension."""
        return Intrinsics(self.params[index], self.model, self.distorted)

    def to(self, *args: torch.device | torch.dtype | str) -> "Intrinsics":
        """Copy to another torch device or dtype."""
        return Intrinsics(self.params.to(*args), self.model, self.distorted)  # pyright: ignore[reportCallIssue, reportArgumentType]

    def reshape(self, *shape: int) -> "Intrinsics":
        """Change the batch shape, for broadcasting against points."""
        return Intrinsics(self.params.reshape(*shape, 8), self.model, self.distorted)


# Lens distortion as OpenCV defines it: radial k1, k2 and tangential p1, p2, on normalised coordinates.
#
# `distort` and `distortion_jacobian` are plain arithmetic, so they work on tensors and, compiled, on single
# numbers.

Number = Any  # a tensor, or a float in compiled loops
UNDISTORT_STEPS, LEAST_DETERMINANT = 12, 1e-9
_LAST_STEP = 1e-9  # after which the next would be below rounding: each is the square of the one before


def distort(x: Number, y: Number, k1: Number, k2: Number, p1: Number, p2: Number) -> tuple[Number, Number]:
    """Distorted normalised coordinates, from ideal ones."""
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return xd, yd


def distortion_jacobian(
    x: Number, y: Number, k1: Number, k2: Number, p1: Number, p2: Number
) -> tuple[Number, Number, Number]:
    """d(xd)/dx, d(xd)/dy = d(yd)/dx, d(yd)/dy; the matrix is symmetric."""
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    slope = 2 * k1 + 4 * k2 * r2
    a = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    b = x * y * slope + 2 * p1 * x + 2 * p2 * y
    d = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return a, b, d


def undistort(xd: Tensor, yd: Tensor, k1: Tensor, k2: Tensor, p1: Tensor, p2: Tensor) -> tuple[Tensor, Tensor]:
    """Ideal normalised coordinates, from distorted ones: Newton's method, started at the distorted point."""
    x, y = xd, yd
    for _ in range(UNDISTORT_STEPS):
        ex, ey = distort(x, y, k1, k2, p1, p2)
        ex, ey = ex - xd, ey - yd
        a, b, d = distortion_jacobian(x, y, k1, k2, p1, p2)
        det = a * d - b * b
        det = torch.where(det.abs() < LEAST_DETERMINANT, torch.full_like(det, LEAST_DETERMINANT), det)
        step_x, step_y = (d * ex - b * ey) / det, (a * ey - b * ex) / det
        x, y = x - step_x, y - step_y
        if x.device.type == "cpu" and torch.maximum(step_x.detach().abs(), step_y.detach().abs()).lt(_LAST_STEP).all():
            break  # elsewhere, to ask would take longer than the steps: it waits for the device
    return x, y


_MIN_DEPTH = 1e-6  # of |p|; a point closer to the plane of the device counts as behind it


def in_front(x: Number, y: Number, z: Number) -> bool | Tensor:
    """Whether a point in device axes has a pixel, in all models; plain arithmetic, for tensors and compiled loops."""
    return -z > _MIN_DEPTH * (x * x + y * y + z * z) ** 0.5


def _norm_anywhere(p: Tensor) -> Tensor:
    """Distance of points from the device; with a finite gradient also at 0."""
    return (p * p).sum(-1).clamp_min(1e-30).sqrt()


# The pinhole model, "OPENCV": (x, y) = (x' / -z', -y' / -z') for a point p = (x', y', z') in device axes.


def pinhole_normalised(x: Number, y: Number, z: Number) -> tuple[Number, Number]:
    """Normalised coordinates (y down) of a point in front; plain arithmetic, for tensors and compiled loops."""
    q = -1 / z
    return x * q, -y * q


def pinhole_normalised_anywhere(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normalised coordinates and `in_front`; finite, with finite gradients, for points behind as well."""
    x, y, z = p.unbind(-1)
    norm = _norm_anywhere(p)
    front = -z > _MIN_DEPTH * norm
    return *pinhole_normalised(x, y, -torch.where(front, -z, norm.detach().clamp_min(1e-15))), front


def pinhole_jacobian(p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normalised coordinates, and their derivatives [..., 3] with respect to the point."""
    x, y, z = p.unbind(-1)
    q = -1 / z
    xn, yn = x * q, -y * q
    o = torch.zeros_like(q)
    return xn, yn, torch.stack([q, o, xn * q], -1), torch.stack([o, -q, yn * q], -1)


def pinhole_direction(x: Tensor, y: Tensor) -> Tensor:
    """Unit direction [..., 3], in device axes, of normalised coordinates."""
    d = torch.stack([x, -y, -torch.ones_like(x)], -1)
    return d / d.norm(dim=-1, keepdim=True)


# The projector with a diffractive optical element, "DOE": (x, y) = (x' / |p|, -y' / |p|) for a point p = (x', y', z').
# Its normalised coordinates are direction cosines, because those of the diffraction orders are evenly spaced (and
# their tangents are not).


def doe_normalised(x: Number, y: Number, z: Number) -> tuple[Number, Number]:
    """Normalised coordinates (y down) of a point in front; plain arithmetic, for tensors and compiled loops."""
    q = 1 / (x * x + y * y + z * z) ** 0.5
    return x * q, -y * q


def doe_normalised_anywhere(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normalised coordinates and `in_front`; finite, with finite gradients, for points behind as well."""
    x, y, z = p.unbind(-1)
    norm = _norm_anywhere(p)
    q = 1 / norm
    return x * q, -y * q, -z > _MIN_DEPTH * norm


def doe_jacobian(p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normalised coordinates, and their derivatives [..., 3] with respect to the point."""
    x, y, z = p.unbind(-1)
    r = p.norm(dim=-1)
    q, q3 = 1 / r, 1 / r**3
    dx = torch.stack([q - x * x * q3, -x * y * q3, -x * z * q3], -1)
    dy = torch.stack([x * y * q3, y * y * q3 - q, y * z * q3], -1)
    return x * q, -y * q, dx, dy


def doe_direction(x: Tensor, y: Tensor) -> Tensor:
    """Unit direction [..., 3], in device axes, of normalised coordinates; NaN beyond 90 degrees, where none exists."""
    return torch.stack([x, -y, -(1 - x * x - y * y).sqrt()], -1)


# The device models by name.


@dataclass(frozen=True)
class DeviceModel:
    """The part of a device that differs between models; lens distortion, focal lengths and principal point do not."""

    code: int  # identifies the model in compiled loops
    normalised_anywhere: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
    jacobian: Callable[[Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]
    direction: Callable[[Tensor, Tensor], Tensor]


MODELS: dict[DeviceKind, DeviceModel] = {
    "OPENCV": DeviceModel(0, pinhole_normalised_anywhere, pinhole_jacobian, pinhole_direction),
    "DOE": DeviceModel(1, doe_normalised_anywhere, doe_jacobian, doe_direction),
}


def for_loops(device: Device) -> tuple[int, Float64[ndarray, "8"]]:
    """Arguments of compiled loops for a device: the code of its model, and its PARAMETERS."""
    return MODELS[device.model].code, device.parameters


_pinhole, _doe, _in_front = compiled(pinhole_normalised), compiled(doe_normalised), compiled(in_front)
_distort, _distortion_jacobian = compiled(distort), compiled(distortion_jacobian)


@compiled
def pixel_of(code, x, y, z, parameters):
    """`project` for one point, in compiled loops: column, row, and whether the point is in front.

    `parameters` are ordered as PARAMETERS. Unlike `project`, it does not detect where the distortion polynomial folds
    back.
    """
    front = _in_front(x, y, z)
    xn, yn = _pinhole(x, y, z if front else -1.0) if code == 0 else _doe(x, y, z)
    xd, yd = _distort(xn, yn, parameters[4], parameters[5], parameters[6], parameters[7])
    return parameters[0] * xd + parameters[2], parameters[1] * yd + parameters[3], front


# From points in device axes to pixels, and back.
#
# Every model maps points to normalised coordinates (image axes, y down). Lens distortion, focal lengths and principal
# point are then applied in the same way for all models.


def project(
    intrinsics: Intrinsics, p: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Pixels of points given in device axes, and a flag for each: whether it has a pixel.

    A point behind the device (or in its plane) has none: its value is finite but meaningless, its gradient is finite,
    and its flag is False. The same holds for a point so far off the axis that the distortion polynomial folds back: it
    would appear a second time, inside the image.
    """
    xn, yn, in_front = MODELS[intrinsics.model].normalised_anywhere(p)
    fx, fy, cx, cy, k1, k2, p1, p2 = intrinsics.params.unbind(-1)
    if intrinsics.distorted:
        a, b, d = distortion_jacobian(xn.detach(), yn.detach(), k1, k2, p1, p2)
        in_front = in_front & (a * d > b * b) & (a > 0)
        xn, yn = distort(xn, yn, k1, k2, p1, p2)
    return torch.stack([fx * xn + cx, fy * yn + cy], -1), in_front


def project_jacobian(intrinsics: Intrinsics, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
    """Derivative of the pixels of `project` with respect to `p`, in closed form; for points in front."""
    xn, yn, dx, dy = MODELS[intrinsics.model].jacobian(p)
    fx, fy, _, _, k1, k2, p1, p2 = intrinsics.params.unbind(-1)
    if intrinsics.distorted:
        a, b, d = distortion_jacobian(xn, yn, k1, k2, p1, p2)
        dx, dy = a[..., None] * dx + b[..., None] * dy, b[..., None] * dx + d[..., None] * dy
    return torch.stack([fx[..., None] * dx, fy[..., None] * dy], -2)


def unproject(intrinsics: Intrinsics, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Unit direction, in device axes, of a pixel; NaN where the model has none, such as a DOE beyond 90 degrees."""
    fx, fy, cx, cy, k1, k2, p1, p2 = intrinsics.params.unbind(-1)
    xd = (uv[..., 0] - cx) / fx
    yd = (uv[..., 1] - cy) / fy
    if intrinsics.distorted:
        xd, yd = undistort(xd, yd, k1, k2, p1, p2)
    return MODELS[intrinsics.model].direction(xd, yd)


# Pixels of single points with their derivatives, and rays of single pixels, for compiled loops.

_CONVERGED = 1e-12  # last step of Newton's method, normalised coordinates


@compiled
def view_of(code, x, y, z, parameters):
    """`project` and `project_jacobian` for one point: u, v, whether in front, du by x, y, z, dv by x, y, z.

    `code` is the model's, `parameters` are ordered as PARAMETERS. The derivatives are for points in front.
    """
    r, front = (x * x + y * y + z * z) ** 0.5, _in_front(x, y, z)
    if code == 0:
        q = 1 / max(r, 1e-15) if not front else -1 / z
        xn, yn = x * q, -y * q
        if not front:
            q = -1 / z if z != 0 else 0.0
        ux, uy, uz = q, 0.0, x * q * q
        vx, vy, vz = 0.0, -q, -y * q * q
    else:
        q = 1 / max(r, 1e-15)
        q3 = q * q * q
        xn, yn = x * q, -y * q
        ux, uy, uz = q - x * x * q3, -x * y * q3, -x * z * q3
        vx, vy, vz = x * y * q3, y * y * q3 - q, y * z * q3
    k1, k2, p1, p2 = parameters[4], parameters[5], parameters[6], parameters[7]
    if k1 != 0 or k2 != 0 or p1 != 0 or p2 != 0:
        a, b, d = _distortion_jacobian(xn, yn, k1, k2, p1, p2)
        front = front and a * d > b * b and a > 0
        xn, yn = _distort(xn, yn, k1, k2, p1, p2)
        ux, vx = a * ux + b * vx, b * ux + d * vx
        uy, vy = a * uy + b * vy, b * uy + d * vy
        uz, vz = a * uz + b * vz, b * uz + d * vz
    fx, fy = parameters[0], parameters[1]
    return (
        fx * xn + parameters[2], fy * yn + parameters[3], front,
        fx * ux, fx * uy, fx * uz, fy * vx, fy * vy, fy * vz,
    )  # fmt: skip


@compiled
def ray_of(code, u, v, parameters):
    """`unproject` for one pixel: x, y, z of the unit direction; NaN where the model has none."""
    xd, yd = (u - parameters[2]) / parameters[0], (v - parameters[3]) / parameters[1]
    k1, k2, p1, p2 = parameters[4], parameters[5], parameters[6], parameters[7]
    x, y = xd, yd
    if k1 != 0 or k2 != 0 or p1 != 0 or p2 != 0:
        for _ in range(UNDISTORT_STEPS):
            ex, ey = _distort(x, y, k1, k2, p1, p2)
            ex, ey = ex - xd, ey - yd
            a, b, d = _distortion_jacobian(x, y, k1, k2, p1, p2)
            det = a * d - b * b
            if abs(det) < LEAST_DETERMINANT:
                det = LEAST_DETERMINANT
            dx, dy = (d * ex - b * ey) / det, (a * ey - b * ex) / det
            x, y = x - dx, y - dy
            if abs(dx) + abs(dy) < _CONVERGED:  # the next step would be about the square of it
                break
    if code == 0:
        q = 1 / (x * x + y * y + 1) ** 0.5
        return x * q, -y * q, -q
    square = 1 - x * x - y * y
    return x, -y, -(square**0.5) if square >= 0 else math.nan


@dataclass(frozen=True)
class DeviceChange:
    """A change of one device's intrinsics; all three numbers are shares of its fl_x. Distortion does not change."""

    focal: float = 0.0
    """Relative change of both focal lengths."""
    x: float = 0.0
    """Shift of the principal point to the right, as a share of the focal length."""
    y: float = 0.0
    """Shift of the principal point downward, as a share of the focal length."""

    def applied(self, device: Device) -> Device:
        """The device after the change."""
        return replace(
            device,
            fl_x=device.fl_x * (1 + self.focal),
            fl_y=device.fl_y * (1 + self.focal),
            cx=device.cx + device.fl_x * self.x,
            cy=device.cy + device.fl_x * self.y,
        )


@dataclass(frozen=True)
class IntrinsicsChange:
    """A change of the intrinsics of the cameras (the same for all) and of the projector."""

    camera: DeviceChange = field(default_factory=DeviceChange)
    """Change of all cameras."""
    projector: DeviceChange = field(default_factory=DeviceChange)
    """Change of the projector."""

    @staticmethod
    def of(values: Sequence[float]) -> "IntrinsicsChange":
        """Create from six numbers: focal, x, y of the cameras, then of the projector."""
        camera, projector = values[:3], values[3:]
        return IntrinsicsChange(DeviceChange(*camera), DeviceChange(*projector))

    @property
    def values(self) -> tuple[float, ...]:
        """Six numbers, in the order of `of`."""
        return (*astuple(self.camera), *astuple(self.projector))

    def __bool__(self) -> bool:
        """Whether it changes anything."""
        return any(self.values)

    def __add__(self, other: "IntrinsicsChange") -> "IntrinsicsChange":
        """Both changes combined, to first order."""
        return IntrinsicsChange.of([a + b for a, b in zip(self.values, other.values, strict=True)])


UNCHANGED = IntrinsicsChange()
