"""The surface of a frame as a small image of points and normals, in which points of other frames are looked up."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from sl_nerfstudio.geometry.devices import Device, for_loops
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, all_finite, nearest_distances, solve_plane
from sl_nerfstudio.parallel import compiled_range
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, directions
from sl_nerfstudio.relative_pose.estimation import RelativePose, RelativePoseError, agreeing_coords
from sl_nerfstudio.relative_pose.intrinsics import camera_depth_by_pose

FEWEST_POINTS = 50  # that a frame must have

# The lattice on which a frame's points are averaged.
LARGEST_SIDE = 200  # map pixels along the longer side: registration needs no more, and poses are refined later
HALF_WINDOW = 2  # map pixels on each side of the centre of a plane fit
FEWEST_PIXELS = 8  # map pixels in a plane fit
LARGEST_RELIEF = 0.03  # RMS departure from the plane, as a share of the depth, beyond which a window holds an edge
LEAST_COSINE = 0.15  # between ray and normal, below which a surface is seen too obliquely
LARGEST_SIGMA_RATIO = 4.0  # uncertainty of a point over the frame's median, beyond which it is left out
LATTICE_ERROR = 0.25  # of a point that no averaging removes, map pixels
ORIENTATIONS = 150  # directions that normals are sorted into, about 15 degrees apart

# What other frames may see too.
CENTRE_DEPTH = 0.4  # radii from the centroid of the visible points to about the centre of the object behind them
MIDDLE = 0.15  # distance from the image's centre, as a share of its shorter side, where the object may be expected
FEWEST_CENTRAL = 200  # map pixels in the middle; with fewer, the middle is larger
NEAR_QUANTILE = 0.3  # of the depths in the middle at which the object is expected: a table may be behind it
NEARNESS = 0.1  # share of that depth by which the object's centre lies behind its surface at most
EMPTY_MARGIN = 0.02  # distance within which nothing of the pattern may be seen, as a share of the image's longer side
PROJECTOR_SIDE = 100  # places along the longer side of the pattern at which it is known how far its light went

# Tone: what of a frame's brightness belongs to its surface.
TONE_WINDOW = 0.06  # sigma of the window in which brightness is compared, as a share of the map's longer side
TONE_COSINE = 0.35  # of the normal with the ray of either device, below which it is seen or lit too obliquely
# Angles of the normal to light, camera and the middle of both, between which brightness is linear: gloss is narrow.
TONE_KNOTS_DEG = (0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 37.0, 45.0, 54.0, 63.0, 72.0, 81.0, 90.0)
TONE_RIDGE = 1e-4  # weight of the squares of those functions, relative to one pixel's
TONE_BORDER = 2  # map pixels along the border of what is known that have no tone
TONE_FEWEST_PIXELS = 60  # of a connected part of the surface that has a tone
TONE_LARGEST = 3.0  # in robust standard deviations of the frame's, beyond which it is cut off: a highlight

# The surface of one frame in camera axes, in units of its own baseline, with the uncertainty of every point.


@dataclass(frozen=True)
class FrameCloud:
    """Points of one frame in camera axes (looking along -z), baseline one, and the maps they come from."""

    name: str
    camera: Device
    projector: Device
    pose: RelativePose
    coords: Float32[ndarray, "h w 2"]  # decoded coordinates that agree with the pose; NaN elsewhere
    uv_camera: Float64[ndarray, "n 2"]  # of the points: `correspondences_of(coords)`
    points: Float64[ndarray, "n 3"]
    sigma_noise: Float64[ndarray, "n"]  # along the camera ray, from decoding noise: independent of other cells
    pose_errors: Float64[ndarray, "n 5"]  # along the camera ray, by one sigma of each principal error of the pose
    light: Float32[ndarray, "h w"] | None = None  # of the projector that each pixel returns; None: not measured
    seen: Bool[ndarray, "h w"] | None = None  # where the camera saw the pattern, decoded or not; None: not known
    alternatives: tuple["FrameCloud", ...] = ()  # with other poses that explain the coordinates nearly as well

    def with_pose(self, projector: Device, pose: RelativePose) -> "FrameCloud":
        """Triangulate with another projector, or another pose of it. Raises as `frame_cloud` does."""
        return frame_cloud(self.name, self.coords, self.camera, projector, pose, light=self.light, seen=self.seen)

    @property
    def sigma(self) -> Float64[ndarray, "n"]:
        """One standard deviation along the camera ray, without that of the unknown length of the baseline."""
        return np.hypot(self.sigma_noise, self.sigma_pose)

    @property
    def sigma_pose(self) -> Float64[ndarray, "n"]:
        """Along the camera ray, from the pose's covariance: points err together."""
        return np.linalg.norm(self.pose_errors, axis=1)

    @property
    def centroid(self) -> Float64[ndarray, "3"]:
        """Mean of the points."""
        return self.points.mean(0)


