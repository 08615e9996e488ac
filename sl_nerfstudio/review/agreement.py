"""Cross-frame agreement: coordinates of one frame, through its own two devices, into those of another.

A point is triangulated in one frame and projected into another camera; the coordinate decoded *there* is compared with
where that frame's projector has the point. A point in front of what the other camera saw contradicts it: it would have
been seen instead. One behind it may be hidden and is not judged; if it is a contradiction, that shows in the other
direction, where the other frame's points then lie in front.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64
from numpy import ndarray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import observe, partners, place_anchors, where_rays_meet
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, Rig, linearise
from sl_nerfstudio.geometry.devices import Device, project
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, centred_on, inverse, rotate, transform
from sl_nerfstudio.geometry.numerics import (
    MAD_TO_SIGMA,
    all_finite,
    component_labels,
    evenly_spaced,
    geman_mcclure_weight,
    nearest_distances,
)
from sl_nerfstudio.geometry.triangulation import Triangulation, triangulate_pixels, world_pixels
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.scan.types import PoseSigma, Scan

_PIXELS_PER_FRAME, _MOST_PIXELS, _LEAST_PIXELS_PER_FRAME = 500, 12000, 60  # that are looked up in other frames
_COMPARED_FRAMES = 150  # most frames of which each is compared with every other
_PARTNERS = 32  # other frames that a frame is compared with, about, where there are more
LEAST_COSINE = 0.2  # between surface normal and ray, below which a device counts as not seeing a point
_SIGMAS = 4.0  # of a residual, from noise and stated uncertainty of the poses, up to which a point agrees: chance alone
# exceeds it once in 3000 points
_FOOTPRINT = 0.25  # error that no calibration and no look-up is assumed to be free of, 1 sigma, in camera pixels
_LARGEST_NOISE_RATIO = 3.0  # of a frame's noise to the median frame's; beyond, a wrong pose of its projector makes it
FEWEST_JUDGED = 30  # points below which nothing is said of a frame or of a pair of frames

# Pairs are compared at this quantile of their residuals: wrong decodings do not reach it, and a plane on which two
# frames agree by chance rarely holds so much of them.
_TYPICAL_QUANTILE = 0.8
_LEAST_TYPICAL = 0.5  # noises: below, look-ups decide, not poses
_LARGEST_TYPICAL = 1.5  # expected sigmas in a scan's better pairs; normal errors in two dimensions have 1.8, and the
# expected sigma is generous
_ROUGH_FACTOR = 1.6  # on the limits where the stated uncertainty of the poses makes up the expected sigma: an error of
# a pose is common to all points of a pair, so right pairs differ by chance
_REFERENCE_QUANTILE = 0.25  # over all pairs, with which each is compared: a quarter of the pairs must be right
CONTRADICTING_EXCESS = 2.5  # residual of a pair over that reference, beyond which its frames contradict each other

GOOD_EXCESS = 2.0  # the same of a frame that agrees well with the others
GOOD_SHARE = 0.95  # of the judged points, those that must agree in such a frame


def pixels_of_each(frames: int) -> int:
    """Decoded pixels of each of so many frames that are looked up."""
    return max(_LEAST_PIXELS_PER_FRAME, min(_PIXELS_PER_FRAME, _MOST_PIXELS // frames))


# The decoding noise of every frame, measured so that an error of its pose does not count as noise.

_ROUNDS = 4  # of reweighted least squares
_FEWEST = 20  # points from which a noise can be measured: three for each of the six unknowns


def frame_noise(linear: Linearisation, anchors: Anchors, frames: int) -> Float[Tensor, "frames"]:
    """Robust 1 sigma of each frame's epipolar residuals after the best small change of its relative pose.

    Pattern pixels, NaN for frames with few points. A wrong relative pose makes residuals that change smoothly over the
    image, and a first-order change of the pose explains these. What is left is the noise of look-ups.
    """
    along = torch.nn.functional.normalize(linear.own_depth, dim=-1)
    across = torch.stack([-along[:, 1], along[:, 0]], -1)
    residual = (across * linear.residuals.own).sum(-1)
    columns = (across[:, :, None] * linear.own).sum(1)
    out = torch.full((frames,), float("nan"), dtype=torch.float64)
    for k in range(frames):
        mine = anchors.frame == k
        if int(mine.sum()) >= _FEWEST:
            out[k] = _remaining_sigma(residual[mine], columns[mine])
    return out


def _remaining_sigma(r: Float[Tensor, "n"], J: Float[Tensor, "n 6"]) -> float:
    """Robust sigma of `r` less the combination of columns that fits it best."""
    J = J / J.norm(dim=0).clamp_min(1e-300)  # translations and rotations have different units
    left, sigma = r, _sigma(r)
    for _ in range(_ROUNDS):
        if sigma == 0:
            break
        w = geman_mcclure_weight((left / (3 * sigma)) ** 2).sqrt()
        # The length of the baseline changes no epipolar line, so one direction is free: the shortest solution.
        x = torch.linalg.lstsq(w[:, None] * J, (w * r)[:, None], rcond=1e-8, driver="gelsd").solution[:, 0]
        left = r - J @ x
        sigma = _sigma(left)
    return sigma


def _sigma(values: Float[Tensor, "n"]) -> float:
    return MAD_TO_SIGMA * float(values.abs().median())


@dataclass(frozen=True)
class LookUps:
    """Points of one frame that another frame can judge."""

    frames: int
    source: Int[ndarray, "points"]  # frame of every point that was tried
    anchor: Int[ndarray, "n"]  # the point that was judged
    viewer: Int[ndarray, "n"]  # by which frame
    px: Float[ndarray, "n"]  # residual, pattern pixels
    normalised: Float[ndarray, "n"]  # in units of what noise and stated uncertainty explain, 1 sigma
    by_poses: Float[ndarray, "n"]  # share of the expected variance that comes from the stated uncertainty of the poses


@dataclass(frozen=True)
class PairAgreement:
    """Two frames that saw some of the same surface."""

    frames: tuple[int, int]
    judged: int  # points of one that the other can judge, both ways
    share: float  # of these, how many agree
    px_median: float  # residual, pattern pixels
    px_p95: float
    excess: float  # residual in units of what is expected, relative to the scan's better pairs


@dataclass(frozen=True)
class FrameCrossAgreement:
    """One frame against all others: medians over its pairs, weighted by judged points; NaN where it has no pair."""

    points: int  # that were looked up
    seen: float  # share of these that at least one other frame can judge
    share: float  # of its judged points, how many agree
    px_median: float  # pattern pixels
    px_p95: float
    excess: float


@dataclass(frozen=True)
class CrossFrameAgreement:
    """All frames against each other, in the order of the frames; NaN where nothing could be judged."""

    noise_px: float  # of one look-up: the median over the frames, pattern pixels
    share: float  # of all judged points, how many agree
    px_median: float
    px_p95: float
    frames: tuple[FrameCrossAgreement, ...]
    pairs: tuple[PairAgreement, ...]  # with enough judged points


def summarise(found: LookUps, noise_px: float) -> CrossFrameAgreement:
    """Figures of the pairs, the frames and all together."""
    pairs = _pairs(found)
    seen = np.zeros(len(found.source), bool)
    seen[found.anchor] = True
    of_frame: list[list[PairAgreement]] = [[] for _ in range(found.frames)]
    for pair in pairs:
        for k in pair.frames:
            of_frame[k].append(pair)
    return CrossFrameAgreement(
        noise_px=noise_px,
        share=_mean(found.normalised < _SIGMAS),
        px_median=_quantile(found.px, 0.5),
        px_p95=_quantile(found.px, 0.95),
        frames=tuple(_frame(seen[found.source == k], of_frame[k]) for k in range(found.frames)),
        pairs=tuple(pairs),
    )


def _pairs(found: LookUps) -> list[PairAgreement]:
    first, second = np.sort(np.stack([found.source[found.anchor], found.viewer]), 0)
    pair = first * found.frames + second
    order = np.argsort(pair, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(pair[order])) + 1) if len(order) else []
    groups = [mine for mine in groups if len(mine) >= FEWEST_JUDGED]
    residuals = np.array([_residual(found, mine) for mine in groups]).reshape(-1, 3)
    noises, stated, chance = residuals.T
    reference = min(_quantile(noises, _REFERENCE_QUANTILE), _LARGEST_TYPICAL * _quantile(stated, 0.5))
    excess = noises / (reference * chance)
    return [
        PairAgreement(
            frames=(int(first[mine[0]]), int(second[mine[0]])),
            judged=len(mine),
            share=_mean(found.normalised[mine] < _SIGMAS),
            px_median=_quantile(found.px[mine], 0.5),
            px_p95=_quantile(found.px[mine], 0.95),
            excess=float(e),
        )
        for mine, e in zip(groups, excess, strict=True)
    ]


def _residual(found: LookUps, mine: Int[ndarray, "m"]) -> tuple[float, float, float]:
    """The typical residual of a pair, its expected sigma, and how much right pairs may differ.

    The first two are in units of the noise, the last is a factor.
    """
    by_noise = np.sqrt(1 - found.by_poses[mine])  # share of the expected sigma
    typical = max(_quantile(found.normalised[mine] / by_noise, _TYPICAL_QUANTILE), _LEAST_TYPICAL)
    return typical, float(np.median(1 / by_noise)), 1 + (_ROUGH_FACTOR - 1) * _mean(found.by_poses[mine])


def _frame(seen: ndarray, pairs: list[PairAgreement]) -> FrameCrossAgreement:
    weight = np.array([p.judged for p in pairs], np.float64)
    figures = (
        _weighted_median(np.array([getattr(p, key) for p in pairs]), weight)
        for key in ("share", "px_median", "px_p95", "excess")
    )
    return FrameCrossAgreement(len(seen), _mean(seen) if len(seen) else 0.0, *figures)


def _weighted_median(values: Float[ndarray, "n"], weight: Float[ndarray, "n"]) -> float:
    if not len(values):
        return float("nan")
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, total[-1] / 2)]])


def _mean(values: ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _quantile(values: ndarray, q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")


@one_library_thread()
def cross_frame_agreement(rig: Rig, maps: CoordinateMaps, sigma: Float[Tensor, "frames 12"]) -> CrossFrameAgreement:
    """Compare all frames. The scene must be normalised: origin at the object's centre, radius about one.

    `sigma` is 1 sigma of each frame's pose as a whole and of its projector against its camera (translation xyz and
    rotation xyz each), in the scene's unit and radian: what these explain is no contradiction.
    """
    generator = torch.Generator().manual_seed(0)
    anchors = place_anchors(rig, maps, pixels_of_each(rig.frames), generator)
    most = rig.frames if rig.frames <= _COMPARED_FRAMES else _PARTNERS
    together = partners(rig, anchors, maps, most, LEAST_COSINE, generator)
    rows = observe(rig, anchors, maps, rig.frames, float("inf"), LEAST_COSINE, generator, together)
    linear = linearise(rig, anchors, rows, maps)
    noise = frame_noise(linear, anchors, rig.frames)
    usual = float(noise.nanmedian())
    noise = noise.nan_to_num(usual).clamp_max(_LARGEST_NOISE_RATIO * usual)
    size = linear.residuals.cross.norm(dim=-1)
    by_noise = _variance_by_noise(linear, anchors, rows, noise**2 + (_FOOTPRINT * _footprint(rig, anchors, maps)) ** 2)
    by_poses = _variance_by_poses(linear, anchors, rows, sigma)
    normalised = size / (by_noise + by_poses).sqrt()
    judged = linear.residuals.cross_valid & ((normalised < _SIGMAS) | _in_front(rig, anchors, rows, maps))
    looked_up = LookUps(
        frames=rig.frames,
        source=anchors.frame.numpy(),
        anchor=rows.anchor[judged].numpy(),
        viewer=rows.frame[judged].numpy(),
        px=size[judged].numpy(),
        normalised=normalised[judged].numpy(),
        by_poses=(by_poses / (by_noise + by_poses))[judged].numpy(),
    )
    return summarise(looked_up, usual)


def _footprint(rig: Rig, anchors: Anchors, maps: CoordinateMaps) -> Float[Tensor, "frames"]:
    """Pattern pixels under one camera pixel: the median over each frame's points."""
    uv, _ = project(rig.camera[anchors.frame], anchors.d_camera)
    size = maps.look_up(anchors.frame, uv).jacobian.flatten(1).norm(dim=-1) / 2**0.5
    found = [size[anchors.frame == k] for k in range(rig.frames)]
    return torch.stack([x.median() if len(x) else torch.zeros((), dtype=size.dtype) for x in found])


