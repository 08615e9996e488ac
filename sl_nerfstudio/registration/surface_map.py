"""The surface of a frame as a small image of points and normals, in which points of other frames are looked up."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled_range
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.devices.models import MODELS
from sl_nerfstudio.geometry.plane_fit import solve_plane
from sl_nerfstudio.registration.empty_places import EmptyPlaces, find_empty_places
from sl_nerfstudio.registration.frame_cloud import FrameCloud, reliable_points
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, SurfaceMapSettings
from sl_nerfstudio.registration.tone.surface_tone import surface_tone
from sl_nerfstudio.relative_pose.ray_pairs import directions


@dataclass(frozen=True)
class View:
    """A guess of which part of a frame other frames see too, as a start of registration."""

    centre: Float64[ndarray, "3"]  # about the centre of the object, which lies behind what is seen of it
    size: float  # a length that is about the same in frames that see the same object from about as far


@dataclass(frozen=True)
class SurfaceMap:
    """Points and normals of a frame on a regular lattice of camera pixels; lengths in units of its baseline."""

    camera: Device  # of the map: the frame's camera, scaled
    point: Float64[ndarray, "h w 3"]  # camera axes
    plane: Float64[ndarray, "h w 5"]  # see tangent_planes
    valid: Bool[ndarray, "h w"]
    tone: Float32[ndarray, "h w"]  # see surface_tone; NaN where unknown
    nothing: EmptyPlaces
    weight: Float64[ndarray, "m"]  # of each valid place when places are drawn: large where few look its way
    centroid: Float64[ndarray, "3"]
    radius: float  # RMS distance of the points from the centroid
    views: tuple[View, ...]  # what may be the object that this and other frames see

    @property
    def normal(self) -> Float64[ndarray, "h w 3"]:
        """Unit normals, towards the camera."""
        return self.plane[..., :3]

    @property
    def sigma(self) -> Float64[ndarray, "h w"]:
        """One standard deviation of the surface along its normal."""
        return self.plane[..., 4]

    @property
    def parameters(self) -> Float64[ndarray, "8"]:
        """PARAMETERS of the map's camera, for compiled loops."""
        return self.camera.parameters

    @property
    def model_code(self) -> int:
        """Model of the map's camera, for compiled loops."""
        return MODELS[self.camera.model].code

    def sample(
        self, count: int, rng: np.random.Generator
    ) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"], Float64[ndarray, "n"]]:
        """Points, normals and sigma of `count` places spread over the image and over the surface's orientations.

        A table says little about where a frame is, however much of the image it fills: orientations that are rare count
        more (normal-space sampling, Rusinkiewicz and Levoy, 3DIM 2001).
        """
        index = np.flatnonzero(self.valid)
        if not len(index):
            return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
        place = (np.arange(count) + rng.uniform(0, 1)) / count
        chosen = index[np.searchsorted(np.cumsum(self.weight), place * self.weight.sum()).clip(0, len(index) - 1)]
        return self.point.reshape(-1, 3)[chosen], self.normal.reshape(-1, 3)[chosen], self.sigma.reshape(-1)[chosen]


def tangent_planes(
    point: Float64[ndarray, "h w 3"], normal: Float64[ndarray, "h w 3"], sigma: Float64[ndarray, "h w"]
) -> Float64[ndarray, "h w 5"]:
    """Normal n, n . p and sigma, side by side in memory: all that is asked about a place, found at once."""
    return np.concatenate([normal, (normal * point).sum(-1, keepdims=True), sigma[..., None]], -1)