def frame_cloud(
    name: str,
    coords: Float32[ndarray, "h w 2"],
    camera: Device,
    projector: Device,
    pose: RelativePose,
    light: Float32[ndarray, "h w"] | None = None,
    seen: Bool[ndarray, "h w"] | None = None,
) -> FrameCloud:
    """Triangulate one frame, with each pose that explains it. `coords` are those from which `pose` was found.

    `light` is how much of the projector's light each pixel returns, NaN where that is unknown;
    `seen` is where the camera saw the pattern.

    Raises RelativePoseError where hardly any point agrees with the pose.
    """
    uv_camera, uv_projector = correspondences_of(coords)
    keep = pose.inliers
    if keep.sum() < FEWEST_POINTS:
        raise RelativePoseError(
            f"{name}: only {keep.sum()} points agree with the projector's pose (at least {FEWEST_POINTS})\n"
            "    cause:  too little of the pattern was decoded\n"
            "    remedy: capture this view again"
        )
    d_camera, d_projector = directions(camera, uv_camera[keep]), directions(projector, uv_projector[keep])
    depth, depth_by_pixel, slopes = camera_depth_by_pose(pose.T_camera_projector, projector, d_camera, d_projector)
    # Changes of depth by one sigma of the pose along each principal axis of its covariance.
    variance, axes = np.linalg.eigh(pose.covariance)
    return FrameCloud(
        name,
        camera,
        projector,
        pose,
        agreeing_coords(coords, camera, projector, pose),
        uv_camera[keep],
        # On the camera ray, not midway between both rays: camera pixels are exact, coordinates are not.
        points=d_camera * depth[:, None],
        sigma_noise=pose.noise_px[keep] * depth_by_pixel,
        pose_errors=slopes @ (axes * np.sqrt(variance.clip(0))),
        light=light,
        seen=seen,
        alternatives=tuple(
            frame_cloud(name, coords, camera, projector, other, light, seen)
            for other in pose.alternatives
            if other.inliers.sum() >= FEWEST_POINTS
        ),
    )


def motion_by_pose_errors(cloud: FrameCloud) -> Float64[ndarray, "7 5"]:
    """What one sigma of each principal error of the pose mostly amounts to: a similarity of the whole surface.

    Increments (v, w, l) about the centroid: `p <- c + exp(l) exp(w) (p - c) + v`, lengths in baselines.
    """
    some = slice(None, None, max(1, len(cloud.points) // 500))
    points = cloud.points[some]
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    moved = ray[:, :, None] * cloud.pose_errors[some, None, :]
    p = points - cloud.centroid
    turns = np.cross(np.eye(3), p[:, None, :]).transpose(0, 2, 1)  # columns e_k x p
    similarity = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns, p[:, :, None]], 2)
    return np.linalg.lstsq(similarity.reshape(-1, 7), moved.reshape(-1, 5), rcond=None)[0]


def reliable_points(cloud: FrameCloud) -> Bool[ndarray, "n"]:
    """Points whose uncertainty is not far above the frame's median: those next to an epipole are left out."""
    sigma = cloud.sigma
    return sigma < LARGEST_SIGMA_RATIO * np.median(sigma)


