"""Cameras and projectors: how a direction becomes a pixel, and back.

Device axes: a device looks along its own -z, +x to the right, +y up (OpenGL, as nerfstudio).
Pixels: continuous, the centre of the first pixel is (0.5, 0.5), x to the right, y down.

Both models first make normalised coordinates (image axes, y down) of `p = (x', y', z')`,
then distort them as OpenCV does, then scale them:

    OPENCV:  (x, y) = (x' / -z', -y' / -z')        pinhole
    DOE:     (x, y) = (x' / |p|, -y' / |p|)        direction cosines of a diffractive element
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

DeviceKind = Literal["OPENCV", "DOE"]
PARAMETERS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
_MIN_DEPTH = 1e-6  # of |p|: nearer to the plane of the device than this counts as behind it


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

    def changed(self, focal: float, x: float, y: float) -> "Device":
        """The same device with its focal lengths longer by a share `focal`, its principal point moved by `x`, `y`.

        All three are shares of fl_x, as `calibration.intrinsics_doubt` has them.
        """
        return replace(
            self,
            fl_x=self.fl_x * (1 + focal),
            fl_y=self.fl_y * (1 + focal),
            cx=self.cx + self.fl_x * x,
            cy=self.cy + self.fl_x * y,
        )

    def scaled(self, factor: float) -> "Device":
        """The same device with its image resized by `factor` (no half pixel: centres are at .5)."""
        return replace(
            self,
            w=round(self.w * factor),
            h=round(self.h * factor),
            **{k: getattr(self, k) * factor for k in ("fl_x", "fl_y", "cx", "cy")},
        )


@dataclass(frozen=True)
class Intrinsics:
    """A batch of devices of one kind as a tensor; `params` holds PARAMETERS in the last dimension."""

    params: Float[Tensor, "*batch 8"]
    model: DeviceKind
    distorted: bool

    @staticmethod
    def of(devices: Device | Sequence[Device], dtype: torch.dtype = torch.float32) -> "Intrinsics":
        """Batch of shape () of one device, or (n,) of a sequence. Raises ValueError for mixed models."""
        if isinstance(devices, Device):
            one = Intrinsics.of([devices], dtype)
            return Intrinsics(one.params[0], one.model, one.distorted)
        models: list[DeviceKind] = sorted({d.model for d in devices})
        if len(models) != 1:
            raise ValueError(f"devices of one batch must share a model, got {models}")
        params = torch.tensor([[getattr(d, k) for k in PARAMETERS] for d in devices], dtype=dtype)
        return Intrinsics(params, models[0], bool((params[:, 4:] != 0).any()))

    def __getitem__(self, index: Int[Tensor, "*n"] | int | slice) -> "Intrinsics":
        """Devices chosen along the first batch dimension."""
        return Intrinsics(self.params[index], self.model, self.distorted)

    def to(self, *args: torch.device | torch.dtype | str) -> "Intrinsics":
        """On another device or of another dtype."""
        return Intrinsics(self.params.to(*args), self.model, self.distorted)  # pyright: ignore[reportCallIssue, reportArgumentType]

    def reshape(self, *shape: int) -> "Intrinsics":
        """With another batch shape, for broadcasting against points."""
        return Intrinsics(self.params.reshape(*shape, 8), self.model, self.distorted)


def project(
    intrinsics: Intrinsics, p: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Pixels of points given in device axes, and whether each has one: it lies in front of the device.

    A point behind the device (or in its plane) has no pixel: its value is finite but meaningless,
    its gradient is finite, and its flag is False. So has a point so far off the axis that the distortion
    polynomial has turned back there: it would appear a second time, inside the image.
    """
    x, y, z = p.unbind(-1)
    norm2 = (p * p).sum(-1)
    norm = norm2.clamp_min(1e-30).sqrt()
    in_front = -z > _MIN_DEPTH * norm
    pinhole = intrinsics.model == "OPENCV"
    q = 1 / (torch.where(in_front, -z, norm.detach().clamp_min(1e-15)) if pinhole else norm)
    fx, fy, cx, cy, k1, k2, p1, p2 = intrinsics.params.unbind(-1)
    xn, yn = x * q, -y * q
    if intrinsics.distorted:
        a, b, d = _distortion_jacobian(xn.detach(), yn.detach(), k1, k2, p1, p2)
        in_front = in_front & (a * d > b * b) & (a > 0)
        xn, yn = _distort(xn, yn, k1, k2, p1, p2)
    return torch.stack([fx * xn + cx, fy * yn + cy], -1), in_front


