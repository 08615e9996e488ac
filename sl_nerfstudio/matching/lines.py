"""Epipolar lines: the ray of each camera pixel in the projector's image, by the inverse distance along it.

Lengths in an image are in periods of the pattern as it appears there.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import Coords, Mask
from sl_nerfstudio.geometry.devices import Device, for_loops, pixel_of, ray_of, view_of
from sl_nerfstudio.parallel import compiled
from sl_nerfstudio.pattern.grid import gaussian_window

TEAR = 0.35  # difference between neighbouring pixels that separates surfaces, periods
FEWEST_FOR_SIZE = 100  # pixels from which the size of a period is told
OUTSIDE_PX = -1e6  # in place of coordinates where nothing is seen
NEAREST_STEPS = 4  # of Gauss-Newton, to the nearest place on a line
NEAREST_EXACT = 1e-6  # change of the inverse distance, as a share of it, that is too small for another step
UNKNOWN = -(2**20)  # far from the number of any inverse distance

# The inverse distances that are tried.
STEP = 0.1  # between two of them on the pattern, periods (median over the image)
FEWEST, MOST = 16, 512  # numbers of them; the step grows where more would be needed
QUANTILE = 0.002  # share of the decoded pixels that may be nearer than the range, and that may be farther
MARGIN = 0.04  # by which the range is longer on each side, as a share of it
AGREEMENT = 0.15  # distance of decoded coordinates from their line up to which they count, periods
OFFSET_WINDOW = 1.0  # standard deviation of the window in which these distances are averaged, periods
OFFSET_PRIOR = 0.05  # share of decoded pixels in the window at which the average is halved


@dataclass(frozen=True)
class EpipolarLines:
    """The epipolar lines of all pixels of an image; curves, if a lens distorts.

    A point at inverse distance w (in inverse baselines) is `ray + w * centre` in the projector's axes, but for its
    length: `centre` is the camera's position there. `offset` is added to where the projector sees it.
    """

    ray: Float64[ndarray, "h w 3"]
    centre: Float64[ndarray, "3"]
    projector: Device
    offset: Coords

    @staticmethod
    def of(camera: Device, projector: Device, T_camera_projector: Float64[ndarray, "4 4"]) -> "EpipolarLines":
        """The lines of two devices; NaN where a pixel has no ray."""
        shape, R = (camera.h, camera.w), np.ascontiguousarray(T_camera_projector[:3, :3])
        rays = np.empty((*shape, 3))
        _turned_rays(*for_loops(camera), R, rays)
        return EpipolarLines(rays, -R.T @ T_camera_projector[:3, 3], projector, np.zeros((*shape, 2), dtype=np.float32))

    def part(self, box: tuple[slice, slice]) -> "EpipolarLines":
        """The lines of the pixels in a box."""
        return replace(self, ray=np.ascontiguousarray(self.ray[box]), offset=np.ascontiguousarray(self.offset[box]))

    def at(self, w: Float64[ndarray, "h w"]) -> Coords:
        """Coordinates at inverse distances; NaN where the projector does not see the point."""
        out = np.empty(self.offset.shape, dtype=np.float32)
        _follow(*self.arrays, w, out)
        return out

    def slopes(self, w: Float64[ndarray, "h w"]) -> Coords:
        """Derivative of the coordinates by the inverse distance."""
        out = np.empty(self.offset.shape, dtype=np.float32)
        _slopes(*self.arrays, w, out)
        return out

    def nearest(self, coords: Coords) -> Float64[ndarray, "h w"]:
        """Inverse distances at which the lines are nearest to given coordinates; NaN where there is none in front."""
        out = np.empty(coords.shape[:2])
        _nearest(*self.arrays, coords, out)
        return out

    @property
    def for_tiles(self) -> tuple[int, ndarray, ndarray, Float32[ndarray, "5 h w"]]:
        """Arguments of `places_on_lines`: model code and parameters, centre, rays and offsets one after the other."""
        values = np.concatenate([self.ray, self.offset], axis=-1, dtype=np.float32)
        return *for_loops(self.projector), self.centre, np.ascontiguousarray(np.moveaxis(values, -1, 0))

    @cached_property
    def arrays(self) -> tuple[int, ndarray, ndarray, ndarray, ndarray]:
        """Arguments of compiled loops: model code and parameters of the projector, rays, centre, offsets."""
        return *for_loops(self.projector), self.ray, self.centre, self.offset


def with_offset(lines: EpipolarLines, coords: Coords, period: float, pixels_a_period: float) -> EpipolarLines:
    """Lines that run through decoded coordinates, on average over a window: poses and lenses are not known exactly."""
    apart = coords - lines.at(lines.nearest(coords))
    good = np.hypot(apart[..., 0], apart[..., 1]) < AGREEMENT * period  # False for NaN
    values = np.dstack([np.where(good[..., None], apart, np.float32(0)), good.astype(np.float32)])
    means = gaussian_window(values, OFFSET_WINDOW * pixels_a_period)
    offset = means[..., :2] / (means[..., 2:] + np.float32(OFFSET_PRIOR))
    return replace(lines, offset=lines.offset + offset)


def hypotheses(
    lines: EpipolarLines, coords: Coords, w: Float64[ndarray, "h w"], mask: Mask, period: float
) -> Float64[ndarray, "k"] | None:
    """Evenly spaced inverse distances around those of the decoded pixels; None where hardly any is near its line.

    `w` are the inverse distances nearest to the decoded coordinates. What the mask shows may be as deep as it is wide:
    parts of which nothing was decoded may lie before or behind.
    """
    apart = np.linalg.norm(coords - lines.at(w), axis=-1)
    good = apart < AGREEMENT * period
    if good.sum() < FEWEST:
        return None
    low, middle, high = np.quantile(w[good], [QUANTILE, 0.5, 1 - QUANTILE])
    depth = _half_width(lines.ray[mask | good])
    low, high = min(low, middle / (1 + depth)), max(high, middle / (1 - depth))
    margin = MARGIN * (high - low)
    low, high = max(low - margin, low / 2), high + margin
    slope = np.linalg.norm(lines.slopes(np.full(w.shape, (low + high) / 2)), axis=-1)[good]
    length = float(np.median(slope)) * (high - low)
    count = int(np.clip(np.ceil(length / (STEP * period)), FEWEST, MOST))
    return np.linspace(low, high, count)


def numbers_of(w: Float64[ndarray, "h w"], tried: Float64[ndarray, "k"]) -> Int32[ndarray, "h w"]:
    """The nearest of the inverse distances that are tried; `UNKNOWN` for NaN and beyond their range."""
    number = np.rint((w - tried[0]) / (tried[1] - tried[0]))
    inside = (number >= 0) & (number < len(tried))  # False for NaN
    return np.where(inside, number, UNKNOWN).astype(np.int32)


def _half_width(rays: Float64[ndarray, "n 3"]) -> float:
    """Half the width of what the rays see, as a share of its distance; at most a half."""
    rays = rays[np.isfinite(rays[:, 0])]
    centre = rays.mean(0)
    cosine = np.quantile(rays @ (centre / np.linalg.norm(centre)), QUANTILE)
    return min(float(np.sqrt(1 - min(cosine, 1.0) ** 2)), 0.5)


def pixels_a_period(coords: Coords, period: float) -> float | None:
    """Pixels of the image in a period of the pattern, median; None where hardly anything is decoded."""
    by_x, by_y = np.diff(coords[:-1], axis=1), np.diff(coords[:, :-1], axis=0)
    smooth = np.ones(by_x.shape[:2], dtype=bool)
    for step in (by_x, by_y):
        for part in (step[..., 0], step[..., 1]):  # numpy takes the larger of two far more slowly
            smooth &= np.abs(part) < TEAR * period
    area = np.abs(by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0])[smooth]
    area = area[area > 0]
    return period / float(np.sqrt(np.median(area))) if len(area) >= FEWEST_FOR_SIZE else None


@compiled
def _turned_rays(code: int, parameters: ndarray, R: ndarray, out: ndarray) -> None:
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            x, y, z = ray_of(code, column + 0.5, row + 0.5, parameters)
            for axis in range(3):
                out[row, column, axis] = R[0, axis] * x + R[1, axis] * y + R[2, axis] * z


@compiled
def _point(ray: ndarray, centre: ndarray, w: float) -> tuple[float, float, float]:
    """A point at an inverse distance in the projector's axes, but for its length."""
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
def places_on_lines(
    code: int, parameters: ndarray, planes: ndarray, centre: ndarray, w: float, x: ndarray, y: ndarray
) -> None:
    """Fill columns and rows in the pattern's image, the first pixel's centre being 0, at one inverse distance.

    They are far outside where the projector does not see the point. Without distortion, this is ten times as fast.
    """
    f = np.float32
    fx, fy, cx, cy = f(parameters[0]), f(-parameters[1]), f(parameters[2] - 0.5), f(parameters[3] - 0.5)
    a, b, c = f(w * centre[0]), f(w * centre[1]), f(w * centre[2])
    outside, nearest = f(OUTSIDE_PX), f(-1e-12)
    ray_x, ray_y, ray_z, du, dv = planes[0], planes[1], planes[2], planes[3], planes[4]
    if code == 0 and not parameters[4:].any():
        for n in range(len(x)):
            z = ray_z[n] + c
            q = f(-1) / min(z, nearest)
            u, v = fx * (ray_x[n] + a) * q + cx + du[n], fy * (ray_y[n] + b) * q + cy + dv[n]
            x[n], y[n] = u if z < f(0) else outside, v if z < f(0) else outside
        return
    for n in range(len(x)):
        u, v, front = pixel_of(code, ray_x[n] + a, ray_y[n] + b, ray_z[n] + c, parameters)
        x[n] = u + du[n] - 0.5 if front else OUTSIDE_PX
        y[n] = v + dv[n] - 0.5 if front else OUTSIDE_PX


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
    """Take a few steps towards the least distance in pixels, from where the camera's ray passes the projector's."""
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
            for _ in range(NEAREST_STEPS):
                view = view_of(code, *_point(a, centre, s), parameters)
                front = view[2]
                if not front:
                    break
                du = view[3] * centre[0] + view[4] * centre[1] + view[5] * centre[2]
                dv = view[6] * centre[0] + view[7] * centre[1] + view[8] * centre[2]
                step = (du * (u - view[0]) + dv * (v - view[1])) / max(du * du + dv * dv, 1e-300)
                s += step
                if abs(step) < NEAREST_EXACT * abs(s):
                    break
            if front and s > 0:
                out[row, column] = s