# How much darker or brighter a surface is than around it: prints, grain and dirt, which stay where they are on it. A
# vase may be turned about its axis without its shape telling; its tone tells.


def surface_tone(
    light: Float64[ndarray, "h w"],
    point: Float64[ndarray, "h w 3"],
    normal: Float64[ndarray, "h w 3"],
    p_projector: Float64[ndarray, "3"],
) -> Float32[ndarray, "h w"]:
    """Logarithm of the reflectance against its surroundings, NaN where unknown; all vectors in camera axes.

    `light` is what the surface returns of the projector's light, NaN where unknown. It is divided by what arrives there
    (Lambert's cosine over the squared distance). What functions of the angles to light and camera explain is taken out,
    because it is light that this view sees, such as gloss, and so is what changes slowly over the image, such as the
    projector's own fall-off.
    """
    ray = p_projector - point
    distance = np.linalg.norm(ray, axis=-1)
    to_light = ray / np.maximum(distance, 1e-300)[..., None]
    to_camera = -point / np.maximum(np.linalg.norm(point, axis=-1, keepdims=True), 1e-300)
    cosine = (to_light * normal).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        known = (light > 0) & (cosine > TONE_COSINE) & ((to_camera * normal).sum(-1) > TONE_COSINE)
        # Along the border the light was measured beside something else.
        square = np.ones((2 * TONE_BORDER + 1,) * 2, dtype=np.uint8)
        known = cv2.erode(known.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,)) > 0
        tone = np.where(known, np.log(light * distance**2 / cosine), np.nan)
    if known.sum() < TONE_FEWEST_PIXELS:
        return np.full(light.shape, np.nan, dtype=np.float32)
    tone = _cut(tone)
    tone[known] -= _explained(tone[known], normal[known], to_light[known], to_camera[known])
    tone = _against_surroundings(tone)
    return _cut(tone).astype(np.float32)


def _cut(tone: Float64[ndarray, "h w"]) -> Float64[ndarray, "h w"]:
    """Less the median, and at most so many robust standard deviations."""
    if np.isnan(tone).all():
        return tone
    centred = tone - np.nanmedian(tone)
    reach = TONE_LARGEST * MAD_TO_SIGMA * float(np.nanmedian(np.abs(centred)))
    return np.clip(centred, -reach, reach)


def _explained(
    tone: Float64[ndarray, "n"],
    normal: Float64[ndarray, "n 3"],
    to_light: Float64[ndarray, "n 3"],
    to_camera: Float64[ndarray, "n 3"],
) -> Float64[ndarray, "n"]:
    """What the directions of light and camera against the normal explain: a sum of three functions, least squares."""
    middle = to_light + to_camera
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    angles = (np.degrees(np.arccos((normal * v).sum(-1).clip(-1, 1))) for v in (to_light, to_camera, middle))
    terms = np.concatenate([_hats(angle) for angle in angles], 1)
    H = terms.T @ terms + TONE_RIDGE * len(tone) * np.eye(terms.shape[1])
    return terms @ np.linalg.solve(H, terms.T @ tone)


def _hats(angle: Float64[ndarray, "n"]) -> Float64[ndarray, "n k"]:
    """Piecewise linear functions of angles, each 1 at its knot and 0 at the others."""
    number = np.arange(len(TONE_KNOTS_DEG))
    return np.maximum(1 - np.abs(np.interp(angle, TONE_KNOTS_DEG, number)[:, None] - number), 0)


def _against_surroundings(tone: Float64[ndarray, "h w"]) -> Float64[ndarray, "h w"]:
    """The tone less its mean around each place, on the same connected part of the surface."""
    known = np.isfinite(tone)
    sigma = TONE_WINDOW * max(tone.shape)
    count, label = cv2.connectedComponents(known.astype(np.uint8), connectivity=4)
    out = np.full(tone.shape, np.nan)
    for number in range(1, count):
        part: Bool[ndarray, "h w"] = label == number
        if part.sum() < TONE_FEWEST_PIXELS:
            continue
        weight = part.astype(np.float32)
        values = np.where(part, tone, 0).astype(np.float32)
        mean = cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT) / np.maximum(
            cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), 1e-6
        )
        out[part] = tone[part] - mean[part]
    return out