def _variance_by_noise(
    linear: Linearisation, anchors: Anchors, rows: Observations, variance: Float[Tensor, "frames"]
) -> Float[Tensor, "rows"]:
    """Variance of a coordinate of each cross residual from the `variance` of look-ups in both frames, px^2.

    An error of the anchor's own coordinate changes its depth, and that the residual.
    """
    own2, cross2 = (linear.own_depth**2).sum(-1).clamp_min(1e-300), (linear.cross_depth**2).sum(-1)
    source = anchors.frame[rows.anchor]
    return variance[rows.frame] + variance[source] * cross2 / own2[rows.anchor]


def _variance_by_poses(
    linear: Linearisation, anchors: Anchors, rows: Observations, sigma: Float[Tensor, "frames 12"]
) -> Float[Tensor, "rows"]:
    """Variance of each cross residual, both coordinates together, from the stated sigma of the poses, px^2."""
    variance = sigma**2
    length2 = (linear.own_depth**2).sum(-1).clamp_min(1e-300)
    depth = (linear.own_depth[:, :, None] * linear.own).sum(1) / length2[:, None]  # by the projector's pose
    through_depth = (depth**2 * variance[anchors.frame, 6:]).sum(-1)[rows.anchor] * (linear.cross_depth**2).sum(-1)
    source, viewer = rows.pairs(anchors)
    of_poses = torch.cat([variance[source, :6], variance[viewer]], 1)
    return (linear.cross**2 * of_poses[:, None, :]).sum((1, 2)) + through_depth


