"""Where in the projector's image the ray of each camera pixel runs, by the inverse distance along it."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from sl_nerfstudio.decoding.grid_edges import slopes
from sl_nerfstudio.geometry.devices import Device, for_loops, pixel_of, ray_of, view_of
from sl_nerfstudio.parallel import compiled

# Settings of matching along epipolar lines. Lengths in the image are in periods of the pattern as it appears there.


@dataclass(frozen=True)
class HypothesisSettings:
    """The inverse distances that are tried."""

    step: float = 0.1
    """between two of them on the pattern, periods (median over the image)"""
    fewest: int = 16
    """so many are tried at least"""
    most: int = 512
    """so many are tried at most; the step grows where more would be needed"""
    quantile: float = 0.002
    """share of the decoded pixels that may be nearer than the range, and share that may be farther"""
    margin: float = 0.04
    """by which the range is longer on each side, as a share of it"""
    agreement: float = 0.15
    """distance of decoded coordinates from their epipolar line up to which they count, periods"""
    offset_window: float = 1.0
    """standard deviation of the window in which these distances are averaged, periods"""
    offset_prior: float = 0.05
    """share of decoded pixels in the window at which the average is halved"""


@dataclass(frozen=True)
class CostSettings:
    """Correlation of image and pattern in a Gaussian window."""

    window: float = 0.14
    """standard deviation of the window, periods"""
    least_pattern_variance: float = 1e-3
    """added to the variance of the drawn pattern: where it is flat, nothing can be compared"""
    least_image_variance: float = 0.03
    """added to the variance of the image, as a share of its median at decoded pixels"""


@dataclass(frozen=True)
class SmoothnessSettings:
    """What a change of distance from one pixel to the next costs; a correlation of 0 costs 127, of -1 costs 254."""

    small: int = 30
    """to the next inverse distance"""
    large: int = 250
    """to any other"""
    steepest: int = 4
    """steps from one pixel to the next up to which a decoded surface is steep; beyond, it has a jump there"""
    apart: int = 3
    """steps from the best inverse distance within which another one is no rival"""


@dataclass(frozen=True)
class LineFitSettings:
    """The fit of coordinates to the image, from matched ones."""

    smoothing: tuple[tuple[float, float], ...] = ((0.25, 0.05), (0.12, 0.1))
    """windows in which the surface is taken to be flat, largest first, and how far from them a pixel may be; periods"""
    window: float = 0.38
    """standard deviation of the window of a shift, periods"""
    rounds: int = 6
    """each recovers a part of the detail that the window of the fit averages over"""
    detail: float = 0.06
    """how far coordinates along the line are expected to be from that flat surface (1 sigma), periods"""
    across: float = 0.02
    """the same across the line: more than there is, because distances from it tell how large noise is"""
    dependent: float = 16.0
    """area, in pixels, over which the errors of an image depend on each other"""
    largest: float = 0.12
    """limit of all shifts together, periods"""
    least_area: float = 1.0
    """smaller regions are left out, periods squared"""
    tear: float = 0.35
    """difference between neighbouring pixels that separates regions, periods"""


@dataclass(frozen=True)
class KeepingSettings:
    """Which pixels are kept."""

    least_probability: float = 0.5
    """that a pixel is right"""
    near: float = 0.1
    """distance within which coordinates count as right, and matched ones as those that were decoded; periods"""
    jump: float = 0.3
    """difference between neighbouring pixels that counts as a jump in depth, periods"""
    smallest_region: float = 2.0
    """smaller regions are left out, periods squared"""
    tear: float = 0.5
    """difference between neighbouring pixels that separates such regions, periods"""
    least_agreement: float = 0.8
    """share of the decoded pixels that must be matched where they were decoded; otherwise nothing is replaced"""


@dataclass(frozen=True)
class MatchingSettings:
    """Everything that matching depends on besides its inputs."""

    hypotheses: HypothesisSettings = field(default_factory=HypothesisSettings)
    """the inverse distances that are tried"""
    costs: CostSettings = field(default_factory=CostSettings)
    """correlation of image and pattern"""
    smoothness: SmoothnessSettings = field(default_factory=SmoothnessSettings)
    """what changes of distance cost"""
    fit: LineFitSettings = field(default_factory=LineFitSettings)
    """the fit to the image"""
    keeping: KeepingSettings = field(default_factory=KeepingSettings)
    """which pixels are kept"""
    finest: float = 12.0
    """pixels per period: finer captures are averaged first"""
    most_bytes: int = 2**28
    """memory for costs; larger images are matched in strips"""
    strip_margin: float = 6.0
    """by which strips overlap on each side, periods"""


MATCHING_DEFAULTS = MatchingSettings()

# How large a period of the pattern is in an image, and coordinates at another resolution.

_TEAR = 0.35  # periods between neighbouring pixels
_FEWEST = 100  # pixels from which a size is told


def pixels_a_period(coords: Float32[ndarray, "h w 2"], period: float) -> float | None:
    """Pixels of the image in a period of the pattern, median; None where hardly anything is decoded."""
    by_x, by_y = np.diff(coords[:-1], axis=1), np.diff(coords[:, :-1], axis=0)
    smooth = np.ones(by_x.shape[:2], dtype=bool)
    for step in (by_x, by_y):
        for part in (step[..., 0], step[..., 1]):  # numpy takes the larger of two far more slowly
            smooth &= np.abs(part) < _TEAR * period
    area = np.abs(by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0])[smooth]
    area = area[area > 0]
    return period / float(np.sqrt(np.median(area))) if len(area) >= _FEWEST else None


def enlarged(
    coords: Float32[ndarray, "a b 2"], factor: int, shape: tuple[int, int], period: float
) -> Float32[ndarray, "h w 2"]:
    """Coordinates at the pixels of an image of the given shape; those given are at squares of `factor` of its pixels.

    Bilinear within a surface; at its border, the square's plane is continued. NaN where a pixel's square has none.
    """
    if factor == 1:
        return coords
    h, w = shape
    size = coords.shape[1] * factor, coords.shape[0] * factor
    near = np.repeat(np.repeat(coords, factor, axis=0), factor, axis=1)
    slope = np.repeat(np.repeat(slopes(coords, period), factor, axis=0), factor, axis=1)
    place = ((np.arange(factor) + 0.5) / factor - 0.5).astype(np.float32)
    x, y = np.tile(place, coords.shape[1])[None, :, None], np.tile(place, coords.shape[0])[:, None, None]
    plane = near + slope[..., 0] * x + slope[..., 1] * y
    linear = cv2.resize(coords, size, interpolation=cv2.INTER_LINEAR)  # NaN beside what is unknown
    smooth = np.abs(linear - near).max(-1, keepdims=True) < _TEAR * period
    half = factor // 2  # beside the image's border, where interpolation has one side only
    smooth[:half], smooth[-half:], smooth[:, :half], smooth[:, -half:] = False, False, False, False
    whole = np.where(smooth, linear, np.where(np.isfinite(plane), plane, near))
    out = np.full((h, w, 2), np.nan, dtype=np.float32)
    out[: size[1], : size[0]] = np.where(np.isfinite(near), whole, np.float32(np.nan))
    return out


_OUTSIDE = -1e6  # where nothing is seen
_STEPS = 4  # of Gauss-Newton, to the nearest place on a line


@dataclass(frozen=True)
class EpipolarLines:
    """The epipolar lines of all pixels of an image; curves, if a lens distorts.

    A point at inverse distance w (in inverse baselines) is `ray + w * centre` in the projector's axes, but for its
    length: `centre` is the camera's position there. `offset` is added to where the projector sees it.
    """

    ray: Float64[ndarray, "h w 3"]
    centre: Float64[ndarray, "3"]
    projector: Device
    offset: Float32[ndarray, "h w 2"]

    @staticmethod
    def of(camera: Device, projector: Device, T_camera_projector: Float64[ndarray, "4 4"]) -> "EpipolarLines":
        """Those of two devices; NaN where a pixel has no ray."""
        shape, R = (camera.h, camera.w), np.ascontiguousarray(T_camera_projector[:3, :3])
        rays = np.empty((*shape, 3))
        _turned_rays(*for_loops(camera), R, rays)
        return EpipolarLines(rays, -R.T @ T_camera_projector[:3, 3], projector, np.zeros((*shape, 2), dtype=np.float32))

    def part(self, box: tuple[slice, slice]) -> "EpipolarLines":
        """Those of the pixels in a box."""
        return replace(self, ray=np.ascontiguousarray(self.ray[box]), offset=np.ascontiguousarray(self.offset[box]))

    def at(self, w: Float64[ndarray, "h w"]) -> Float32[ndarray, "h w 2"]:
        """Coordinates at inverse distances; NaN where the projector does not see the point."""
        out = np.empty(self.offset.shape, dtype=np.float32)
        _follow(*self.arrays, w, out)
        return out

    def pixels_at(self, w: float, x: Float32[ndarray, "h w"], y: Float32[ndarray, "h w"]) -> None:
        """Fill columns and rows in the pattern's image, the first pixel's centre being 0, at one inverse distance.

        They are far outside where the projector does not see the point.
        """
        code, parameters, ray, centre, offset = self.arrays
        if code == 0 and not parameters[4:].any():
            _pinhole_pixels(parameters, self._planes, centre, w, x, y)
        else:
            _pixels(code, parameters, ray, centre, offset, w, x, y)

    def slopes(self, w: Float64[ndarray, "h w"]) -> Float32[ndarray, "h w 2"]:
        """Derivative of the coordinates by the inverse distance."""
        out = np.empty(self.offset.shape, dtype=np.float32)
        _slopes(*self.arrays, w, out)
        return out

    def nearest(self, coords: Float32[ndarray, "h w 2"]) -> Float64[ndarray, "h w"]:
        """Inverse distances at which the lines are nearest to given coordinates; NaN where there is none in front."""
        out = np.empty(coords.shape[:2])
        _nearest(*self.arrays, coords, out)
        return out

    @cached_property
    def _planes(self) -> Float32[ndarray, "5 h w"]:
        """Rays and offsets, one coordinate after the other."""
        values = np.concatenate([self.ray, self.offset], axis=-1, dtype=np.float32)
        return np.ascontiguousarray(np.moveaxis(values, -1, 0))

    @cached_property
    def arrays(self) -> tuple[int, ndarray, ndarray, ndarray, ndarray]:
        """For compiled loops: model code and parameters of the projector, rays, centre, offsets."""
        return *for_loops(self.projector), self.ray, self.centre, self.offset


@compiled
def _turned_rays(code: int, parameters: ndarray, R: ndarray, out: ndarray) -> None:
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            x, y, z = ray_of(code, column + 0.5, row + 0.5, parameters)
            for axis in range(3):
                out[row, column, axis] = R[0, axis] * x + R[1, axis] * y + R[2, axis] * z


@compiled
def _point(ray: ndarray, centre: ndarray, w: float) -> tuple[float, float, float]:
    """In the projector's axes, but for its length."""
    return ray[0] + w * centre[0], ray[1] + w * centre[1], ray[2] + w * centre[2]


