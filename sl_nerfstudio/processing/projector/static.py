"""`--rig static-projector`: cameras placed by the codes, the projector by resection, every frame calibrated with it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker, with_kept_cloud
from sl_nerfstudio.processing.kept.large_clouds import LargeClouds
from sl_nerfstudio.processing.kept.stages import StageStore
from sl_nerfstudio.processing.projector.estimation import sigma_of_fields
from sl_nerfstudio.processing.projector.found import FoundProjector
from sl_nerfstudio.processing.projector.words import static_doubt, static_not_found
from sl_nerfstudio.registration.frame_cloud import FrameCloud, frame_cloud
from sl_nerfstudio.registration.result import NoCommonSurface, Registration
from sl_nerfstudio.registration.static_projector.solve import (
    NoPlacement,
    StaticPlacement,
    place_under_static_projector,
)
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, relative_pose_near
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of

_METHOD = "by resection from the cameras"
_FEWEST = 2  # cameras


@dataclass(frozen=True)
class PlacedFrames:
    """All frames under a projector that stands still."""

    results: Sequence[FrameStageResult]
    projector: Device
    found: FoundProjector | None  # None: its intrinsics are as stated
    registration: Registration  # of the frames that have clouds


def place_static(job: FrameJob, results: Sequence[FrameStageResult], stated: bool, estimate: bool) -> PlacedFrames:
    """Placement of all decoded frames; the projector's intrinsics are found if none are stated, or on request.

    Raises UserError, with what was measured and what to add, where the frames do not determine the poses.
    """
    worker = FrameWorker(job)
    decoded = [result for result in results if result.key]
    if len(decoded) < _FEWEST:
        return PlacedFrames(results, job.projector, None, _registration((), np.zeros((0, 4, 4)), np.zeros(0)))
    coords = [worker.load(result).coords for result in decoded]
    known = stated and not estimate
    cameras = [job.camera_of(result.frame) for result in decoded]
    placed = StageStore(job.work).kept(
        "static projector",
        (coords, cameras, job.projector, known, stated),
        lambda: place_under_static_projector(coords, cameras, job.projector, known, stated),
    )
    if isinstance(placed, NoPlacement):
        raise static_not_found(placed, len(decoded))
    found = None if known else _found(placed, len(decoded))
    T = {result.name: pose for result, pose in zip(decoded, placed.T_world_camera, strict=True)}
    maps = {result.name: uv for result, uv in zip(decoded, coords, strict=True)}
    clouds = LargeClouds()
    results = [with_kept_cloud(_calibrated(result, maps, T, placed, job), clouds) for result in results]
    with_cloud = [result for result in results if result.cloud is not None]
    poses = np.stack([T[result.name] for result in with_cloud]) if with_cloud else np.zeros((0, 4, 4))
    baseline = np.linalg.norm(poses[:, :3, 3] - placed.T_world_projector[:3, 3], axis=1)
    return PlacedFrames(results, placed.projector, found, _registration([r.name for r in with_cloud], poses, baseline))


def _found(placed: StaticPlacement, frames: int) -> FoundProjector:
    sigma = sigma_of_fields(placed.projector, placed.covariance)
    doubt = static_doubt(sigma[0] / placed.projector.fl_x, frames)
    return FoundProjector(placed.projector, sigma, frames, placed.noise_px, _METHOD, doubt)


def _calibrated(
    result: FrameStageResult,
    coords: dict[str, Float32[ndarray, "_ _ 2"]],
    T_world_camera: dict[str, Float64[ndarray, "4 4"]],
    placed: StaticPlacement,
    job: FrameJob,
) -> FrameStageResult:
    """The frame with the relative pose that the placement gives, refined by its own coordinates; or left out."""
    if result.name not in coords:
        return result
    T, uv = T_world_camera[result.name], coords[result.name]
    if not np.isfinite(T).all():
        reason = (
            f"{result.frame.images[0].parent}: it shares too little with the other frames to place its camera\n"
            "    cause:  few codes of the projector are seen by it and by another camera\n"
            "    remedy: capture views in between"
        )
        return replace(result, stage="calibrating", reason=reason)
    relative = np.linalg.inv(T) @ placed.T_world_projector
    own = relative_pose_near(relative, *correspondences_of(uv), job.camera_of(result.frame), placed.projector, job.seed)
    relative[:3, 3] /= np.linalg.norm(relative[:3, 3])
    pose = replace(own, T_camera_projector=relative)  # all frames together know it better than this one alone
    try:
        cloud: FrameCloud | None = frame_cloud(result.name, uv, job.camera_of(result.frame), placed.projector, pose)
    except RelativePoseError as error:
        return replace(result, stage="calibrating", reason=str(error))
    return replace(result, cloud=cloud)


def _registration(
    names: Sequence[str], T_world_camera: Float64[ndarray, "n 4 4"], baseline: Float64[ndarray, "n"]
) -> Registration:
    """What registration says of frames that were placed by their codes: all in one component, in the first's axes.

    No pairs of surfaces were compared, so there are no edges.
    """
    n = len(names)
    if n < _FEWEST:
        one = np.full(n, np.nan)
        exclusions = tuple(NoCommonSurface(name) for name in names)
        return Registration(
            tuple(names), np.full((n, 4, 4), np.nan), one, np.zeros(n, bool), np.full(n, -1), one, (), exclusions, ()
        )
    scale = 1 / np.exp(np.log(baseline).mean())
    T = np.linalg.inv(T_world_camera[0]) @ T_world_camera
    T[:, :3, 3] *= scale
    return Registration(
        tuple(names), T, scale * baseline, np.ones(n, bool), np.zeros(n, np.int64), np.ones(n), (), (), ()
    )