def build_surface_map(
    cloud: FrameCloud, settings: SurfaceMapSettings = REGISTRATION_DEFAULTS.surface_map
) -> SurfaceMap:
    """Average a cloud on a lattice of camera pixels and fit planes to windows of inverse depth.

    The inverse depth of a plane is linear in the pixel, so steep parts are not biased by the averaging.
    """
    factor = min(1.0, settings.largest_side / max(cloud.camera.w, cloud.camera.h))
    camera = cloud.camera.scaled(factor)
    keep = reliable_points(cloud, settings.largest_sigma_ratio)
    column, row = np.floor(cloud.uv_camera[keep] * factor).astype(np.int64).T
    index = np.minimum(row, camera.h - 1) * camera.w + np.minimum(column, camera.w - 1)
    size = camera.w * camera.h
    weight = np.bincount(index, minlength=size)
    shape = (camera.h, camera.w)
    mean = np.bincount(index, -1 / cloud.points[keep, 2], size) / np.maximum(weight, 1)
    inverse_depth = np.where(weight > 0, mean, np.nan).reshape(shape)
    sigma_noise, *pose_errors = (
        (np.bincount(index, values, size) / np.maximum(weight, 1)).reshape(shape)
        for values in (cloud.sigma_noise[keep], *cloud.pose_errors[keep].T)
    )
    fitted = np.full((camera.h, camera.w, 3), np.nan)
    _fit_inverse_depth(
        camera.h,
        inverse_depth.astype(np.float32),
        settings.half_window,
        settings.fewest_pixels,
        settings.largest_relief,
        fitted,
    )
    uv = np.stack(np.meshgrid(np.arange(camera.w) + 0.5, np.arange(camera.h) + 0.5), -1).reshape(-1, 2)
    ray = directions(camera, uv).reshape(camera.h, camera.w, 3)
    ray = ray / -ray[..., 2:]
    point = ray / fitted[..., :1]
    normal = _normals(fitted, ray, camera)
    cosine = -(normal * ray).sum(-1) / np.linalg.norm(ray, axis=-1)
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(point).all(-1) & (fitted[..., 0] > 0) & (cosine > settings.least_cosine)
    depth = np.linalg.norm(np.nan_to_num(point), axis=-1)
    points, place = (point[valid], uv.reshape(*shape, 2)[valid]) if valid.any() else (cloud.points, None)
    centroid, radius = _centre_and_radius(points)
    along_normal = np.nan_to_num(np.abs(cosine))
    sigma = np.hypot(sigma_noise * along_normal, settings.lattice_error * depth / camera.fl_x)
    if valid.any():
        errors = np.stack(pose_errors, -1)[valid] * along_normal[valid][:, None]
        shape_errors = _beyond_similarity(errors, (point[valid] - centroid) / radius, normal[valid])
        sigma[valid] = np.hypot(sigma[valid], np.linalg.norm(shape_errors, axis=-1))
    return SurfaceMap(
        camera,
        np.ascontiguousarray(np.nan_to_num(point)),
        tangent_planes(np.nan_to_num(point), np.nan_to_num(normal), sigma),
        valid,
        _tone(cloud, keep, index, point, normal, valid, settings),
        find_empty_places(cloud, camera, settings.empty),
        _orientation_weights(normal[valid], settings.orientations),
        centroid,
        radius,
        _views(points, place, camera, settings),
    )


def _tone(
    cloud: FrameCloud,
    keep: Bool[ndarray, "n"],
    index: Int64[ndarray, "m"],
    point: Float64[ndarray, "h w 3"],
    normal: Float64[ndarray, "h w 3"],
    valid: Bool[ndarray, "h w"],
    settings: SurfaceMapSettings,
) -> Float32[ndarray, "h w"]:
    """The surface's tone on the lattice; `index` is the place in the lattice of each point that is kept."""
    if cloud.light is None:
        return np.full(valid.shape, np.nan, dtype=np.float32)
    column, row = np.floor(cloud.uv_camera[keep]).astype(np.int64).T
    light = cloud.light[row, column]
    known = np.isfinite(light)
    count = np.bincount(index[known], minlength=valid.size)
    mean = np.bincount(index[known], light[known], valid.size) / np.maximum(count, 1)
    light = np.where(valid & (count.reshape(valid.shape) > 0), mean.reshape(valid.shape), np.nan)
    return surface_tone(light, point, normal, cloud.pose.T_camera_projector[:3, 3], settings.tone)


def _beyond_similarity(
    errors: Float64[ndarray, "m k"], p: Float64[ndarray, "m 3"], normal: Float64[ndarray, "m 3"]
) -> Float64[ndarray, "m k"]:
    """What remains of displacements along the normals after the similarity that takes up most of each.

    An error of the projector's pose mostly moves, turns and scales the surface as a whole. Registration finds that
    similarity anyway; only the rest keeps two surfaces apart.
    """
    moves = np.concatenate([normal, np.cross(p, normal), (p * normal).sum(-1, keepdims=True)], 1)
    return errors - moves @ np.linalg.lstsq(moves, errors, rcond=None)[0]


