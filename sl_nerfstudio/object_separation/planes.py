"""Planes in the points of all frames: found, judged (surroundings or part of the object), and told from what rises.

The pose of a frame may be wrong by more than its points are noisy. A plane fitted again in each frame, with the common
plane as prior, takes that error out of the heights above it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, all_finite, geman_mcclure_weight
from sl_nerfstudio.geometry.triangulation import epipolar_residual, triangulate
from sl_nerfstudio.parallel import compiled, compiled_range

# Limits are in standard deviations of the measured noise, or shares; none is a length.

NEIGHBOURS = 12  # points of the same frame from which the normal of a point is found
NORMAL_COSINE = 0.9  # smallest cosine between the normals of a point and of its plane, or of two points of one place
SEARCH_SIGMAS = 4.0  # distance from a plane within which a point counts as part of it, while planes are searched for
CLEAR_SIGMAS = 8.0  # distance from a plane above which a point certainly does not belong to it


@dataclass(frozen=True)
class Plane:
    """All points with `normal . p = offset`; heights are positive on the side that the unit normal points to."""

    normal: Float64[ndarray, "3"]
    offset: float

    def heights(self, p_world: Float[ndarray, "n 3"]) -> Float64[ndarray, "n"]:
        """Signed distances of points."""
        return p_world @ self.normal - self.offset

    def flipped(self) -> "Plane":
        """Turn the other side up."""
        return Plane(-self.normal, -self.offset)

    def axes(self) -> Float64[ndarray, "2 3"]:
        """Two unit vectors in the plane, perpendicular to each other."""
        least = np.eye(3)[np.argmin(np.abs(self.normal))]
        first = np.cross(self.normal, least)
        first = first / np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)])


def fit_plane(p_world: Float[ndarray, "n 3"], weight: Float[ndarray, "n"]) -> Plane:
    """The plane with the least weighted sum of squared distances; at least three points not on a line."""
    centre = (weight[:, None] * p_world).sum(0) / weight.sum()
    offset = p_world - centre
    _, vectors = np.linalg.eigh((weight[:, None] * offset).T @ offset)
    normal = vectors[:, 0]
    return Plane(normal, float(normal @ centre))


# Triangulated points of decoded frames, with their measured noise.

LEAST_COSINE = 0.05  # between a ray and a plane's normal: a ray in the plane would have no noise across it
_LEAST_NOISE_PX = 0.01  # rounding of stored coordinates and poses
_SAME_PLACE = 3.0  # spacings: how far apart points of two frames on the same surface may be


@dataclass(frozen=True)
class DecodedFrame:
    """The decoded coordinates of one frame, at every `stride`-th pixel, with both devices in the world."""

    camera: Device
    projector: Device
    T_world_camera: Float64[ndarray, "4 4"]
    T_world_projector: Float64[ndarray, "4 4"]
    coords: Float32[ndarray, "h w 2"]  # NaN where not decoded
    seen: Bool[ndarray, "h w"]  # where the pattern was seen, decoded or not
    stride: int = 1

    def thinned(self, most: int) -> "DecodedFrame":
        """Keep every n-th pixel, so that at most about `most` are decoded."""
        count = int(all_finite(self.coords).sum())
        step = max(1, int(np.ceil(np.sqrt(count / most))))
        coords, seen = self.coords[::step, ::step].copy(), self.seen[::step, ::step].copy()
        return replace(self, coords=coords, seen=seen, stride=step * self.stride)


@dataclass(frozen=True)
class FramePoints:
    """The surface points of one frame."""

    row: Int64[ndarray, "n"]  # of the thinned frame
    column: Int64[ndarray, "n"]
    p_world: Float64[ndarray, "n 3"]
    ray: Float64[ndarray, "n 3"]  # unit direction from the camera
    sigma: Float64[ndarray, "n"]  # 1 sigma along the ray

    def __len__(self) -> int:
        """Number of points."""
        return len(self.p_world)

    def chosen(self, index: Int64[ndarray, "m"] | Bool[ndarray, "n"]) -> "FramePoints":
        """Choose points by mask or by index."""
        return FramePoints(*(values[index] for values in vars(self).values()))

    def sigma_along(self, normal: Float[ndarray, "3"] | Float[ndarray, "n 3"]) -> Float64[ndarray, "n"]:
        """1 sigma of each point's place along a direction."""
        return self.sigma * np.abs((self.ray * normal).sum(-1)).clip(LEAST_COSINE)


