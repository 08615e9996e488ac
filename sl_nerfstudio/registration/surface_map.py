"""A frame's surface as a small image of points and normals, in which other frames' points are looked up."""

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled_parallel
from sl_nerfstudio.geometry.devices import PARAMETERS, Device
from sl_nerfstudio.geometry.devices.models import MODELS
from sl_nerfstudio.geometry.plane_fit import solve_plane
from sl_nerfstudio.registration.frame_cloud import FrameCloud, well_known
from sl_nerfstudio.relative_pose.ray_pairs import directions

_SIDE = 200  # of the map, at most: registration by surfaces needs no more, and poses are refined from coordinates later
_WINDOW = 2  # map pixels around each, of a plane fit
_LEAST = 8  # pixels in a fit
_TORN = 0.03  # of the depth: a window that departs more from its plane holds an edge
_BEHIND = 0.4  # radii from the visible points' centroid to about the middle of the object
_STEEP = 0.15  # cosine between ray and normal, below which a surface is seen too obliquely


@dataclass(frozen=True)
class SurfaceMap:
    """Points and normals of a frame on a regular lattice of camera pixels; lengths in units of its baseline."""

    camera: Device  # of the map: the frame's camera, scaled
    point: Float64[ndarray, "h w 3"]  # camera axes
    normal: Float64[ndarray, "h w 3"]  # towards the camera
    valid: Bool[ndarray, "h w"]
    decoded: Bool[ndarray, "h w"]  # where there is a point at all, be it at an edge
    centroid: Float64[ndarray, "3"]
    radius: float  # RMS distance of the points from the centroid
    sigma: float  # median standard deviation along the ray, of noise averaged over a window, and of the pose

    @property
    def parameters(self) -> Float64[ndarray, "8"]:
        """PARAMETERS of the map's camera, for compiled loops."""
        return np.array([getattr(self.camera, key) for key in PARAMETERS])

    @property
    def model_code(self) -> int:
        """Model of the map's camera, for compiled loops."""
        return MODELS[self.camera.model].code

    @property
    def middle(self) -> Float64[ndarray, "3"]:
        """About the middle of the object, which lies behind what is seen of it."""
        return self.centroid * (1 + _BEHIND * self.radius / np.linalg.norm(self.centroid))

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
        """Points and normals of about `count` places spread evenly over the image."""
        index = np.flatnonzero(self.valid)
        step = max(1.0, len(index) / count)
        chosen = index[np.floor(np.arange(0, len(index) - 1e-9, step) + rng.uniform(0, 0.999)).astype(int) % len(index)]
        return self.point.reshape(-1, 3)[chosen], self.normal.reshape(-1, 3)[chosen]


def build_surface_map(cloud: FrameCloud) -> SurfaceMap:
    """Average a cloud onto a lattice of at most 200 x 200 and fit planes to windows of inverse depth.

    The inverse depth of a plane is linear in the pixel, so steep parts are not biased by the averaging.
    """
    factor = min(1.0, _SIDE / max(cloud.camera.w, cloud.camera.h))
    camera = cloud.camera.scaled(factor)
    keep = well_known(cloud)
    column, row = np.floor(cloud.uv_camera[keep] * factor).astype(np.int64).T
    index = np.minimum(row, camera.h - 1) * camera.w + np.minimum(column, camera.w - 1)
    size = camera.w * camera.h
    weight = np.bincount(index, minlength=size)
    mean = np.bincount(index, -1 / cloud.points[keep, 2], size) / np.maximum(weight, 1)
    inverse_depth = np.where(weight > 0, mean, np.nan).reshape(camera.h, camera.w)
    fitted = np.full((camera.h, camera.w, 3), np.nan)
    _fit_inverse_depth(inverse_depth.astype(np.float32), fitted)
    uv = np.stack(np.meshgrid(np.arange(camera.w) + 0.5, np.arange(camera.h) + 0.5), -1).reshape(-1, 2)
    ray = directions(camera, uv).reshape(camera.h, camera.w, 3)
    ray = ray / -ray[..., 2:]
    point = ray / fitted[..., :1]
    normal = _normals(fitted, ray, camera)
    cosine = -(normal * ray).sum(-1) / np.linalg.norm(ray, axis=-1)
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(point).all(-1) & (fitted[..., 0] > 0) & (cosine > _STEEP)
    points = point[valid] if valid.any() else cloud.points
    centroid = points.mean(0)
    pixels = max(float(weight[weight > 0].mean()), 1.0) * 9  # whose noise a window averages, if half is missing
    sigma = np.hypot(np.median(cloud.sigma_noise) / np.sqrt(pixels), np.median(cloud.sigma_pose))
    return SurfaceMap(
        camera,
        np.ascontiguousarray(np.nan_to_num(point)),
        np.ascontiguousarray(np.nan_to_num(normal)),
        valid,
        weight.reshape(camera.h, camera.w) > 0,
        centroid,
        float(np.sqrt(((points - centroid) ** 2).sum(-1).mean())),
        float(sigma),
    )


def _normals(
    fitted: Float64[ndarray, "h w 3"], ray: Float64[ndarray, "h w 3"], camera: Device
) -> Float64[ndarray, "h w 3"]:
    """Normals of planes from inverse depth q and its slopes: q = n . ray / (n . p), ray = (x, -y, -1)."""
    q, q_u, q_v = np.moveaxis(fitted, -1, 0)
    a, b = q_u * camera.fl_x, q_v * camera.fl_y  # by the normalised pixel (x, y)
    x, y = ray[..., 0], -ray[..., 1]
    n = -np.stack([a, -b, -(q - a * x - b * y)], -1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True).clip(1e-300)


@compiled_parallel
def _fit_inverse_depth(q, fitted):
    """Planes `q = c + u du + v dv` in windows around every pixel that has a value; NaN where torn or too sparse."""
    h, w = q.shape
    for row in numba.prange(h):
        for column in range(w):
            if not np.isfinite(q[row, column]):
                continue
            n = sx = sy = sxx = sxy = syy = s0 = s1 = s2 = ss = 0.0
            origin = float(q[row, column])
            for y in range(max(row - _WINDOW, 0), min(row + _WINDOW + 1, h)):
                for x in range(max(column - _WINDOW, 0), min(column + _WINDOW + 1, w)):
                    if not np.isfinite(q[y, x]):
                        continue
                    d, dx, dy = float(q[y, x]) - origin, float(x - column), float(y - row)
                    n += 1.0
                    sx += dx
                    sy += dy
                    sxx += dx * dx
                    sxy += dx * dy
                    syy += dy * dy
                    s0 += d
                    s1 += d * dx
                    s2 += d * dy
                    ss += d * d
            if n < _LEAST:
                continue
            solvable, c, u, v = solve_plane(n, sx, sy, sxx, sxy, syy, s0, s1, s2, 1e-3 * n)
            if not solvable:
                continue
            rough2 = (ss - c * s0 - u * s1 - v * s2) / n
            if rough2 < (_TORN * origin) ** 2:
                fitted[row, column, 0] = c + origin
                fitted[row, column, 1] = u
                fitted[row, column, 2] = v
