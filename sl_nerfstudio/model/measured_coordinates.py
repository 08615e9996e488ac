"""Decoded coordinates looked up at scene points, for the residual image in the viewer."""

from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.geometry.se3 import transform
from sl_nerfstudio.scan import Scan

_KEPT = 2  # frames whose coordinates stay in memory


class MeasuredCoordinates:
    """The coordinate files of a scan; the frames that were used last stay in memory."""

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self._image = lru_cache(maxsize=_KEPT)(self._read)

    def at(
        self, p: Float[Tensor, "n 3"], views: Int[Tensor, "n"], T_camera_scene: Float[Tensor, "frames 4 4"]
    ) -> Float[Tensor, "n 2"]:
        """The coordinates decoded at the pixels where frames `views` see scene points; NaN where not decoded."""
        result = torch.full_like(p[:, :2], float("nan"))
        for view in views.unique().tolist():
            mine = views == view
            camera = self._scan.frames[view].camera
            uv, in_front = project(Intrinsics.of(camera).to(p.device), transform(T_camera_scene[view], p[mine]))
            inside = in_front & (uv >= 0).all(-1) & (uv < uv.new_tensor([camera.w, camera.h])).all(-1)
            pixel = torch.where(inside[:, None], uv, 0.0).long()
            decoded = self._image(view).to(p.device)[pixel[:, 1], pixel[:, 0]]
            result[mine] = torch.where(inside[:, None], decoded, float("nan"))
        return result

    def _read(self, view: int) -> Float[Tensor, "h w 2"]:
        return torch.from_numpy(self._scan.frames[view].read_coords())
