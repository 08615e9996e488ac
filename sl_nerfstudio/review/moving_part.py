"""Do all cameras stand in one place while part of what they see moves? Then the scan shows the wall, not the object.

On a turntable before a wall, everything that stands still says that the camera stood still. It is right, agrees with
itself, and is most of the picture: what turns counts as wrongly decoded. Seen from one place, a pixel that shows what
stands still has the same coordinate in every frame, or the same depth if the projector was moved. What has neither,
in patches and in nearly all frames, moves.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray
from scipy.ndimage import binary_fill_holes, label, uniform_filter

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import DevicePoses, angle_deg, inverse, transform
from sl_nerfstudio.geometry.numerics import evenly_spaced
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.scan.types import PoseSigma, Scan

# In one place: what follows from the poses of the cameras alone.
_PLACE = 0.02  # distance between cameras, as a share of the working distance
_TURN_DEG = 1.0

_SIDE = 320  # pixels along the longer side at which frames are compared
_COMPARED = 13  # frames with which all are compared, at most
_SIGMAS = 4.0  # of the noise, and of the stated uncertainty of the relative poses, in which coordinates are the same
_PATCH = 5  # compared pixels along the side of the squares whose majority counts
_LEAST_TOLERANCE = 0.3  # pattern pixels within which two coordinates always count as the same
_LEAST_STILL = 0.2  # share of the compared pixels that must stand still: else the cameras are at the wrong place
_LEAST_MOVING = 0.005  # share of a frame's decoded pixels that must move, in patches
_SMALLEST_PATCH = 0.1  # of a frame's largest patch that moves
_MOST_FRAMES = 0.75  # share of the frames in which something must move


@dataclass(frozen=True)
class MovingPart:
    """What moves before cameras that stand still."""

    masks: tuple[Bool[ndarray, "_h _w"], ...]  # of every frame: the pixels that show it
    share: float  # of the decoded pixels: the median over the frames
    rigid: bool  # the projector stood still, too
    registered: bool = False  # the frames are where this puts them, and not where the background does


def moving_share(scan: Scan) -> float | None:
    """The share of a scan's decoded pixels that moves before cameras in one place; None if nothing does."""
    coords = (frame.read_masked_coords() for frame in scan.frames)
    cameras, sigma = [f.camera for f in scan.frames], [f.pose_sigma for f in scan.frames]
    found = find_moving_part(cameras, scan.projector, scan.poses, coords, sigma)
    return found and found.share