# Where a frame saw nothing of the pattern, although it would have fallen on a surface there: a camera that looks into
# empty space says as much of an object as one that sees its surface. Two faces of a box agree wherever one lies on the
# other; but where the larger one ends, the frame of the smaller one saw nothing.


@dataclass(frozen=True)
class EmptyPlaces:
    """Where one frame saw nothing; lengths in units of its baseline."""

    empty: Bool[ndarray, "h w"]  # places of the surface map around which the camera saw nothing of the pattern
    projector: Device  # of the lattice of `reach`: the frame's projector, scaled
    T_projector_camera: Float64[ndarray, "4 4"]
    reach: Float64[ndarray, "a b"]  # how far from the projector a surface would be lit: up to what was seen; see below

    @cached_property
    def light(self) -> tuple[int, Float64[ndarray, "8"], Float64[ndarray, "4 4"], Float64[ndarray, "a b"]]:
        """The projector, its pose and `reach`, for compiled loops."""
        return *for_loops(self.projector), self.T_projector_camera, self.reach


def find_empty_places(cloud: FrameCloud, camera: Device) -> EmptyPlaces:
    """Find them on the lattice of `camera`; none if it is not known where the frame saw the pattern.

    `reach` is infinite where the camera saw nothing of what the projector lit, and 0 beside the pattern: there, and
    behind what was seen, a surface may be dark.
    """
    T = np.linalg.inv(cloud.pose.T_camera_projector)
    factor = min(1.0, PROJECTOR_SIDE / max(cloud.projector.w, cloud.projector.h))
    projector = cloud.projector.scaled(factor)
    if cloud.seen is None:
        nowhere = np.zeros((camera.h, camera.w), dtype=bool)
        return EmptyPlaces(nowhere, projector, T, np.zeros((projector.h, projector.w)))
    uv = correspondences_of(cloud.coords)[1]
    distance = np.linalg.norm(cloud.points @ T[:3, :3].T + T[:3, 3], axis=1)
    cells = _cell(uv[:, 1], factor, projector.h), _cell(uv[:, 0], factor, projector.w)
    reach = nearest_distances(cells, distance, (projector.h, projector.w))
    reach[[0, -1]] = reach[:, [0, -1]] = 0.0
    return EmptyPlaces(_empty(cloud.seen, camera), projector, T, reach)


def _empty(pattern_seen: Bool[ndarray, "H W"], camera: Device) -> Bool[ndarray, "h w"]:
    seen = np.zeros((camera.h, camera.w), dtype=bool)
    factor = max(camera.w, camera.h) / max(pattern_seen.shape)
    row, column = np.nonzero(pattern_seen)
    seen[_cell(row + 0.5, factor, camera.h), _cell(column + 0.5, factor, camera.w)] = True
    around = np.pad(seen, 1, constant_values=True)  # what is beside the image is not known
    return np.asarray(distance_transform_edt(~around))[1:-1, 1:-1] > EMPTY_MARGIN * max(camera.w, camera.h)


def _cell(place: Float64[ndarray, "n"], factor: float, count: int) -> ndarray:
    return np.minimum(np.floor(place * factor).astype(np.int64), count - 1)