@compiled
def _follow(
    code: int, parameters: ndarray, ray: ndarray, centre: ndarray, offset: ndarray, w: ndarray, out: ndarray
) -> None:
    for row in range(w.shape[0]):
        for column in range(w.shape[1]):
            a, s = ray[row, column], w[row, column]
            view = view_of(code, *_point(a, centre, s), parameters)
            seen = view[2] and s == s
            out[row, column, 0] = view[0] + offset[row, column, 0] if seen else np.nan
            out[row, column, 1] = view[1] + offset[row, column, 1] if seen else np.nan


@compiled
def _pixels(
    code: int, parameters: ndarray, ray: ndarray, centre: ndarray, offset: ndarray, w: float, x: ndarray, y: ndarray
) -> None:
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            u, v, front = pixel_of(code, *_point(ray[row, column], centre, w), parameters)
            x[row, column] = u + offset[row, column, 0] - 0.5 if front else _OUTSIDE
            y[row, column] = v + offset[row, column, 1] - 0.5 if front else _OUTSIDE


@compiled
def _pinhole_pixels(parameters: ndarray, planes: ndarray, centre: ndarray, w: float, x: ndarray, y: ndarray) -> None:
    """The same for a pinhole without distortion, ten times as fast."""
    f = np.float32
    fx, fy, cx, cy = f(parameters[0]), f(-parameters[1]), f(parameters[2] - 0.5), f(parameters[3] - 0.5)
    a, b, c = f(w * centre[0]), f(w * centre[1]), f(w * centre[2])
    outside, nearest = f(_OUTSIDE), f(-1e-12)
    ray_x, ray_y, ray_z, du, dv = planes[0], planes[1], planes[2], planes[3], planes[4]
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            z = ray_z[row, column] + c
            q = f(-1) / min(z, nearest)
            u = fx * (ray_x[row, column] + a) * q + cx + du[row, column]
            v = fy * (ray_y[row, column] + b) * q + cy + dv[row, column]
            x[row, column] = u if z < f(0) else outside
            y[row, column] = v if z < f(0) else outside