def _in_front(rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps) -> Bool[Tensor, "rows"]:
    """Whether a point is nearer to the other camera than what that camera saw in its place."""
    j, a = rows.frame, rows.anchor
    p_world = transform(rig.T_world_camera[anchors.frame[a]], (anchors.depth[:, None] * anchors.d_camera)[a])
    p_j = transform(inverse(rig.T_world_camera)[j], p_world)
    uv, _ = project(rig.camera[j], p_j)
    _, depth, meet = where_rays_meet(rig, j, uv, maps.look_up(j, uv).uv_projector)
    return meet & (p_j.norm(dim=-1) < depth)


# Cross-frame agreement of a scan, from its devices, poses and coordinate images in any world and unit.

_POINTS_PER_FRAME = 500
_EDGE = 2.0  # per cent of the points on each side that may lie outside the object's box: wrong decodings


def compare_scan_frames(scan: Scan, poses: DevicePoses, sigma: Sequence[PoseSigma | None]) -> CrossFrameAgreement:
    """Compare the frames of a scan: `compare_frames` with coordinates from its files, where the masks allow them."""
    images = (frame.read_masked_coords() for frame in scan.frames)
    return compare_frames([f.camera for f in scan.frames], scan.projector, poses, images, sigma)


def compare_frames(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    coords: Iterable[Float32[ndarray, "_h _w 2"]],
    sigma: Sequence[PoseSigma | None],
) -> CrossFrameAgreement:
    """Cross-frame agreement with the given poses; `sigma` in the poses' unit, None where poses count as exact."""
    maps = CoordinateMaps.of(torch.from_numpy(image) for image in coords)
    S_scene_world = _scene(cameras, projector, poses, maps)
    rig = Rig.of(cameras, projector, poses, S_scene_world)
    rows = [_four(s, S_scene_world.scale) for s in sigma]
    stated = torch.tensor(rows, dtype=torch.float64).repeat_interleave(3, 1)
    return cross_frame_agreement(rig, maps, stated)