def project_jacobian(intrinsics: Intrinsics, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
    """Derivative of `project`'s pixels with respect to `p`, in closed form; for points in front."""
    x, y, z = p.unbind(-1)
    fx, fy, _, _, k1, k2, p1, p2 = intrinsics.params.unbind(-1)
    if intrinsics.model == "DOE":
        r = p.norm(dim=-1)
        q, q3 = 1 / r, 1 / r**3
        xn, yn = x * q, -y * q
        dx = torch.stack([q - x * x * q3, -x * y * q3, -x * z * q3], -1)
        dy = torch.stack([x * y * q3, y * y * q3 - q, y * z * q3], -1)
    else:
        q = -1 / z
        xn, yn = x * q, -y * q
        o = torch.zeros_like(q)
        dx = torch.stack([q, o, xn * q], -1)
        dy = torch.stack([o, -q, yn * q], -1)
    if intrinsics.distorted:
        a, b, d = _distortion_jacobian(xn, yn, k1, k2, p1, p2)
        dx, dy = a[..., None] * dx + b[..., None] * dy, b[..., None] * dx + d[..., None] * dy
    return torch.stack([fx[..., None] * dx, fy[..., None] * dy], -2)


def unproject(intrinsics: Intrinsics, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Unit direction, in device axes, of a pixel.

    A DOE has no direction beyond 90 degrees: there the result is NaN.
    """
    fx, fy, cx, cy, k1, k2, p1, p2 = intrinsics.params.unbind(-1)
    xd = (uv[..., 0] - cx) / fx
    yd = (uv[..., 1] - cy) / fy
    if intrinsics.distorted:
        xd, yd = _undistort(xd, yd, k1, k2, p1, p2)
    if intrinsics.model == "DOE":
        return torch.stack([xd, -yd, -(1 - xd * xd - yd * yd).sqrt()], -1)
    d = torch.stack([xd, -yd, -torch.ones_like(xd)], -1)
    return d / d.norm(dim=-1, keepdim=True)


def _distort(x: Tensor, y: Tensor, k1: Tensor, k2: Tensor, p1: Tensor, p2: Tensor) -> tuple[Tensor, Tensor]:
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return xd, yd


def _distortion_jacobian(
    x: Tensor, y: Tensor, k1: Tensor, k2: Tensor, p1: Tensor, p2: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """d(xd)/dx, d(xd)/dy = d(yd)/dx, d(yd)/dy: the matrix is symmetric."""
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    slope = 2 * k1 + 4 * k2 * r2
    a = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    b = x * y * slope + 2 * p1 * x + 2 * p2 * y
    d = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return a, b, d


def _undistort(
    xd: Tensor, yd: Tensor, k1: Tensor, k2: Tensor, p1: Tensor, p2: Tensor, iterations: int = 12
) -> tuple[Tensor, Tensor]:
    """Newton's method on `_distort(x, y) = (xd, yd)`, started at the distorted point."""
    x, y = xd, yd
    for _ in range(iterations):
        ex, ey = _distort(x, y, k1, k2, p1, p2)
        ex, ey = ex - xd, ey - yd
        a, b, d = _distortion_jacobian(x, y, k1, k2, p1, p2)
        det = a * d - b * b
        det = torch.where(det.abs() < 1e-9, torch.full_like(det, 1e-9), det)
        x = x - (d * ex - b * ey) / det
        y = y - (a * ey - b * ex) / det
    return x, y


DEVICE_FIELDS = tuple(f.name for f in fields(Device))