@compiled
def _slopes(
    code: int, parameters: ndarray, ray: ndarray, centre: ndarray, offset: ndarray, w: ndarray, out: ndarray
) -> None:
    for row in range(w.shape[0]):
        for column in range(w.shape[1]):
            a, s = ray[row, column], w[row, column]
            view = view_of(code, *_point(a, centre, s), parameters)
            out[row, column, 0] = view[3] * centre[0] + view[4] * centre[1] + view[5] * centre[2]
            out[row, column, 1] = view[6] * centre[0] + view[7] * centre[1] + view[8] * centre[2]


@compiled
def _nearest(
    code: int, parameters: ndarray, ray: ndarray, centre: ndarray, offset: ndarray, coords: ndarray, out: ndarray
) -> None:
    """From where the camera's ray passes the projector's, a few steps towards the least distance in pixels."""
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            out[row, column] = np.nan
            u, v = coords[row, column, 0] - offset[row, column, 0], coords[row, column, 1] - offset[row, column, 1]
            if not (u == u and v == v):
                continue
            x, y, z = ray_of(code, u, v, parameters)
            a = ray[row, column]
            # (ray + w centre) x (x, y, z) = 0
            ax, ay, az = a[1] * z - a[2] * y, a[2] * x - a[0] * z, a[0] * y - a[1] * x
            bx, by, bz = centre[1] * z - centre[2] * y, centre[2] * x - centre[0] * z, centre[0] * y - centre[1] * x
            square = bx * bx + by * by + bz * bz
            if not square > 0:
                continue
            s, front = -(ax * bx + ay * by + az * bz) / square, False
            for _ in range(_STEPS):
                view = view_of(code, *_point(a, centre, s), parameters)
                front = view[2]
                if not front:
                    break
                du = view[3] * centre[0] + view[4] * centre[1] + view[5] * centre[2]
                dv = view[6] * centre[0] + view[7] * centre[1] + view[8] * centre[2]
                s += (du * (u - view[0]) + dv * (v - view[1])) / max(du * du + dv * dv, 1e-300)
            if front and s > 0:
                out[row, column] = s