def points_of(frame: DecodedFrame) -> FramePoints:
    """Triangulate a frame; pixels whose rays meet behind a device, or nowhere, have no point.

    The noise of the coordinates is measured: the robust standard deviation of the epipolar residual.
    """
    row, column = np.nonzero(all_finite(frame.coords))
    uv = torch.from_numpy(np.stack([column, row], -1) * float(frame.stride) + 0.5)
    pair = (
        Intrinsics.of(frame.camera, torch.float64), torch.from_numpy(frame.T_world_camera), uv,
        Intrinsics.of(frame.projector, torch.float64), torch.from_numpy(frame.T_world_projector),
        torch.from_numpy(frame.coords[row, column].astype(np.float64)),
    )  # fmt: skip
    found = triangulate(*pair)
    residual = epipolar_residual(*pair).numpy()
    origin = frame.T_world_camera[:3, 3]
    p = found.p_world.numpy()
    good = np.isfinite(residual) & all_finite(p)
    noise = MAD_TO_SIGMA * float(np.median(np.abs(residual[good]))) if good.any() else 0.0
    ray = p[good] - origin
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    sigma = found.sigma_depth.numpy()[good] * max(noise, _LEAST_NOISE_PX)
    return FramePoints(row[good].astype(np.int64), column[good].astype(np.int64), p[good], ray, sigma)