def _four(s: PoseSigma | None, scale: float) -> tuple[float, float, float, float]:
    """Translation and rotation of the frame, then of its projector against its camera; scene's unit and radian."""
    if s is None:
        return 0.0, 0.0, 0.0, 0.0
    turns = np.radians([s.camera_rotation_deg, s.relative_rotation_deg]).tolist()
    return s.camera_translation * scale, turns[0], s.relative_translation * scale, turns[1]


def _scene(cameras: Sequence[Device], projector: Device, poses: DevicePoses, maps: CoordinateMaps) -> Similarity:
    """World to scene: the centre of the decoded surface becomes the origin, its radius one."""
    parts = [np.zeros((0, 3))]
    for k, (camera, T_c, T_p) in enumerate(zip(cameras, poses.T_world_camera, poses.T_world_projector, strict=True)):
        _, found = triangulate_some(camera, projector, T_c, T_p, maps.image(k).numpy(), _POINTS_PER_FRAME)
        good = found.p_world.isfinite().all(-1) & (found.depth_camera > 0) & (found.depth_projector > 0)
        parts.append(found.p_world[good].numpy())
    points: Float[ndarray, "n 3"] = np.concatenate(parts)
    return centred_on(points, _EDGE) if len(points) > 1 else Similarity.identity()


