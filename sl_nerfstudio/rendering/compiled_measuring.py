"""Where camera rays meet projector rays, in one compiled loop on the CPU, without gradients.

`direct_losses.py` has the same as torch operations, each of which takes longer to begin than to do its work.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sl_nerfstudio.compiled import compiled, compiled_range
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.devices.compiled_view import view_of
from sl_nerfstudio.geometry.devices.models import MODELS
from sl_nerfstudio.geometry.rigid import row_times_rotation

_PARALLEL = 1e-12  # sin^2 of the angle between rays, below which they count as parallel


def compiled_measures(*tensors: Tensor) -> bool:
    """Whether tensors are float32 on the CPU, and none needs a gradient."""
    return all(x.device.type == "cpu" and x.dtype == torch.float32 and not x.requires_grad for x in tensors)


def measured(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    T_scene_projector: Float[Tensor, "n 4 4"],
    directions: Float[Tensor, "n 3"],
    decoded: Bool[Tensor, "n"],
    projector: Intrinsics,
    noise_px: float,
    px_per_length: float,
    gate: float,
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Distances along camera `rays` (origins, directions), their sigmas, and weights.

    `directions` are those of the projector rays in the projector's axes. Rays that miss each other by more than `gate`
    sigmas, or meet behind a device, have the weight 0.
    """
    found = torch.empty(3, len(decoded))
    arrays = [tensor.detach().contiguous().numpy() for tensor in (*rays, T_scene_projector, directions, decoded)]
    device = MODELS[projector.model].code, projector.params.detach().double().numpy()
    _measure(len(decoded), *arrays, *device, noise_px, px_per_length, gate, found.numpy())
    return found[0], found[1], found[2]


@compiled
def _double(v):
    return float(v[0]), float(v[1]), float(v[2])


@compiled
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled_range
def _measure(first, last, origins, directions, poses, others, decoded, code, parameters, noise, usual, gate, found):
    for k in range(first, last):
        found[0, k], found[1, k], found[2, k] = 1.0, 0.0, 0.0
        T, o1, d1, d2 = poses[k], _double(origins[k]), _double(directions[k]), _double(others[k])
        d2 = _dot(T[0], d2), _dot(T[1], d2), _dot(T[2], d2)
        between = T[0, 3] - o1[0], T[1, 3] - o1[1], T[2, 3] - o1[2]
        normal = _cross(d1, d2)
        sin2 = _dot(normal, normal)
        if not sin2 > _PARALLEL:
            continue
        depth, other = _dot(_cross(between, d2), normal) / sin2, _dot(_cross(between, d1), normal) / sin2
        p = depth * d1[0] - between[0], depth * d1[1] - between[1], depth * d1[2] - between[2]  # from the projector
        x, y, z = row_times_rotation(p[0], p[1], p[2], T)
        _, _, _, ux, uy, uz, vx, vy, vz = view_of(code, x, y, z, parameters)
        x, y, z = row_times_rotation(other * d2[0] - p[0], other * d2[1] - p[1], other * d2[2] - p[2], T)
        gap = np.hypot(ux * x + uy * y + uz * z, vx * x + vy * y + vz * z)
        x, y, z = row_times_rotation(d1[0], d1[1], d1[2], T)
        slope = np.hypot(ux * x + uy * y + uz * z, vx * x + vy * y + vz * z)  # pixels per length
        found[0, k], found[1, k] = depth, noise / max(slope, 1e-9)
        if decoded[k] and gap < gate * noise and depth > 0 and other > 0:
            found[2, k] = min(max(slope / usual, 0.1), 2.0)