def normals_of(points: FramePoints) -> Float64[ndarray, "n 3"]:
    """Unit normals towards the camera, from the nearest points of the same frame; NaN with too few points."""
    if len(points) < NEIGHBOURS:
        return np.full((len(points), 3), np.nan)
    _, near = KDTree(points.p_world).query(points.p_world, NEIGHBOURS)
    offset = points.p_world[near] - points.p_world[near].mean(1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
    normal = vectors[:, :, 0]
    return normal * -np.sign((normal * points.ray).sum(-1, keepdims=True))


def cross_frame_noise(frames: Sequence[FramePoints], normals: Sequence[Float[ndarray, "_n 3"]]) -> float:
    """Distance between points of different frames over what their own noise explains; at least 1.

    Every frame is compared with some others, one by one: each point with the tangent plane at the nearest point there.
    What exceeds the noise of coordinates is error of the poses.
    """
    count = len(frames)
    ratios = [
        _distances_in_sigmas(frames[k], normals[k], frames[other], normals[other])
        for k in range(count)
        for other in sorted({(k + step) % count for step in (1, 2, count // 3, count // 2)} - {k})
    ]
    ratio = np.concatenate([np.zeros(0), *ratios])
    return max(1.0, MAD_TO_SIGMA * float(np.median(ratio))) if len(ratio) else 1.0


def _distances_in_sigmas(
    a: FramePoints, normal_a: Float[ndarray, "n 3"], b: FramePoints, normal_b: Float[ndarray, "m 3"]
) -> Float64[ndarray, "k"]:
    """Distances of points of one frame from tangent planes of another, where both show the same surface."""
    if min(len(a), len(b)) < 2:
        return np.zeros(0)
    tree = KDTree(b.p_world)
    spacing = float(np.median(np.asarray(tree.query(b.p_world, 2)[0])[:, 1]))
    distance, near = (np.asarray(v) for v in tree.query(a.p_world, distance_upper_bound=_SAME_PLACE * spacing))
    mine = np.flatnonzero(np.isfinite(distance))
    there = near[mine]
    same = (normal_a[mine] * normal_b[there]).sum(-1) > NORMAL_COSINE
    mine, there = mine[same], there[same]
    off = ((a.p_world[mine] - b.p_world[there]) * normal_b[there]).sum(-1)
    sigma = np.hypot(a.sigma_along(normal_a)[mine], b.sigma_along(normal_b)[there])
    return np.abs(off) / sigma


# Dominant planes, by random sampling: planes grown from single points, in a compiled loop over hypotheses.

_SCORED = 6000  # points on which hypotheses are compared
_HYPOTHESES = 300  # planes that are tried in each round
_PLANES = 8  # that are looked for, at most
_LEAST_SUPPORT = 0.03  # share of the points that a plane must hold
GROWTH = (0.2, 0.5, np.inf)  # of the radius: a plane is fitted near its seed first, and then to more and more points
FEWEST = 6  # points that a plane is fitted to


def grown_planes(
    points: FramePoints, normal: Float64[ndarray, "n 3"], seeds: Int64[ndarray, "s"], radius: float
) -> tuple[Float64[ndarray, "s 4"], Int64[ndarray, "s"]]:
    """Planes (unit normal, offset) through points along their normals, fitted to more and more points around them.

    Points within `SEARCH_SIGMAS` of a plane, and with a normal like its own, are part of it. Returns the planes, and
    the number of points that are part of each.
    """
    planes, counts = np.zeros((len(seeds), 4)), np.zeros(len(seeds), dtype=np.int64)
    arrays = [np.ascontiguousarray(x) for x in (points.p_world, points.ray, points.sigma, normal)]
    reaches = np.array([reach * radius for reach in GROWTH])
    _grow(len(seeds), seeds, *arrays, reaches, SEARCH_SIGMAS, NORMAL_COSINE, planes, counts)
    return planes, counts


@compiled_range
def _grow(first, last, seeds, p, ray, sigma, normal, reaches, sigmas, cosine, planes, counts):
    for k in range(first, last):
        seed, plane = seeds[k], planes[k]
        plane[:3] = normal[seed]
        plane[3] = normal[seed] @ p[seed]
        moments = np.empty((4, 4))
        for reach in reaches:
            if _moments(p, ray, sigma, normal, p[seed], reach, sigmas, cosine, plane, moments) >= FEWEST:
                _fit(moments, p[seed], plane)
        counts[k] = _moments(p, ray, sigma, normal, p[seed], np.inf, sigmas, cosine, plane, moments)


@compiled
def _moments(p, ray, sigma, normal, about, reach, sigmas, cosine, plane, moments):
    """Weighted sums of (1, x, y, z) (1, x, y, z)^T about a point, and the number of points that are part of a plane."""
    a, b, c, offset = plane
    count, here = 0, np.empty(4)
    here[0] = 1.0
    moments[:] = 0.0
    for i in range(len(p)):
        height = a * p[i, 0] + b * p[i, 1] + c * p[i, 2] - offset
        along = sigma[i] * max(abs(a * ray[i, 0] + b * ray[i, 1] + c * ray[i, 2]), LEAST_COSINE)
        if not abs(height) < sigmas * along:
            continue
        if not abs(a * normal[i, 0] + b * normal[i, 1] + c * normal[i, 2]) > cosine:
            continue
        distance = 0.0
        for j in range(3):
            here[j + 1] = p[i, j] - about[j]
            distance += here[j + 1] ** 2
        if not distance < reach * reach:
            continue
        count += 1
        for j in range(4):
            for m in range(4):
                moments[j, m] += here[j] * here[m] / along**2
    return count


@compiled
def _fit(moments, about, plane):
    """The plane of least weighted squared distances, on the same side up as before."""
    centre = moments[0, 1:] / moments[0, 0]
    spread = moments[1:, 1:] - moments[0, 0] * centre.reshape(3, 1) * centre
    axis = np.ascontiguousarray(np.linalg.eigh(spread)[1][:, 0])
    if axis @ plane[:3] < 0:
        axis = -axis
    plane[:3] = axis
    plane[3] = axis @ (centre + about)


@dataclass(frozen=True)
class PointPool:
    """Points of all frames together, thinned, with normals."""

    points: FramePoints
    normal: Float64[ndarray, "n 3"]
    frame: Int64[ndarray, "n"]

    @staticmethod
    def of(frames: Sequence[FramePoints], normals: Sequence[Float[ndarray, "_n 3"]]) -> "PointPool":
        """Join the points of several frames that have a normal."""
        joined = FramePoints(*(np.concatenate([vars(f)[key] for f in frames]) for key in vars(frames[0])))
        frame = np.repeat(np.arange(len(frames)), [len(f) for f in frames])
        pool = PointPool(joined, np.concatenate(list(normals)), frame)
        return pool.chosen(all_finite(pool.normal))

    def chosen(self, index: Int64[ndarray, "m"] | Bool[ndarray, "n"]) -> "PointPool":
        """Choose points by mask or by index."""
        return PointPool(self.points.chosen(index), self.normal[index], self.frame[index])

    def __len__(self) -> int:
        """Number of points."""
        return len(self.frame)

    def on(self, plane: Plane) -> Bool[ndarray, "n"]:
        """The points that are part of a plane: by their place and by their normal."""
        height, sigma = plane.heights(self.points.p_world), self.points.sigma_along(plane.normal)
        return (np.abs(height) < SEARCH_SIGMAS * sigma) & (np.abs(self.normal @ plane.normal) > NORMAL_COSINE)


def find_planes(pool: PointPool, radius: float, rng: np.random.Generator) -> list[tuple[Plane, float]]:
    """Planes with the share of all points that they hold, the largest first; none that holds too few or one frame's.

    `radius` is that of the viewed region.
    """
    found: list[tuple[Plane, float]] = []
    rest = pool
    for _ in range(_PLANES):
        plane = _largest(rest, radius, rng)
        if plane is None:
            break
        on = rest.on(plane)
        if on.sum() < _LEAST_SUPPORT * len(pool) or len(np.unique(rest.frame[on])) < 2:
            break
        found.append((plane, float(on.sum() / len(pool))))
        height, sigma = plane.heights(rest.points.p_world), rest.points.sigma_along(plane.normal)
        rest = rest.chosen(np.abs(height) > CLEAR_SIGMAS * sigma)
    return found


def _largest(pool: PointPool, radius: float, rng: np.random.Generator) -> Plane | None:
    """The plane that holds the most points, of planes grown from random points; None if there are too few points."""
    if len(pool) < NEIGHBOURS:
        return None
    some = pool.chosen(rng.choice(len(pool), min(_SCORED, len(pool)), replace=False))
    seeds = rng.integers(0, len(some), _HYPOTHESES)
    planes, counts = grown_planes(some.points, some.normal, seeds, radius)
    most = int(counts.argmax())
    if counts[most] == 0:
        return None
    best = Plane(planes[most, :3], float(planes[most, 3]))
    for _ in range(3):
        on = pool.points.chosen(pool.on(best))
        if len(on) >= FEWEST:
            found = fit_plane(on.p_world, 1 / on.sigma_along(best.normal) ** 2)
            best = found if found.normal @ best.normal > 0 else found.flipped()
    return best


# Where all cameras look at: the point that their axes pass nearest, and how far around it they see.

_TOWARDS_POINTS = 1e-2  # weight of the points' middle against one axis; it decides where all axes are parallel


@dataclass(frozen=True)
class ViewedRegion:
    """A sphere that most frames see, and light, completely."""

    focus: Float64[ndarray, "3"]
    radius: float

    def contains(self, p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether points are in it."""
        return np.linalg.norm(p_world - self.focus, axis=-1) < self.radius


def viewed_region(frames: Sequence[DecodedFrame], p_world: Float[ndarray, "n 3"]) -> ViewedRegion:
    """Find the region from the poses and fields of view of all devices; `p_world` are points of all frames."""
    middle = np.median(p_world, axis=0)
    A, b = _TOWARDS_POINTS * np.eye(3), _TOWARDS_POINTS * middle
    for frame in frames:
        axis, origin = frame.T_world_camera[:3, 2], frame.T_world_camera[:3, 3]
        across = np.eye(3) - np.outer(axis, axis)
        A, b = A + across, b + across @ origin
    focus = np.linalg.solve(A, b)
    reach = [
        min(_reach(frame.camera, frame.T_world_camera, focus), _reach(frame.projector, frame.T_world_projector, focus))
        for frame in frames
    ]
    return ViewedRegion(focus, float(np.median(reach)))


def _reach(device: Device, T_world_device: Float[ndarray, "4 4"], focus: Float[ndarray, "3"]) -> float:
    """Half the width of what a device sees at the distance of the focus."""
    distance = float(np.linalg.norm(T_world_device[:3, 3] - focus))
    return distance * min(device.w / device.fl_x, device.h / device.fl_y) / 2


# Whether a plane is what the object stands on or stands before, or a part of the object itself.

Verdict = Literal[
    "leaves the views", "object stands on it", "cameras on both sides", "surface behind it", "nothing on it",
    "edges seen",
]  # fmt: skip
"""Why a plane is surroundings (the first two), or why it may be a part of the object and is kept."""

_CAMERAS_IN_FRONT = 0.95  # share of the cameras that must be in front of a plane that is left out
_MOST_BEHIND = 0.05  # share of the points in the viewed region that may lie behind such a plane
_LEAST_ABOVE = 0.005  # share of them that must lie in front of it: there must be an object
_DIRECTIONS = 36  # in which the edge of a plane is looked for
_VIEW_MARGIN = 0.1  # strip along the borders of image and pattern, a share, where an edge may be the end of the view
_EDGE_FRAMES = 0.15  # share of the frames that must look past the edge of a plane, for the edge to count as seen
_CONTINUES = 0.5  # share of the directions in which a plane must leave the views, for it to be more than the object
# A plane whose edges are seen is a support if its bare area is so many times that of what stands on it, if that rises
# so high, in roots of its area, and if the plane extends beyond it in so many of the directions.
_SUPPORT_AREA, _SUPPORT_HEIGHT, _AROUND = 3.0, 0.25, 0.75
_CELLS = 20  # of the grid in the plane, along the radius of the viewed region
_POINTS_IN_CELL = 3
_BEYOND_EDGE = (1.04, 1.1, 1.2, 1.35)  # distances from the middle at which to look past the edge, in that of the edge


@dataclass(frozen=True, eq=False)
class PlaneFinding:
    """A plane, facing the cameras, and what it is."""

    plane: Plane
    share: float  # of all points, those that lie on it
    verdict: Verdict

    @property
    def is_surroundings(self) -> bool:
        """Whether the plane is not part of the object."""
        return self.verdict in ("leaves the views", "object stands on it")


def judge_plane(
    plane: Plane,
    share: float,
    pool: PointPool,
    frames: Sequence[DecodedFrame],
    points: Sequence[FramePoints],
    region: ViewedRegion,
) -> PlaneFinding:
    """Judge one plane. `pool` has points of all frames, `points` are those of each frame.

    Surroundings have all cameras in front of them and nothing of the object behind them, carry something, and either
    extend beyond the views (no frame looks past their edge), or are far larger than what rises from them.
    """
    centres = np.stack([frame.T_world_camera[:3, 3] for frame in frames])
    if (plane.heights(centres) > 0).mean() < 0.5:
        plane = plane.flipped()

    def verdict() -> Verdict:
        p = pool.points.p_world
        height, clear = plane.heights(p), CLEAR_SIGMAS * pool.points.sigma_along(plane.normal)
        inside = region.contains(p)
        behind, above = ((side & inside).sum() / max(inside.sum(), 1) for side in (height < -clear, height > clear))
        if (plane.heights(centres) > 0).mean() < _CAMERAS_IN_FRONT:
            return "cameras on both sides"
        if behind > _MOST_BEHIND:
            return "surface behind it"
        if above < _LEAST_ABOVE:
            return "nothing on it"
        on = p[pool.on(plane)]
        if _continues(plane, on, frames, points) >= _CONTINUES:
            return "leaves the views"
        area, tall, around = _what_stands_on_it(plane, on, p[inside & (height > clear)], region)
        if area >= _SUPPORT_AREA and tall >= _SUPPORT_HEIGHT and around >= _AROUND:
            return "object stands on it"
        return "edges seen"

    return PlaneFinding(plane, share, verdict())


def _continues(
    plane: Plane, on: Float[ndarray, "n 3"], frames: Sequence[DecodedFrame], points: Sequence[FramePoints]
) -> float:
    """Share of the directions in the plane in which no more than a few frames look past its edge."""
    if not len(on):
        return 0.0
    centre = np.median(on, axis=0)
    flat = (on - centre) @ plane.axes().T
    distance = np.linalg.norm(flat, axis=1)
    sector = _sectors(flat, _DIRECTIONS)
    probes = []
    for k in range(_DIRECTIONS):
        if (sector == k).sum() < _POINTS_IN_CELL:
            continue
        reach = np.percentile(distance[sector == k], 98) * np.array(_BEYOND_EDGE)
        angle = 2 * np.pi * (k + 0.5) / _DIRECTIONS - np.pi
        outward = np.array([np.cos(angle), np.sin(angle)]) @ plane.axes()
        probes.append(centre + reach[:, None] * outward)
    if not probes:
        return 0.0
    places = np.concatenate(probes)
    past = sum(_looks_past(plane, places, frame, own).astype(int) for frame, own in zip(frames, points, strict=True))
    # A rim may stand on the edge, so that only places farther out show that nothing follows.
    most = np.reshape(past, (len(probes), -1)).max(1)
    return float((most <= _EDGE_FRAMES * len(frames)).mean())


def _looks_past(
    plane: Plane, probes: Float[ndarray, "m 3"], frame: DecodedFrame, points: FramePoints
) -> Bool[ndarray, "m"]:
    """Places where a frame looks past the plane: well inside its view, it saw something behind it or nothing at all."""
    uv, inside = _well_inside(frame.camera, frame.T_world_camera, probes)
    _, lit = _well_inside(frame.projector, frame.T_world_projector, probes)
    looked = inside & lit
    nothing, beyond = ~frame.seen, np.zeros_like(frame.seen)
    below = plane.heights(points.p_world) < -CLEAR_SIGMAS * points.sigma_along(plane.normal)
    beyond[points.row[below], points.column[below]] = True
    past = np.zeros(len(probes), dtype=bool)
    for k in np.flatnonzero(looked):
        column, row = (uv[k] / frame.stride).astype(int)
        window = slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2)
        past[k] = (nothing[window] | beyond[window]).all()
    return past


def _well_inside(
    device: Device, T_world_device: Float[ndarray, "4 4"], p_world: Float[ndarray, "m 3"]
) -> tuple[Float[ndarray, "m 2"], Bool[ndarray, "m"]]:
    """Pixels of points, and whether they are in the image without a strip along its borders."""
    p_device = (p_world - T_world_device[:3, 3]) @ T_world_device[:3, :3]
    found, in_front = project(Intrinsics.of(device, torch.float64), torch.from_numpy(np.ascontiguousarray(p_device)))
    uv = found.numpy()
    share = uv / (device.w, device.h)
    return uv, in_front.numpy() & (share > _VIEW_MARGIN).all(1) & (share < 1 - _VIEW_MARGIN).all(1)


def _what_stands_on_it(
    plane: Plane, on: Float[ndarray, "n 3"], above: Float[ndarray, "m 3"], region: ViewedRegion
) -> tuple[float, float, float]:
    """Compare a plane with what rises from it.

    Returns its bare area in areas of what rises, the height of that in roots of its area, and the share of the
    directions in which the plane extends beyond it.
    """
    size = region.radius / _CELLS

    def cells(p: Float[ndarray, "k 3"]) -> Int64[ndarray, "c 2"]:
        cell, place = _cells(plane, p - region.focus, size)
        return cell[np.bincount(place, minlength=len(cell)) >= _POINTS_IN_CELL]

    standing, bare = cells(above), cells(on)
    if not len(standing) or not len(bare):
        return 0.0, 0.0, 0.0
    bare = bare[~(bare[:, None] == standing[None]).all(-1).any(1)]
    tall = float(np.percentile(plane.heights(above), 95)) / (size * np.sqrt(len(standing)))
    middle = standing.mean(0)
    beyond = []
    own, others = (_sectors(c - middle, 12) for c in (standing, bare))
    for k in range(12):
        edge = np.linalg.norm(standing[own == k] - middle, axis=1).max(initial=0.0)
        beyond.append(np.linalg.norm(bare[others == k] - middle, axis=1).max(initial=0.0) > edge + 1)
    return len(bare) / len(standing), tall, float(np.mean(beyond))


def _sectors(flat: Float[ndarray, "n 2"], count: int) -> Int64[ndarray, "n"]:
    """Number of the angular sector of each place."""
    turn = (np.arctan2(flat[:, 1], flat[:, 0]) + np.pi) / (2 * np.pi)
    return np.minimum((count * turn).astype(np.int64), count - 1)


# Planes as each frame sees them, and where nothing rises from them.

_PLANE_SIGMAS = 3.0  # height up to which a pixel is part of the plane where the object may be near, at least. Decoders
# err more beside edges than elsewhere, so the height is measured: nothing is below the plane, what seems to be is error
_ERROR_SHARE = 0.98  # share of the errors below the plane that the measured height covers
_MOST_SIGMAS = 30.0  # what is farther below the plane is no error of this kind
_BARE_SIGMAS, _BARE_FACTOR = 8.0, 3.0  # height up to which a pixel is part of a bare plane: the larger of these, the
# second in measured heights
_BARE_SHARE = 0.7  # of the points near the plane, those that must lie on it for a place to count as bare
_FEWEST = 100  # points on a plane from which a frame's own plane is found
_STEPS = 6
_PRESENT = 0.1  # share of the points of a cell with which something is there


@dataclass(frozen=True)
class FramePlane:
    """A plane in one frame, and how noisy its points are relative to their stated sigma."""

    plane: Plane
    noise: float

    def in_sigmas(self, points: FramePoints) -> Float64[ndarray, "n"]:
        """Heights of points in standard deviations."""
        return self.plane.heights(points.p_world) / (self.noise * points.sigma_along(self.plane.normal))


def plane_in_frame(plane: Plane, points: FramePoints, pose_noise: float, region_radius: float) -> FramePlane:
    """The plane fitted to the points of one frame that are near it.

    `points` have the noise of their coordinates; that of poses makes heights `pose_noise` times as uncertain.
    """
    found, noise = plane, 1.0
    width = CLEAR_SIGMAS * pose_noise
    for _ in range(_STEPS):
        sigma = points.sigma_along(found.normal)
        z = found.heights(points.p_world) / sigma
        near = np.abs(z) < width
        if near.sum() < _FEWEST:
            return FramePlane(plane, pose_noise)
        found = _corrected(found, plane, points.chosen(near), z[near], pose_noise, region_radius)
        z = found.heights(points.p_world) / sigma
        noise = max(1.0, MAD_TO_SIGMA * float(np.median(np.abs(z[np.abs(z) < width]))))
        width = max(SEARCH_SIGMAS * noise, width / 2)
    return FramePlane(found, noise)


def _corrected(
    found: Plane, prior: Plane, points: FramePoints, z: Float[ndarray, "n"], pose_noise: float, radius: float
) -> Plane:
    """One step of robust least squares for height and slopes, with the common plane as prior."""
    axes = prior.axes()
    centre = points.p_world.mean(0)
    centre = centre - prior.heights(centre[None])[0] * prior.normal
    flat = (points.p_world - centre) @ axes.T / radius
    sigma = points.sigma_along(found.normal)
    weight = geman_mcclure_weight((z / 3) ** 2) / sigma**2
    A = np.concatenate([np.ones((len(z), 1)), flat], 1)
    b = prior.heights(points.p_world)
    spread = max(pose_noise, 2.0) * float(np.median(sigma))  # how far this frame's plane may be from the common one
    H = (weight[:, None] * A).T @ A + np.eye(3) / spread**2
    height, u, v = np.linalg.solve(H, (weight * b) @ A)
    normal = prior.normal - (u * axes[0] + v * axes[1]) / radius
    normal = normal / np.linalg.norm(normal)
    return Plane(normal, float(normal @ (centre + height * prior.normal)))


@dataclass(frozen=True)
class BarePlaces:
    """The cells of a grid in a plane in which nothing rises from it, and how high its points seem to be; in sigmas."""

    plane: Plane
    size: float  # of a cell
    cells: frozenset[tuple[int, int]]
    near: float  # height up to which a point is part of the plane where something may rise from it
    bare: float  # and where nothing does

    def at(self, p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether the plane is bare below points."""
        cell, place = _cells(self.plane, p_world, self.size)
        return np.array([tuple(c) in self.cells for c in cell.tolist()], dtype=bool)[place]


def find_bare_places(plane: Plane, frames: Sequence[tuple[FramePoints, FramePlane]], size: float) -> BarePlaces:
    """Cells where nearly all points near the plane are part of it, in all frames together.

    First with the points' own noise. Where something rises from the plane, what seems to be below it is error, and says
    how high points of the plane may seem to be there; the cells are judged again with that.
    """
    p = np.concatenate([points.p_world for points, _ in frames])
    z = np.concatenate([own.in_sigmas(points) for points, own in frames])
    first = _bare(plane, p, z, size, _PLANE_SIGMAS)
    near = np.abs(z) < _MOST_SIGMAS
    errors = -z[near][_beside_what_rises(plane, p[near], z[near], size) & (z[near] < 0) & ~first.at(p[near])]
    measured = float(np.quantile(errors, _ERROR_SHARE)) if len(errors) >= _FEWEST else 0.0
    return _bare(plane, p, z, size, max(_PLANE_SIGMAS, measured))


def _beside_what_rises(
    plane: Plane, p_world: Float[ndarray, "n 3"], z: Float[ndarray, "n"], size: float
) -> Bool[ndarray, "n"]:
    """Points in cells that hold parts of the plane, and of what rises from it.

    At the edge of a plate, too, there are points below the plane; but those are surface.
    """
    _, place = _cells(plane, p_world, size)
    count = np.bincount(place)
    rising = np.bincount(place, (z > _PLANE_SIGMAS).astype(float)) > _PRESENT * count
    flat = np.bincount(place, (np.abs(z) < _PLANE_SIGMAS).astype(float)) > _PRESENT * count
    return (rising & flat)[place]


def _bare(
    plane: Plane, p_world: Float[ndarray, "n 3"], z: Float[ndarray, "n"], size: float, height: float
) -> BarePlaces:
    """The cells in which nearly all points near the plane seem to be no higher than `height` (in sigmas)."""
    bare = max(_BARE_SIGMAS, _BARE_FACTOR * height)
    near = np.abs(z) < 2 * bare
    cell, place = _cells(plane, p_world[near], size)
    flat = (np.abs(z[near]) < height).astype(float)
    share = np.bincount(place, flat, len(cell)) / np.maximum(np.bincount(place, minlength=len(cell)), 1)
    chosen = cell[share >= _BARE_SHARE]
    return BarePlaces(plane, size, frozenset((a, b) for a, b in chosen.tolist()), height, bare)


def on_plane(points: FramePoints, own: FramePlane, bare: BarePlaces) -> Bool[ndarray, "n"]:
    """Points that are part of a plane or behind it."""
    z = own.in_sigmas(points)
    low = z < bare.near
    unsure = ~low & (z < bare.bare)
    low[unsure] = bare.at(points.p_world[unsure])
    return low


def _cells(
    plane: Plane, p_world: Float[ndarray, "n 3"], size: float
) -> tuple[Int64[ndarray, "c 2"], Int64[ndarray, "n"]]:
    """The cells of a grid in a plane that hold points, and the number of each point's cell."""
    cell = np.floor(p_world @ plane.axes().T / size).astype(np.int64)
    cells, place = np.unique(cell, axis=0, return_inverse=True)
    return cells, place.reshape(-1)