def triangulate_some(
    camera: Device,
    projector: Device,
    T_world_camera: Float64[ndarray, "4 4"],
    T_world_projector: Float64[ndarray, "4 4"],
    coords: Float32[ndarray, "_h _w 2"],
    most: int,
) -> tuple[Float64[Tensor, "n 2"], Triangulation]:
    """Some decoded camera pixels, evenly chosen, and the points that their coordinates make of them."""
    decoded = np.flatnonzero(all_finite(coords))
    some = decoded[evenly_spaced(len(decoded), min(most, len(decoded)))]
    row, column = np.divmod(some, coords.shape[1])
    found = triangulate_pixels(camera, projector, T_world_camera, T_world_projector, coords, row, column)
    return torch.from_numpy(np.stack([column, row], -1) + 0.5), found


# Groups of frames: those that agree with each other, and weak places in a graph of pairs.

Pair = tuple[int, int]


def agreeing_groups(found: CrossFrameAgreement) -> list[list[int]]:
    """Groups of frames that agree with each other and contradict the other groups, the largest first.

    Frames that no other frame can judge are in no group. Greedy correlation clustering: the two groups with the most
    judged points in agreeing pairs, less those in contradicting pairs, are joined as long as the agreeing ones prevail.
    All pairs between two groups thus count together: a pair that agrees by accident joins nothing.
    """
    frames = sorted({k for p in found.pairs for k in p.frames})
    votes = np.zeros((len(frames), len(frames)))
    for p in found.pairs:
        i, j = (frames.index(k) for k in p.frames)
        agrees = p.excess <= CONTRADICTING_EXCESS
        votes[i, j] = votes[j, i] = p.judged if agrees else -p.judged
    groups = [[k] for k in frames]
    while len(groups) > 1 and (pair := _best(votes)) is not None:
        i, j = pair
        groups[i] += groups.pop(j)
        votes[i] += votes[j]
        votes[:, i] += votes[:, j]
        votes = np.delete(np.delete(votes, j, 0), j, 1)
    return sorted((sorted(group) for group in groups), key=lambda group: (-len(group), group[0]))


def _best(votes: Float[ndarray, "n n"]) -> Pair | None:
    """The two groups (i < j) with the most votes for joining them; None if no two have any."""
    i, j = np.unravel_index(int(np.argmax(np.triu(votes, 1))), votes.shape)
    return (int(i), int(j)) if i < j and votes[i, j] > 0 else None


def bridges(edges: Sequence[Pair], nodes: int) -> list[tuple[Pair, list[int]]]:
    """Edges whose removal splits the graph of so many nodes, each with the nodes of the smaller part."""
    found = []
    for edge in dict.fromkeys(edges):
        first, second = np.array([e for e in edges if e != edge], dtype=np.int64).reshape(-1, 2).T
        label = component_labels(first, second, nodes)
        if label[edge[0]] != label[edge[1]]:
            parts = (np.flatnonzero(label == label[end]).tolist() for end in edge)
            found.append((edge, min(parts, key=lambda part: (len(part), part[0]))))
    return found


# What a frame has of the surface that other frames show: how much it decoded, and how much it should have seen.
#
# Of the visible pattern, a part may lie on a table or a wall far behind the object, too fine or too blurred to be
# decoded. That says nothing against the frame. What the others decoded does: it is there, and can be decoded.
#
# Where both devices of a frame look at a surface, and nothing that any frame shows lies before it, the camera sees
# the pattern. If it does not, this frame is at the wrong place, or those that show the surface are: faces of a box
# agree with each other at many places, and nothing but their ends tells which is right.

_MARGIN = 0.02  # share of the image's longer side: how far from all that a frame saw of the pattern it saw nothing, and
# how far inside the image and the pattern a point must lie
_LIT_COSINE = 0.35  # between a surface's normal and its rays to both devices, above which it would be lit and seen
_CELLS = 60  # places along the longer side of an image at which it is known what lies nearest to the device
_THICKNESS = 0.08  # share of the surface's radius: farther behind what is nearest, points count as hidden


@dataclass(frozen=True)
class SurfacePoints:
    """Points of all frames, spread over what each decoded."""

    p_world: Float64[ndarray, "n 3"]
    normal: Float64[ndarray, "n 3"]
    source: Int64[ndarray, "n"]  # the frame that shows it

    def sights(self, centre: Float64[ndarray, "3"]) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"]]:
        """Distances from a device at `centre`, and the cosines between the normals and the way there."""
        sight = centre - self.p_world
        distance = np.linalg.norm(sight, axis=1)
        return distance, (sight * self.normal).sum(1) / distance


@dataclass(frozen=True)
class SurfaceShares:
    """Shares of the surface that others show in one frame; None where too little is known."""

    decoded: float | None  # see `shared_surface`
    missing: float | None  # see `missing_shares`