def _orientation_weights(normal: Float64[ndarray, "m 3"], count: int) -> Float64[ndarray, "m"]:
    """One over the square root of how many normals have about the same direction."""
    if not len(normal):
        return np.zeros(0)
    k = np.arange(count) + 0.5
    height, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k  # a lattice of directions (Vogel's spiral)
    flat = np.sqrt(1 - height**2)
    nearest = (normal @ np.stack([flat * np.cos(turn), flat * np.sin(turn), height])).argmax(1)
    return 1 / np.sqrt(np.bincount(nearest, minlength=count)[nearest])


def _centre_and_radius(points: Float64[ndarray, "n 3"]) -> tuple[Float64[ndarray, "3"], float]:
    centroid = points.mean(0)
    return centroid, float(np.sqrt(((points - centroid) ** 2).sum(-1).mean()))


def _views(
    points: Float64[ndarray, "n 3"],
    uv: Float64[ndarray, "n 2"] | None,
    camera: Device,
    settings: SurfaceMapSettings,
) -> tuple[View, ...]:
    """Everything that the frame sees; and what lies in the middle of its image, at what depth that is.

    With nothing but the object in view, its visible parts are about equally large in all frames. A wall that only some
    frames see changes size and centre of everything; cameras that look at the object have it in the middle all the
    same, and are about equally far from it.
    """
    centroid, radius = _centre_and_radius(points)
    behind = settings.centre_depth * radius
    views = [View(centroid * (1 + behind / np.linalg.norm(centroid)), radius)]
    if uv is None:
        return tuple(views)
    off = np.abs(uv - (camera.cx, camera.cy)).max(-1) / min(camera.w, camera.h)
    central = np.sort(off)[min(len(off), settings.fewest_central) - 1]
    middle = points[off <= max(central, settings.middle)]
    depth = np.linalg.norm(middle, axis=1)
    place = np.median(middle / depth[:, None], axis=0)
    near = float(np.quantile(depth, settings.near_quantile))
    views.append(View(place / np.linalg.norm(place) * (near + min(behind, settings.nearness * near)), near))
    return tuple(views)


def _normals(
    fitted: Float64[ndarray, "h w 3"], ray: Float64[ndarray, "h w 3"], camera: Device
) -> Float64[ndarray, "h w 3"]:
    """Normals of planes from inverse depth q and its slopes: q = n . ray / (n . p), ray = (x, -y, -1).

    The slope of the lens distortion is neglected.
    """
    q, q_u, q_v = np.moveaxis(fitted, -1, 0)
    a, b = q_u * camera.fl_x, q_v * camera.fl_y  # by the normalised pixel (x, y)
    x, y = ray[..., 0], -ray[..., 1]
    n = -np.stack([a, -b, -(q - a * x - b * y)], -1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True).clip(1e-300)


@compiled_range
def _fit_inverse_depth(first, last, q, half_window, fewest, largest_relief, fitted):
    """Planes `q = c + u du + v dv` in windows around every pixel with a value; NaN at edges and where too sparse."""
    h, w = q.shape
    for row in range(first, last):
        for column in range(w):
            if not np.isfinite(q[row, column]):
                continue
            n = sx = sy = sxx = sxy = syy = s0 = s1 = s2 = ss = 0.0
            origin = float(q[row, column])
            for y in range(max(row - half_window, 0), min(row + half_window + 1, h)):
                for x in range(max(column - half_window, 0), min(column + half_window + 1, w)):
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
            if n < fewest:
                continue
            solvable, c, u, v = solve_plane(n, sx, sy, sxx, sxy, syy, s0, s1, s2, 1e-3 * n)
            if not solvable:
                continue
            relief2 = (ss - c * s0 - u * s1 - v * s2) / n
            if relief2 < (largest_relief * origin) ** 2:
                fitted[row, column, 0] = c + origin
                fitted[row, column, 1] = u
                fitted[row, column, 2] = v