@one_library_thread()
def find_moving_part(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    coords: Iterable[Float32[ndarray, "_h _w 2"]],
    sigma: Sequence[PoseSigma | None],
) -> MovingPart | None:
    """What moves; None if cameras are in different places, or if nothing contradicts that they are in one.

    `poses` are NaN for frames without a place: these are compared by their coordinates alone. `sigma` in the poses'
    unit.
    """
    if np.isfinite(poses.T_world_camera).all((1, 2)).sum() < 2 or len({(camera.w, camera.h) for camera in cameras}) > 1:
        return None
    step = max(1, -(-max(cameras[0].w, cameras[0].h) // _SIDE))
    T = poses.T_camera_projector
    placed = np.isfinite(T).all((1, 2))
    T = np.where(placed[:, None, None], T, T[np.argmax(placed)])
    every = iter(coords)
    thin = [np.ascontiguousarray(next(every)[step // 2 :: step, step // 2 :: step])]
    depth = _median(-_points(cameras[0], T[0], thin[0], projector, step)[..., 2])
    if not in_one_place(poses, depth):
        return None  # without reading the others
    thin += [np.ascontiguousarray(image[step // 2 :: step, step // 2 :: step]) for image in every]
    tolerance = [_tolerance(*each, projector, depth) for each in zip(cameras, sigma, strict=True)]
    apart = [_median(np.linalg.norm(thin[0] - image, axis=-1)) for image in thin]
    rigid = bool(np.median(apart[1:]) < _tolerance(cameras[0], None, projector, depth))
    if rigid:
        T = np.tile(T[np.argmax(placed)], (len(T), 1, 1))
        tolerance = [_tolerance(camera, None, projector, depth) for camera in cameras]
    points = [_points(*each, projector, step) for each in zip(cameras, T, thin, strict=True)]
    depths = [-p[..., 2] for p in points]
    some = evenly_spaced(len(thin), min(_COMPARED, len(thin))).tolist()

    def agree(k: int, j: int) -> Bool[ndarray, "h w"]:
        apart = _residual(points[k], projector, T[j], thin[j])
        return apart < np.clip(_SIGMAS * _median(apart), _LEAST_TOLERANCE, max(tolerance[k], tolerance[j]))

    # Whatever moves is before what stands still: at each pixel, the farthest that two frames show; if no two show the
    # same, nothing there stands still.
    farthest, reference = np.full(thin[0].shape[:2], -np.inf), np.full(thin[0].shape[:2], -1)
    for k in some:
        shown = np.isfinite(depths[k])
        if len(some) > 2:
            shown &= np.any([agree(k, j) for j in some if j != k], 0)
        farther = shown & (np.nan_to_num(depths[k], nan=-np.inf) > farthest)
        farthest[farther], reference[farther] = depths[k][farther], k
    found, still, judged = [], 0, 0
    for k, image in enumerate(thin):
        decoded, before = np.isfinite(image[..., 0]), depths[k] < farthest
        before &= ~np.any([(reference == j) & agree(k, j) for j in some], 0)
        moves, compared = before | (reference < 0), decoded & (sum(np.isfinite(depths[j]) for j in some if j != k) > 0)
        still, judged = still + int((compared & ~moves).sum()), judged + int(compared.sum())
        found.append(_patches(decoded, moves, compared))
    shares = [
        float(mask.sum() / max(1, np.isfinite(image[..., 0]).sum())) for mask, image in zip(found, thin, strict=True)
    ]
    if still < _LEAST_STILL * judged or np.mean([share > _LEAST_MOVING for share in shares]) < _MOST_FRAMES:
        return None
    size = cameras[0].w, cameras[0].h
    masks = tuple(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for mask in found)
    return MovingPart(masks, float(np.median(shares)), rigid)


def _median(values: Float64[ndarray, "*at"] | Float32[ndarray, "*at"]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0


def in_one_place(poses: DevicePoses, depth: float) -> bool:
    """Whether all cameras are in one place, as seen from what they look at, `depth` away."""
    T = poses.T_world_camera[np.isfinite(poses.T_world_camera).all((1, 2))]
    if len(T) < 2:
        return False
    away = np.linalg.norm(T[:, :3, 3] - np.median(T[:, :3, 3], 0), axis=1)
    return bool(away.max() < _PLACE * depth) and max(angle_deg(T[0, :3, :3].T @ R) for R in T[:, :3, :3]) < _TURN_DEG


def _points(
    camera: Device, T_camera_projector: Float64[ndarray, "4 4"], coords: Float32[ndarray, "h w 2"], projector: Device,
    step: int,
) -> Float64[ndarray, "h w 3"]:  # fmt: skip
    """Points in camera axes at every `step`th pixel; NaN where nothing was decoded, or the frame has no place."""
    y, x = np.indices(coords.shape[:2]) * step + step // 2 + 0.5
    found = triangulate(
        Intrinsics.of(camera, torch.float64),
        torch.eye(4, dtype=torch.float64),
        torch.from_numpy(np.stack([x, y], -1).reshape(-1, 2)),
        Intrinsics.of(projector, torch.float64),
        torch.from_numpy(T_camera_projector),
        torch.from_numpy(coords.reshape(-1, 2).astype(np.float64)),
    )
    points = found.p_world.numpy().reshape(*coords.shape[:2], 3)
    return np.where((points[..., 2:] < 0) & np.isfinite(points).all(-1, keepdims=True), points, np.nan)


def _residual(
    points: Float64[ndarray, "h w 3"], projector: Device, T_camera_projector: Float64[ndarray, "4 4"],
    coords: Float32[ndarray, "h w 2"],
) -> Float64[ndarray, "h w"]:  # fmt: skip
    """How far the pattern that another frame shows at the same pixels is from that of its projector, pattern pixels."""
    T = inverse(torch.from_numpy(T_camera_projector))
    uv, in_front = project(Intrinsics.of(projector, torch.float64), transform(T, torch.from_numpy(points)))
    return np.where(in_front.numpy(), np.linalg.norm(uv.numpy() - coords, axis=-1), np.nan)


def _tolerance(camera: Device, sigma: PoseSigma | None, projector: Device, depth: float) -> float:
    """Distance between coordinates within which they count as the same, pattern pixels: look-ups, and stated errors."""
    focal = (projector.fl_x + projector.fl_y) / 2
    stated = 0.0 if sigma is None else np.radians(sigma.relative_rotation_deg) + sigma.relative_translation / depth
    return max(1.0, 2 * focal / (camera.fl_x + camera.fl_y)) + _SIGMAS * focal * stated


def _patches(
    decoded: Bool[ndarray, "h w"], moves: Bool[ndarray, "h w"], compared: Bool[ndarray, "h w"]
) -> Bool[ndarray, "h w"]:
    """Decoded pixels in patches that move: most neighbours do, most of a patch was compared, and it is not tiny."""
    around = np.asarray(uniform_filter(decoded.astype(np.float32), _PATCH))
    moving = np.asarray(uniform_filter((decoded & moves).astype(np.float32), _PATCH))
    patch = np.zeros(decoded.shape, np.int32)
    label(binary_fill_holes(moving > np.maximum(around / 2, _PATCH**-2)), output=patch)
    count = int(patch.max(initial=0))
    if not count:
        return np.zeros_like(decoded)
    index = np.arange(1, count + 1)
    area = np.bincount(patch[decoded], minlength=count + 1)[index]
    contradicting = np.bincount(patch[decoded & moves & compared], minlength=count + 1)[index]
    kept = index[(area >= _SMALLEST_PATCH * area.max()) & (contradicting > area / 2)]
    return np.isin(patch, kept) & decoded
