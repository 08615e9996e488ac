"""Epipolar geometry of a camera and a projector."""

from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.geometry.devices import Intrinsics, project, project_jacobian
from sl_nerfstudio.geometry.rays import pixel_rays
from sl_nerfstudio.geometry.se3 import inverse, rotate, transform
from sl_nerfstudio.geometry.triangulation import closest_approach


def epipolar_residual(
    camera: Intrinsics,
    T_world_camera: Float[Tensor, "*#batch 4 4"],
    uv_camera: Float[Tensor, "*#batch 2"],
    projector: Intrinsics,
    T_world_projector: Float[Tensor, "*#batch 4 4"],
    uv_projector: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "*#batch"]:
    """Signed distance, in projector pixels, of `uv_projector` from the epipolar curve of `uv_camera`.

    The curve is the image of the camera ray in the projector. It is linearised where the two rays come
    closest to each other, so it is valid for pinhole, distorted and DOE projectors alike.
    NaN if that point is behind either device or the rays are parallel.
    """
    o_c, d_c = pixel_rays(camera, T_world_camera, uv_camera)
    o_p, d_p = pixel_rays(projector, T_world_projector, uv_projector)
    depth, depth_projector = closest_approach(o_c, d_c, o_p, d_p)
    T_projector_world = inverse(T_world_projector)
    p_projector = transform(T_projector_world, o_c + depth[..., None] * d_c)
    uv, in_front = project(projector, p_projector)
    tangent = (project_jacobian(projector, p_projector) * rotate(T_projector_world, d_c)[..., None, :]).sum(-1)
    tangent = tangent / tangent.norm(dim=-1, keepdim=True)
    offset = uv - uv_projector
    residual = tangent[..., 0] * offset[..., 1] - tangent[..., 1] * offset[..., 0]
    valid = in_front & (depth > 0) & (depth_projector > 0)
    return residual.where(valid, residual.new_tensor(float("nan")))
