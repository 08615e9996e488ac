"""Rays of camera pixels in the normalised scene."""

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.rays import pixel_rays
from sl_nerfstudio.scan import Scan


class SceneRays:
    """Makes rays from one pose for each frame, on the device that holds the poses.

    They equal those of nerfstudio's `Cameras.generate_rays`, without the work for camera types that cannot occur here.
    """

    def __init__(self, scan: Scan, T_scene_camera: Float[Tensor, "n 4 4"], refined: bool = False) -> None:
        """`refined` marks the rays, so that the model does not correct them again."""
        self._cameras = Intrinsics.of([frame.camera for frame in scan.frames]).to(T_scene_camera.device)
        self._T_scene_camera = T_scene_camera
        self._refined = refined

    def __call__(self, frame: Int[Tensor, "n"], uv: Float[Tensor, "n 2"]) -> RayBundle:
        """Rays through pixels `uv` of the given frames."""
        cameras = self._cameras[frame]
        origins, directions = pixel_rays(cameras, self._T_scene_camera[frame], uv)
        view = frame[:, None]
        metadata = {"sl_view": view, "sl_uv": uv, "directions_norm": torch.ones_like(origins[:, :1])}
        if self._refined:
            metadata["sl_refined"] = torch.ones_like(view, dtype=torch.bool)
        return RayBundle(
            origins=origins,
            directions=directions,
            pixel_area=1 / cameras.params[:, :2].prod(-1, keepdim=True),
            camera_indices=view,
            metadata=metadata,
        )