@dataclass(frozen=True)
class SharedSurface:
    """The surface that the frames of a scan show, and how much of the others' each of them decoded."""

    points: SurfacePoints
    decoded: tuple[float | None, ...]  # see `shared_surface`


def shared_surface_of_scan(scan: Scan) -> SharedSurface:
    """Compare the surfaces of a scan's frames: `shared_surface` with its files and its own poses."""
    return shared_surface(
        [f.camera for f in scan.frames],
        scan.projector,
        scan.poses,
        (f.read_coords() for f in scan.frames),
        (f.read_mask() for f in scan.frames),
    )


@one_library_thread()
def shared_surface(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    coords: Iterable[Float32[ndarray, "_h _w 2"]],
    masks: Iterable[Bool[ndarray, "_h _w"]],
) -> SharedSurface:
    """The share that a frame decoded of the points of other frames that lie where it sees the pattern.

    `masks`: where each frame sees the pattern. None for a frame on which too few points lie.
    """
    maps = CoordinateMaps.of(torch.from_numpy(image) for image in coords)
    points = _points(Rig.of(cameras, projector, poses, Similarity.identity()), maps)
    shares: list[float | None] = []
    for k, mask in enumerate(masks):
        uv, inside = world_pixels(cameras[k], poses.T_world_camera[k], points.p_world)
        _, cosine = points.sights(poses.T_world_camera[k, :3, 3])
        column, row = uv[inside & (cosine > LEAST_COSINE) & (points.source != k)].astype(np.int64).T
        decoded = maps.image(k).isfinite().all(-1).numpy()
        found = decoded[row, column][(mask | decoded)[row, column]]
        shares.append(float(found.mean()) if len(found) >= FEWEST_JUDGED else None)
    return SharedSurface(points, tuple(shares))


def _points(rig: Rig, maps: CoordinateMaps) -> SurfacePoints:
    anchors = place_anchors(rig, maps, pixels_of_each(rig.frames), torch.Generator().manual_seed(0))
    T = rig.T_world_camera[anchors.frame]
    p_world = transform(T, anchors.depth[:, None] * anchors.d_camera).numpy()
    return SurfacePoints(p_world, rotate(T, anchors.normal).numpy(), anchors.frame.numpy())


@one_library_thread()
def missing_shares(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    points: SurfacePoints,
    seen: Iterable[Bool[ndarray, "_h _w"] | None],
) -> list[float | None]:
    """The share around which a frame saw nothing, of the points of other frames that both of its devices look at.

    `seen`: where each camera saw the pattern, None if that is not known. None for a frame of which it is not, or in
    whose sight too few points lie.
    """
    centre = np.median(points.p_world, axis=0)
    thickness = _THICKNESS * float(np.median(np.linalg.norm(points.p_world - centre, axis=1)))
    shares: list[float | None] = []
    for k, pattern_seen in enumerate(seen):
        if pattern_seen is None:
            shares.append(None)
            continue
        uv, visible = _in_sight(cameras[k], poses.T_world_camera[k], points, thickness)
        _, lit = _in_sight(projector, poses.T_world_projector[k], points, thickness)
        column, row = uv[visible & lit & (points.source != k)].astype(np.int64).T
        far = np.asarray(distance_transform_edt(~pattern_seen)) > _MARGIN * max(pattern_seen.shape)
        shares.append(float(far[row, column].mean()) if len(row) >= FEWEST_JUDGED else None)
    return shares


def _in_sight(
    device: Device, T_world_device: Float64[ndarray, "4 4"], points: SurfacePoints, thickness: float
) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pixels of all points, and which of them face the device and are not hidden from it by others."""
    uv, inside = world_pixels(device, T_world_device, points.p_world)
    distance, cosine = points.sights(T_world_device[:3, 3])
    border = _MARGIN * max(device.w, device.h)
    inner = inside & (uv > border).all(1) & (uv < np.array([device.w, device.h]) - border).all(1)
    factor = _CELLS / max(device.w, device.h)
    column, row = (uv[inside] * factor).astype(np.int64).T
    shape = int(device.h * factor) + 1, int(device.w * factor) + 1
    nearest = nearest_distances((row, column), distance[inside], shape)
    open_to = np.zeros(len(uv), dtype=bool)
    open_to[inside] = distance[inside] < nearest[row, column] + thickness
    return uv, inner & (cosine > _LIT_COSINE) & open_to