@dataclass(frozen=True)
class Lattice:
    """Places of a smaller image, in each of which what points of a cloud say is averaged."""

    camera: Device  # the frame's camera, scaled
    index: Int64[ndarray, "n"]  # place of each point, row after row
    count: Int64[ndarray, "h w"]  # points in each place

    @staticmethod
    def of(camera: Device, uv_camera: Float64[ndarray, "n 2"], largest_side: int) -> "Lattice":
        """Places of points; at most `largest_side` of them along the longer side of the image."""
        factor = min(1.0, largest_side / max(camera.w, camera.h))
        small = camera.scaled(factor)
        column, row = np.floor(uv_camera * factor).astype(np.int64).T
        index = np.minimum(row, small.h - 1) * small.w + np.minimum(column, small.w - 1)
        return Lattice(small, index, np.bincount(index, minlength=small.h * small.w).reshape(small.h, small.w))

    def mean(self, values: Float[ndarray, "n"]) -> Float64[ndarray, "h w"]:
        """Mean of the points in each place; zero where there are none."""
        sums = np.bincount(self.index, values, self.count.size).reshape(self.count.shape)
        return sums / np.maximum(self.count, 1)

    def centres(self) -> Float64[ndarray, "h w 2"]:
        """Centres of the places, in pixels of the lattice."""
        h, w = self.count.shape
        return np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), -1)

    def rays(self) -> Float64[ndarray, "h w 3"]:
        """Unit directions of the centres."""
        return directions(self.camera, self.centres().reshape(-1, 2)).reshape(*self.count.shape, 3)


@dataclass(frozen=True)
class FrameView:
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
    views: tuple[FrameView, ...]  # what may be the object that this and other frames see

    @property
    def normal(self) -> Float64[ndarray, "h w 3"]:
        """Unit normals, towards the camera."""
        return self.plane[..., :3]

    @property
    def sigma(self) -> Float64[ndarray, "h w"]:
        """One standard deviation of the surface along its normal."""
        return self.plane[..., 4]

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


def build_surface_map(cloud: FrameCloud) -> SurfaceMap:
    """Average a cloud on a lattice of camera pixels and fit planes to windows of inverse depth.

    The inverse depth of a plane is linear in the pixel, so steep parts are not biased by the averaging.
    """
    keep = reliable_points(cloud)
    lattice = Lattice.of(cloud.camera, cloud.uv_camera[keep], LARGEST_SIDE)
    camera, mean = lattice.camera, lattice.mean
    inverse_depth = np.where(lattice.count > 0, mean(-1 / cloud.points[keep, 2]), np.nan)
    fitted = np.full((camera.h, camera.w, 3), np.nan)
    planes_of = inverse_depth.astype(np.float32)
    _fit_inverse_depth(camera.h, planes_of, HALF_WINDOW, FEWEST_PIXELS, LARGEST_RELIEF, fitted)
    ray = lattice.rays()
    ray = ray / -ray[..., 2:]
    point = ray / fitted[..., :1]
    normal = _normals(fitted, ray, camera)
    cosine = -(normal * ray).sum(-1) / np.linalg.norm(ray, axis=-1)
    with np.errstate(invalid="ignore"):
        valid = all_finite(point) & (fitted[..., 0] > 0) & (cosine > LEAST_COSINE)
    depth = np.linalg.norm(np.nan_to_num(point), axis=-1)
    points, place = (point[valid], lattice.centres()[valid]) if valid.any() else (cloud.points, None)
    centroid, radius = centre_and_radius(points)
    along_normal = np.nan_to_num(np.abs(cosine))
    sigma = np.hypot(mean(cloud.sigma_noise[keep]) * along_normal, LATTICE_ERROR * depth / camera.fl_x)
    if valid.any():
        pose_errors = np.stack([mean(values) for values in cloud.pose_errors[keep].T], -1)
        errors = pose_errors[valid] * along_normal[valid][:, None]
        shape_errors = _beyond_similarity(errors, (point[valid] - centroid) / radius, normal[valid])
        sigma[valid] = np.hypot(sigma[valid], np.linalg.norm(shape_errors, axis=-1))
    return SurfaceMap(
        camera,
        np.ascontiguousarray(np.nan_to_num(point)),
        tangent_planes(np.nan_to_num(point), np.nan_to_num(normal), sigma),
        valid,
        _tone(cloud, keep, point, normal, valid),
        find_empty_places(cloud, camera),
        _orientation_weights(normal[valid]),
        centroid,
        radius,
        _views(points, place, camera),
    )


