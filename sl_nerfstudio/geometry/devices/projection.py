"""From points in device axes to pixels, and back.

Every model maps points to normalised coordinates (image axes, y down). Lens distortion, focal lengths and principal
point are then applied in the same way for all models.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sl_nerfstudio.geometry.devices.device import Intrinsics
from sl_nerfstudio.geometry.devices.distortion import distort, distortion_jacobian, undistort
from sl_nerfstudio.geometry.devices.models import MODELS


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