def _tone(
    cloud: FrameCloud,
    keep: Bool[ndarray, "n"],
    point: Float64[ndarray, "h w 3"],
    normal: Float64[ndarray, "h w 3"],
    valid: Bool[ndarray, "h w"],
) -> Float32[ndarray, "h w"]:
    """The surface's tone on the lattice, from the points that are kept."""
    if cloud.light is None:
        return np.full(valid.shape, np.nan, dtype=np.float32)
    uv_camera = cloud.uv_camera[keep]
    column, row = np.floor(uv_camera).astype(np.int64).T
    light = cloud.light[row, column]
    known = np.isfinite(light)
    measured = Lattice.of(cloud.camera, uv_camera[known], LARGEST_SIDE)
    light = np.where(valid & (measured.count > 0), measured.mean(light[known]), np.nan)
    return surface_tone(light, point, normal, cloud.pose.T_camera_projector[:3, 3])


def _beyond_similarity(
    errors: Float64[ndarray, "m k"], p: Float64[ndarray, "m 3"], normal: Float64[ndarray, "m 3"]
) -> Float64[ndarray, "m k"]:
    """What remains of displacements along the normals after the similarity that takes up most of each.

    An error of the projector's pose mostly moves, turns and scales the surface as a whole. Registration finds that
    similarity anyway; only the rest keeps two surfaces apart.
    """
    moves = np.concatenate([normal, np.cross(p, normal), (p * normal).sum(-1, keepdims=True)], 1)
    return errors - moves @ np.linalg.lstsq(moves, errors, rcond=None)[0]


def _orientation_weights(normal: Float64[ndarray, "m 3"]) -> Float64[ndarray, "m"]:
    """One over the square root of how many normals have about the same direction."""
    if not len(normal):
        return np.zeros(0)
    k = np.arange(ORIENTATIONS) + 0.5
    height, turn = 1 - 2 * k / ORIENTATIONS, np.pi * (1 + 5**0.5) * k  # a lattice of directions (Vogel's spiral)
    flat = np.sqrt(1 - height**2)
    nearest = (normal @ np.stack([flat * np.cos(turn), flat * np.sin(turn), height])).argmax(1)
    return 1 / np.sqrt(np.bincount(nearest, minlength=ORIENTATIONS)[nearest])


def centre_and_radius(points: Float64[ndarray, "n 3"]) -> tuple[Float64[ndarray, "3"], float]:
    """The mean of points, and their root mean square distance from it."""
    centroid = points.mean(0)
    return centroid, float(np.sqrt(((points - centroid) ** 2).sum(-1).mean()))


def _views(
    points: Float64[ndarray, "n 3"], uv: Float64[ndarray, "n 2"] | None, camera: Device
) -> tuple[FrameView, ...]:
    """Everything that the frame sees; and what lies in the middle of its image, at what depth that is.

    With nothing but the object in view, its visible parts are about equally large in all frames. A wall that only some
    frames see changes size and centre of everything; cameras that look at the object have it in the middle all the
    same, and are about equally far from it.
    """
    centroid, radius = centre_and_radius(points)
    behind = CENTRE_DEPTH * radius
    views = [FrameView(centroid * (1 + behind / np.linalg.norm(centroid)), radius)]
    if uv is None:
        return tuple(views)
    off = np.abs(uv - (camera.cx, camera.cy)).max(-1) / min(camera.w, camera.h)
    central = np.sort(off)[min(len(off), FEWEST_CENTRAL) - 1]
    middle = points[off <= max(central, MIDDLE)]
    depth = np.linalg.norm(middle, axis=1)
    place = np.median(middle / depth[:, None], axis=0)
    near = float(np.quantile(depth, NEAR_QUANTILE))
    views.append(FrameView(place / np.linalg.norm(place) * (near + min(behind, NEARNESS * near)), near))
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
